"""Every effect against MuJoCo C with it compiled in, or against its law."""

import copy
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from easi_jax.gap.predictor import opened
from easi_jax.model import effects
from easi_jax.model.effects import Effects
from easi_jax.model.parameters import ParameterSpace
from easi_jax.simulation.simulator import Simulator

ARM = """
<mujoco>
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <body name="upper">
      <joint name="shoulder" axis="0 1 0" damping="0.05" armature="0.01"/>
      <geom name="upper" type="capsule" fromto="0 0 0 0.3 0 0" size="0.03" mass="1"/>
      <body name="lower" pos="0.3 0 0">
        <joint name="elbow" axis="0 1 0" armature="0.01"/>
        <geom type="capsule" fromto="0 0 0 0.2 0 0" size="0.02" mass="0.5"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="m" joint="shoulder" ctrlrange="-6 6"/>
    <position name="p" joint="elbow" kp="10" kv="0.3"/>
  </actuator>
</mujoco>
"""
STEPS, SUBSTEPS, DELAYS = 60, 3, 30
DT = SUBSTEPS * 0.002


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(ARM)


@pytest.fixture(scope="module")
def ctrl() -> np.ndarray:
    t = DT * np.arange(STEPS)
    return np.stack([4 * np.sin(9 * t) + 2.5, 0.8 * np.sin(14 * t)], 1)


@pytest.fixture(scope="module")
def simulate(model: mujoco.MjModel, ctrl: np.ndarray) -> Any:
    simulator = Simulator(opened(model), ParameterSpace(()), DT)
    base = simulator.model(jnp.zeros(0))

    @jax.jit
    def run(e: Effects) -> jax.Array:
        m = base.replace(
            mjx=effects.with_effects(base.mjx, e), effects=e, delay_steps=DELAYS
        )
        first = simulator.start(jnp.zeros(2), jnp.zeros(2), m)

        def step(s: Any, u: jax.Array) -> Any:
            s = simulator.step(m, s, u)
            return s, s.qpos

        return jax.lax.scan(step, first, jnp.asarray(ctrl, jnp.float32))[1]

    return run


def native(m: mujoco.MjModel, ctrl: np.ndarray, act: Any = None) -> np.ndarray:
    """MuJoCo C, ``act(m, d)`` called before each physics step."""
    d = mujoco.MjData(m)
    out = []
    for u in ctrl:
        d.ctrl[:] = u
        for _ in range(SUBSTEPS):
            if act is not None:
                act(m, d)
            mujoco.mj_step(m, d)
        out.append(d.qpos.copy())
    return np.array(out)


def vector(size: int, at: int, value: float) -> jax.Array:
    return jnp.zeros(size).at[at].set(value)


def changed(model: mujoco.MjModel, **fields: Any) -> mujoco.MjModel:
    m = copy.deepcopy(model)
    for name, (index, value) in fields.items():
        getattr(m, name)[index] = value
    mujoco.mj_setConst(m, mujoco.MjData(m))
    return m


def test_none_is_the_model(simulate: Any, model: mujoco.MjModel, ctrl: Any) -> None:
    got = simulate(effects.none(model))
    np.testing.assert_allclose(got, native(model, ctrl), atol=2e-4)


def _forces(torque: Any) -> Any:
    def act(m: mujoco.MjModel, d: mujoco.MjData) -> None:
        d.qfrc_applied[1] = torque(d.qpos[1], d.qvel[1])

    return act


