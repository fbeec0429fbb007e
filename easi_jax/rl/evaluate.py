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
        return _episode(env, model, policy, act, key, deterministic, _nothing)[0]

    keys = jax.random.split(key, num_envs)
    return jax.vmap(episode, in_axes=(0 if batched else None, 0))(models, keys)


def play(
    env: Env,
    model: Model,
    policy: PolicyParams,
    act: Act,
    key: jax.Array,
    num_envs: int,
) -> tuple[jax.Array, jax.Array]:
    """`evaluate` in one model, deterministic, watched.

    Returns:
        Returns ``(num_envs,)``; positions ``(T + 1, nq)`` of the first episode, which
        stands still at its end.
    """

    def episode(key: jax.Array) -> Any:
        return _episode(env, model, policy, act, key, True, lambda s: s.physics.qpos)

    returns, qpos = jax.vmap(episode)(jax.random.split(key, num_envs))
    return returns, qpos[0]


def _nothing(state: Any) -> None:
    del state


def _episode(
    env: Env,
    model: Model,
    policy: PolicyParams,
    act: Act,
    key: jax.Array,
    deterministic: bool,
    watch: Callable[[Any], Any],
) -> tuple[jax.Array, Any]:
    """Return of one episode; what ``watch`` sees of its states, ``(T + 1, ...)``."""
    k_reset, k_act = jax.random.split(key)

    def step(carry: Any, k: jax.Array) -> tuple[Any, Any]:
        state, total = carry
        done = (state.terminated + state.truncated) > 0
        new = env.step(model, state, act(policy, state.obs, k, deterministic))
        gain = jnp.where(jnp.isfinite(new.obs).all(), new.reward, jnp.nan)
        state = jax.tree.map(lambda a, b: jnp.where(done, a, b), state, new)
        return (state, total + jnp.where(done, 0.0, gain)), watch(state)

    first = env.reset(model, k_reset)
    keys = jax.random.split(k_act, env.episode_length)
    (_, total), seen = jax.lax.scan(step, (first, jnp.zeros(())), keys)
    whole = jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), watch(first), seen)
    return total, whole
