"""Proximal policy optimization as one pure function, with brax's loss and networks.

Schulman et al., *Proximal Policy Optimization Algorithms* (2017), eq. 7, with
generalized advantages (Schulman et al., 2016). Where a time limit cuts an episode, the
value of its terminal observation is added to the last reward (Pardo et al., *Time
Limits in Reinforcement Learning*, 2018); a step whose simulation broke takes no part
in the losses.
"""

import copy
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import flax.struct
import jax
import jax.numpy as jnp
import optax
from brax.training import networks, types
from brax.training.acme import running_statistics
from brax.training.agents.ppo import losses
from brax.training.agents.ppo.networks import PPONetworks
from flax import linen
from jax.sharding import Mesh

from easi_jax.rl.config import PpoConfig
from easi_jax.rl.episodes import Episodes, Tested, finite, mean_where, raw_key
from easi_jax.rl.learner import Info
from easi_jax.rl.networks import PolicyParams, make_networks, standardize
from easi_jax.simulation.env import Env, EnvState, Model


@flax.struct.dataclass
class PpoState:
    """All state of a training, ordinary arrays only; continuing from it is exact.

    Attributes:
        params: weights of policy and value (brax's ``PPONetworkParams``).
        optimizer: Adam's state.
        normalizer: running statistics of observations.
        envs: environment states, leading axis ``num_envs``.
        theta: parameters of each environment's model, leading axis ``num_envs``.
        returns: undiscounted returns so far, ``(num_envs,)``.
        key: raw PRNG key.
        iteration: unrolls done, ``()`` int32.
    """

    params: Any
    optimizer: Any
    normalizer: Any
    envs: EnvState
    theta: Any
    returns: jax.Array
    key: jax.Array
    iteration: jax.Array


