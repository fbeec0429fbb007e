"""When the noise that a fit leaves takes the place of what rows alone tell."""

import dataclasses
from types import SimpleNamespace
from typing import Any

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from easi_jax.data.cleaning import to_common_step, true_readings
from easi_jax.data.noise import finest
from easi_jax.data.recording import Run
from easi_jax.estimation.from_runs import _Finish
from easi_jax.model.found_effects import EffectEntry
from easi_jax.model.joint_space import Configuration

SIGMA = np.array([1e-3, 2e-2])
TOLD = np.array([1.02e-3, 9e-2])  # rows take rough motion for noise


def recorded(rows: int = 60, dt: float = 0.01, **more: Any) -> Run:
    time = dt * np.arange(rows)
    return Run(
        name="run",
        source="run.csv",
        dt=dt,
        time=time,
        qpos=np.sin(time)[:, None],
        qvel=np.cos(time)[:, None],
        qvel_measured=True,
        ctrl=np.zeros((rows, 1)),
        configuration=Configuration(1, 1, (0,), (0,), ()),
        **more,
    )


def learned(
    runs: list[Run], steps: int = 25, given: bool = False, least: float = 0.0
) -> np.ndarray:
    rng = np.random.default_rng(0)
    error = SIGMA * rng.normal(size=(200, steps, 2))
    finish: Any = object.__new__(_Finish)
    finish.problem = SimpleNamespace(noise_given=given, fit=runs)
    finish.told, finish.least = jnp.asarray(TOLD), jnp.asarray([0.0, least])
    pieces = SimpleNamespace(read=(), count=len(error), horizon=steps)
    found: Any = SimpleNamespace(residuals=jnp.asarray(error), pieces=pieces)
    return np.asarray(finish.learned(found))


def test_noise_is_that_of_the_errors() -> None:
    np.testing.assert_allclose(learned([recorded()]), SIGMA, rtol=0.05)
    # Not below what the resolution makes.
    np.testing.assert_allclose(learned([recorded()], least=0.05)[1], 0.05, rtol=1e-6)


@pytest.mark.parametrize("why", ["given", "few steps", "uneven rows", "another rate"])
def test_noise_is_as_it_was_told(why: str) -> None:
    run = recorded()
    if why == "uneven rows":
        run = dataclasses.replace(run, stamps=run.time + 1e-3)
    runs = [run]
    if why == "another rate":
        runs = to_common_step([run, recorded(dt=0.02)])[0]
    steps = 5 if why == "few steps" else 25
    np.testing.assert_allclose(learned(runs, steps, why == "given"), TOLD, rtol=1e-6)


def test_what_was_interpolated_once_stays_so() -> None:
    """Also where an offset is taken out of its readings afterwards."""
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><body><joint name="a" type="slide"/>'
        '<geom size=".1" mass="1"/></body></worldbody></mujoco>'
    )
    entry = EffectEntry("sensor_bias", "a", "joint", {"bias": 0.1}, {})
    fine, coarse = recorded(), recorded(dt=0.02)
    runs = true_readings(model, to_common_step([fine, coarse])[0], [entry])
    assert [run.smoothed for run in runs] == [False, True]


def test_resolution_is_the_least_that_any_run_tells() -> None:
    each = [np.array([0.0, 1e-3]), np.array([0.0, 0.4]), np.array([0.0, 0.0])]
    assert finest(each).tolist() == [0.0, 1e-3]
