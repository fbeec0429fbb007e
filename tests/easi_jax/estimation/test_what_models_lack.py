"""What is stated of machines that their model is not, from the search's end on."""

import copy

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from easi_jax.data.measured import measured_runs
from easi_jax.data.recording import Log, Run
from easi_jax.data.segments import cut, join, to_device
from easi_jax.data.windows import fitted_velocity
from easi_jax.estimation import from_runs
from easi_jax.estimation.problem import problem_of
from easi_jax.estimation.step_error import error_of_steps
from easi_jax.model.distribution import covariance
from easi_jax.model.joint_space import Configuration
from easi_jax.model.parameters import ParameterSpace, declare
from easi_jax.search.config import SearchConfig
from easi_jax.search.easi import Search
from easi_jax.simulation import engine, open_loop
from easi_jax.simulation.simulator import Simulator
from easi_jax.simulation.slopes import shift_readings

_DT, _ROWS, _NOISE, _OFFSET = 0.01, 1000, 1e-4, 0.02  # s, rows, rad, rad
_XML = """<mujoco><option timestep="0.005" integrator="implicitfast"/>
  <worldbody><body><joint name="shoulder" axis="0 1 0" damping="0.2"
      armature="0.01"/>
    <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.03" mass="1"/>
    <body name="fore" pos="0.3 0 0"><joint name="elbow" axis="0 1 0" damping="0.08"
        armature="0.005"/>
      <geom type="capsule" fromto="0 0 0 0.25 0 0" size="0.025" mass="0.66"/></body>
  </body></worldbody>
  <actuator><position name="s" joint="shoulder" kp="40" kv="1.5"/>
    <position name="e" joint="elbow" kp="20" kv="0.6"/></actuator></mujoco>"""
_PLACES = {
    "damping": ("joint.elbow.damping", 0.08),
    "kp": ("actuator.e.kp", 20.0),
    "mass": ("body.fore.mass", 0.66),
}


def _recorded(m: mujoco.MjModel, seed: int, name: str, off: float, finer: int) -> Run:
    """Motion of a machine whose elbow reads ``off`` [rad] too much, simulated in
    ``finer`` steps."""
    rng, real = np.random.default_rng(seed), copy.copy(m)
    real.opt.timestep /= finer
    d = mujoco.MjData(real)
    turn, phase = rng.uniform(0.6, 7.0, (2, 4)), rng.uniform(0.0, 6.0, (2, 4))
    q, ctrl = np.zeros((_ROWS, 2)), np.zeros((_ROWS, 2))
    for k in range(_ROWS):
        ctrl[k] = 0.35 * np.sin(turn * k * _DT + phase).sum(1)
        q[k] = d.qpos + [0.0, off] + _NOISE * rng.normal(size=2)
        d.ctrl[:] = ctrl[k]
        mujoco.mj_step(real, d, 2 * finer)
    shape = Configuration.of(m)
    v, time = fitted_velocity(q, _DT, shape), _DT * np.arange(_ROWS)
    return Run(name, name, _DT, time, q, v, False, ctrl, shape)


