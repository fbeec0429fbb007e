"""Velocities that come late or from a filter, by closed form."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from easi_jax.data.cleaning import trusted_velocities
from easi_jax.data.recording import Run
from easi_jax.data.velocity_lag import set_right
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
    runs, notes, changed = set_right([run for run, _ in given], NAMES)
    assert changed.tolist() == [True, False]
    (note,) = notes
    # A short delay and a short filter are alike.
    assert note.startswith("velocity of a: ") and (seconds < 0.01 or way in note)
    assert abs(float(note.split(" ms")[0].split()[-1]) - 1e3 * seconds) < 1.0
    assert trusted_velocities(runs).all()
    for run, (before, true) in zip(runs, given, strict=True):
        lost = len(before) - len(run)
        assert lost <= np.ceil(1.1 * seconds / dt)
        off, was = (
            np.std((r.qvel - true[: len(r)])[: len(run), 0]) for r in (run, before)
        )
        # Undoing a filter makes more of the noise.
        assert off < max(0.3 * was, 2.5 * NOISE[1])
        np.testing.assert_array_equal(run.qvel[:, 1], before.qvel[: len(run), 1])


@pytest.mark.parametrize("dt", [0.02, 0.004, 0.001])
@pytest.mark.parametrize("way", ["right", "scaled"])
def test_other_velocities_stay_as_they_are(dt: float, way: str) -> None:
    given = [recorded(k, dt, way, 0.0)[0] for k in range(2)]
    runs, notes, changed = set_right(given, NAMES)
    assert not notes and not changed.any()
    assert all(a is b for a, b in zip(runs, given, strict=True))


def test_a_delay_of_one_run_of_two_is_none_of_the_machine() -> None:
    runs = [recorded(0, 0.01, "late", 0.015)[0], recorded(1, 0.01, "right", 0.0)[0]]
    found, _, changed = set_right(runs, NAMES)
    assert not changed.any() and not trusted_velocities(found)[0]


def test_what_nobody_measured_has_no_delay() -> None:
    run, _ = recorded(0, 0.01, "late", 0.015)
    for odd in (
        replace(run, hidden=np.array([True, False])),
        replace(run, qvel_measured=False),
    ):
        assert not set_right([odd], NAMES)[2].any()
