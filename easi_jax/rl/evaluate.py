"""Returns of a policy over whole episodes."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from easi_jax.env import Env, Model
from easi_jax.rl.networks import PolicyParams

Act = Callable[[PolicyParams, jax.Array, jax.Array, bool], jax.Array]


def evaluate(
    env: Env,
    models: Model,
    policy: PolicyParams,
    act: Act,
    key: jax.Array,
    num_envs: int,
    deterministic: bool = True,
    batched: bool = False,
) -> jax.Array:
    """Undiscounted return of one episode in each of ``num_envs`` environments.

    An environment stands still once its episode is over; nothing resets.

    Args:
        env: the environment.
        models: one model for all, or with ``batched`` one for each environment
            (every leaf with a leading axis ``num_envs``).
        policy: handed to ``act``.
        act: ``act(policy, obs, key, deterministic) -> action``.
        key: for resets and stochastic actions.
        num_envs: number of episodes.
        deterministic: act by the policy's mode.
        batched: whether ``models`` has a leading axis.

    Returns:
        ``(num_envs,)``; NaN where the simulation did not stay finite.
    """

    def episode(model: Model, key: jax.Array) -> jax.Array:
        k_reset, k_act = jax.random.split(key)

        def step(carry: Any, k: jax.Array) -> tuple[Any, None]:
            state, total = carry
            done = (state.terminated + state.truncated) > 0
            new = env.step(model, state, act(policy, state.obs, k, deterministic))
            gain = jnp.where(jnp.isfinite(new.obs).all(), new.reward, jnp.nan)
            state = jax.tree.map(lambda a, b: jnp.where(done, a, b), state, new)
            return (state, total + jnp.where(done, 0.0, gain)), None

        start = (env.reset(model, k_reset), jnp.zeros(()))
        keys = jax.random.split(k_act, env.episode_length)
        (_, total), _ = jax.lax.scan(step, start, keys)
        return total

    keys = jax.random.split(key, num_envs)
    return jax.vmap(episode, in_axes=(0 if batched else None, 0))(models, keys)


def record(
    env: Env, model: Model, policy: PolicyParams, act: Act, key: jax.Array
) -> jax.Array:
    """Positions ``(T + 1, nq)`` of one episode, deterministic; it stands at its end."""

    def step(state: Any, k: jax.Array) -> tuple[Any, jax.Array]:
        done = (state.terminated + state.truncated) > 0
        new = env.step(model, state, act(policy, state.obs, k, True))
        state = jax.tree.map(lambda a, b: jnp.where(done, a, b), state, new)
        return state, state.physics.qpos

    k_reset, k_act = jax.random.split(key)
    first = env.reset(model, k_reset)
    _, qpos = jax.lax.scan(step, first, jax.random.split(k_act, env.episode_length))
    return jnp.concatenate([first.physics.qpos[None], qpos])