CASES: dict[str, tuple[dict[str, Any], dict[str, Any], Any]] = {
    "coulomb": ({"coulomb": vector(2, 1, 0.2)}, {"dof_frictionloss": (1, 0.2)}, None),
    "damping": ({"damping": vector(2, 1, 0.1)}, {"dof_damping": (1, 0.1)}, None),
    "armature": ({"armature": vector(2, 1, 0.05)}, {"dof_armature": (1, 0.06)}, None),
    "limit": (
        {"limit": jnp.array([3.0, 1e9])},
        {
            "actuator_forcerange": (0, [-3, 3]),
            "actuator_forcelimited": (0, 1),
        },
        None,
    ),
    "com": (
        {"com": jnp.zeros((3, 3)).at[2].set(jnp.array([0.02, 0.0, 0.03]))},
        {"body_ipos": (2, [0.12, 0.0, 0.03])},
        None,
    ),
    "stiffness": (
        {"stiffness": vector(2, 1, 2.0), "spring": vector(2, 1, 0.6)},
        {},
        _forces(lambda q, v: 0.6 - 2.0 * q),
    ),
    "ripple": (
        {
            "ripple": vector(2, 1, 0.3),
            "cycles": jnp.array([1.0, 9.0]),
            "phase": vector(2, 1, 0.4),
        },
        {},
        _forces(lambda q, v: 0.3 * np.sin(9 * q + 0.4)),
    ),
    "constant": ({"constant": vector(2, 1, 0.3)}, {}, _forces(lambda q, v: 0.3)),
}


@pytest.mark.parametrize("name", list(CASES))
def test_as_mujoco_c(name: str, simulate: Any, model: Any, ctrl: np.ndarray) -> None:
    fields, change, act = CASES[name]
    got = simulate(effects.none(model).replace(**fields))
    want = native(changed(model, **change), ctrl, act)
    np.testing.assert_allclose(got, want, atol=1e-3)
    assert np.abs(want - native(model, ctrl)).max() > 0.02, "the effect is visible"


def test_drag_and_stribeck_follow_their_law(
    simulate: Any, model: mujoco.MjModel, ctrl: np.ndarray
) -> None:
    def drag(m: mujoco.MjModel, d: mujoco.MjData) -> None:
        m.dof_damping[1] = 0.05 * abs(d.qvel[1])

    got = simulate(effects.none(model).replace(drag=vector(2, 1, 0.05)))
    np.testing.assert_allclose(got, native(copy.deepcopy(model), ctrl, drag), atol=1e-3)

    def stribeck(m: mujoco.MjModel, d: mujoco.MjData) -> None:
        m.dof_frictionloss[1] = 0.1 + 0.2 * np.exp(-((d.qvel[1] / 0.5) ** 2))

    e = effects.none(model).replace(
        coulomb=vector(2, 1, 0.1),
        static=vector(2, 1, 0.2),
        stribeck=jnp.array([1.0, 0.5]),
    )
    want = native(copy.deepcopy(model), ctrl, stribeck)
    np.testing.assert_allclose(simulate(e), want, atol=2e-3)


def test_bodies_resist_motion_as_its_square(
    simulate: Any, model: mujoco.MjModel, ctrl: np.ndarray
) -> None:
    def resist(m: mujoco.MjModel, d: mujoco.MjData) -> None:
        mujoco.mj_forward(m, d)
        v = np.zeros(6)
        mujoco.mj_objectVelocity(m, d, mujoco.mjtObj.mjOBJ_BODY, 2, v, 0)
        v = v[3:]  # of the center of mass
        d.xfrc_applied[2, :3] = -0.3 * np.linalg.norm(v) * v

    got = simulate(effects.none(model).replace(resistance=vector(3, 2, 0.3)))
    want = native(copy.deepcopy(model), ctrl, resist)
    np.testing.assert_allclose(got, want, atol=1e-3)
    assert np.abs(want - native(model, ctrl)).max() > 0.02, "the effect is visible"


@pytest.mark.parametrize("spread", [0.0, 1.0])
def test_payload(spread: float, simulate: Any, model: Any, ctrl: np.ndarray) -> None:
    e = effects.none(model).replace(mass=vector(3, 2, 0.4), spread=vector(3, 2, spread))
    inertia = model.body_inertia[2] * (1 + spread * 0.8)
    want = changed(model, body_mass=(2, 0.9), body_inertia=(2, inertia))
    np.testing.assert_allclose(simulate(e), native(want, ctrl), atol=1e-3)


def test_gain_also_beyond_the_command_range(
    simulate: Any, model: Any, ctrl: np.ndarray
) -> None:
    e = effects.none(model).replace(gain=jnp.array([1.4, 0.7]))
    want = copy.deepcopy(model)
    want.actuator_gainprm[:, 0] *= [1.4, 0.7]
    np.testing.assert_allclose(simulate(e), native(want, ctrl), atol=1e-3)


