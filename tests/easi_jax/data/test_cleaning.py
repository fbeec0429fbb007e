"""Noise, splits and segments of measured runs."""

import dataclasses
from typing import Any

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from easi_jax.data.cleaning import (
    split_at_resets,
    to_common_step,
    true_readings,
    trusted_velocities,
    without_odd_ends,
)
from easi_jax.data.noise import estimate_noise
from easi_jax.data.recording import Run
from easi_jax.data.resampling import mean_held
from easi_jax.data.windows import fitted_velocity
from easi_jax.errors import UserError
from easi_jax.estimation.held_out import ready_errors
from easi_jax.estimation.pieces import segments_from_runs, visible_steps
from easi_jax.estimation.prediction_error import (
    believed,
    misfit_of,
    outlier_weights,
    white_noise,
)
from easi_jax.estimation.problem import Problem
from easi_jax.io.logs.reader import read_logs
from easi_jax.model.found_effects import EffectEntry
from easi_jax.model.joint_space import Configuration
from easi_jax.model.parameters import ParameterSpace, declare
from easi_jax.simulation.simulator import Simulator

XML = """<mujoco><option timestep="0.01"/><worldbody><body>
  <joint name="slide" type="slide" axis="1 0 0" damping="0.5"/>
  <geom size=".1" mass="1"/>
</body></worldbody><actuator><motor name="push" joint="slide"/></actuator></mujoco>"""
FLAT = Configuration(1, 1, (0,), (0,), ())


@pytest.fixture(scope="module")
def simulator() -> Simulator:
    model = mujoco.MjModel.from_xml_string(XML)
    return Simulator(
        model, ParameterSpace((declare(model, "m", "joint.slide.damping"),))
    )


def make_run(
    qpos: np.ndarray, name: str = "run", dt: float = 0.01, size: float = 0.0
) -> Run:
    """``size``: of its commands; by default they count its rows."""
    rows = len(qpos)
    ctrl = np.full(rows, size) if size else np.arange(rows, dtype=float)
    return Run(
        name=name,
        source=f"{name}.csv",
        dt=dt,
        time=dt * np.arange(rows),
        qpos=qpos[:, None],
        qvel=fitted_velocity(qpos[:, None], dt, FLAT),
        qvel_measured=False,
        ctrl=ctrl[:, None],
        configuration=FLAT,
    )


def sine(rows: int = 4000, dt: float = 0.01) -> np.ndarray:
    return 0.7 * np.sin(2 * np.pi * 0.8 * dt * np.arange(rows))


@pytest.mark.parametrize("sigma", [1e-4, 3e-3])
def test_noise_of_a_known_signal(sigma):
    rng = np.random.default_rng(0)
    run = make_run(sine() + sigma * rng.standard_normal(4000))
    noise = estimate_noise(run)
    assert noise[0] == pytest.approx(sigma, rel=0.1)
    clean = fitted_velocity(sine()[:, None], 0.01, FLAT)
    error = (run.qvel - clean)[5:-5].std()
    assert noise[1] == pytest.approx(error, rel=0.15)


def test_noise_survives_jumps_and_rests():
    rng = np.random.default_rng(1)
    qpos = np.where(np.arange(4000) % 400 < 100, 0.3, sine())  # with 20 jumps
    run = make_run(qpos + 1e-3 * rng.standard_normal(4000))
    assert estimate_noise(run)[0] == pytest.approx(1e-3, rel=0.15)


def test_quantized_readings_are_as_noisy_as_their_step():
    step = 2 * np.pi / 4096
    for qpos in (sine(), 0.02 * np.sin(0.01 * np.arange(4000))):  # fast, nearly at rest
        noise = estimate_noise(make_run(np.round(qpos / step) * step))
        assert noise[0] == pytest.approx(step / np.sqrt(12), rel=0.2)


def test_measured_velocities_have_their_own_noise():
    rng = np.random.default_rng(2)
    run = make_run(sine())
    qvel = run.qvel + 0.02 * rng.standard_normal(run.qvel.shape)
    run = dataclasses.replace(run, qvel=qvel, qvel_measured=True)
    assert estimate_noise(run)[1] == pytest.approx(0.02, rel=0.1)


