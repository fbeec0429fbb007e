"""Windows and fitted velocities against analytic motions."""

import dataclasses
from typing import Any

import mujoco
import numpy as np
import pytest

from easi_jax.data.recording import Run, physics_steps
from easi_jax.data.windows import fitted_velocity, make_windows, slope_noise
from easi_jax.io.logs.reader import read_logs
from easi_jax.model.joint_space import Configuration

XML = """
<mujoco><worldbody>
  <body><joint name="hinge"/><geom size=".1"/></body>
  <body><freejoint name="base"/><geom size=".1"/></body>
</worldbody><actuator><motor name="drive" joint="hinge"/></actuator></mujoco>
"""
FLAT = Configuration(1, 1, (0,), (0,), ())


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(XML)


def flat_run(qpos: np.ndarray, dt: float) -> Run:
    rows = len(qpos)
    return Run(
        name="run",
        source="",
        dt=dt,
        time=dt * np.arange(rows),
        qpos=qpos[:, None],
        qvel=fitted_velocity(qpos[:, None], dt, FLAT),
        qvel_measured=False,
        ctrl=np.arange(rows, dtype=float)[:, None],
        configuration=FLAT,
    )


@pytest.mark.parametrize("dt", [0.001, 0.004, 0.02, 0.1])
def test_velocity_of_a_parabola_is_exact_in_every_row(dt):
    time = dt * np.arange(60)
    velocity = fitted_velocity((3 - 2 * time + 5 * time**2)[:, None], dt, FLAT)
    np.testing.assert_allclose(velocity[:, 0], -2 + 10 * time, atol=1e-9)


@pytest.mark.parametrize(("dt", "rows"), [(0.001, 41), (0.004, 11), (0.02, 5)])
def test_velocity_is_the_quadratic_fit_of_the_log_format(dt, rows):
    values = np.random.default_rng(0).normal(size=100)
    velocity = fitted_velocity(values[:, None], dt, FLAT)[:, 0]
    half = rows // 2
    time = dt * np.arange(-half, half + 1)
    for row in (half, 50, 99 - half):
        fit = np.polynomial.Polynomial.fit(time, values[row - half : row + half + 1], 2)
        assert velocity[row] == pytest.approx(fit.deriv()(0.0), rel=1e-9)
    # at the run's start only the rows that exist, and at least five
    span = max(half + 1, 5)
    fit = np.polynomial.Polynomial.fit(dt * np.arange(span), values[:span], 2)
    assert velocity[0] == pytest.approx(fit.deriv()(0.0), rel=1e-9)


@pytest.mark.parametrize("dt", [0.001, 0.02])
def test_noise_of_velocities(dt):
    white = np.random.default_rng(0).normal(size=(20_000, 1))
    spread = fitted_velocity(white, dt, FLAT)[50:-50].std()
    assert spread == pytest.approx(slope_noise(dt), rel=0.03)


def test_velocity_of_short_runs():
    assert fitted_velocity(np.ones((1, 1)), 0.1, FLAT) == 0
    two = fitted_velocity(np.array([[1.0], [1.5]]), 0.1, FLAT)
    np.testing.assert_allclose(two[:, 0], 5.0)
    three = fitted_velocity(np.array([[0.0], [0.1], [0.4]]), 0.1, FLAT)
    np.testing.assert_allclose(three[:, 0], [0.0, 2.0, 4.0], atol=1e-12)


def test_velocity_of_a_turning_body_is_in_its_own_frame(model):
    """A body that turns at a constant rate in its own frame, across a sign flip."""
    space = Configuration.of(model)
    rate = np.array([0.0, 0.3, -0.2, 1.0, 2.0, -3.0, 4.0])  # hinge, then free joint
    dt, rows = 0.005, 400
    qpos = np.empty((rows, model.nq))
    qpos[0] = [0.2, 1.0, 2.0, 3.0, 1.0, 0.0, 0.0, 0.0]
    for i in range(1, rows):
        qpos[i] = space.integrate(qpos[i - 1], rate * dt)
    qpos[100:, 4:] *= -1
    velocity = fitted_velocity(qpos, dt, space)
    np.testing.assert_allclose(velocity, np.tile(rate, (rows, 1)), atol=1e-9)