@pytest.mark.parametrize(
    ("field", "kp", "kv"), [("kp", 7, 0.3), ("kv", 10, 0.21), ("strength", 7, 0.21)]
)
def test_a_drive_with_other_gains(
    field: str, kp: float, kv: float, simulate: Any, model: Any, ctrl: np.ndarray
) -> None:
    """As MuJoCo compiles them; both times the target is the command."""
    e = effects.none(model).replace(**{field: jnp.array([1.0, 0.7])})
    other = ARM.replace('kp="10" kv="0.3"', f'kp="{kp}" kv="{kv}"')
    want = native(mujoco.MjModel.from_xml_string(other), ctrl)
    np.testing.assert_allclose(simulate(e), want, atol=1e-3)
    assert np.abs(want - native(model, ctrl)).max() > 0.02, "the effect is visible"


def test_tilt_turns_gravity() -> None:
    turned = effects.tilted(jnp.array([0.0, 0.0, -9.81]), jnp.array([0.0, 0.1]))
    np.testing.assert_allclose(
        turned, 9.81 * np.array([np.sin(0.1), 0, -np.cos(0.1)]), rtol=1e-5
    )
    turned = effects.tilted(jnp.array([0.0, 0.0, -9.81]), jnp.array([0.1, 0.0]))
    np.testing.assert_allclose(
        turned, 9.81 * np.array([0, -np.sin(0.1), -np.cos(0.1)]), rtol=1e-5
    )


def arrived(e: Effects, ctrl: np.ndarray, substeps: int = 4) -> np.ndarray:
    memory = effects.first_memory(DELAYS, ctrl.shape[1])
    out = []
    for u in ctrl:
        got, memory = effects.commands(e, memory, jnp.asarray(u), 0.01, substeps)
        out.append(got)
    return np.concatenate(out)


def test_delay_is_exact_in_the_mean(model: mujoco.MjModel) -> None:
    rng = np.random.default_rng(0)
    ctrl = rng.normal(size=(20, 2))
    e = effects.none(model).replace(delay=jnp.array([0.0173, 0.0]))
    got = arrived(e, ctrl)
    fine = np.repeat(ctrl[:, 0], 1000)  # of 10 us
    late = np.concatenate([np.full(1730, ctrl[0, 0]), fine])[: len(fine)]
    np.testing.assert_allclose(got[:, 0], late.reshape(-1, 250).mean(1), atol=1e-5)
    np.testing.assert_allclose(got[:, 1], np.repeat(ctrl[:, 1], 4), atol=1e-6)


def test_lag_is_a_first_order_response(model: mujoco.MjModel) -> None:
    ctrl = np.ones((30, 2))
    ctrl[0] = 0.0
    e = effects.none(model).replace(lag=jnp.array([0.05, 0.0]))
    got = arrived(e, ctrl)
    edges = 0.0025 * np.arange(len(got) - 3)
    late = 1 - np.exp(-edges / 0.05)
    mean = 1 - 0.05 / 0.0025 * -np.diff(np.exp(-edges / 0.05))
    assert late[-1] > 0.99
    np.testing.assert_allclose(got[4:, 0], mean, atol=1e-5)
    np.testing.assert_allclose(got[4:, 1], 1.0, atol=1e-6)


@pytest.mark.parametrize("jump", [0.0, 1.0])
def test_deadband(jump: float, model: mujoco.MjModel) -> None:
    ctrl = np.array([[0.1, 0.1], [-0.1, 0.1], [0.5, 0.5], [-0.5, -0.5]])
    e = effects.none(model).replace(
        deadband=jnp.array([0.2, 0.0]), jump=jnp.array([jump, 0.0])
    )
    got = arrived(e, ctrl, 1)
    beyond = 0.5 if jump else 0.3
    np.testing.assert_allclose(got[:, 0], [0, 0, beyond, -beyond], atol=1e-6)
    np.testing.assert_allclose(got[:, 1], ctrl[:, 1], atol=1e-6)
