"""A robot with a task of any model: rest where it is; for `benchmarks.commands`."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco

from easi_jax.errors import UserError
from easi_jax.io.models.completed import as_read
from easi_jax.model import Model
from easi_jax.model.parameter_proposal import propose
from easi_jax.rl.config import SacConfig
from easi_jax.simulation.action_map import ActionMap
from easi_jax.simulation.env import EnvState, advance, start
from easi_jax.simulation.step import Physics
from envs.robot import Robot, not_finite

_START = 0.1  # rad/s, m/s: spread of the velocities that an episode starts with


class Resting(Robot):
    """Observation ``(nq + nv,)``, action ``(nu,)``: shares of the commands' ranges."""

    name = "resting"
    episode_length = 20
    dt = 0.008
    action_map = ActionMap()
    training: Mapping[str, Any] = {
        "sac": SacConfig(
            env_steps=400,
            num_envs=20,
            random_steps=100,
            updates_per_step=1,
            batch_size=32,
            buffer_size=1000,
            hidden=(16, 16),
            evaluate_every=10,
        )
    }

    def __init__(self, path: Path) -> None:
        super().__init__({"varied": varied(as_read(path).compile())}, path)
        m = self.mj_model
        self.obs_size, self.action_size = m.nq + m.nv, m.nu

    def reset(self, model: Model, key: jax.Array) -> EnvState:
        """The model's own pose, moving a little."""
        del model
        m = self.mj_model
        moving = _START * jax.random.normal(key, (m.nv,))
        physics = self.simulator.start(jnp.asarray(m.qpos0), moving)
        return start(physics, _seen(physics))

    def control(self, state: EnvState, action: jax.Array) -> jax.Array:
        """Shares of the commands' ranges."""
        del state
        return self.action_map(None, action)

    def step(self, model: Model, state: EnvState, action: jax.Array) -> EnvState:
        """One control step."""
        p = self.advance_physics(model, state, action)
        reward = jnp.exp(-jnp.sum(p.qvel**2))
        failed = not_finite(p.qpos, p.qvel)
        return advance(state, p, _seen(p), reward, failed, self.episode_length)


def varied(m: mujoco.MjModel) -> str:
    """The address of a number above zero in the model: the first that is proposed, or
    gravity where none is."""
    try:
        proposed = [p.parameter for p in propose(m, tie=False)]
    except UserError:  # nothing that has a name
        proposed = []
    return next((p.addresses[0] for p in proposed if p.nominal > 0), "option.gravity")


def _seen(p: Physics) -> jax.Array:
    return jnp.concatenate([p.qpos, p.qvel])
