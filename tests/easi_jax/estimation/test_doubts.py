"""Effects that a model may lack: late commands, friction, zeros of joints."""

import copy
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from easi_jax.data.recording import Run
from easi_jax.data.scales import scales_of
from easi_jax.data.segments import Segments, cut, join, to_device
from easi_jax.errors import UserError
from easi_jax.estimation import posterior
from easi_jax.estimation.doubts import (
    LAG,
    LATE,
    Doubts,
    all_doubts,
    doubted,
    doubts_of,
    told,
    without,
)
from easi_jax.estimation.levenberg_marquardt import RefineResult
from easi_jax.estimation.normal_equations import PairedFit
from easi_jax.estimation.posterior import Estimate, estimate, no_region, polished
from easi_jax.model.distribution import covariance
from easi_jax.model.joint_space import Configuration
from easi_jax.model.parameters import ParameterSpace, declare
from easi_jax.simulation.open_loop import errors
from easi_jax.simulation.simulator import Simulator

_DT, _STEPS = 0.01, 20  # s, control steps
_NOISE = np.array([2e-4, 5e-3])  # rad, rad/s
_LATE = 0.004  # s
_FRICTION = 0.05  # N m
_OFFSET = 0.01  # rad
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


def _recorded(
    m: mujoco.MjModel, late: int, past: int, seed: int
) -> tuple[Segments, Run]:
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
    configuration = Configuration.of(m)
    run = Run(*("run", "made", _DT, time[:, 0], q, v, True, u[:, None], configuration))
    return to_device(join([piece])), run


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
    slopes = jnp.asarray(root, jnp.float32)
    numbers = unit, info, zero, zero, unit, 2 * info, zero, zero
    fit = RefineResult(*numbers, slopes, zero, jnp.zeros((1, 2, 5)))
    reduced, effects = without(fit, 2)
    own = np.asarray(info)[3:, 3:] + np.eye(2)
    less = root[:, :3] - root[:, 3:] @ np.linalg.solve(own, np.asarray(info)[3:, :3])
    np.testing.assert_allclose(reduced.gradients, less, rtol=2e-3, atol=1e-4)
    for got, given in ((reduced.hessian, info), (reduced.raised_hessian, 2 * info)):
        whole = np.asarray(given, float) + np.diag([0.0, 0.0, 0.0, 1.0, 1.0])
        exact = np.linalg.inv(whole)
        np.testing.assert_allclose(np.linalg.inv(got), exact[:3, :3], rtol=2e-3)
    exact = np.linalg.inv(np.asarray(info) + np.diag([0.0, 0.0, 0.0, 1.0, 1.0]))
    np.testing.assert_allclose(effects[:, 0], [3.0, 4.0])
    np.testing.assert_allclose(effects[:, 1] ** 2, np.diag(exact)[3:], rtol=2e-3)


def _fits(
    plain: Simulator, space: ParameterSpace, doubts: Doubts
) -> Callable[[Segments], tuple[Estimate, Estimate]]:
    """A fit that begins at the nominal values, without doubt and with it."""
    noise, cov = jnp.asarray(_NOISE, jnp.float32), 0.01 * jnp.eye(3)
    nominal = space.to_unit(jnp.asarray(space.nominal))

    @jax.jit
    def fit(pieces: Segments) -> tuple[Estimate, Estimate]:
        given = PairedFit(plain, space, pieces, noise), nominal, cov
        return polished(*given), polished(*given, doubts=doubts)

    return fit


def test_values_hold_where_commands_come_late(doubts: Doubts) -> None:
    """Without doubt they are wrong by ten of the standard deviations with it."""
    simulator = doubts.simulator
    m, space = simulator.mj_model, _space(simulator.mj_model)
    plain = Simulator(m, space, _DT, engine="mujoco")
    truth = space.to_unit(jnp.asarray(space.nominal))
    fit = _fits(plain, space, doubts)

    def off(found: Estimate, stated: Estimate) -> float:
        std = np.sqrt(np.diag(covariance(stated.distribution)))
        return float((np.abs(found.distribution.mean - truth) / std).max())

    late, _ = _recorded(m, 2, simulator.past_steps, 0)
    alone, marginal = fit(late)
    assert off(alone, marginal) > 10.0 and off(marginal, marginal) < 3.0
    mean, std = np.asarray(marginal.doubts[0]) * float(
        np.ptp(doubts.parameters[0].initial)
    )
    assert abs(mean - _LATE) < 4.0 * std and std < 0.1 * _LATE
    (line,) = told(doubts.parameters, np.asarray(marginal.doubts), 0.002)
    assert line.startswith(LATE) and "0.004" in line
    # On time, nothing is lost but a little sureness.
    alone, marginal = fit(_recorded(m, 0, simulator.past_steps, 1)[0])
    spreads = [np.sqrt(np.diag(covariance(x.distribution))) for x in (alone, marginal)]
    assert off(marginal, marginal) < 3.0 and (spreads[1] < 3.0 * spreads[0]).all()
    assert not list(told(doubts.parameters, np.asarray(marginal.doubts), 0.002))