class Ppo:
    """PPO for one environment; the same methods as `easi_jax.rl.sac.Sac`.

    One ``step`` is an unroll of all environments and the updates from it.
    """

    def __init__(
        self,
        env: Env,
        config: PpoConfig,
        bind: Callable[[Any], Model],
        draw: Callable[[Any, jax.Array], Any],
        tested: Tested | None = None,
    ) -> None:
        """Builds networks and loss; arguments as for `Sac`."""
        self.env, self.config = env, config
        self._episodes = Episodes(
            env, bind, draw, config.num_envs, config.eval_envs, tested=tested
        )
        actor = make_networks(
            env.obs_size, env.action_size, config.hidden, scaled=self._scaled
        )
        build: Any = PPONetworks
        self._networks = build(
            policy_network=actor.policy_network,
            value_network=networks.make_value_network(
                env.obs_size,
                preprocess_observations_fn=self._scaled,
                hidden_layer_sizes=config.hidden,
                activation=linen.relu,
            ),
            parametric_action_distribution=actor.parametric_action_distribution,
        )
        self._optimizer = _optimizer(config)

    def _scaled(self, observation: Any, preprocessor_params: Any) -> Any:
        """Inputs as the networks take them."""
        return standardize(observation, preprocessor_params)

    def over(self, mesh: Mesh) -> "Ppo":
        """The same training with its environments split over the devices of a mesh."""
        other = copy.copy(self)
        other._episodes = replace(self._episodes, mesh=mesh)
        return other

    def init(self, key: jax.Array, dist: Any) -> PpoState:
        """The state before the first unroll; ``key`` is a typed or raw PRNG key."""
        key, k_policy, k_value, k_reset = jax.random.split(raw_key(key), 4)
        build: Any = losses.PPONetworkParams
        params = build(
            policy=self._networks.policy_network.init(k_policy),
            value=self._networks.value_network.init(k_value),
        )
        normalizer = running_statistics.init_state(jnp.zeros(self.env.obs_size))
        envs, theta = self._episodes.unborn(dist, k_reset)
        return PpoState(
            params=params,
            optimizer=self._optimizer.init(params),
            normalizer=replace(normalizer, std_eps=jnp.zeros(())),
            envs=envs,
            theta=theta,
            returns=jnp.zeros(self.config.num_envs),
            key=key,
            iteration=jnp.zeros((), jnp.int32),
        )

    def continued(self, fresh: PpoState, old: PpoState) -> PpoState:
        """A fresh state with the networks and observation statistics of another
        training; optimizer, environments and step count start anew."""
        return replace(fresh, params=old.params, normalizer=old.normalizer)

    def policy(self, state: PpoState) -> PolicyParams:
        """The policy as it is now, for ``act``."""
        statistics: Any = state.normalizer
        return PolicyParams(statistics.mean, statistics.std, state.params.policy)

    def values(self, state: PpoState, obs: jax.Array) -> jax.Array:
        """Estimated returns ``(...)`` from ``obs`` ``(..., obs_size)``."""
        network = self._networks.value_network
        return network.apply(state.normalizer, state.params.value, obs)

    def step(
        self, state: PpoState, dist: Any, eval_dist: Any = None
    ) -> tuple[PpoState, Info]:
        """An unroll of ``config.unroll`` control steps, then the updates.

        Returns:
            The new state and scalars: ``episodes``, ``return``, ``nonfinite``,
            ``eval_return`` and ``eval_nonfinite`` as `Sac.step`; ``policy_loss``,
            ``value_loss`` and ``entropy_loss`` as means over the updates.
        """
        config = self.config
        key, k_unroll, k_learn, k_eval = jax.random.split(
            jax.random.wrap_key_data(state.key), 4
        )
        state, rows, told = self._unroll(state, dist, k_unroll)
        ended, usable = told["ended"], told["usable"]
        beyond = self.values(state, rows.next_observation)
        bonus = config.discount / config.reward_scaling * beyond
        bonus = jnp.where(told["cut"], bonus, 0.0)
        k_judge = jax.random.fold_in(k_learn, _NO_EPOCH)
        state, rows, more = self._judged(state, rows, bonus, k_judge)
        state, info = self._learn(state, rows, k_learn)
        if config.normalize_observations:
            # After the updates: the policy that acted saw the old statistics.
            statistics = running_statistics.update(
                state.normalizer, rows.observation, weights=usable.astype(jnp.float32)
            )
            state = replace(state, normalizer=statistics)
        state = replace(
            state, key=jax.random.key_data(key), iteration=state.iteration + 1
        )
        info |= more | {
            "episodes": ended.sum(),
            "return": mean_where(ended, told["returns"]),
            "nonfinite": (~usable).sum(),
        }
        if config.evaluate_every:
            due = state.iteration % config.evaluate_every == 0
            target = dist if eval_dist is None else eval_dist
            info |= self._episodes.evaluate(self.policy(state), target, k_eval, due)
        return state, info

    def run_chunk(
        self, state: PpoState, dist: Any, n: int, eval_dist: Any = None
    ) -> tuple[PpoState, Info]:
        """``n`` steps; history with a leading axis ``n``. Chunks add up to a run."""
        return jax.lax.scan(lambda s, _: self.step(s, dist, eval_dist), state, length=n)

    def train(
        self, key: jax.Array, dist: Any, eval_dist: Any = None
    ) -> tuple[PpoState, Info]:
        """The whole training, ``config.iterations`` steps."""
        state = self.init(key, dist)
        return self.run_chunk(state, dist, self.config.iterations, eval_dist)

    @staticmethod
    def clock(state: PpoState) -> tuple[jax.Array, ...]:
        """Counters that are the same for all seeds (see `easi_jax.rl.seeds`)."""
        return (state.iteration,)

    @staticmethod
    def with_clock(state: PpoState, clock: tuple[jax.Array, ...]) -> PpoState:
        """The state with other counters."""
        return replace(state, iteration=clock[0])

    def _unroll(
        self, state: PpoState, dist: Any, key: jax.Array
    ) -> tuple[PpoState, types.Transition, Info]:
        """``config.unroll`` control steps; rows ``(unroll, num_envs, ...)``."""
        (envs, theta, returns), (rows, told) = jax.lax.scan(
            lambda carry, k: self._move(state, dist, carry, k),
            (state.envs, state.theta, state.returns),
            jax.random.split(key, self.config.unroll),
        )
        state = replace(state, envs=envs, theta=theta, returns=returns)
        return state, rows, told

    def _judged(
        self, state: Any, rows: Any, bonus: jax.Array, key: jax.Array
    ) -> tuple[Any, Any, Info]:
        """Rows with the rewards that are learned from, ``bonus`` for what comes after
        a time limit among them, and scalars to tell."""
        del key
        return state, rows._replace(reward=rows.reward + bonus), {}

    def _noted(
        self, envs: EnvState, new: EnvState, theta: Any, action: jax.Array
    ) -> Any:
        """What `_judged` needs of a step of all environments; leaves ``(n, ...)``."""
        del envs, new, theta, action
        return ()

    def _move(self, state: PpoState, dist: Any, carry: Any, key: jax.Array) -> Any:
        k_reset, k_act = jax.random.split(key)
        envs, theta, returns = carry
        envs, theta, returns = self._episodes.reset_finished(
            envs, theta, returns, dist, k_reset
        )
        usable = finite(envs)
        obs = jnp.where(usable[:, None], envs.obs, 0.0)
        actions = self._networks.parametric_action_distribution
        logits = self._networks.policy_network.apply(
            state.normalizer, state.params.policy, obs
        )
        raw = actions.sample_no_postprocessing(logits, k_act)
        new = self._episodes.step(envs, theta, actions.postprocess(raw))
        ok = usable & finite(new)
        returns = returns + new.reward
        extras: Any = {
            # brax leaves these rows out of the losses.
            "state_extras": {"truncation": 1.0 - ok.astype(obs.dtype)},
            "policy_extras": {
                "raw_action": raw,
                "log_prob": actions.log_prob(logits, raw),
                "distribution_params": logits,
            },
            "noted": self._noted(envs, new, theta, actions.postprocess(raw)),
        }
        row = types.Transition(
            observation=obs,
            action=raw,
            reward=jnp.where(ok, new.reward, 0.0),
            discount=1.0 - (new.terminated + new.truncated) * ok,
            next_observation=jnp.where(ok[:, None], new.obs, obs),
            extras=extras,
        )
        ended = ok & (new.terminated + new.truncated > 0)
        cut = ok & (new.truncated > 0)
        told = {"ended": ended, "usable": ok, "returns": returns, "cut": cut}
        return (new, theta, returns), (row, told)

    def _loss(
        self,
        statistics: Any,
        params: Any,
        batch: Any,
        key: jax.Array,
        of_policy: bool = False,
    ) -> tuple[jax.Array, Any]:
        """brax's loss of rows ``(envs, unroll, ...)``, and what it tells.

        ``of_policy``: without the value's and the entropy's parts.
        """
        c = self.config
        return losses.compute_ppo_loss(
            params,
            statistics,
            batch,
            key,
            self._networks,
            entropy_cost=0.0 if of_policy else c.entropy_cost,
            discounting=c.discount,
            reward_scaling=c.reward_scaling,
            gae_lambda=c.gae_lambda,
            clipping_epsilon=c.clipping,
            vf_coefficient=0.0 if of_policy else c.value_cost,
        )

    def _learn(
        self, state: PpoState, rows: Any, key: jax.Array
    ) -> tuple[PpoState, Info]:
        """All epochs over the rows ``(unroll, num_envs, ...)``."""
        c = self.config
        data = jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), rows)
        loss = partial(self._loss, state.normalizer)

        def update(carry: Any, item: Any) -> tuple[Any, Info]:
            params, optimizer = carry
            batch, k = item
            grads, told = jax.grad(loss, has_aux=True)(params, batch, k)
            change, optimizer = self._optimizer.update(
                grads, optimizer, params, kl=told["kl_mean"]
            )
            new = optax.apply_updates(params, change)
            info = {
                "policy_loss": told["policy_loss"],
                "value_loss": told["v_loss"],
                "entropy_loss": told["entropy_loss"],
            }
            return (new, optimizer), info

        def epoch(carry: Any, k: jax.Array) -> tuple[Any, Info]:
            k_order, k_loss = jax.random.split(k)
            order = jax.random.permutation(k_order, c.num_envs)
            batches = jax.tree.map(
                lambda x: x[order].reshape(c.minibatches, -1, *x.shape[1:]), data
            )
            return jax.lax.scan(
                update, carry, (batches, jax.random.split(k_loss, c.minibatches))
            )

        (params, optimizer), info = jax.lax.scan(
            epoch, (state.params, state.optimizer), jax.random.split(key, c.epochs)
        )
        state = replace(state, params=params, optimizer=optimizer)
        return state, jax.tree.map(jnp.mean, info)


