"""Residuals and their slopes on native MuJoCo, against a pendulum written by hand."""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from easi_jax.data.segments import Segments
from easi_jax.model.parameters import ParameterSpace, declare
from easi_jax.simulation import open_loop
from easi_jax.simulation.simulator import Simulator
from easi_jax.simulation.slopes import linearized, parts_and_turns, residuals

_H, _LENGTH, _STEPS = 0.01, 0.3, 20  # s, m, of one physics step each
# A point at the end of a light rod, with a little inertia of its own.
_XML = f"""<mujoco>
  <option timestep="{_H}" integrator="implicitfast"/>
  <worldbody>
    <body name="arm">
      <inertial pos="0 0 -{_LENGTH}" mass="0.5" diaginertia="1e-3 1e-3 1e-3"/>
      <joint name="hinge" axis="0 1 0" damping="0.1" armature="0.01"/>
      <geom type="sphere" size="0.02" contype="0" conaffinity="0"/>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="hinge" gear="2"/></actuator>
</mujoco>"""
_PLACES = {
    "mass": "body.arm.mass",
    "damping": "joint.hinge.damping",
    "armature": "joint.hinge.armature",
    "gear": "actuator.motor.gear",
    "constant": "effect.constant.hinge",
}
_TRUE = np.array([0.5, 0.1, 0.01, 2.0, 0.1])


@pytest.fixture(scope="module")
def native() -> tuple[Simulator, ParameterSpace]:
    m = mujoco.MjModel.from_xml_string(_XML)
    space = ParameterSpace(
        tuple(
            declare(m, name, address, nominal=value, initial=(value / 2, 2 * value))
            for (name, address), value in zip(_PLACES.items(), _TRUE, strict=True)
        )
    )
    return Simulator(m, space, _H, engine="mujoco"), space


def _pendulum(theta: Any, q: Any, v: Any, ctrl: np.ndarray) -> np.ndarray:
    """Angles and speeds after each step, ``(T, 2)``; of complex numbers as well."""
    mass, damping, armature, gear, constant = theta
    inertia = mass * _LENGTH**2 + 1e-3 * mass / 0.5 + armature
    out = []
    for u in ctrl:
        torque = gear * u + constant - mass * 9.81 * _LENGTH * np.sin(q) - damping * v
        v = v + _H * torque / (inertia + _H * damping)  # implicit in the damping
        q = q + _H * v
        out.append([q, v])
    return np.array(out)


def _piece(seed: int = 0) -> Segments:
    rng = np.random.default_rng(seed)
    f32 = jnp.float32
    return Segments(
        qpos=jnp.asarray(rng.normal(size=1), f32),
        qvel=jnp.asarray(rng.normal(size=1), f32),
        ctrl=jnp.asarray(rng.normal(size=(_STEPS, 1)), f32),
        next_qpos=jnp.zeros((_STEPS, 1)),
        next_qvel=jnp.zeros((_STEPS, 1)),
        weight=jnp.ones(()),
    )


def _by_hand(space: ParameterSpace, unit: np.ndarray, piece: Segments) -> Any:
    """Residuals and slopes, these by complex steps."""
    ctrl = np.asarray(piece.ctrl, float)[:, 0]
    low, high = space.initial

    def at(x: np.ndarray) -> np.ndarray:
        theta = low * (high / low) ** (unit + x[:5])
        q, v = (float(s[0]) for s in (piece.qpos, piece.qvel))
        return _pendulum(theta, q + x[5], v + x[6], ctrl)

    ways = 1e-30j * np.eye(7)
    return at(np.zeros(7)), np.stack([np.imag(at(w)) / 1e-30 for w in ways], -1)


def test_slopes_are_those_of_a_pendulum_by_hand(native: Any) -> None:
    """Along the start as exact as the single precision in which they are given; along a
    parameter, one way only, to the share of its step that a difference leaves out."""
    simulator, space = native
    piece = _piece()
    unit = np.asarray(space.to_unit(1.1 * _TRUE), np.float32)

    @jax.jit
    def found(unit: jax.Array, piece: Segments) -> Any:
        r, slopes = linearized(simulator, space, unit, jnp.zeros(2), piece)
        # What crosses in single precision leaves of a difference.
        step = 4e-3 * jnp.eye(5)
        model = jax.vmap(lambda du: simulator.model(space.to_si(unit + du)))
        one = jax.tree.map(lambda x: x[None], piece)

        def rough(model: Any) -> jax.Array:
            return open_loop.errors(simulator, model, one)[0]

        up, down = (jax.vmap(rough)(model(s * step)) for s in (1, -1))
        return r, slopes, jnp.moveaxis(down - up, 0, -1) / 8e-3

    r, slopes, rough = found(jnp.asarray(unit), piece)
    known, exact = _by_hand(space, unit.astype(float), piece)
    assert r.dtype == slopes.dtype == jnp.float32
    np.testing.assert_allclose(r, known, rtol=1e-6, atol=1e-7)
    size = np.abs(exact).max((0, 1))
    off = np.abs(slopes - exact).max((0, 1)) / size
    assert off[5:].max() < 5e-7  # of a start: both ways
    assert off[:5].max() < 3e-5
    assert (np.abs(rough - exact[..., :5]).max((0, 1)) / size[:5]).max() > 5e-5