def test_late_velocities_are_not_trusted():
    run = make_run(sine())
    late = dataclasses.replace(run, qvel=np.roll(run.qvel, 8, 0), qvel_measured=True)
    assert not trusted_velocities([late]).any()
    close = dataclasses.replace(run, qvel=1.02 * run.qvel, qvel_measured=True)
    assert trusted_velocities([close]).all()
    assert not trusted_velocities([close, late]).any()
    assert not trusted_velocities([close, run]).any(), "one run has none"


def test_velocities_too_fast_for_the_fit_are_trusted_where_they_integrate():
    """Ten rows a swing: a parabola through them is off by more than a tenth."""
    slow = make_run(sine())
    t = np.arange(len(slow))
    qpos = np.sin(0.63 * t)[:, None]
    qvel = 0.63 / slow.dt * np.cos(0.63 * t)[:, None]
    fast = dataclasses.replace(slow, qpos=qpos, qvel=qvel, qvel_measured=True)
    fitted = fitted_velocity(qpos, slow.dt, slow.configuration)
    assert np.abs(fitted - qvel).max() > 0.1 * qvel.max()
    assert trusted_velocities([fast]).all()
    assert not trusted_velocities(
        [dataclasses.replace(fast, qvel=np.roll(qvel, 2, 0))]
    ).any()