def test_windows_hold_the_rows_they_say():
    run = flat_run(np.sin(np.arange(101) * 0.05), 0.01)
    windows = make_windows(run, 0.2)
    assert windows.start_row.tolist() == [0, 10, 20, 30, 40, 50, 60, 70, 80]
    assert windows.ctrl.shape == (9, 20, 1)
    assert windows.target_qpos.shape == (9, 20, 1)
    for w, row in enumerate(windows.start_row):
        assert windows.start_qpos[w] == run.qpos[row]
        assert windows.start_qvel[w] == run.qvel[row]
        np.testing.assert_array_equal(windows.ctrl[w, :, 0], row + np.arange(20))
        np.testing.assert_array_equal(
            windows.target_qpos[w], run.qpos[row + 1 : row + 21]
        )
    assert windows.dt == 0.01


def test_spacing_and_least_length_of_windows():
    run = flat_run(np.zeros(50), 0.01)
    assert make_windows(run, 0.02).ctrl.shape[1] == 10
    assert make_windows(run, 0.1, 0.01).start_row.tolist() == list(range(40))
    assert make_windows(run, 0.49).start_row.tolist() == [0]
    assert make_windows(run, 0.5).ctrl.shape == (0, 50, 1)
    with pytest.raises(ValueError, match="positive"):
        make_windows(run, 0.1, 0.0)
    with pytest.raises(ValueError, match="positive"):
        make_windows(run, -1.0)


def test_start_velocity_is_fitted_even_where_velocities_were_measured():
    run = flat_run(np.arange(50) * 0.01, 0.01)
    lagging = dataclasses.replace(run, qvel=run.qvel * 0, qvel_measured=True)
    np.testing.assert_allclose(make_windows(lagging, 0.1).start_qvel, 1.0)


def test_nothing_looks_across_the_end_of_a_run(tmp_path, model):
    """The same rows give the same numbers, whatever the run beside them holds."""
    rng = np.random.default_rng(1)
    names = ["qpos.hinge", *(f"qpos.base.{i}" for i in range(7)), "ctrl.drive"]

    def read(second: np.ndarray):
        qpos = np.zeros((60, 8))
        qpos[:, 4] = 1.0
        qpos[:30, :3] = first
        qpos[30:, :3] = second
        columns: dict[str, Any] = dict(
            zip(names, [*qpos.T, np.arange(60.0)], strict=True)
        )
        time = 0.01 * np.arange(60)
        run = np.repeat([1, 2], 30)
        np.savez(tmp_path / "log.npz", time=time, run=run, **columns)
        return read_logs(tmp_path / "log.npz", model).runs

    first = rng.normal(size=(30, 3))
    calm, wild = read(np.zeros((30, 3))), read(rng.normal(size=(30, 3)) * 50)
    assert [run.name for run in calm] == ["log/1", "log/2"]
    np.testing.assert_array_equal(calm[0].qvel, wild[0].qvel)
    for a, b in zip(
        make_windows(calm[0], 0.1), make_windows(wild[0], 0.1), strict=True
    ):
        np.testing.assert_array_equal(a, b)
    np.testing.assert_array_equal(calm[1].qvel, np.zeros((30, 7)))


@pytest.mark.parametrize(
    ("control", "timestep", "expected"),
    [
        (0.02, 0.005, 4),
        (0.02, 0.0051, 4),
        (0.02, 0.0049, 5),
        (0.004, 0.004, 1),
        (0.00400002, 0.004, 1),  # a clock's error
        (0.0041, 0.004, 2),
        (0.001, 0.004, 1),
        (0.1, 0.01, 10),
    ],
)
def test_physics_steps(control, timestep, expected):
    assert physics_steps(control, timestep) == expected
