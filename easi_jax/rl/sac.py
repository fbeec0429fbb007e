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
from jax.sharding import Mesh

from easi_jax.rl.buffer import RingQueue
from easi_jax.rl.config import SacConfig
from easi_jax.rl.episodes import Episodes, Tested, finite, mean_where, raw_key
from easi_jax.rl.learner import Info, Learner, LearnerState
from easi_jax.rl.networks import PolicyParams, act
from easi_jax.simulation.env import Env, EnvState, Model


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
        tested: Tested | None = None,
    ) -> None:
        """Builds networks and losses.

        Args:
            env: the environment.
            config: settings.
            bind: the model for parameters ``theta``; pure.
            draw: ``draw(dist, key) -> theta``, one sample of a distribution, which
                is any pytree of arrays.
            tested: where evaluations are made, if not in ``env``.
        """
        self.env, self.config = env, config
        self._episodes = Episodes(
            env, bind, draw, config.num_envs, config.eval_envs, tested=tested
        )
        self._learner = Learner(config, env.obs_size, env.action_size)
        obs, zero = jnp.zeros(env.obs_size), jnp.zeros(())
        self._buffer = RingQueue(
            config.capacity,
            _transition(obs, jnp.zeros(env.action_size), zero, zero, obs, zero),
            config.batch_size * config.updates_per_step,
        )

    def over(self, mesh: Mesh) -> None:
        """Nothing: a training spends its time in updates, and stays on one device."""

    def init(self, key: jax.Array, dist: Any) -> SacState:
        """The state before the first step; ``key`` is a typed or raw PRNG key."""
        n = self.config.num_envs
        key = raw_key(key)
        key, k_learner, k_buffer = jax.random.split(key, 3)
        normalizer = running_statistics.init_state(jnp.zeros(self.env.obs_size))

        envs, theta = self._episodes.unborn(dist, k_buffer)
        return SacState(
            learner=self._learner.init(k_learner),
            normalizer=replace(normalizer, std_eps=jnp.zeros(())),
            buffer=self._buffer.init(k_buffer),
            envs=envs,
            theta=theta,
            returns=jnp.zeros(n),
            key=key,
            iteration=jnp.zeros((), jnp.int32),
        )

    def continued(self, fresh: SacState, old: SacState) -> SacState:
        """A fresh state with the networks, temperature and observation statistics of
        another training; optimizer, buffer and step count start anew."""
        learner = replace(
            fresh.learner,
            policy=old.learner.policy,
            critics=old.learner.critics,
            target_critics=old.learner.target_critics,
            log_temperature=old.learner.log_temperature,
        )
        return replace(fresh, learner=learner, normalizer=old.normalizer)

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
        envs, theta, returns = self._episodes.reset_finished(
            state.envs, state.theta, state.returns, dist, k_reset
        )
        state = replace(state, envs=envs, theta=theta, returns=returns)
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
            info |= self._episodes.evaluate(self.policy(state), target, k_eval, due)
        return state, info

    @staticmethod
    def clock(state: SacState) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Counters that are the same for all seeds (see `easi_jax.rl.seeds`)."""
        buffer = state.buffer
        return state.iteration, buffer.insert_position, buffer.sample_position

    @staticmethod
    def with_clock(state: SacState, clock: tuple[jax.Array, ...]) -> SacState:
        """The state with other counters."""
        iteration, insert, sample = clock
        buffer = replace(state.buffer, insert_position=insert, sample_position=sample)
        return replace(state, iteration=iteration, buffer=buffer)

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

    def _move(
        self, state: SacState, key: jax.Array, learning: jax.Array
    ) -> tuple[SacState, Info]:
        envs, usable = state.envs, finite(state.envs)
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
        new = self._episodes.step(envs, state.theta, action)
        ok = usable & finite(new)
        rows = _transition(
            observation=obs,
            action=action,
            reward=jnp.where(ok, new.reward, 0.0),
            discount=1.0 - new.terminated,
            next_observation=jnp.where(ok[:, None], new.obs, obs),
            masked=1.0 - ok.astype(obs.dtype),
        )
        returns = state.returns + new.reward
        ended = ok & (new.terminated + new.truncated > 0)
        info = {
            "episodes": ended.sum(),
            "return": mean_where(ended, returns),
            "nonfinite": (~ok).sum(),
        }
        buffer = self._buffer.insert_internal(state.buffer, rows)
        return replace(state, envs=new, buffer=buffer, returns=returns), info


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