@pytest.mark.parametrize("seed", range(5))
def test_noise_of_positions_does_not_make_velocities_doubtful(seed):
    """Positions whose noise hides the motion from row to row; runs of two seconds."""
    rng, rows, dt = np.random.default_rng(seed), 100, 0.02
    t = dt * np.arange(-20, rows)
    # Motion of a drive that follows new targets all the time.
    pushes = np.repeat(rng.normal(size=len(t) // 4), 4)
    speed = 0.08 * np.convolve(pushes, np.exp(-np.arange(20) / 6.0) / 3.0)[: len(t)]

    def runs(late: int = 0, gain: float = 1.0, count: int = 10) -> list[Run]:
        out = []
        for _ in range(count):
            fine = np.cumsum(0.5 * dt * (speed + np.r_[0.0, speed[:-1]]))
            read = gain * np.roll(speed, late) + 4e-3 * rng.normal(size=len(t))
            qpos = (fine + 5e-4 * rng.normal(size=len(t)))[20:]
            run = make_run(qpos, dt=dt)
            qvel = read[20:, None]
            out.append(dataclasses.replace(run, qvel=qvel, qvel_measured=True))
        return out

    assert trusted_velocities(runs()).all()
    assert not trusted_velocities(runs(late=1)).any()
    assert not trusted_velocities(runs(gain=1.3)).any()
    assert not trusted_velocities([*runs(), *runs(late=5, count=1)]).any(), "one run"


@pytest.mark.parametrize(("dt", "noise"), [(0.01, 1e-3), (0.005, 5e-4), (0.02, 2e-3)])
def test_velocities_that_are_zero_are_not_trusted(dt, noise):
    """However much noise of positions makes of their steps."""
    rng = np.random.default_rng(0)
    t = dt * np.arange(round(10 / dt))
    for _ in range(5):
        qpos = 0.022 * np.sin(2 * np.pi * t) + noise * rng.normal(size=len(t))
        run = dataclasses.replace(make_run(qpos, dt=dt), qvel_measured=True)
        qvel = 0.14 * np.cos(2 * np.pi * t)[:, None]
        good = qvel + 5e-3 * rng.normal(size=qvel.shape)
        assert trusted_velocities([dataclasses.replace(run, qvel=good)]).all()
        for bad in (0.0 * qvel, 1.5 * good, np.roll(good, round(0.05 / dt), 0)):
            assert not trusted_velocities([dataclasses.replace(run, qvel=bad)]).any()


def test_too_few_rows_say_nothing_of_velocities():
    run = dataclasses.replace(make_run(np.zeros(1)), qvel_measured=True)
    assert not trusted_velocities([run]).any()


def test_visible_steps_grow_with_noise():
    run = make_run(sine())
    found = [visible_steps([run], np.array([s, 1e-9]), 50, 30) for s in (1e-6, 1e-3, 1)]
    assert found[0] == 1
    assert 1 < found[1] < 50
    assert found[2] == 50


def test_readings_of_a_slow_sensor_do_not_multiply():
    """Where its run is brought to another's rate: each stays one, in the row beside."""
    coarse = make_run(sine(50, 0.02), "slow", 0.02)
    fine = make_run(sine(1000, 0.001), "fast", 0.001)
    read = np.full((len(coarse), 1), np.nan)
    read[3::10] = np.sin(coarse.time[3::10])[:, None]
    coarse = dataclasses.replace(coarse, sensors={"gyro": read})
    runs, _ = to_common_step([coarse, fine])
    found = runs[0].sensors["gyro"][:, 0]
    there = np.isfinite(found)
    assert there.sum() == np.isfinite(read).sum()
    np.testing.assert_allclose(
        runs[0].time[there], coarse.time[3::10], atol=0.6 * runs[0].dt
    )


def test_runs_of_two_rates_come_to_the_smaller_step():
    fast, slow = make_run(sine(100)), make_run(sine(50, 0.02), "slow", 0.02)
    runs, notes = to_common_step([slow, fast])
    assert [r.dt for r in runs] == [0.01, 0.01]
    assert len(runs[0]) == 99
    np.testing.assert_allclose(runs[0].qpos[::2], slow.qpos)
    middle = (slow.qpos[1:] + slow.qpos[:-1]) / 2
    np.testing.assert_allclose(runs[0].qpos[1::2], middle)
    np.testing.assert_allclose(runs[0].ctrl[1::2], slow.ctrl[:-1])  # held
    assert len(notes) == 1
    assert "slow" in notes[0]


def test_a_command_that_changes_within_a_step_acts_for_a_part_of_it():
    rng = np.random.default_rng(5)
    time = np.cumsum(rng.uniform(0.006, 0.014, 60))
    ctrl = rng.normal(size=(60, 2))
    at = time[0] + 0.01 * np.arange(50)
    fine = at[:, None] + 0.01 * (np.arange(4000) + 0.5) / 4000
    held = ctrl[np.searchsorted(time, fine, side="right") - 1].mean(1)
    np.testing.assert_allclose(mean_held(time, ctrl, at, 0.01), held, atol=2e-3)


def test_noise_of_uneven_rows_is_not_lost_by_their_interpolation(tmp_path):
    """Rows of a plain oscillation, with stamps off by up to a fifth of a step."""
    rng, sigma, rows = np.random.default_rng(4), 2e-3, 3000
    time = 0.01 * (np.arange(rows) + rng.uniform(-0.2, 0.2, rows))
    text = ["time,qpos.slide,ctrl.push"]
    for t, e in zip(time, sigma * rng.standard_normal(rows), strict=True):
        text.append(f"{t:.9f},{0.3 * np.sin(3 * t) + e:.9f},{np.sin(t):.6f}")
    (tmp_path / "log.csv").write_text("\n".join(text) + "\n")
    model = mujoco.MjModel.from_xml_string(XML)
    (run,) = read_logs(tmp_path / "log.csv", model).runs
    assert run.stamps is not None and run.sent is not None
    assert estimate_noise(run)[0] == pytest.approx(sigma, rel=0.1)
    even = dataclasses.replace(run, stamps=None)
    assert estimate_noise(even)[0] < 0.75 * sigma


@pytest.mark.fault("wild readings, joints that stand still")
def test_runs_are_cut_at_leaps_and_nowhere_else():
    rng = np.random.default_rng(2)
    time = 0.01 * np.arange(600)
    noise = np.full(2, 1e-3)
    swing = np.sin(2 * time) + 1e-3 * rng.standard_normal(600)
    bounce = np.abs(np.sin(4 * time)) + 1e-3 * rng.standard_normal(600)
    runs, notes = split_at_resets([make_run(swing), make_run(bounce)], noise)
    assert [len(r) for r in runs] == [600, 600] and not notes
    swing[200:] -= 1.0
    swing[450] += 0.8  # one bad reading
    runs, (note,) = split_at_resets([make_run(swing)], noise)
    assert [len(r) for r in runs] == [200, 250, 149]
    assert [r.name for r in runs] == ["run/1", "run/2", "run/3"]
    assert "run at 1.99 s, 4.49 s, 4.5 s" in note
    # What was derived across a leap is derived again.
    for run in runs:
        assert np.abs(run.qvel).max() < 2.5


@pytest.mark.parametrize("resolution", [0.0, 1e-3])
@pytest.mark.fault("wild readings, joints that stand still")
def test_wild_readings_do_not_make_noise(resolution):
    rng = np.random.default_rng(3)
    swing = sine(600) + 1e-4 * rng.standard_normal(600)
    if resolution:
        swing = np.round(swing / resolution) * resolution
    calm = estimate_noise(make_run(swing))
    swing[[100, 300, 301]] = -3e3, 1e4, 1e4
    (*_, wild), _ = split_at_resets([make_run(swing)], estimate_noise(make_run(swing)))
    assert len(wild) == 298
    np.testing.assert_allclose(estimate_noise(wild), calm, rtol=0.2)
    if not resolution:
        np.testing.assert_allclose(estimate_noise(make_run(swing)), calm, rtol=0.2)


@pytest.mark.fault("wild readings, joints that stand still")
def test_wild_velocities_are_left_out_and_impacts_are_not():
    time = 0.01 * np.arange(600)
    run = make_run(np.abs(np.sin(4 * time)))
    speed = 4 * np.sign(np.sin(4 * time)) * np.cos(4 * time)
    run = dataclasses.replace(run, qvel=speed[:, None], qvel_measured=True)
    same, notes = split_at_resets([run], np.full(2, 1e-4))
    assert same == [run] and not notes
    run.qvel[[50, 400]] += [[1e6], [-40.0]]
    runs, _ = split_at_resets([run], np.full(2, 1e-4))
    assert [len(r) for r in runs] == [50, 349, 199]
    assert all(np.abs(r.qvel).max() <= 4 for r in runs)


def test_readings_are_mended(simulator):
    entries = [
        EffectEntry("sensor_bias", "slide", "joint", {"bias": 0.2}, {}),
        EffectEntry("sensor_delay", "slide", "joint", {"late": 0.025}, {}),
        EffectEntry("sensor_delay", "qvel.slide", "sensor", {"late": 0.01}, {}),
        EffectEntry("armature", "slide", "joint", {"armature": 0.1}, {}),
    ]
    time = 0.01 * np.arange(300)
    read = make_run(np.sin(time - 0.025) + 0.2)
    (run,) = true_readings(simulator.mj_model, [read], entries)
    assert len(run) == 297
    np.testing.assert_allclose(run.qpos[:, 0], np.sin(run.time), atol=2e-5)
    assert true_readings(simulator.mj_model, [read], entries[3:])[0] is read
    entries[0] = EffectEntry("sensor_bias", "slid", "joint", {"bias": 0.2}, {})
    with pytest.raises(UserError, match="slid"):
        true_readings(simulator.mj_model, [read], entries)


def test_segments_never_cross_runs(simulator):
    runs = [make_run(np.full(21, v)) for v in (1.0, 2.0)]
    pieces = segments_from_runs(simulator, runs, 10, 5)
    assert pieces.count == 6
    assert pieces.horizon == 10
    np.testing.assert_array_equal(
        pieces.next_qpos, np.broadcast_to(pieces.qpos[:, None], (6, 10, 1))
    )
    with pytest.raises(UserError, match="no run is longer than 30 steps"):
        segments_from_runs(simulator, runs, 30, 5)
    with pytest.raises(ValueError, match="control step"):
        segments_from_runs(simulator, [make_run(np.zeros(50), dt=0.02)], 10, 5)


def test_error_of_the_true_model_is_the_noise_floor(simulator):
    """Motion by MuJoCo C, noise added: errors are what the floor says, which is less
    where measured velocities help to find starts."""
    model = simulator.mj_model
    rng = np.random.default_rng(3)
    rows, sigma = 1500, 2e-3

    def recorded(phase: float) -> Any:
        data = mujoco.MjData(model)
        ctrl = 5 * np.sin(0.03 * np.arange(rows) + phase)
        qpos, qvel = np.empty((2, rows))
        for t in range(rows):
            qpos[t], qvel[t], data.ctrl[0] = data.qpos[0], data.qvel[0], ctrl[t]
            mujoco.mj_step(model, data)
        run = make_run(qpos + sigma * rng.standard_normal(rows))
        qvel += 2e-2 * rng.standard_normal(rows)
        run = dataclasses.replace(run, ctrl=ctrl[:, None])
        return run, dataclasses.replace(run, qvel=qvel[:, None], qvel_measured=True)

    both = list(zip(recorded(0.0), recorded(1.0), strict=True))
    problem, faster = (
        Problem(
            *("cart", simulator, [fit], [held], "held", estimate_noise(fit)),
            *(np.full(1, known), 20, 20, 20 * simulator.dt, []),
        )
        for known, (fit, held) in zip((False, True), both, strict=True)
    )
    held_out, fitted = ready_errors(problem, simulator.space, several=True)
    assert fitted is not None
    first, lost, least = held_out.with_floor(jnp.asarray(simulator.space.nominal))
    assert not lost
    np.testing.assert_allclose(first, least, rtol=0.1)
    quick, _ = ready_errors(faster, simulator.space)
    better, _, less = quick.with_floor(jnp.asarray(simulator.space.nominal))
    np.testing.assert_allclose(better, less, rtol=0.1)
    assert less[0] < 0.95 * least[0]
    # Held-out runs without velocities, and velocities that are given as exact.
    for other in (
        dataclasses.replace(faster, held=problem.held),
        dataclasses.replace(faster, noise=faster.noise * np.array([1.0, 0.0])),
    ):
        alone, _ = ready_errors(other, simulator.space)
        off, _, due = alone.with_floor(jnp.asarray(simulator.space.nominal))
        assert 0.85 < off[0] / due[0] < 1.3, (off, due)
    second, _ = fitted.of(jnp.asarray(simulator.space.nominal))
    np.testing.assert_allclose(second, least, rtol=0.15)
    wrong, _, noise = held_out.with_floor(jnp.asarray([5.0]))
    assert wrong[0] > 2 * first[0]
    assert noise[0] < 1.5 * least[0], "errors of a model are no noise"
    # Predictions that are not finite are counted, and as large as motion is.
    exploded, lost = held_out.of(jnp.asarray([jnp.nan]))
    assert lost == held_out.count > 0
    np.testing.assert_allclose(exploded, held_out.largest, rtol=1e-5)


def test_misfit_counts_only_what_noise_does_not_explain():
    rng = np.random.default_rng(4)
    white = jnp.asarray(rng.standard_normal((200, 30, 2)))
    noise, ones = jnp.ones(2), jnp.ones(white.shape)
    assert float(misfit_of(white, noise, ones).max()) < 0.3
    steady = jnp.broadcast_to(3 * white[:, :1], white.shape)  # the same in each step
    expected = np.sqrt((9 - 1) * 30)
    np.testing.assert_allclose(misfit_of(steady, noise, ones), expected, rtol=0.15)
    hidden = misfit_of(steady, jnp.array([1.0, jnp.inf]), ones)
    np.testing.assert_allclose(hidden[0], [expected, 0.0], rtol=0.15)
    broken = steady.at[:20, 4].set(jnp.nan)
    np.testing.assert_allclose(misfit_of(broken, noise, ones), expected, rtol=0.15)


def test_misfit_grows_along_a_piece_as_errors_do():
    """One channel errs as a wrong force does, one as at the start, one is read now and
    then."""
    rng = np.random.default_rng(5)
    share = np.arange(1, 31) / 30
    off = rng.standard_normal((200, 1, 3)) * [8.0, 3.0, 8.0]
    shape = np.stack([share**2, np.ones(30), share**2], 1)
    there = np.ones((200, 30, 3))
    there[..., 2] = np.arange(30) % 5 == 2
    error = there * (rng.standard_normal(off.shape) + off * shape)
    found = misfit_of(jnp.asarray(error), jnp.ones(3), jnp.asarray(there))
    errs = np.array([8.0, 3.0, 8.0]) * shape
    ratio = np.asarray(found)[5:] / errs[5:]
    # As many steps count as one: of a few readings nearly all do.
    assert (np.ptp(ratio, axis=0) < 0.2 * ratio.mean(0)).all(), ratio
    counted = ratio.mean(0) ** 2
    assert 15 < counted[0] < 25 and 26 < counted[1] < 33 and 3 < counted[2] < 6, counted


@pytest.mark.parametrize("pieces", [60, 1000])
def test_misfit_of_a_reading_that_never_moves(pieces: int) -> None:
    """Its noise is as good as none, which single precision has no square of."""
    rng = np.random.default_rng(6)
    error = 1e-4 * np.abs(rng.standard_normal((pieces, 1, 1))) * np.ones((1, 60, 1))
    noise, half = jnp.array([1e-9]), 0.5 * jnp.ones(error.shape)
    found = misfit_of(jnp.asarray(error, jnp.float32), noise, half)
    np.testing.assert_allclose(found, 1e-4 * np.sqrt(60), rtol=0.2)
    assert not np.asarray(misfit_of(jnp.zeros(error.shape), noise, half)).any()


def test_noise_is_what_errors_leave_white():
    """Whatever a model errs by in slow waves, and in jumps of a tenth of the pieces."""
    rng, sigma = np.random.default_rng(3), np.array([0.01, 0.02])
    wave = np.sin(2 * np.pi * (np.arange(25) / 25 + rng.uniform(size=(300, 1))))
    jump = 0.5 * (np.arange(25) > 12) * (np.arange(300) % 10 == 0)[:, None]
    error = sigma * rng.normal(size=(300, 25, 2))
    error[..., 1] += 0.2 * wave + jump
    error[7] = np.nan
    np.testing.assert_allclose(white_noise(jnp.asarray(error)), sigma, rtol=0.05)
    # Of what is slow or has gaps as well.
    there = np.ones(error.shape)
    there[:, 4] = there[::2, 9:12] = 0.0
    gaps = white_noise(jnp.asarray(there * error), jnp.asarray(there))
    np.testing.assert_allclose(gaps, sigma, rtol=0.05)
    there[..., 0] = np.arange(25) % 4 == 1
    there[..., 1] = np.arange(25) % 13 == 1
    slow = white_noise(jnp.asarray(there * error), jnp.asarray(there))
    np.testing.assert_allclose(slow[0], sigma[0], rtol=0.08)
    assert np.isnan(slow[1])
    # Rows that tell less than that are right: then the model errs from row to row.
    told = jnp.array([0.008, 0.3])
    found = believed(white_noise(jnp.asarray(error)), told)
    np.testing.assert_allclose(found, [0.008, 0.02], rtol=0.05)


def test_outliers_weigh_less():
    error = jnp.ones((9, 5, 2)).at[4].set(20.0)
    weight = outlier_weights(error, jnp.ones(2), jnp.zeros(2), 2.5)
    np.testing.assert_allclose(weight[4], 2.5 / 20, rtol=1e-5)
    np.testing.assert_allclose(np.delete(np.asarray(weight), 4), 1.0)
    broken = error.at[:6, 3].set(jnp.inf)
    weight = outlier_weights(broken, jnp.ones(2), jnp.zeros(2), 2.5)
    np.testing.assert_allclose(weight, [0.0] * 6 + [1.0] * 3)


def test_an_end_row_that_the_others_do_not_follow_from_is_left_out() -> None:
    noise = np.array([1e-5, 1e-3])
    x = sine(400) + 1e-5 * np.random.default_rng(0).standard_normal(400)
    clean, notes = without_odd_ends([make_run(x)], noise)
    assert len(clean[0]) == 400 and not notes
    x[0] += 0.02
    x[-2:] -= 0.03
    cut, notes = without_odd_ends([make_run(x, "stale")], noise)
    np.testing.assert_array_equal(cut[0].qpos[:, 0], x[1:-2])
    assert "first 1 of stale" in notes[0] and "last 2 of stale" in notes[0]


def test_motion_that_starts_with_a_jerk_is_kept() -> None:
    noise = np.array([1e-5, 1e-3])
    t = 0.01 * np.arange(400)
    bump = np.abs(np.sin(6 * t))  # bounces: its velocity jumps again and again
    fall = np.maximum(0.0, 5 * (t - 0.005)) ** 2
    for x in (bump, fall):
        assert len(without_odd_ends([make_run(x)], noise)[0][0]) == 400
