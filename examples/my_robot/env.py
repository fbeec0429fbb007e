"""A robot of your own with a task to train: copy this folder and change what differs.

    python -m train.udr --env examples/my_robot/env.py --out results/my_udr
    python -m train.easi --env examples/my_robot/env.py --udr results/my_udr

A two-link arm with torque motors swings itself to a point in the plane. The model is an
argument of everything that simulates: never read numbers from ``self.mj_model`` there,
or the search would change nothing.
"""

from collections.abc import Mapping
from pathlib import Path

import jax
import jax.numpy as jnp

from easi_jax.model.mjx_model import Model
from easi_jax.rl.config import SacConfig
from easi_jax.rl.trainer import TrainingConfig
from easi_jax.simulation.action_map import ActionMap
from easi_jax.simulation.env import EnvState, advance, start
from easi_jax.simulation.step import Physics
from envs.robot import Robot, not_finite

LINK = 0.3  # m
GOAL = jnp.array([0.25, 0.3])  # m, in the plane of the arm


class TwoLink(Robot):
    """Hold the tip of a two-link arm at a point.

    Observation ``(6,)``: sine and cosine of shoulder and elbow, then their rates as
    tenths of rad/s. Action ``(2,)``: torques, as shares of the motors' range.
    """

    name = "two_link"
    obs_size = 6
    action_size = 2
    episode_length = 100
    dt = 0.02  # s, a control step; the model's timestep divides it
    k = 2.0  # UDR and the search start in [nominal / k, nominal k]
    default_target = ("upper_mass*1.5", "shoulder_damping*2")
    # For train.export: what the policy reads, and what the actuators are sent.
    obs_names = (
        *("shoulder.sin", "elbow.sin", "shoulder.cos", "elbow.cos"),
        *("shoulder.speed/10", "elbow.speed/10"),
    )
    action_map = ActionMap()
    training: Mapping[str, TrainingConfig] = {
        "sac": SacConfig(
            env_steps=40_000,
            num_envs=50,
            random_steps=1_000,
            updates_per_step=10,
            batch_size=128,
            buffer_size=40_000,
            hidden=(64, 64),
            learning_rate=1e-3,
            tau=0.05,
            discount=0.97,
            evaluate_every=100,
        )
    }

    def __init__(self) -> None:
        super().__init__(
            {
                "upper_mass": "body.upper.mass",
                "lower_mass": "body.lower.mass",
                "shoulder_damping": "joint.shoulder.damping",
                "elbow_damping": "joint.elbow.damping",
                "shoulder_gear": "actuator.shoulder.gear",
            },
            Path(__file__).parent / "model.xml",
        )

    def reset(self, model: Model, key: jax.Array) -> EnvState:
        """Anywhere, nearly at rest."""
        del model
        at, speed = jax.random.split(key)
        qpos = jax.random.uniform(at, (2,), minval=-jnp.pi, maxval=jnp.pi)
        physics = self.simulator.start(qpos, 0.1 * jax.random.normal(speed, (2,)))
        return start(physics, _observe(physics))

    def control(self, state: EnvState, action: jax.Array) -> jax.Array:
        """Torques as the actuators take them."""
        del state
        return self.action_map(None, action)

    def step(self, model: Model, state: EnvState, action: jax.Array) -> EnvState:
        """One control step; never resets."""
        physics = self.advance_physics(model, state, action)
        shoulder, elbow = physics.qpos
        tip = LINK * jnp.stack(
            [
                jnp.sin(shoulder) + jnp.sin(shoulder + elbow),
                jnp.cos(shoulder) + jnp.cos(shoulder + elbow),
            ]
        )
        away = jnp.linalg.norm(tip - GOAL)
        reward = jnp.exp(-5 * away) - 0.01 * jnp.sum(jnp.square(action))
        failed = not_finite(physics.qpos, physics.qvel)
        obs = _observe(physics)
        return advance(state, physics, obs, reward, failed, self.episode_length)


def _observe(physics: Physics) -> jax.Array:
    q = physics.qpos
    return jnp.concatenate([jnp.sin(q), jnp.cos(q), physics.qvel / 10])


def make() -> TwoLink:
    """What ``--env`` calls."""
    return TwoLink()
