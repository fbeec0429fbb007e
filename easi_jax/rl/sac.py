"""Soft actor-critic as pure functions; the parameters of the model are redrawn.

One ``step`` moves all environments by one control step and makes some gradient
updates; one scan of it is a training.

How episodes end: a transition keeps the true terminal observation. Termination
stops the bootstrap (``discount`` 0); at a time limit the value of the terminal
observation is bootstrapped like any other. Resets happen here, before a step, never
in the environment. brax's ``truncation`` mask is therefore not needed for time
limits; it marks transitions of simulations that are no longer finite, so that the
critics never see them.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
from brax.training import types
from brax.training.acme import running_statistics

from easi_jax.env import Env, EnvState, Model
from easi_jax.rl.buffer import RingQueue
from easi_jax.rl.config import SacConfig
from easi_jax.rl.evaluate import evaluate
from easi_jax.rl.learner import Info, Learner, LearnerState
from easi_jax.rl.networks import PolicyParams, act


@flax.struct.dataclass
class SacState:
    """All state of a training, ordinary arrays only; continuing from it is exact.

    Attributes:
        learner: networks and optimizers.
        normalizer: running statistics of observations.
        buffer: replay memory, brax's ``ReplayBufferState``.
        envs: environment states, leading axis ``num_envs``.
        theta: parameters of each environment's model, leading axis ``num_envs``.
        returns: undiscounted returns so far, ``(num_envs,)``.
        key: raw PRNG key.
        iteration: steps of all environments done, ``()`` int32.
    """

    learner: LearnerState
    normalizer: running_statistics.RunningStatisticsState
    buffer: Any
    envs: EnvState
    theta: Any
    returns: jax.Array
    key: jax.Array
    iteration: jax.Array


class Sac:
    """SAC for one environment. All methods are pure and may be jitted and vmapped."""

    def __init__(
        self,
        env: Env,
        config: SacConfig,
        bind: Callable[[Any], Model],
        draw: Callable[[Any, jax.Array], Any],
    ) -> None:
        """Builds networks and losses.

        Args:
            env: the environment.
            config: settings.
            bind: the model for parameters ``theta``; pure.
            draw: ``draw(dist, key) -> theta``, one sample of a distribution, which
                is any pytree of arrays.
        """
        self.env, self.config = env, config
        self._bind, self._draw = bind, draw
        self._learner = Learner(config, env.obs_size, env.action_size)
        obs, zero = jnp.zeros(env.obs_size), jnp.zeros(())
        self._buffer = RingQueue(
            config.capacity,
            _transition(obs, jnp.zeros(env.action_size), zero, zero, obs, zero),
            config.batch_size * config.updates_per_step,
        )

    def init(self, key: jax.Array, dist: Any) -> SacState:
        """The state before the first step; ``key`` is a typed or raw PRNG key."""
        n = self.config.num_envs
        if jnp.issubdtype(key.dtype, jax.dtypes.prng_key):
            key = jax.random.key_data(key)
        key, k_learner, k_buffer = jax.random.split(key, 3)
        normalizer = running_statistics.init_state(jnp.zeros(self.env.obs_size))

        def episode(key: jax.Array) -> tuple[Any, EnvState]:
            theta = self._draw(dist, key)
            return theta, self.env.reset(self._bind(theta), key)

        # Every environment starts as finished, so that the first step resets it:
        # a program holds one reset only, and compiles faster.
        theta, envs = jax.tree.map(
            lambda x: jnp.zeros((n, *x.shape), x.dtype),
            jax.eval_shape(episode, k_buffer),
        )
        return SacState(
            learner=self._learner.init(k_learner),
            normalizer=replace(normalizer, std_eps=jnp.zeros(())),
            buffer=self._buffer.init(k_buffer),
            envs=replace(envs, terminated=jnp.ones_like(envs.terminated)),
            theta=theta,
            returns=jnp.zeros(n),
            key=key,
            iteration=jnp.zeros((), jnp.int32),
        )

    def policy(self, state: SacState) -> PolicyParams:
        """The policy as it is now, for ``act``."""
        statistics: Any = state.normalizer
        return PolicyParams(statistics.mean, statistics.std, state.learner.policy)

    def q_values(self, state: SacState, obs: jax.Array, action: jax.Array) -> jax.Array:
        """Both critics' values, ``(..., 2)``.

        Args:
            state: whose critics.
            obs: ``(..., obs_size)``.
            action: ``(..., action_size)``, in [-1, 1].
        """
        return self._learner.q_values(state.learner, state.normalizer, obs, action)

    def step(
        self, state: SacState, dist: Any, eval_dist: Any = None
    ) -> tuple[SacState, Info]:
        """One control step of all environments, then the gradient updates.

        Args:
            state: from ``init`` or an earlier step.
            dist: parameters of new episodes are drawn from it.
            eval_dist: the same for evaluations; ``dist`` where None.

        Returns:
            The new state and scalars:

            - ``episodes``, ``return``: how many episodes ended in this step and
              their mean return (NaN where none did);
            - ``nonfinite``: simulations that stopped being finite in this step;
            - ``critic_loss``, ``policy_loss``, ``temperature``: means over the
              updates (NaN where none were made);
            - with ``evaluate_every``: ``eval_return``, mean over finite episodes
              (NaN in steps without evaluation), and ``eval_nonfinite``, the others.
        """
        config = self.config
        key, k_reset, k_move, k_learn, k_eval = jax.random.split(
            jax.random.wrap_key_data(state.key), 5
        )
        state = self._reset_finished(state, dist, k_reset)
        learning = state.iteration >= config.random_iterations
        state, info = self._move(state, k_move, learning)

        # Only what changes goes through the branches: the memory is large.
        def learn() -> tuple[LearnerState, jax.Array, Info]:
            buffer, rows = self._buffer.sample_internal(state.buffer)
            learner, info = self._learner.updates(
                state.learner, state.normalizer, rows, k_learn
            )
            return learner, buffer.key, info

        def wait() -> tuple[LearnerState, jax.Array, Info]:
            shapes = jax.eval_shape(learn)[2]
            nans = {k: jnp.full((), jnp.nan, x.dtype) for k, x in shapes.items()}
            return state.learner, state.buffer.key, nans

        learner, buffer_key, learn_info = jax.lax.cond(learning, learn, wait)
        state = replace(
            state,
            learner=learner,
            buffer=replace(state.buffer, key=buffer_key),
            key=jax.random.key_data(key),
            iteration=state.iteration + 1,
        )
        info |= learn_info
        if config.evaluate_every:
            due = state.iteration % config.evaluate_every == 0
            target = dist if eval_dist is None else eval_dist
            info |= self._evaluate(self.policy(state), target, k_eval, due)
        return state, info

    def run_chunk(
        self, state: SacState, dist: Any, n: int, eval_dist: Any = None
    ) -> tuple[SacState, Info]:
        """``n`` steps; history with a leading axis ``n``. Chunks add up to a run."""
        return jax.lax.scan(lambda s, _: self.step(s, dist, eval_dist), state, length=n)

    def train(
        self, key: jax.Array, dist: Any, eval_dist: Any = None
    ) -> tuple[SacState, Info]:
        """The whole training, ``config.iterations`` steps."""
        state = self.init(key, dist)
        return self.run_chunk(state, dist, self.config.iterations, eval_dist)

    def _reset_finished(self, state: SacState, dist: Any, key: jax.Array) -> SacState:
        envs = state.envs
        done = ~_finite(envs) | (envs.terminated + envs.truncated > 0)
        k_draw, k_reset = jax.random.split(key)
        drawn = jax.vmap(self._draw, (None, 0))(dist, self._each(k_draw))
        theta = _where(done, drawn, state.theta)
        fresh = jax.vmap(self.env.reset)(
            jax.vmap(self._bind)(theta), self._each(k_reset)
        )
        return replace(
            state,
            theta=theta,
            envs=_where(done, fresh, envs),
            returns=jnp.where(done, 0.0, state.returns),
        )

    def _move(
        self, state: SacState, key: jax.Array, learning: jax.Array
    ) -> tuple[SacState, Info]:
        envs, usable = state.envs, _finite(state.envs)
        obs = jnp.where(usable[:, None], envs.obs, 0.0)
        if self.config.normalize_observations:
            weights = usable.astype(obs.dtype)
            state = replace(
                state,
                normalizer=running_statistics.update(
                    state.normalizer, obs, weights=weights
                ),
            )
        k_policy, k_random = jax.random.split(key)
        action = act(self.policy(state), obs, k_policy)
        uniform = jax.random.uniform(k_random, action.shape, action.dtype, -1.0)
        action = jnp.where(learning, action, uniform)
        models = jax.vmap(self._bind)(state.theta)
        new = jax.vmap(self.env.step)(models, envs, action)
        finite = usable & _finite(new)
        rows = _transition(
            observation=obs,
            action=action,
            reward=jnp.where(finite, new.reward, 0.0),
            discount=1.0 - new.terminated,
            next_observation=jnp.where(finite[:, None], new.obs, obs),
            masked=1.0 - finite.astype(obs.dtype),
        )
        returns = state.returns + new.reward
        ended = finite & (new.terminated + new.truncated > 0)
        info = {
            "episodes": ended.sum(),
            "return": _mean_where(ended, returns),
            "nonfinite": (~finite).sum(),
        }
        buffer = self._buffer.insert_internal(state.buffer, rows)
        return replace(state, envs=new, buffer=buffer, returns=returns), info

    def _evaluate(
        self, policy: PolicyParams, dist: Any, key: jax.Array, due: jax.Array
    ) -> Info:
        n = self.config.eval_envs

        def run() -> Info:
            k_draw, k_run = jax.random.split(key)
            theta = jax.vmap(self._draw, (None, 0))(dist, jax.random.split(k_draw, n))
            models = jax.vmap(self._bind)(theta)
            returns = evaluate(self.env, models, policy, act, k_run, n, batched=True)
            finite = jnp.isfinite(returns)
            return {
                "eval_return": _mean_where(finite, returns),
                "eval_nonfinite": (~finite).sum(),
            }

        def skip() -> Info:
            shapes = jax.eval_shape(run)
            return {
                "eval_return": jnp.full((), jnp.nan, shapes["eval_return"].dtype),
                "eval_nonfinite": jnp.zeros((), shapes["eval_nonfinite"].dtype),
            }

        return jax.lax.cond(due, run, skip)

    def _each(self, key: jax.Array) -> jax.Array:
        return jax.random.split(key, self.config.num_envs)


def _transition(
    observation: jax.Array,
    action: jax.Array,
    reward: jax.Array,
    discount: jax.Array,
    next_observation: jax.Array,
    masked: jax.Array,
) -> types.Transition:
    extras: Any = {"state_extras": {"truncation": masked}, "policy_extras": {}}
    return types.Transition(
        observation, action, reward, discount, next_observation, extras
    )


def _finite(envs: EnvState) -> jax.Array:
    """Which environments are still finite, ``(n,)`` bool."""
    return jnp.isfinite(envs.obs).all(-1) & jnp.isfinite(envs.reward)


def _mean_where(mask: jax.Array, values: jax.Array) -> jax.Array:
    """Mean of ``values`` where ``mask``; NaN where none is."""
    total, count = jnp.where(mask, values, 0.0).sum(), mask.sum()
    return jnp.where(count > 0, total / jnp.maximum(count, 1), jnp.nan)


def _where(done: jax.Array, new: Any, old: Any) -> Any:
    """``new`` where ``done`` ``(n,)``, else ``old``; leaves ``(n, ...)``."""
    return jax.tree.map(
        lambda a, b: jnp.where(done.reshape(-1, *([1] * (a.ndim - 1))), a, b), new, old
    )