# Folded into the key of an unroll's epochs, which `jax.random.split` counts from 0, so
# that what it gives is none of theirs.
_NO_EPOCH = 2**31 - 1


def _optimizer(config: PpoConfig) -> optax.GradientTransformationExtraArgs:
    cut = optax.clip_by_global_norm(config.max_gradient)
    if config.clip_apart:
        build: Any = losses.PPONetworkParams
        parts: Any = {"policy": cut, "value": cut}
        cut = optax.partition(parts, build(policy="policy", value="value"))
    if config.target_kl:
        adam = optax.flatten(optax.scale_by_adam())
        return optax.chain(cut, adam, steered(config.learning_rate, config.target_kl))
    adam = optax.flatten(optax.adam(_learning_rate(config)))
    return optax.with_extra_args_support(optax.chain(cut, adam))


# Slowest and fastest learning rate that is steered to, and the factor of one step.
_SLOWEST, _FASTEST, _STEER = 1e-5, 1e-2, 1.5


class Steered(NamedTuple):
    """State of a learning rate that follows a divergence."""

    rate: jax.Array


def steered(rate: float, target: float) -> optax.GradientTransformationExtraArgs:
    """Steps at a rate that keeps the divergence of an update near ``target``."""

    def init(params: Any) -> Steered:
        del params
        return Steered(jnp.asarray(rate))

    def update(updates: Any, state: Any, params: Any = None, **more: Any) -> Any:
        del params
        kl, now = more["kl"], state.rate
        slower = jnp.maximum(now / _STEER, _SLOWEST)
        faster = jnp.minimum(now * _STEER, _FASTEST)
        now = jnp.where(kl > 2 * target, slower, now)
        now = jnp.where((kl < target / 2) & (kl > 0), faster, now)
        return jax.tree.map(lambda g: -now * g, updates), Steered(now)

    return optax.GradientTransformationExtraArgs(init, update)


def learning_rate_of(config: PpoConfig, state: PpoState) -> jax.Array:
    """The rate that the next update of a training has, ``()``."""
    now = optax.tree_utils.tree_get(state.optimizer, "rate")
    if now is not None:
        return now
    rate = _learning_rate(config)
    done = state.iteration * config.epochs * config.minibatches
    return jnp.asarray(rate(done) if callable(rate) else rate)


def _learning_rate(config: PpoConfig) -> optax.ScalarOrSchedule:
    if config.learning_rate_decay == 1.0:
        return config.learning_rate
    updates = config.iterations * config.epochs * config.minibatches
    end = config.learning_rate * config.learning_rate_decay
    return optax.linear_schedule(config.learning_rate, end, updates)
