"""Cartpole demonstrations, simulated once for all tests that fit them."""

from typing import Any

import jax
import jax.numpy as jnp
import pytest

from easi_jax.data.segments import Segments
from easi_jax.simulation import rollout
from envs.cartpole import Cartpole


@pytest.fixture(scope="session")
def cartpole() -> Cartpole:
    return Cartpole()


@pytest.fixture(scope="session")
def trajectories(cartpole: Cartpole) -> Segments:
    """24 noise-free trajectories of 60 steps under a restless stabilizer."""

    def act(obs: jax.Array, key: jax.Array) -> jax.Array:
        x, v, angle, rate = obs
        u = (1.5 * x + 0.6 * v + 3.0 * angle + 0.55 * rate) / 0.4
        return jnp.clip(u[None] + 0.5 * jax.random.normal(key, (1,)), -1.0, 1.0)

    def run(key: jax.Array) -> Any:
        return rollout.collect(cartpole, cartpole.model(), act, key, 24, 60)

    return jax.jit(run)(jax.random.key(0))
