"""The noise of readings told from motion, or said to be a bound."""

from dataclasses import replace
from functools import cache

import mujoco
import numpy as np
import pytest

from easi_jax.data.noise import Noise, noise_of, pooled, sensor_noise, without_held
from easi_jax.data.recording import Run
from easi_jax.model.joint_space import Configuration

_ROWS = 3000
_ARM = """<mujoco><option timestep="0.0005" integrator="implicitfast"/><worldbody>
<body pos="0 0 1"><joint name="j" axis="0 1 0" damping=".05" frictionloss=".05"
 armature=".01"/><geom type="capsule" fromto="0 0 0 0 0 -.3" size=".02" mass=".3"/>
</body></worldbody><actuator><motor joint="j"/></actuator></mujoco>"""


@cache
def _motion(rate: int, kind: str) -> tuple[np.ndarray, np.ndarray]:
    """Positions and velocities ``(T, 1)`` under smooth commands, such as are held for
    0.1 s, such as jump at every row, or none."""
    m = mujoco.MjModel.from_xml_string(_ARM)
    d, dt, rng = mujoco.MjData(m), 1.0 / rate, np.random.default_rng(0)
    t = dt * np.arange(_ROWS)
    jumps = rng.uniform(-2, 2, _ROWS)
    ctrl = {
        "smooth": 1.5 * np.sin(9 * t) + 1.2 * np.sin(13 * t),
        "held": np.repeat(jumps, max(1, rate // 10))[:_ROWS],
        "jumping": jumps,
        "free": np.zeros(_ROWS),
    }[kind]
    d.qpos[0] = 2.0 if kind == "free" else 0.0
    out = np.empty((2, _ROWS, 1))
    for k, u in enumerate(ctrl):
        out[:, k, 0] = d.qpos[0], d.qvel[0]
        d.ctrl[0] = u
        mujoco.mj_step(m, d, round(dt / m.opt.timestep))
    return out[0], out[1]


def _run(rate: int, kind: str, noise: float, speed: float, seed: int = 0) -> Run:
    rng = np.random.default_rng(seed)
    qpos, qvel = (
        x + s * rng.normal(size=x.shape)
        for x, s in zip(_motion(rate, kind), (noise, speed), strict=True)
    )
    c, t = Configuration(1, 1, (0,), (0,), ()), np.arange(_ROWS) / rate
    return Run("r", "r", 1.0 / rate, t, qpos, qvel, True, np.zeros((_ROWS, 0)), c)


@pytest.mark.parametrize("kind", ["smooth", "held", "jumping", "free"])
@pytest.mark.parametrize("rate", [50, 100, 250, 500, 1000])
@pytest.mark.parametrize("noise", [5e-5, 1e-3])
def test_noise_is_right_or_a_bound(rate: int, kind: str, noise: float) -> None:
    truth = np.array([noise, 50 * noise])
    std, is_bound = noise_of(_run(rate, kind, *truth))
    assert np.all(std > 0.92 * truth)
    assert np.all(is_bound | (std < 1.1 * truth))


@pytest.mark.parametrize("rate", [50, 100, 250, 500, 1000])
def test_what_can_be_told_is_no_bound(rate: int) -> None:
    """Smooth motion at up to 20 rad/s, noise of an encoder."""
    assert 8.0 < np.abs(_motion(rate, "smooth")[1]).max() < 25.0
    said = [noise_of(_run(rate, "smooth", 1e-3, 0.5, s)).is_bound for s in range(4)]
    assert np.mean(said, axis=0)[0] <= 0.25


def test_a_joint_that_never_moves_is_no_better_known_than_others() -> None:
    """Read in steps, it may move by half of one unseen."""
    rng, time = np.random.default_rng(0), 0.01 * np.arange(400)
    moving = np.round((np.sin(3 * time) + 1e-4 * rng.normal(size=400)) / 0.004) * 0.004
    still = np.full(400, 0.012)
    both = Configuration(2, 2, (0, 1), (0, 1), ())
    q = np.stack([moving, still], 1)
    rest = np.zeros((400, 1))
    run = Run("r", "r", 0.01, time, q, 0 * q, False, rest, both)
    noise = pooled([run, replace(run, qpos=q[::-1].copy())])
    assert noise.std[1] == pytest.approx(0.004 / np.sqrt(12), rel=1e-6)
    assert noise.std[3] > 0.1 * noise.std[2]
    alone = replace(run, qpos=np.stack([still, still], 1))
    assert pooled([alone]).std[:2].tolist() == [0.0, 0.0]


def test_what_cannot_be_told_is_a_bound() -> None:
    for rate in (50, 100, 250):
        run = _run(rate, "jumping", 2e-5, 1e-2)
        std, is_bound = noise_of(run)
        assert is_bound.all() and std[0] > 4e-5 and std[1] > 0.1
        derived = noise_of(replace(run, qvel_measured=False))
        assert derived.is_bound.all()
    few = _run(500, "smooth", 1e-3, 0.1)
    few = replace(few, time=few.time[:30], qpos=few.qpos[:30], qvel=few.qvel[:30])
    assert noise_of(few).is_bound.all()


def test_runs_that_tell_count_for_those_that_do_not() -> None:
    rough, fine = _run(50, "jumping", 1e-3, 0.1), _run(500, "smooth", 1e-3, 0.1)
    assert noise_of(rough).is_bound[0] and not noise_of(fine).is_bound[0]
    both = pooled([rough, rough, fine])
    assert both.std[0] == noise_of(fine).std[0] and not both.is_bound[0]
    assert pooled([rough, rough]).is_bound[0]


def _with(run: Run, **sensors: np.ndarray) -> Run:
    return replace(run, sensors=sensors)


def test_noise_of_sensors() -> None:
    run, rng = _run(500, "smooth", 1e-3, 0.1), np.random.default_rng(1)
    sizes = np.array([0.3, 0.01, 0.05])
    t = run.time[:, None]
    gyro = np.sin(t * np.array([3.0, 5.0, 7.0])) + sizes * rng.normal(size=(_ROWS, 3))
    torque = np.round((np.sin(4 * t) + 0.001 * rng.normal(size=t.shape)) / 0.05) * 0.05
    gaps = gyro.copy()
    gaps[np.arange(_ROWS) % 3 != 0] = np.nan
    held = np.repeat(gyro[::5], 5, axis=0)
    angle = np.stack([np.cos(t[:, 0] / 2), *np.zeros((2, _ROWS)), np.sin(t[:, 0] / 2)])
    turn = angle.T + 1e-4 * rng.normal(size=(_ROWS, 4))
    turn *= np.sign(rng.normal(size=(_ROWS, 1)))
    given = {"gyro": gyro, "gaps": gaps, "held": held, "torque": torque, "turn": turn}
    found = sensor_noise([_with(run, **given), _with(run, gyro=gyro)])
    assert set(found) == set(given)
    assert all(isinstance(x, Noise) for x in found.values())
    np.testing.assert_allclose(found["gyro"].std, sizes, rtol=0.1)
    assert not found["gyro"].is_bound.any()
    for name in ("gaps", "held"):
        np.testing.assert_allclose(found[name].std, sizes, rtol=0.15)
    np.testing.assert_allclose(found["torque"].std, 0.05 / np.sqrt(12), rtol=0.3)
    np.testing.assert_allclose(found["turn"].std, 1e-4, rtol=0.1)
    nothing = np.full((_ROWS, 1), np.nan)
    assert sensor_noise([run, _with(run, dead=nothing)]) == {}


def test_rows_in_which_a_slow_sensor_is_held_hold_no_reading() -> None:
    run, rng = _run(100, "smooth", 1e-3, 0.1), np.random.default_rng(4)
    row, wave = np.arange(_ROWS), np.sin(3.0 * run.time)[:, None]
    slow = row - row % 5
    ctrl = np.repeat(rng.normal(size=(_ROWS // 10, 1)), 10, 0)
    slow[202:] = row[202:] - (row[202:] - 1) % 5  # a clock that drifts
    sensors = {
        "held": wave[slow] + 1e-3 * rng.normal(size=(_ROWS, 1))[slow],
        "touch": np.maximum(np.sin(row / 9.0), 0.0)[:, None]
        * (row % 150 < 50)[:, None],
        "coarse": np.round(wave / 0.05) * 0.05,
        "fast": wave + 1e-3 * rng.normal(size=(_ROWS, 2)),
        "none": np.full((_ROWS, 1), np.nan),
        "torque": ctrl,  # of a motor, told by what it is asked for
    }
    found = without_held(_with(replace(run, ctrl=ctrl), **sensors)).sensors
    for name in ("touch", "coarse", "fast", "none", "torque"):
        np.testing.assert_array_equal(found[name], sensors[name])
    new = np.diff(sensors["held"][:, 0], prepend=np.nan) != 0
    np.testing.assert_array_equal(np.isfinite(found["held"][:, 0]), new)
    np.testing.assert_array_equal(found["held"][new], sensors["held"][new])


def test_jumps_of_commands_are_no_noise_of_torques() -> None:
    run, rng = _run(100, "smooth", 1e-3, 0.1), np.random.default_rng(2)
    ctrl = np.repeat(rng.normal(size=(len(run), 1)), 1, 1)
    run = replace(run, ctrl=ctrl)
    white = 0.01 * rng.normal(size=(len(run), 2))
    slow = np.sin(3.0 * run.time)
    before = np.vstack([ctrl[:1], ctrl[:-1]])[:, 0]
    torque = np.stack([5.0 * ctrl[:, 0] + slow, -2.0 * before + slow], 1) + white
    found = sensor_noise([_with(run, torque=torque)])["torque"]
    np.testing.assert_allclose(found.std, 0.01, rtol=0.1)


@pytest.mark.parametrize("rows", [2, 3, 4, 8])
def test_a_short_run_whose_rows_were_interpolated_has_a_noise(rows: int) -> None:
    whole = _run(100, "smooth", 1e-3, 0.1)
    cut = {k: getattr(whole, k)[:rows] for k in ("time", "qpos", "qvel", "ctrl")}
    stamps = cut["time"] + 1e-3 * np.sin(np.arange(rows))
    run = replace(whole, **cut, stamps=stamps, qvel_measured=False)
    assert np.all(noise_of(run).std >= 0)
    assert np.all(pooled([whole, run]).std > 0)
