"""Starts that no log holds: activations, velocities that come from positions."""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from easi_jax.data.measured import MeasuredRuns
from easi_jax.data.recording import Run
from easi_jax.data.segments import Segments, to_device
from easi_jax.data.windows import fitted_velocity
from easi_jax.estimation.from_runs import start_spread
from easi_jax.estimation.normal_equations import PairedFit
from easi_jax.estimation.pieces import segments_from_runs
from easi_jax.estimation.posterior import estimate
from easi_jax.estimation.problem import Problem, problem_of
from easi_jax.model.distribution import covariance
from easi_jax.model.joint_space import Configuration
from easi_jax.model.parameters import ParameterSpace, declare
from easi_jax.simulation import engine
from easi_jax.simulation.slopes import linearized

_DT, _NOISE, _STEPS = 0.01, 2e-4, 25  # s, rad, control steps
_XML = """<mujoco><option timestep="0.005" integrator="implicitfast"/>
  <worldbody><body><joint name="j" axis="0 1 0" damping="0.06" armature="0.01"/>
    <geom type="capsule" size="0.02" fromto="0 0 0 0 0 -0.3" mass="0.5"/></body>
  </worldbody>
  <actuator><general name="a" joint="j" dyntype="filterexact" dynprm="0.04"
    gainprm="15" biastype="affine" biasprm="0 -15 -0.6"/></actuator></mujoco>"""
_PLACES = {
    "kp": ("actuator.a.kp", 15.0),
    "time_constant": ("actuator.a.time_constant", 0.04),
    "damping": ("joint.j.damping", 0.06),
}


def _recorded(m: mujoco.MjModel, seed: int, rows: int) -> tuple[Run, np.ndarray]:
    """Positions with noise, of MuJoCo C alone; and the activations."""
    rng, d = np.random.default_rng(seed), mujoco.MjData(m)
    phase = rng.uniform(0, 2 * np.pi, 3)
    q, u, act = np.empty((3, rows, 1))
    for k in range(rows):
        u[k] = np.sin(np.array([3.0, 7.3, 12.1]) * k * _DT + phase).sum()
        q[k], act[k] = d.qpos, d.act
        d.ctrl[:] = u[k]
        mujoco.mj_step(m, d, 2)
    q += _NOISE * rng.normal(size=q.shape)
    shape = Configuration.of(m)
    v = fitted_velocity(q, _DT, shape)
    time = _DT * np.arange(rows)
    return Run("r", "r", _DT, time, q, v, False, u, shape), act


def _problem(name: engine.Engine) -> Problem:
    m = mujoco.MjModel.from_xml_string(_XML)
    space = ParameterSpace(
        tuple(
            declare(m, name, address, nominal=value, initial=(value / 2, 2 * value))
            for name, (address, value) in _PLACES.items()
        )
    )
    fit, held = ([_recorded(m, seed, 400)[0]] for seed in (0, 1))
    noise = np.array([_NOISE, 0.01])
    with engine.using(name):
        runs = MeasuredRuns(tuple(fit), noise, fit, held, "r", [])
        return problem_of("drive", m, space, runs)


@pytest.fixture(scope="module")
def native() -> Problem:
    return _problem("mujoco")


def _pieces(problem: Problem) -> Segments:
    found = segments_from_runs(problem.simulator, problem.fit, _STEPS, _STEPS)
    return to_device(found)


def test_pieces_begin_at_the_guess(native: Problem) -> None:
    act = _recorded(native.simulator.mj_model, 0, 400)[1]
    pieces = _pieces(native)
    assert pieces.act.shape == (pieces.count, 1)
    np.testing.assert_allclose(pieces.act[2:], act[::_STEPS][2:-1], atol=5e-3)
    assert float(jnp.std(pieces.act)) > 0.3


def test_what_is_not_measured_may_be_anything(native: Problem) -> None:
    """Of positions the reading's noise; of speeds and activations what occurs."""
    position, speed, act = np.asarray(start_spread(native, jnp.asarray(native.noise)))
    assert position == pytest.approx(_NOISE)
    assert speed > np.std(native.fit[0].qvel) and 0.3 < act < 3.0
    for gain, low, high in ((1.0, 0.0099, 0.012), (1.05, 0.1, 1.0)):
        # A gain error of velocities is no noise: what they are off by counts.
        (run,) = native.fit
        time = run.dt * np.arange(len(run))[:, None]
        late = 0.0025  # s, half a physics step, as simulated ones are
        speed = gain * 3 * np.cos(3 * (time - late))
        runs = [replace(run, qpos=np.sin(3 * time), qvel=speed, qvel_measured=True)]
        measured = replace(native, fit=runs, measured=np.array([True]))
        spread = start_spread(measured, jnp.asarray(native.noise))
        assert low < float(spread[1]) < high
    unseen = start_spread(native, jnp.full(2, jnp.inf))
    assert np.isfinite(unseen).all() and float(unseen[0]) == pytest.approx(1.0)


@pytest.mark.parametrize("name", ["mujoco", "mjx"])
def test_slopes_along_the_start(name: engine.Engine) -> None:
    """Beside differences of MuJoCo C."""
    problem = _problem(name)
    simulator, space = problem.simulator, problem.simulator.space
    piece = _pieces(problem).take(3)
    unit = space.to_unit(jnp.asarray(space.nominal))

    @jax.jit
    def run(shift: Any) -> Any:
        return linearized(simulator, space, unit, shift, piece)[1]

    found = np.asarray(run(jnp.zeros(3)), float)[..., 3:]

    def simulated(way: np.ndarray) -> np.ndarray:
        m, out = simulator.mj_model, []
        d = mujoco.MjData(m)
        start = np.concatenate([piece.qpos, piece.qvel, piece.act]).astype(float)
        d.qpos[:], d.qvel[:], d.act[:] = np.split(start + 1e-5 * way, 3)
        for u in np.asarray(piece.ctrl, float):
            d.ctrl[:] = u
            mujoco.mj_step(m, d, simulator.substeps)
            out.append(np.concatenate([d.qpos, d.qvel]))
        return np.array(out)

    exact = [(simulated(way) - simulated(-way)) / 2e-5 for way in np.eye(3)]
    np.testing.assert_allclose(found, np.stack(exact, -1), atol=2e-3)
    assert np.abs(found[..., 2]).max() > 0.3  # an activation moves the joint


def test_a_drive_is_found_from_positions_alone(native: Problem) -> None:
    simulator, space = native.simulator, native.simulator.space
    pieces, noise = _pieces(native), jnp.asarray(native.noise)
    start = start_spread(native, noise)
    truth = space.to_unit(jnp.asarray(space.nominal))
    wrong = truth + jnp.array([0.2, -0.3, 0.25])
    hidden = jnp.array([0.0, jnp.inf])  # speeds come from positions

    @jax.jit
    def run(pieces: Segments) -> Any:
        paired = PairedFit(simulator, space, pieces, noise, start=start, misfit=hidden)
        return estimate(paired, wrong, 0.1 * jnp.eye(3), True, robust=0)

    found = run(pieces)
    std = np.sqrt(np.diag(covariance(found.distribution)))
    assert (std[:2] < 0.02).all()
    assert (np.abs(np.asarray(found.distribution.mean - truth)) < 3.0 * std).all()
    act = _recorded(simulator.mj_model, 0, 400)[1][::_STEPS][:-1]
    off = pieces.act + found.delta[:, 2:] - act
    assert found.delta.shape == (pieces.count, 3)
    assert np.std(off) < 0.3 * np.std(act)