def test_what_is_as_good_as_zero_without_doubts_need_not_be_with_them(
    doubts: Doubts, monkeypatch: pytest.MonkeyPatch
) -> None:
    """There the logarithm has no slope, so that a fit with doubts begins above it."""
    simulator = doubts.simulator
    m, space = simulator.mj_model, _space(simulator.mj_model)
    plain = Simulator(m, space, _DT, engine="mujoco")
    truth = space.to_unit(jnp.asarray(space.nominal))
    late, _ = _recorded(m, 2, simulator.past_steps, 0)
    given = PairedFit(plain, space, late, jnp.asarray(_NOISE, jnp.float32))
    at = list(_PLACES).index("damping")
    mean = truth.at[at].set(-16.0)
    begun = posterior.begun

    def lost(*given: Any, **more: Any) -> Estimate:
        return replace(begun(*given, **more), fit=mean)

    monkeypatch.setattr(posterior, "begun", lost)
    fit = jax.jit(lambda m: estimate(given, m, 0.01 * jnp.eye(3), True, doubts=doubts))
    found = fit(truth)
    std = np.sqrt(np.diag(covariance(found.distribution)))
    assert (np.abs(found.distribution.mean - truth) < 3.0 * std).all()
    assert std[at] < 0.3


def test_what_is_in_doubt_where_something_is_missing() -> None:
    """What no parameter that is asked for sets; of many joints all alike."""
    m = mujoco.MjModel.from_xml_string(_XML)
    _, run = _recorded(m, 0, 0, 0)
    scales = scales_of(m, [run])
    asked = _space(m).select(["damping"])
    found = all_doubts(Simulator(m, asked, _DT, engine="mujoco"), asked, scales)
    assert found is not None
    late, lag, roll, pitch, strength, friction, force, zero = found.parameters
    assert (roll.addresses, pitch.addresses) == (("effect.tilt.0",), ("effect.tilt.1",))
    assert (late.name, lag.name) == (LATE, LAG)
    assert lag.addresses == ("effect.lag.a",) and lag.bounds[0] > 0
    assert strength.addresses == ("effect.strength.a",)
    assert strength.nominal == 1.0 and strength.initial == (1.0, 1.05)
    assert friction.addresses == ("effect.coulomb.j",) and friction.bounds[0] > 0
    assert force.addresses == ("effect.constant.j",) and force.bounds[0] < 0
    assert force.initial[1] == pytest.approx(0.05 * scales.torque[0])
    assert zero.addresses == ("effect.bias.j",) and zero.bounds[0] < 0
    assert zero.initial[1] == pytest.approx(np.radians(0.5))
    # A drive's gains are its strength.
    whole = _space(m)
    found = all_doubts(Simulator(m, whole, _DT, engine="mujoco"), whole, scales)
    assert found is not None
    assert not any("strength" in p.name for p in found.parameters)


@pytest.mark.parametrize(
    ("address", "own"),
    [
        ("effect.coulomb.*", "effect.coulomb.j"),
        ("joint.*.frictionloss", "effect.coulomb.j"),
        ("effect.strength.*", "effect.strength.a"),
        ("effect.constant.*", "effect.constant.j"),
    ],
)
def test_what_a_pattern_sets_is_not_in_doubt(address: str, own: str) -> None:
    m = mujoco.MjModel.from_xml_string(_XML)
    _, run = _recorded(m, 0, 0, 0)
    low = 1.0 if "strength" in address else 0.01
    asked = declare(m, "p", address, nominal=low, initial=(low, 2 * low))
    space = ParameterSpace((asked,))
    simulator = Simulator(m, space, _DT, engine="mujoco")
    found = all_doubts(simulator, space, scales_of(m, [run]))
    assert found is not None
    assert (own,) not in [p.addresses for p in found.parameters]


def test_names_with_dots_are_names() -> None:
    """What is asked for at such a joint is not in doubt there."""
    m = mujoco.MjModel.from_xml_string(_XML.replace('"j"', '"leg.1"'))
    _, run = _recorded(m, 0, 0, 0)
    given = {"nominal": 0.01, "initial": (0.01, 0.02)}
    space = ParameterSpace((declare(m, "p", "joint.leg.1.frictionloss", **given),))
    found = all_doubts(
        Simulator(m, space, _DT, engine="mujoco"), space, scales_of(m, [run])
    )
    assert found is not None
    addresses = [a for p in found.parameters for a in p.addresses]
    assert "effect.coulomb.leg.1" not in addresses
    assert "effect.constant.leg.1" in addresses


