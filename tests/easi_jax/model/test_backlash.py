"""Play against MuJoCo C, where rotor and load are two bodies between stops."""

from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from easi_jax.gap.predictor import opened
from easi_jax.model import backlash, effects
from easi_jax.model.effects import Effects
from easi_jax.model.parameters import ParameterSpace
from easi_jax.simulation.simulator import Simulator

ROTOR, LOAD, WIDTH, DT, SUBSTEPS = 0.4, 0.6, 0.03, 0.01, 10
OWNER = f"""
<mujoco>
  <option timestep="{DT / SUBSTEPS}" integrator="implicitfast"/>
  <worldbody>
    <body name="cart">
      <joint name="x" type="slide" axis="1 0 0" damping="0.3" armature="{ROTOR}"/>
      <geom type="box" size="0.1 0.1 0.1" mass="{LOAD}"/>
    </body>
  </worldbody>
  <actuator>{{drive}}</actuator>
</mujoco>
"""
# The gap is a joint of its own; its stops are stiff.
TRUTH = f"""
<mujoco>
  <option timestep="0.0001" integrator="implicitfast" gravity="0 0 0"/>
  <worldbody>
    <body name="rotor">
      <joint name="r" type="slide" axis="1 0 0"/>
      <geom type="box" size="0.1 0.1 0.1" mass="{ROTOR}" contype="0" conaffinity="0"/>
      <body name="load">
        <joint name="gap" type="slide" axis="1 0 0" range="{-WIDTH / 2} {WIDTH / 2}"
               limited="true" solreflimit="0.0004 1" solimplimit="0.99 0.9999 0.0001"/>
        <geom type="box" size="0.1 0.1 0.1" mass="{LOAD}" contype="0" conaffinity="0"/>
      </body>
    </body>
  </worldbody>
</mujoco>
"""
MOTOR = '<motor name="m" joint="x" gear="2"/>'
SERVO = '<position name="m" joint="x" kp="60" kv="6"/>'


def owner(drive: str) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(OWNER.format(drive=drive))


def native(law: Any, ctrl: np.ndarray) -> np.ndarray:
    """Positions of the load; ``law(u, q, v)`` is the force on the rotor."""
    m = mujoco.MjModel.from_xml_string(TRUTH)
    d = mujoco.MjData(m)
    out = []
    for u in ctrl:
        for _ in range(round(DT / m.opt.timestep)):
            q, v = d.qpos.sum(), d.qvel.sum()
            push = law(u, q, v)
            # The gap's joint force is on the load and back on the rotor.
            d.qfrc_applied[:] = [push - 0.3 * v, -0.3 * v]
            mujoco.mj_step(m, d)
        out.append(d.qpos.sum())
    return np.array(out)


def simulated(drive: str, ctrl: np.ndarray, **fields: Any) -> np.ndarray:
    m = owner(drive)
    simulator = Simulator(opened(m), ParameterSpace(()), DT)
    base = simulator.model(jnp.zeros(0))

    @jax.jit
    def run(e: Effects) -> jax.Array:
        mjx = effects.with_effects(base.mjx, e)
        model = base.replace(mjx=mjx, effects=e, delay_steps=1)
        first = simulator.start(jnp.zeros(1), jnp.zeros(1), model)

        def step(s: Any, u: jax.Array) -> Any:
            s = simulator.step(model, s, u)
            return s, s.qpos[0]

        return jax.lax.scan(step, first, jnp.asarray(ctrl, jnp.float32))[1]

    return np.asarray(run(effects.none(m).replace(**fields)))


def play(width: float) -> dict[str, jax.Array]:
    return {"width": jnp.array([width]), "rotor": jnp.array([ROTOR])}


@pytest.mark.parametrize(
    ("drive", "law"),
    [
        (MOTOR, lambda u, q, v: 2 * u),
        (SERVO, lambda u, q, v: 60 * (u - q) - 6 * v),
    ],
    ids=["motor", "servo"],
)
def test_as_two_bodies_between_stops(drive: str, law: Any) -> None:
    t = DT * np.arange(200)[:, None]
    size = 1.0 if drive == MOTOR else 0.15
    ctrl = size * np.cos(7 * t) * (1 - 0.5 * (t > 1))
    want = native(law, ctrl[:, 0])
    got = simulated(drive, ctrl, **play(WIDTH))
    rigid = simulated(drive, ctrl)
    effect = np.sqrt(np.mean((rigid - want) ** 2))
    error = np.sqrt(np.mean((got - want) ** 2))
    assert effect > 0.004, "the play is visible"
    # A servo's loop also sees that a step's positions are half a step ahead.
    assert error < 0.08 * effect


def test_no_play_is_the_model() -> None:
    ctrl = np.cos(7 * DT * np.arange(100))[:, None]
    np.testing.assert_array_equal(
        simulated(MOTOR, ctrl, **play(0.0)), simulated(MOTOR, ctrl)
    )
    # Teeth without a gap are a rigid shaft.
    tight = simulated(MOTOR, ctrl, **play(1e-6))
    np.testing.assert_allclose(tight, simulated(MOTOR, ctrl), atol=5e-4)


def test_momentum_is_kept() -> None:
    """Nothing is lost to the teeth: a push moves rotor and load as one mass."""
    m = owner(MOTOR.replace('gear="2"', 'gear="1"'))
    drives = backlash.geared(opened(m))
    assert drives == {0: [0]}
    rotor = backlash.first_rotor([(0, 0)], jnp.zeros(1), jnp.zeros(1))
    q, v, h = 0.0, 0.0, 0.002
    turn = jax.jit(
        lambda rotor, q, v: backlash.pushes(
            opened(m),
            drives,
            rotor,
            jnp.array([WIDTH]),
            jnp.array([ROTOR]),
            jnp.array([LOAD]),
            (q[None], v[None]),
            jnp.array([1.0]),
            jnp.array(h),
        )
    )
    for _ in range(400):
        rotor = turn(rotor, jnp.array(q), jnp.array(v))
        v += h * float(rotor.push[0]) / LOAD
        q += h * v
    total = ROTOR * float(rotor.speed[0]) + LOAD * v
    assert total == pytest.approx(400 * h, rel=1e-3)
    assert v == pytest.approx(float(rotor.speed[0]), rel=1e-3)
