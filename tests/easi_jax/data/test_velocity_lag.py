"""Velocities that come late or from a filter, by closed form."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from scipy.signal import lfilter

from easi_jax.data.cleaning import rows_of, trusted_velocities
from easi_jax.data.recording import Run
from easi_jax.data.velocity_lag import of_model, set_right
from easi_jax.gap.sensor_faults import reading_faults
from easi_jax.model.joint_space import Configuration

NOISE, FINE, SECONDS = (1e-4, 1e-2), 1e-4, 6.0
NAMES = ("a", "b")


def recorded(seed: int, dt: float, way: str, seconds: float) -> tuple[Run, np.ndarray]:
    """Two joints that swing at several frequencies, the second read right; and the true
    velocities."""
    rng, time = np.random.default_rng(seed), np.arange(0.0, SECONDS, FINE)
    q, v = np.zeros((2, len(time), 2))
    for d in range(2):
        turn = 2 * np.pi * rng.uniform(0.5, 4.0, 6)
        phase = turn * time[:, None] + rng.uniform(0, 6, 6)
        size = rng.normal(size=6) / turn
        q[:, d] = (size * np.sin(phase)).sum(1)
        v[:, d] = (size * turn * np.cos(phase)).sum(1)
    read = v.copy()
    if way == "late":
        read[:, 0] = np.interp(time - seconds, time, v[:, 0])
    elif way == "filtered":
        keeps = np.exp(-FINE / seconds)
        begin = [keeps * v[0, 0]]
        read[:, 0] = lfilter([1 - keeps], [1.0, -keeps], v[:, 0], zi=begin)[0]
    elif way == "scaled":
        read[:, 0] *= 1.3
    every = round(dt / FINE)
    q, v, read, time = (x[::every] for x in (q, v, read, time))
    q = q + NOISE[0] * rng.normal(size=q.shape)
    read = read + NOISE[1] * rng.normal(size=read.shape)
    shape = Configuration(2, 2, (0, 1), (0, 1), ())
    ctrl, name = np.zeros((len(q), 0)), f"r{seed}"
    return Run(name, name, dt, time, q, read, True, ctrl, shape), v


@pytest.mark.parametrize("dt", [0.01, 0.004, 0.001])
@pytest.mark.parametrize(
    ("way", "seconds"), [("late", 0.003), ("late", 0.015), ("filtered", 0.012)]
)
def test_what_is_late_or_filtered_is_set_right(
    dt: float, way: str, seconds: float
) -> None:
    given = [recorded(k, dt, way, seconds) for k in range(2)]
    right = set_right([run for run, _ in given], NAMES)
    (note,), runs = right.notes, right.runs
    assert right.noisier[1] == 1.0
    # A short delay and a short filter are alike.
    assert note.startswith("velocity of a: ") and (seconds < 0.01 or way in note)
    assert abs(float(note.split(" ms")[0].split()[-1]) - 1e3 * seconds) < 1.0
    assert trusted_velocities(runs).all()
    for run, (before, true) in zip(runs, given, strict=True):
        lost = len(before) - len(run)
        assert lost <= np.ceil(1.1 * seconds / dt)
        wrong, rest = (
            r.qvel[: len(run), 0] - true[: len(run), 0] for r in (before, run)
        )
        noise = NOISE[1] * right.noisier[0]
        assert np.std(rest) < max(0.3 * np.std(wrong), 1.3 * noise)
        # What is told of the noise is what second differences leave.
        white = np.sqrt(np.mean(np.diff(rest, 2) ** 2) / 6.0)
        if seconds / dt % 1 and "late" in note:
            assert 0.8 * noise < white < 1.3 * noise
        np.testing.assert_array_equal(run.qvel[:, 1], before.qvel[: len(run), 1])


@pytest.mark.parametrize("late", [4.0, 4.1, 4.25])
def test_lateness_has_no_bias_by_the_noise_of_positions(late: float) -> None:
    """Steps of positions that are as noisy as they are fast: shifted by half a row they
    are averaged most, and nothing else may make that shift look better."""
    given = [recorded(k, 0.001, "late", 1e-3 * late)[0] for k in range(2)]
    rng = np.random.default_rng(3)
    given = [
        replace(run, qpos=run.qpos + 2e-4 * rng.normal(size=run.qpos.shape))
        for run in given
    ]
    (note,) = set_right(given, NAMES).notes
    assert abs(float(note.split(" ms")[0].split()[-1]) - late) < 0.03


@pytest.mark.parametrize("way", ["right", "late"])
def test_an_offset_is_taken_out(way: str) -> None:
    """Beside others, which stay as they were read; of a late one too."""
    given, by = [recorded(k, 0.004, way, 0.012)[0] for k in range(2)], 0.03
    read = [replace(run, qvel=run.qvel + np.array([by, 0.0])) for run in given]
    plain, right = set_right(given, NAMES), set_right(read, NAMES)
    assert right.notes[-1].startswith("velocity of a: off by 0.0")
    assert len(right.notes) == 1 + (way == "late")
    for one, other in zip(right.runs, plain.runs, strict=True):
        rows = min(len(one), len(other))
        np.testing.assert_allclose(one.qvel[:rows], other.qvel[:rows], atol=4e-3)
        np.testing.assert_array_equal(one.qvel[:rows, 1], other.qvel[:rows, 1])


@pytest.mark.parametrize("dt", [0.02, 0.004, 0.001])
@pytest.mark.parametrize("way", ["right", "scaled"])
def test_other_velocities_stay_as_they_are(dt: float, way: str) -> None:
    given = [recorded(k, dt, way, 0.0)[0] for k in range(2)]
    right = set_right(given, NAMES)
    assert not right.notes and (right.noisier == 1.0).all()
    assert all(a is b for a, b in zip(right.runs, given, strict=True))


def test_half_a_step_of_a_fall_is_no_offset() -> None:
    """What is thrown upwards: a simulation reads its speed half a step late, which is
    the same in every row."""
    m = mujoco.MjModel.from_xml_string(
        """<mujoco><option timestep="0.005"/><worldbody><body><joint name="z"
          type="slide" axis="0 0 1"/><geom size=".1"/></body></worldbody></mujoco>"""
    )
    d, rows, rng = mujoco.MjData(m), 120, np.random.default_rng(0)
    q, v, d.qvel[0] = np.zeros((rows, 1)), np.zeros((rows, 1)), 3.0
    for k in range(rows):
        q[k], v[k] = d.qpos + 1e-4 * rng.normal(), d.qvel + 1e-2 * rng.normal()
        mujoco.mj_step(m, d)
    shape, time = Configuration.of(m), 0.005 * np.arange(rows)
    run = Run("r", "r", 0.005, time, q, v, True, np.zeros((rows, 0)), shape)
    assert not set_right([run], ["z"], of_model(m, 0.005)).notes
    assert not reading_faults(m, [run])


@pytest.mark.parametrize("moving", [0.0, 0.02, 1.0])
def test_velocities_better_than_the_steps_of_positions_stay(moving: float) -> None:
    """Steps of positions that are read with ten times the noise of the velocities, also
    of a joint at rest: whatever smooths them comes nearer to what was read."""
    for dt in (0.02, 0.01, 0.002):
        given = []
        for seed in range(2):
            run, true = recorded(seed, dt, "right", 0.0)
            rng = np.random.default_rng(9 + seed)
            noise = 1e-3 * dt / 0.01 * rng.normal(size=run.qpos.shape)
            read = moving * true + NOISE[1] * rng.normal(size=true.shape)
            qpos = moving * run.qpos + noise
            given.append(replace(run, qpos=qpos, qvel=read))
        right = set_right(given, NAMES)
        assert not right.notes and all(
            a is b for a, b in zip(right.runs, given, strict=True)
        )


def test_a_delay_of_one_run_of_two_is_none_of_the_machine() -> None:
    runs = [recorded(0, 0.01, "late", 0.015)[0], recorded(1, 0.01, "right", 0.0)[0]]
    right = set_right(runs, NAMES)
    assert not right.notes and not trusted_velocities(right.runs)[0]


def test_what_nobody_measured_has_no_delay() -> None:
    run, _ = recorded(0, 0.01, "late", 0.015)
    for odd in (
        replace(run, hidden=np.array([True, False])),
        replace(run, qvel_measured=False),
    ):
        assert not set_right([odd], NAMES).notes


def test_runs_are_cut_once_and_short_ones_stay() -> None:
    """Both joints late; a piece that is shorter than that beside it."""
    run, true = recorded(0, 0.001, "late", 0.02)
    other, _ = recorded(0, 0.001, "right", 0.0)
    late = np.stack([run.qvel[:, 0], np.roll(other.qvel[:, 1], 20)], 1)
    late[:20, 1] = other.qvel[0, 1]
    run = replace(run, qvel=late)
    right = set_right([run, rows_of(run, 100, 112)], NAMES)
    assert len(right.notes) == 2
    assert [len(r) for r in right.runs] == [len(run) - 20, 12]
    whole, short = right.runs
    assert np.std(whole.qvel - true[: len(whole)]) < 2 * NOISE[1]
    assert np.isfinite(short.qvel).all()