def test_values_hold_where_friction_is_missing() -> None:
    """Without doubt they are wrong by many of the standard deviations with it."""
    m = mujoco.MjModel.from_xml_string(_XML)
    real = copy.copy(m)
    real.dof_frictionloss[:] = _FRICTION
    space = _space(m)
    simulator = Simulator(m, space, _DT, engine="mujoco")
    _, run = _recorded(real, 0, 0, 3)
    doubts = all_doubts(simulator, space, scales_of(m, [run]))
    assert doubts is not None
    pieces, _ = _recorded(real, 0, doubts.simulator.past_steps, 3)
    truth = space.to_unit(jnp.asarray(space.nominal))
    fit = _fits(simulator, space, doubts)

    alone, marginal = fit(pieces)
    std = np.sqrt(np.diag(covariance(marginal.distribution)))
    assert (np.abs(alone.distribution.mean - truth) / std).max() > 5.0
    assert (np.abs(marginal.distribution.mean - truth) / std).max() < 3.0
    told_of = list(told(marginal.doubted, np.asarray(marginal.doubts), 0.002))
    assert any('"j" has more dry friction' in line for line in told_of)
    assert not no_region(marginal)


def test_values_hold_where_a_zero_is_off() -> None:
    """A joint that reads 0.01 rad too much: its drive pulls to another place."""
    m = mujoco.MjModel.from_xml_string(_XML)
    space = _space(m)
    simulator = Simulator(m, space, _DT, engine="mujoco")
    _, run = _recorded(m, 0, 0, 4)
    every = all_doubts(simulator, space, scales_of(m, [run]))
    assert every is not None
    # A tilted base would pull a single joint alike.
    level = [p for p in every.parameters if "tilt" not in p.addresses[0]]
    doubts = doubted(simulator, space, level)
    assert doubts is not None
    zero = [p.addresses for p in level].index(("effect.bias.j",))
    pieces, _ = _recorded(m, 0, doubts.simulator.past_steps, 4)
    read = replace(
        pieces, qpos=pieces.qpos + _OFFSET, next_qpos=pieces.next_qpos + _OFFSET
    )
    truth = space.to_unit(jnp.asarray(space.nominal))
    alone, marginal = _fits(simulator, space, doubts)(read)
    std = np.sqrt(np.diag(covariance(marginal.distribution)))
    assert (np.abs(alone.distribution.mean - truth) / std).max() > 5.0
    assert (np.abs(marginal.distribution.mean - truth) / std).max() < 3.0
    mean, spread = np.asarray(marginal.doubts[zero]) * np.ptp(level[zero].initial)
    assert abs(mean - _OFFSET) < 4.0 * spread and spread < 0.3 * _OFFSET
    told_of = list(told(marginal.doubted, np.asarray(marginal.doubts), 0.002))
    assert any('readings of "j" have an offset' in line for line in told_of)


def test_offset_of_readings_is_that_of_what_is_predicted() -> None:
    """Exact motion, read with an offset, under a model that knows of it."""
    m = mujoco.MjModel.from_xml_string(_XML)
    space = _space(m)
    plain = Simulator(m, space, _DT, engine="mujoco")
    known = Simulator(m, space, _DT, fixed={"effect.bias.j": 0.3}, engine="mujoco")
    pieces, _ = _recorded(m, 0, 0, 5)
    nominal = jnp.asarray(space.nominal)
    before = errors(plain, plain.model(nominal), pieces)
    read = replace(pieces, qpos=pieces.qpos + 0.3, next_qpos=pieces.next_qpos + 0.3)
    after = errors(known, known.model(nominal), read)
    np.testing.assert_allclose(after, before, atol=2e-6)
    assert np.abs(errors(plain, plain.model(nominal), read)).max() > 0.01


def test_offsets_are_no_parameters_of_a_machine() -> None:
    m = mujoco.MjModel.from_xml_string(_XML)
    with pytest.raises(UserError, match=r"in what is read.*sensor_bias.*--effects"):
        declare(m, "zero", "effect.bias.j", initial=(-0.1, 0.1))


def test_no_region_is_stated_where_nothing_likely_explains_the_error() -> None:
    """A spring that grows with the cube of the angle, and a noise far below it."""
    m = mujoco.MjModel.from_xml_string(_XML)
    odd = _XML.replace('damping="0.1"', 'damping="0.1" stiffness="0 0 30"')
    space = _space(m)
    simulator = Simulator(m, space, _DT, engine="mujoco")
    doubts = doubts_of(simulator, space)
    assert doubts is not None
    past = doubts.simulator.past_steps
    fit = _fits(simulator, space, doubts)

    right, _ = _recorded(m, 0, past, 4)
    wrong, _ = _recorded(mujoco.MjModel.from_xml_string(odd), 0, past, 4)
    assert not no_region(fit(right)[1])
    found = fit(wrong)[1]
    why = no_region(found)
    assert why.startswith("no region is stated") and "times the noise" in why
    # Values still predict as the fit does.
    places = space.clip(found.fit), found.distribution.mean
    models = (simulator.model(space.to_si(unit)) for unit in places)
    fitted, stated = (errors(simulator, model, wrong) for model in models)
    assert np.std(stated) < 1.02 * np.std(fitted)
