"""Cartpole: a position-controlled cart with a free pole, balanced upright.

Task, figures and parameters: EASI (NeurIPS 2024), section 4 and its reference
implementation. Coulomb friction is MuJoCo's `frictionloss` (N, N m) and the cart's
speed limit clips the velocity after each physics step, since MuJoCo has none.
"""

import jax
import jax.numpy as jnp
import mujoco

from easi_jax.model.mjx_model import Model
from easi_jax.model.parameters import Parameter, ParameterSpace
from easi_jax.simulation.action_map import ActionMap
from easi_jax.simulation.engine import of_built_in
from easi_jax.simulation.env import EnvState, advance, start
from easi_jax.simulation.simulator import Simulator
from easi_jax.simulation.step import Physics
from envs.robot import model_file

TARGET_RANGE = 0.2  # m of cart target at action 1
FAIL_X = 0.18  # m
FAIL_ANGLE = jnp.pi / 2  # rad

# name, address, nominal, unit
_PARAMETERS = (
    ("pole_length", "geom.pole.length", 0.3, "m"),
    ("pole_mass", "body.pole.mass", 0.1, "kg"),
    ("cart_mass", "body.cart.mass", 0.3, "kg"),
    ("pole_friction", "joint.pole.frictionloss", 3e-4, "N m"),
    ("pole_damping", "joint.pole.damping", 2e-3, "N m s/rad"),
    ("pole_armature", "joint.pole.armature", 5e-3, "kg m^2"),
    ("cart_friction", "joint.cart.frictionloss", 1e-2, "N"),
    ("cart_kp", "actuator.cart.kp", 20.0, "N/m"),
    ("cart_kv", "actuator.cart.kv", 0.3, "N s/m"),
    ("cart_force_limit", "actuator.cart.force_limit", 5.0, "N"),
    ("cart_speed_limit", "joint.cart.speed_limit", 0.6, "m/s"),
)


def space(k: float = 3.0) -> ParameterSpace:
    """The 11 parameters; they start in [nominal / k, k nominal]."""
    return ParameterSpace(
        tuple(
            Parameter(
                name=name,
                addresses=(address,),
                nominal=nominal,
                initial=(nominal / k, nominal * k),
                bounds=(0.0 if "friction" in name else 1e-3 * nominal, 1e3 * nominal),
                unit=unit,
                log=True,
            )
            for name, address, nominal, unit in _PARAMETERS
        )
    )


class Cartpole:
    """Balance the pole for 200 steps of 20 ms.

    Observation ``(4,)``: cart position [m] and speed [m/s], pole angle [rad] and
    rate [rad/s]. Action ``(1,)``: the cart's target position, in units of 0.2 m.
    Reward ``1 - angle^2 - 0.01 |speed| - 0.005 |rate|``; -2 and the end where the
    cart is beyond 0.18 m or the pole beyond 90 degrees.
    """

    name = "cartpole"
    obs_names = ("x", "v", "angle", "rate")
    obs_size = 4
    action_size = 1
    episode_length = 200
    dt = 0.02
    default_target = ("cart_kp*0.5",)
    action_map = ActionMap(scale=TARGET_RANGE)

    def __init__(self) -> None:
        text = model_file("cartpole").read_text()
        self.mj_model = mujoco.MjModel.from_xml_string(text)
        self.space = space()
        self.simulator = Simulator(
            *(self.mj_model, self.space, self.dt), engine=of_built_in(self.mj_model)
        )

    def model(self, theta: jax.Array | None = None) -> Model:
        """The model at ``theta`` ``(11,)`` in SI units; nominal without it."""
        return self.simulator.model(
            jnp.asarray(self.space.nominal) if theta is None else theta
        )

    def reset(self, model: Model, key: jax.Array) -> EnvState:
        """x and angle uniform in +-0.1, speed and rate in +-0.2."""
        del model
        scale = jnp.array([0.1, 0.1, 0.2, 0.2])
        s = jax.random.uniform(key, (4,), minval=-scale, maxval=scale)
        physics = self.simulator.start(s[:2], s[2:])
        return start(physics, self.observe(physics))

    def control(self, state: EnvState, action: jax.Array) -> jax.Array:
        """The actuator's ctrl ``(1,)`` [m] for an action in [-1, 1]."""
        del state
        return self.action_map(None, action)

    def observe(self, physics: Physics) -> jax.Array:
        """Observation ``(4,)`` of a physics state."""
        (x, angle), (v, rate) = physics.qpos, physics.qvel
        return jnp.stack([x, v, angle, rate])

    def step(self, model: Model, state: EnvState, action: jax.Array) -> EnvState:
        """One control step of 20 ms; never resets."""
        physics = self.simulator.step(model, state.physics, self.control(state, action))
        obs = self.observe(physics)
        x, v, angle, rate = obs
        failed = (jnp.abs(x) > FAIL_X) | (jnp.abs(angle) > FAIL_ANGLE)
        failed |= ~jnp.isfinite(obs).all()
        upright = 1 - angle**2 - 0.01 * jnp.abs(v) - 0.005 * jnp.abs(rate)
        reward = jnp.where(failed, -2.0, upright)
        return advance(state, physics, obs, reward, failed, self.episode_length)
