"""Effects that a model may lack: commands that come late."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from easi_jax.data.segments import Segments, cut, join, to_device
from easi_jax.estimation.doubts import LATE, Doubts, doubts_of, told, without
from easi_jax.estimation.levenberg_marquardt import RefineResult
from easi_jax.estimation.normal_equations import PairedFit
from easi_jax.estimation.posterior import Estimate, polished
from easi_jax.model.distribution import covariance
from easi_jax.model.parameters import ParameterSpace, declare
from easi_jax.simulation.simulator import Simulator

_DT, _STEPS = 0.01, 20  # s, control steps
_NOISE = np.array([2e-4, 5e-3])  # rad, rad/s
_LATE = 0.004  # s
_XML = """<mujoco><option timestep="0.002" integrator="implicitfast"/>
  <worldbody><body><joint name="j" axis="0 1 0" damping="0.1" armature="0.01"/>
    <geom type="capsule" size="0.02" fromto="0 0 0 0 0 -0.3" mass="0.5"/></body>
  </worldbody>
  <actuator><position name="a" joint="j" kp="8" kv="0.3"/></actuator></mujoco>"""
_PLACES = {
    "kp": ("actuator.a.kp", 8.0),
    "damping": ("joint.j.damping", 0.1),
    "armature": ("joint.j.armature", 0.01),
}


def _space(m: mujoco.MjModel) -> ParameterSpace:
    return ParameterSpace(
        tuple(
            declare(m, name, address, nominal=value, initial=(value / 2, 2 * value))
            for name, (address, value) in _PLACES.items()
        )
    )


def _recorded(m: mujoco.MjModel, late: int, past: int, seed: int) -> Segments:
    """Pieces with noise, of MuJoCo C alone, commands late by physics steps."""
    rng, rows, sub = np.random.default_rng(seed), 600, 5
    d = mujoco.MjData(m)
    phase = rng.uniform(0, 2 * np.pi, 3)
    time = _DT * np.arange(rows)[:, None]
    u = 0.5 * np.sin(np.array([4.0, 9.1, 17.3]) * time + phase).sum(1)
    arrived = np.concatenate([np.full(late, u[0]), np.repeat(u, sub)])
    states = np.empty((rows, 2))
    for k in range(rows):
        states[k] = *d.qpos, *d.qvel
        for i in range(sub):
            d.ctrl[:] = arrived[k * sub + i]
            mujoco.mj_step(m, d)
    states += _NOISE * rng.normal(size=states.shape)
    q, v = np.split(states, 2, axis=1)
    piece = cut(q, v, u[:, None], _STEPS, _STEPS, past)
    assert piece is not None
    return to_device(join([piece]))


@pytest.fixture(scope="module")
def doubts() -> Doubts:
    m = mujoco.MjModel.from_xml_string(_XML)
    space = _space(m)
    found = doubts_of(Simulator(m, space, _DT, engine="mujoco"), space)
    assert found is not None
    return found


def test_nothing_is_doubted_without_commands_or_where_it_is_modelled() -> None:
    passive = mujoco.MjModel.from_xml_string(_XML.split("<actuator>")[0] + "</mujoco>")
    names = {"damping", "armature"}
    space = _space(mujoco.MjModel.from_xml_string(_XML)).select(sorted(names))
    assert doubts_of(Simulator(passive, space, _DT, engine="mujoco"), space) is None
    m = mujoco.MjModel.from_xml_string(_XML)
    fixed = {"effect.delay.a": 0.003}
    own = Simulator(m, space, _DT, fixed=fixed, engine="mujoco")
    assert doubts_of(own, space) is None


def test_what_is_said_of_parameters_whatever_the_effects_are() -> None:
    """The inverse of what is left is the parameters' part of the whole inverse."""
    root = np.random.default_rng(0).normal(size=(9, 5))
    info = jnp.asarray(root.T @ root, jnp.float32)
    zero = jnp.zeros(())
    unit = jnp.arange(5.0)
    fit = RefineResult(unit, info, zero, zero, unit, 2 * info, zero, zero)
    reduced, effects = without(fit, 2)
    for got, given in ((reduced.hessian, info), (reduced.raised_hessian, 2 * info)):
        whole = np.asarray(given, float) + np.diag([0.0, 0.0, 0.0, 1.0, 1.0])
        exact = np.linalg.inv(whole)
        np.testing.assert_allclose(np.linalg.inv(got), exact[:3, :3], rtol=2e-3)
    exact = np.linalg.inv(np.asarray(info) + np.diag([0.0, 0.0, 0.0, 1.0, 1.0]))
    np.testing.assert_allclose(effects[:, 0], [3.0, 4.0])
    np.testing.assert_allclose(effects[:, 1] ** 2, np.diag(exact)[3:], rtol=2e-3)


def test_values_hold_where_commands_come_late(doubts: Doubts) -> None:
    """Without doubt they are wrong by ten of the standard deviations with it."""
    simulator = doubts.simulator
    m, space = simulator.mj_model, _space(simulator.mj_model)
    plain = Simulator(m, space, _DT, engine="mujoco")
    noise, cov = jnp.asarray(_NOISE, jnp.float32), 0.01 * jnp.eye(3)
    truth = space.to_unit(jnp.asarray(space.nominal))

    @jax.jit
    def fit(pieces: Segments) -> tuple[Estimate, Estimate]:
        given = PairedFit(plain, space, pieces, noise), truth, cov
        return polished(*given), polished(*given, doubts=doubts)

    def off(found: Estimate, stated: Estimate) -> float:
        std = np.sqrt(np.diag(covariance(stated.distribution)))
        return float((np.abs(found.distribution.mean - truth) / std).max())

    late = _recorded(m, 2, simulator.past_steps, 0)
    alone, marginal = fit(late)
    assert off(alone, marginal) > 10.0 and off(marginal, marginal) < 3.0
    mean, std = np.asarray(marginal.doubts[0]) * float(doubts.deviations[0])
    assert abs(mean - _LATE) < 4.0 * std and std < 0.1 * _LATE
    (line,) = told(doubts, np.asarray(marginal.doubts))
    assert line.startswith(LATE) and "0.004" in line
    # On time, nothing is lost but a little sureness.
    alone, marginal = fit(_recorded(m, 0, simulator.past_steps, 1))
    spreads = [np.sqrt(np.diag(covariance(x.distribution))) for x in (alone, marginal)]
    assert off(marginal, marginal) < 3.0 and (spreads[1] < 3.0 * spreads[0]).all()
    assert not told(doubts, np.asarray(marginal.doubts))
