"""Ballbalance: a tray on three driven legs catches a ball and keeps it in the middle.

Task, figures and parameters: EASI (NeurIPS 2024) and its reference implementation. The
action moves the knees' position targets, which are observed here (the reference hides
them, and its transitions are not Markov). MuJoCo has no coefficient of restitution: the
tray's contact damping takes its place (at 70 1/s and a stiffness of 5,000 1/s^2 the
ball comes back with a third of its speed).
"""

import jax
import jax.numpy as jnp

from easi_jax.model.mjx_model import Model
from easi_jax.simulation.action_map import ActionMap
from easi_jax.simulation.env import EnvState, advance, start
from easi_jax.simulation.step import Physics
from envs.robot import Robot, not_finite, vector

RATE = 2.0  # rad of target at action 1, in a step
LOWEST = 0.30  # m, of the ball
REST = 0.5  # m: the height that the reward asks for
KNEES = jnp.array([8, 10, 12])  # in qpos
_KNEE_SPEEDS = jnp.array([7, 9, 11])
_BALL, _BALL_SPEED = slice(13, 16), slice(12, 15)

ADDRESSES = {
    "ball_mass": "body.ball.mass",
    "tray_mass": "body.tray.mass",
    "tray_friction": "geom.tray.friction",
    "tray_contact_damping": "geom.tray.contact_damping",
    "knee_kp": "actuator.knee_*.kp",
    "knee_kv": "actuator.knee_*.kv",
    "knee_friction": "joint.knee_*.frictionloss",
}


class Ballbalance(Robot):
    """Keep the ball on the tray for 500 steps of 0.1 s.

    Observation ``(15,)``: 3 knee angles [rad] and speeds [rad/s], position [m] and
    velocity [m/s] of the ball, 3 knee targets [rad]. Action ``(3,)``: change of the
    targets, in units of 2 rad. Reward ``1 / (1 + d)^2 / (1 + |ball velocity|)`` with
    ``d^2 = x^2 + y^2 + 2 (z - 0.5)^2``; the episode ends where the ball is below 0.3 m.
    """

    name = "ballbalance"
    obs_size = 15
    action_size = 3
    episode_length = 500
    dt = 0.1
    default_target = ("ball_mass*0.5",)
    obs_names = (
        *(f"knee_{i}.angle" for i in (1, 2, 3)),
        *(f"knee_{i}.speed" for i in (1, 2, 3)),
        *vector("ball.position"),
        *vector("ball.velocity"),
        *(f"knee_{i}.target" for i in (1, 2, 3)),
    )

    def __init__(self, episode_length: int = 500) -> None:
        super().__init__(ADDRESSES)
        self.episode_length = episode_length
        low, high = self.mj_model.actuator_ctrlrange.T
        targets = tuple(range(self.obs_size - self.action_size, self.obs_size))
        self.action_map = ActionMap(RATE, low=low, high=high, added=targets)

    def reset(self, model: Model, key: jax.Array) -> EnvState:
        """The tray at its place; a ball is thrown at it from above.

        1 to 2 m high, up to 0.5 m off the axis, falling at 2 m/s and moving inward at
        up to 2 m/s, slower the nearer it is to the axis.
        """
        del model
        k_far, k_way, k_high, k_fast = jax.random.split(key, 4)
        far = jax.random.uniform(k_far, minval=0.001, maxval=0.5)
        way = jax.random.uniform(k_way, maxval=2 * jnp.pi)
        out = jnp.stack([jnp.cos(way), jnp.sin(way)])
        inward = (far - 0.001) / 0.499 * jax.random.uniform(k_fast, maxval=2.0)
        height = jax.random.uniform(k_high, minval=1.0, maxval=2.0)
        qpos = jnp.asarray(self.mj_model.qpos0)
        qpos = qpos.at[_BALL].set(jnp.append(far * out, height))
        qvel = jnp.zeros(self.mj_model.nv)
        qvel = qvel.at[_BALL_SPEED].set(jnp.append(-inward * out, -2.0))
        physics = self.simulator.start(qpos, qvel)
        targets = jnp.zeros(3)
        return start(physics, self.observe(physics, targets), targets)

    def control(self, state: EnvState, action: jax.Array) -> jax.Array:
        """The knee targets ``(3,)`` [rad] that an action in [-1, 1] leads to."""
        return self.action_map(state.obs, action)

    def observe(self, physics: Physics, targets: jax.Array) -> jax.Array:
        """Observation ``(15,)`` of a physics state."""
        q, v = physics.qpos, physics.qvel
        return jnp.concatenate(
            [q[KNEES], v[_KNEE_SPEEDS], q[_BALL], v[_BALL_SPEED], targets]
        )

    def step(self, model: Model, state: EnvState, action: jax.Array) -> EnvState:
        """One control step of 0.1 s; never resets."""
        targets = self.control(state, action)
        physics = self.advance_physics(model, state, action)
        obs = self.observe(physics, targets)
        x, y, z = physics.qpos[_BALL]
        distance = jnp.sqrt(x**2 + y**2 + 2 * (z - REST) ** 2)
        speed = jnp.linalg.norm(physics.qvel[_BALL_SPEED])
        reward = 1 / (1 + distance) ** 2 / (1 + speed)
        failed = (z < LOWEST) | not_finite(physics.qpos, physics.qvel)
        reward = jnp.where(jnp.isfinite(reward), reward, 0.0)
        return advance(
            state, physics, obs, reward, failed, self.episode_length, targets
        )
