"""A brax environment as it comes, its observation and reward kept, its physics varied.

python -m train.udr --env examples/brax_env/env.py --algorithm ppo
"""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
from brax import envs as brax_envs

from easi_jax.simulation.env import EnvState, advance, start
from envs.robot import Robot, not_finite


class InvertedPendulum(Robot):
    name, obs_size, action_size, episode_length = "inverted_pendulum", 4, 1, 500
    default_target = ("pole_mass*2",)

    def __init__(self) -> None:
        self.brax = brax_envs.get_environment("inverted_pendulum", backend="mjx")
        self.dt = float(self.brax.dt)
        model = self.brax.sys.mj_model
        super().__init__(
            {"pole_mass": "body.pole.mass", "gear": "actuator.slide.gear"}, model
        )

    def _obs(self, p):
        return self.brax._get_obs(SimpleNamespace(q=p.qpos, qd=p.qvel))

    def reset(self, model, key):
        q, v = 0.01 * jax.random.uniform(key, (2, 2), minval=-1.0)
        physics = self.simulator.start(q, v)
        return start(physics, self._obs(physics))

    def control(self, state, action):
        return 3.0 * jnp.clip(action, -1, 1)

    def step(self, model, state, action) -> EnvState:
        p = self.advance_physics(model, state, action)
        failed = (jnp.abs(p.qpos[1]) > 0.2) | not_finite(p.qpos, p.qvel)
        return advance(
            state, p, self._obs(p), jnp.ones(()), failed, self.episode_length
        )


make = InvertedPendulum
