"""Returns of a policy over whole episodes."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from easi_jax.rl.networks import PolicyParams
from easi_jax.simulation.env import Env, Model

Act = Callable[[PolicyParams, jax.Array, jax.Array, bool], jax.Array]


def evaluate(
    env: Env,
    models: Model,
    policy: PolicyParams,
    act: Act,
    keys: jax.Array,
    deterministic: bool = True,
    batched: bool = False,
) -> jax.Array:
    """Undiscounted return of one episode for each of ``keys``.

    An environment stands still once its episode is over; nothing resets.

    Args:
        env: the environment.
        models: one model for all, or with ``batched`` one for each environment
            (every leaf with a leading axis ``n``).
        policy: handed to ``act``.
        act: ``act(policy, obs, key, deterministic) -> action``.
        keys: ``(n,)``, for resets and stochastic actions.
        deterministic: act by the policy's mode.
        batched: whether ``models`` has a leading axis.

    Returns:
        ``(n,)``; NaN where the simulation did not stay finite.
    """
    return _episodes(
        env, models, policy, act, keys, deterministic, batched, lambda _: None
    )[0]


def play(
    env: Env,
    model: Model,
    policy: PolicyParams,
    act: Act,
    keys: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """`evaluate` in one model, deterministic, watched.

    Returns:
        Returns ``(n,)``; positions ``(T + 1, nq)`` of the first episode, which
        stands still at its end.
    """
    return _episodes(
        env, model, policy, act, keys, True, False, lambda s: s.physics.qpos[0]
    )


def _episodes(
    env: Env,
    models: Model,
    policy: PolicyParams,
    act: Act,
    keys: jax.Array,
    deterministic: bool,
    batched: bool,
    watch: Callable[[Any], Any],
) -> tuple[jax.Array, Any]:
    """Returns of all episodes ``(n,)``, and what ``watch`` sees of all their states
    together at every time, ``(T + 1, ...)``."""
    axis = 0 if batched else None
    k_reset, k_act = jax.vmap(jax.random.split, out_axes=1)(keys)

    def one(model: Model, state: Any, total: jax.Array, k: jax.Array) -> Any:
        done = (state.terminated + state.truncated) > 0
        new = env.step(model, state, act(policy, state.obs, k, deterministic))
        gain = jnp.where(jnp.isfinite(new.obs).all(), new.reward, jnp.nan)
        state = jax.tree.map(lambda a, b: jnp.where(done, a, b), state, new)
        return state, total + jnp.where(done, 0.0, gain)

    def step(carry: Any, ks: jax.Array) -> tuple[Any, Any]:
        each = jax.vmap(one, in_axes=(axis, 0, 0, 0))
        carry = each(models, carry[0], carry[1], ks)
        return carry, watch(carry[0])

    first = jax.vmap(env.reset, in_axes=(axis, 0))(models, k_reset)
    split = jax.vmap(lambda k: jax.random.split(k, env.episode_length), out_axes=1)
    start = (first, jnp.zeros(len(keys)))
    (_, total), seen = jax.lax.scan(step, start, split(k_act))
    join = lambda a, b: jnp.concatenate([a[None], b])  # noqa: E731
    return total, jax.tree.map(join, watch(first), seen)