def _stated(off: float, finer: int) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Errors in unit coordinates, their standard deviations, and notes."""
    m = mujoco.MjModel.from_xml_string(_XML)
    space = _space(m)
    truth = np.asarray(space.to_unit(jnp.asarray(space.nominal)), float)
    runs = tuple(_recorded(m, k, f"r{k}", off, finer) for k in range(3))
    cleaned = measured_runs(m, Log(runs[:2], ()), Log(runs[2:], ()), 0.2)
    with engine.using("mujoco"):
        problem = problem_of("arm", m, space, cleaned)
        config = SearchConfig(source="replay", horizon=problem.piece, population=4)
        finish = from_runs.ready_finish(problem, Search(problem.simulator, config))
        mean = jnp.asarray(truth + np.array([0.2, -0.2, 0.1]))
        ((found,), notes) = finish(mean[None], 0.04 * jnp.eye(3)[None])
    std = np.sqrt(np.diag(covariance(found.distribution)))
    return np.asarray(found.distribution.mean, float) - truth, std, notes(0)


def _space(m: mujoco.MjModel) -> ParameterSpace:
    return ParameterSpace(
        tuple(
            declare(m, name, address, nominal=value, initial=(value / 3, 3 * value))
            for name, (address, value) in _PLACES.items()
        )
    )


@pytest.mark.slow
def test_an_offset_does_not_move_what_is_stated() -> None:
    """Without the offset in mind, the best fit has no damping at all: as good as zero,
    where the logarithm has no slope. What is fitted with it finds the way back."""
    off, std, notes = _stated(_OFFSET, 1)
    assert (np.abs(off) < 3.0 * std).all() and (std < 0.05).all(), (off, std)
    assert any('readings of "elbow" have an offset, by 0.02' in n for n in notes)


@pytest.mark.slow
def test_the_models_steps_are_in_doubt_where_the_machine_has_none() -> None:
    """A drive's damping is off by many deviations for a step of 5 ms; data of such
    steps fit worse without them, and nothing is said."""
    own, usual, quiet = _stated(0.0, 1)
    off, std, notes = _stated(0.0, 16)
    assert (np.abs(own) < 3.0 * usual).all() and not any("timestep" in n for n in quiet)
    assert (np.abs(off) > 5.0 * usual).any(), "else there is nothing to see"
    assert (np.abs(off) < 2.0 * std).all(), (off, std)
    (note,) = (n for n in notes if "has a part in values" in n)
    assert "timestep of 5 ms" in note and "damping" in note


def test_error_of_steps_is_what_a_fine_simulation_lacks() -> None:
    """Predictions less that error are those of steps a hundred times as fine."""
    m = mujoco.MjModel.from_xml_string(_XML)
    space = _space(m)
    coarse = Simulator(m, space, _DT, engine="mujoco")
    finest = copy.copy(m)
    finest.opt.timestep /= 100
    fine = Simulator(finest, space, _DT, engine="mujoco")
    run = _recorded(m, 0, "r", 0.0, 1)
    piece = cut(run.qpos, run.qvel, run.ctrl, 20, 100)
    assert piece is not None
    pieces = to_device(join([piece]))
    unit = space.to_unit(jnp.asarray(space.nominal))
    still = jnp.zeros((pieces.count, 4))
    got = np.asarray(error_of_steps(coarse)(unit, pieces, still))
    both = (
        open_loop.predict(s, s.model(space.to_si(unit)), pieces) for s in (fine, coarse)
    )
    want = np.asarray(open_loop.prediction_residuals(coarse, *both))
    assert np.abs(want).max() > 1e-3
    assert np.abs(got - want).max() < 0.1 * np.abs(want).max()
    # Taken off what was read, it is what the model would have predicted.
    shifted = shift_readings(coarse, pieces, jnp.asarray(got))
    np.testing.assert_allclose(
        shifted.next_qpos - pieces.next_qpos, got[..., :2], atol=1e-6
    )


def test_a_center_of_mass_that_only_mjx_moves() -> None:
    """Of a body that floats by itself, whose steps are then compared by MJX."""
    m = mujoco.MjModel.from_xml_string(
        """<mujoco><option timestep="0.005"/><worldbody><body name="b"><freejoint
          name="f"/><geom size=".1 .2 .3" type="box" mass="1"/></body></worldbody>
        </mujoco>"""
    )
    com = declare(m, "c", "effect.com.b.0", nominal=0.01, initial=(0.0, 0.02))
    space = ParameterSpace((com,))
    simulator = Simulator(m, space, _DT, engine="mjx")
    q, v = (
        np.tile([0.0, 0, 0, 1, 0, 0, 0], (8, 1)),
        np.tile([0.0, 0, 0, 1, 2, 3], (8, 1)),
    )
    piece = cut(q, v, np.zeros((8, 0)), 4, 4)
    assert piece is not None and simulator.moves_centers
    pieces = to_device(join([piece]))
    still = jnp.zeros((pieces.count, 12))
    error = error_of_steps(simulator)(jnp.zeros(1), pieces, still)
    assert error.shape == (pieces.count, 4, 12) and 0 < np.abs(error).max() < 0.1