def test_a_value_that_is_fixed_leaves_the_others_in_doubles() -> None:
    """Mass writes inertia, which a fixed mass has left in single precision."""
    tip = """<body name="tip" pos="0 0 -0.3"><inertial pos="0 0 -0.1" mass="0.2"
diaginertia="0.02 0.02 0.02"/></body></body></worldbody>"""
    m = mujoco.MjModel.from_xml_string(
        _XML.replace("1e-3 1e-3 1e-3", "0.1 0.1 0.1").replace(
            "</body>\n  </worldbody>", tip
        )
    )
    places = {"mass": "body.arm.mass", "gain": "effect.gain.motor"}
    space = ParameterSpace(
        tuple(
            declare(m, n, at, nominal=v, initial=(v / 2, 2 * v))
            for (n, at), v in zip(places.items(), (0.5, 0.8), strict=True)
        )
    )
    given = space.to_unit(np.array([0.6, 0.9])), _piece()

    def slopes(**fixed: Any) -> np.ndarray:
        simulator = Simulator(m, space, _H, engine="mujoco", **fixed)
        found = jax.jit(
            lambda u, piece: linearized(simulator, space, u, jnp.zeros(2), piece)[1]
        )(*given)
        return np.asarray(found)

    free, fixed = slopes(), slopes(fixed={"body.tip.mass": 0.2})
    size = np.abs(free).max((0, 1))
    assert (np.abs(fixed - free).max((0, 1)) < 1e-5 * size).all()


def test_jax_is_in_single_precision_again(native: Any) -> None:
    simulator, space = native
    unit = space.to_unit(_TRUE)
    r = residuals(simulator, space, unit, jnp.zeros(2), _piece())
    assert r.dtype == jnp.zeros(1).dtype == jnp.float32


def test_the_first_steps_alone(native: Any) -> None:
    """What is simulated of a piece may be decided by a program; one program for all."""
    simulator, space = native
    piece, unit = _piece(), space.to_unit(_TRUE)
    run = jax.jit(lambda k: residuals(simulator, space, unit, jnp.zeros(2), piece, k))
    whole = np.asarray(run(_STEPS))
    part = np.asarray(run(7))
    np.testing.assert_array_equal(part[:7], whole[:7])
    start = [float(piece.qpos[0]), float(piece.qvel[0])]
    np.testing.assert_allclose(part[7:], np.tile(start, (_STEPS - 7, 1)), rtol=1e-6)


def test_at_a_bound_the_slope_is_one_sided(native: Any) -> None:
    simulator, space = native
    gear = space.names.index("gear")
    low, high = space.initial
    bounded = [*space.parameters]
    bounded[gear] = replace(bounded[gear], bounds=(low[gear], high[gear]))
    edge = ParameterSpace(tuple(bounded))
    unit = np.array(edge.to_unit(_TRUE))
    unit[gear] = 1.0
    piece = _piece()
    given = jnp.asarray(unit), jnp.zeros(2), piece
    slopes = jax.jit(lambda *x: linearized(simulator, edge, *x)[1])(*given)
    exact = _by_hand(edge, unit.astype(float), piece)[1]
    size = np.abs(exact[..., gear]).max()
    assert np.abs(slopes[..., gear] - exact[..., gear]).max() < 1e-3 * size


def test_starts_of_separate_parts_are_moved_at_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Two legs of two joints in a stand, one with a slow drive: the slopes are those
    of one number after the other, from fewer simulations."""
    leg = """<body pos="0 {y} 1"><joint name="{n}1" axis="1 0 0" damping="0.1"/>
<geom size="0.05" mass="1" pos="0 0.1 -0.1"/><body pos="0 0 -0.3"><joint name="{n}2"
axis="0 1 0" damping="0.1"/><geom size="0.05" mass="1" pos="0.05 0 -0.2"/></body>
</body>"""
    m = mujoco.MjModel.from_xml_string(f"""<mujoco>
  <default><geom contype="0" conaffinity="0"/></default>
  <worldbody>{leg.format(n="a", y=0)}{leg.format(n="b", y=1)}</worldbody>
  <actuator><motor joint="a1"/><motor joint="a2"/><motor joint="b1"/>
  <general joint="b2" dyntype="filter" dynprm="0.05"/></actuator></mujoco>""")
    place = declare(m, "damping", "joint.*.damping", nominal=0.1, initial=(0.05, 0.2))
    space = ParameterSpace((place,))
    simulator = Simulator(m, space, _H, engine="mujoco")
    rng = np.random.default_rng(1)
    zero = jnp.zeros((_STEPS, 4))
    piece = Segments(
        qpos=jnp.asarray(rng.normal(size=4), jnp.float32),
        qvel=jnp.asarray(rng.normal(size=4), jnp.float32),
        ctrl=jnp.asarray(rng.normal(size=(_STEPS, 4)), jnp.float32),
        next_qpos=zero,
        next_qvel=zero,
        weight=jnp.ones(()),
        act=jnp.zeros(1),
    )

    def found() -> tuple[np.ndarray, int]:
        given = space.to_unit(np.array([0.1])), jnp.zeros(9), piece
        slopes = jax.jit(lambda *x: linearized(simulator, space, *x)[1])(*given)
        return np.asarray(slopes), int(parts_and_turns(simulator, piece, 9)[1].max())

    at_once, most = found()
    monkeypatch.setattr(
        "easi_jax.simulation.slopes.start_parts", lambda _: np.zeros(9, int)
    )
    alone, count = found()
    assert (most, count) == (4, 8)
    np.testing.assert_allclose(at_once, alone, atol=1e-5 * np.abs(alone).max())
    assert np.abs(at_once[:, [2, 3]][..., 1]).max() == 0, "the other leg stays"
