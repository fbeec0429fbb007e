"""Episodes of many environments at once, each with its own drawn parameters."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.sharding import Mesh

from easi_jax.devices.mesh import sharded_map
from easi_jax.rl.evaluate import evaluate
from easi_jax.rl.learner import Info
from easi_jax.rl.networks import PolicyParams, act
from easi_jax.simulation.env import Env, EnvState, Model


class Tested(NamedTuple):
    """Where evaluations are made: environment, ``bind`` and ``draw`` of `Episodes`."""

    env: Env
    bind: Callable[[Any], Model]
    draw: Callable[[Any, jax.Array], Any]


@dataclass(frozen=True)
class Episodes:
    """What SAC and PPO share: resets with redrawn parameters, and evaluations.

    Attributes:
        env: the environment.
        bind: the model for parameters ``theta``; pure.
        draw: ``draw(dist, key) -> theta``, one sample of a distribution.
        num_envs: environments that step together.
        eval_envs: episodes of an evaluation.
        mesh: devices that the environments are split over; None: where the caller is.
        tested: where evaluations are made; None: where training is.
    """

    env: Env
    bind: Callable[[Any], Model]
    draw: Callable[[Any, jax.Array], Any]
    num_envs: int
    eval_envs: int
    mesh: Mesh | None = None
    tested: Tested | None = None

    def unborn(self, dist: Any, key: jax.Array) -> tuple[EnvState, Any]:
        """Environments that count as finished, so that the first step resets them.

        A program then holds one reset only, and compiles faster.

        Returns:
            States and parameters, leading axis ``num_envs``.
        """

        def episode(key: jax.Array) -> tuple[EnvState, Any]:
            theta = self.draw(dist, key)
            return self.env.reset(self.bind(theta), key), theta

        envs, theta = jax.tree.map(
            lambda x: jnp.zeros((self.num_envs, *x.shape), x.dtype),
            jax.eval_shape(episode, key),
        )
        return replace(envs, terminated=jnp.ones_like(envs.terminated)), theta

    def reset_finished(
        self, envs: EnvState, theta: Any, returns: jax.Array, dist: Any, key: jax.Array
    ) -> tuple[EnvState, Any, jax.Array]:
        """New episodes, with new parameters, where the old ones are over."""
        done = ~finite(envs) | (envs.terminated + envs.truncated > 0)
        k_draw, k_reset = jax.random.split(key)

        def local(given: Any, dist: Any) -> Any:
            done, envs, theta, returns, k_draw, k_reset = given
            drawn = jax.vmap(self.draw, (None, 0))(dist, k_draw)
            theta = _where(done, drawn, theta)
            fresh = jax.vmap(self.env.reset)(jax.vmap(self.bind)(theta), k_reset)
            return _where(done, fresh, envs), theta, jnp.where(done, 0.0, returns)

        keys = self.each(k_draw), self.each(k_reset)
        return self._split(local, (done, envs, theta, returns, *keys), dist)

    def step(self, envs: EnvState, theta: Any, action: jax.Array) -> EnvState:
        """One control step of all, ``action (num_envs, action_size)``."""

        def local(given: Any) -> EnvState:
            theta, envs, action = given
            return jax.vmap(self.env.step)(jax.vmap(self.bind)(theta), envs, action)

        return self._split(local, (theta, envs, action))

    def evaluate(
        self, policy: PolicyParams, dist: Any, key: jax.Array, due: jax.Array
    ) -> Info:
        """``eval_return`` and ``eval_nonfinite`` where ``due``, NaN and 0 elsewhere."""
        n = self.eval_envs
        env, bind, draw = self.tested or (self.env, self.bind, self.draw)

        def local(keys: Any, dist: Any, policy: PolicyParams) -> jax.Array:
            k_draw, k_run = keys
            models = jax.vmap(bind)(jax.vmap(draw, (None, 0))(dist, k_draw))
            return evaluate(env, models, policy, act, k_run, batched=True)

        def run() -> Info:
            keys = jax.vmap(lambda k: jax.random.split(k, n))(jax.random.split(key))
            returns = self._split(local, (keys[0], keys[1]), dist, policy)
            ok = jnp.isfinite(returns)
            return {
                "eval_return": mean_where(ok, returns),
                "eval_nonfinite": (~ok).sum(),
            }

        def skip() -> Info:
            shapes = jax.eval_shape(run)
            return {
                "eval_return": jnp.full((), jnp.nan, shapes["eval_return"].dtype),
                "eval_nonfinite": jnp.zeros((), shapes["eval_nonfinite"].dtype),
            }

        return jax.lax.cond(due, run, skip)

    def _split(self, fun: Callable[..., Any], split: Any, *whole: Any) -> Any:
        if self.mesh is None:
            return fun(split, *whole)
        return sharded_map(fun, self.mesh, split, *whole)

    def each(self, key: jax.Array) -> jax.Array:
        """A key for each environment."""
        return jax.random.split(key, self.num_envs)


def raw_key(key: jax.Array) -> jax.Array:
    """A key as ordinary numbers, whatever kind it was."""
    if jnp.issubdtype(key.dtype, jax.dtypes.prng_key):
        return jax.random.key_data(key)
    return key


def finite(envs: EnvState) -> jax.Array:
    """Which environments are still finite, ``(n,)`` bool."""
    return jnp.isfinite(envs.obs).all(-1) & jnp.isfinite(envs.reward)


def mean_where(mask: jax.Array, values: jax.Array) -> jax.Array:
    """Mean of ``values`` where ``mask``; NaN where none is."""
    total, count = jnp.where(mask, values, 0.0).sum(), mask.sum()
    return jnp.where(count > 0, total / jnp.maximum(count, 1), jnp.nan)


def _where(done: jax.Array, new: Any, old: Any) -> Any:
    """``new`` where ``done`` ``(n,)``, else ``old``; leaves ``(n, ...)``."""
    return jax.tree.map(
        lambda a, b: jnp.where(done.reshape(-1, *([1] * (a.ndim - 1))), a, b), new, old
    )
