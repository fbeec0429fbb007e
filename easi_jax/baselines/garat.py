"""GARAT: a simulator whose actions are changed until it moves like the machine.

Desai, Durugkar, Karnan, Warnell, Hanna and Stone, *An Imitation from Observation
Approach to Transfer Learning with Dynamics Mismatch*, NeurIPS 2020.
"""

import math
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from easi_jax.baselines.policies import Learned, Practice, budgeted, trained_at
from easi_jax.baselines.task import Budget
from easi_jax.data.segments import Segments
from easi_jax.rl.config import PpoConfig
from easi_jax.rl.networks import PolicyParams, act
from easi_jax.rl.ppo import Ppo
from easi_jax.search import discriminator as critic
from easi_jax.simulation.env import EnvState
from easi_jax.simulation.rollout import collect

_LEAST = 1e-6  # of 1 - D, so that its logarithm is finite
_ENVS = 250  # that the transformer trains in


class Grounding(NamedTuple):
    """What a transformer's episode needs besides its state."""

    theta: jax.Array
    agent: PolicyParams
    critic: critic.CriticState
    mid: jax.Array
    std: jax.Array


@dataclass(frozen=True)
class Garat:
    """GARAT as published, not as EASI's reference has it.

    An action transformer adds a change to the agent's action; a discriminator tells
    (s, a, s') of the machine from those of the simulation, and PPO trains the
    transformer to be taken for the machine. Published settings: standardized inputs;
    binary cross-entropy with gradient penalty 10; 5 grounding steps of 50 iterations
    with 5,000 real and 5,000 simulated transitions each; PPO with learning rate 3e-4,
    lambda 0.95, clip 0.1 to 0.2 and entropy 0.01; then the agent goes on training in
    the grounded simulator. States are positions and velocities, actions what is sent
    to the drives.
    """

    grounding_steps: int = 5
    """Times ``iterations``."""
    iterations: int = 50
    """Of discriminator and transformer in a grounding step; fewer in all where the
    budget does not pay for them."""
    transitions: int = 5_000
    """Real and simulated ones in each iteration."""
    discriminator_updates: int = 5
    """Gradient steps of the discriminator in each iteration."""
    penalty: float = 10.0
    """Of the discriminator's gradient."""
    hidden: tuple[int, ...] = (64, 64)
    """Layers of transformer and discriminator."""
    learning_rate: float = 3e-4
    """Of both."""
    clipping: float = 0.2
    """PPO's."""
    entropy_cost: float = 0.01
    """PPO's."""

    def fit(
        self,
        practice: Practice,
        demonstrations: Segments,
        budget: Budget,
        key: jax.Array,
    ) -> Learned:
        """Grounds the simulation, and trains the agent in it."""
        k_ground, k_train = jax.random.split(key)
        transformer, simulated = self.ground(practice, demonstrations, budget, k_ground)
        training = budgeted(practice.training, budget)
        policy = trained_at(
            GroundedEnv(practice.env),
            training,
            (practice.theta, transformer),
            k_train,
            practice.state,
        )
        return Learned(policy, simulated + training.env_steps)

    def ground(
        self,
        practice: Practice,
        demonstrations: Segments,
        budget: Budget,
        key: jax.Array,
    ) -> tuple[PolicyParams, int]:
        """The transformer, and how many control steps it took.

        Raises:
            UserError: the budget does not pay for one iteration.
        """
        env = TransformerEnv(practice.env)
        unroll = max(1, self.transitions // _ENVS)
        runs = math.ceil(self.transitions / env.episode_length)
        each = _ENVS * unroll + runs * env.episode_length
        rounds = min(self.grounding_steps * self.iterations, budget.rounds(each))
        trainer = self._trainer(env, rounds, unroll)
        judge = critic.CriticConfig(
            hidden=self.hidden,
            loss="gan",
            regularizer="gradient_penalty",
            penalty=self.penalty,
            learning_rate=self.learning_rate,
        )
        env.judge = judge
        real, known, mid, std = standard_inputs(demonstrations)

        def iteration(carry: Any, key: jax.Array) -> tuple[Any, jax.Array]:
            state, grounding = carry
            k_roll, k_real, k_judge = jax.random.split(key, 3)
            transformer = trainer.policy(state)
            fake = collect(
                env,
                grounding,
                lambda obs, k: act(transformer, obs, k),
                k_roll,
                runs,
                env.episode_length,
            )
            some, alive = inputs(fake)
            some = (some - mid) / std
            index = jax.random.randint(k_real, (self.transitions,), 0, known)
            batch = (real[index] - mid) / std

            def update(s: Any, k: jax.Array) -> Any:
                k_order, k_loss = jax.random.split(k)
                order = jax.random.permutation(k_order, some.shape[0])
                return critic.update(judge, s, k_loss, batch, some[order], alive[order])

            keys = jax.random.split(k_judge, self.discriminator_updates)
            found, losses = jax.lax.scan(update, grounding.critic, keys)
            grounding = grounding._replace(critic=found)
            # Running episodes too are judged by the discriminator as it is now.
            everywhere = jax.tree.map(
                lambda x: jnp.broadcast_to(x, (_ENVS, *jnp.shape(x))), grounding
            )
            state, _ = trainer.step(replace(state, theta=everywhere), grounding)
            return (state, grounding), losses[-1]

        def run(key: jax.Array, theta: jax.Array, agent: PolicyParams) -> PolicyParams:
            k_critic, k_state, k_run = jax.random.split(key, 3)
            first = critic.init(judge, k_critic, real.shape[-1])
            grounding = Grounding(theta, agent, first, mid, std)
            start = (trainer.init(k_state, grounding), grounding)
            (state, _), _ = jax.lax.scan(
                iteration, start, jax.random.split(k_run, rounds)
            )
            return trainer.policy(state)

        transformer = jax.jit(run)(key, practice.theta, practice.policy)
        return transformer, rounds * each

    def _trainer(self, env: "TransformerEnv", rounds: int, unroll: int) -> Ppo:
        config = PpoConfig(
            env_steps=rounds * _ENVS * unroll,
            num_envs=_ENVS,
            unroll=unroll,
            hidden=self.hidden,
            minibatches=5,
            learning_rate=self.learning_rate,
            gae_lambda=0.95,
            clipping=self.clipping,
            entropy_cost=self.entropy_cost,
        )
        return Ppo(
            env, config, lambda grounding: grounding, lambda grounding, _: grounding
        )


def standard_inputs(
    trajectories: Segments,
) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """`inputs`, those that count first; how many these are, and their mean and
    standard deviation, ``(F,)``."""
    real, weight = inputs(trajectories)
    rows = jnp.argsort(weight <= 0, stable=True)
    real, known = real[rows], jnp.maximum((weight > 0).sum(), 1)
    w = (weight[rows] > 0)[:, None] / known
    mid = (w * real).sum(0)
    std = jnp.sqrt((w * (real - mid) ** 2).sum(0))
    return real, known, mid, jnp.where(std > 1e-9, std, 1.0)


def inputs(trajectories: Segments) -> tuple[jax.Array, jax.Array]:
    """What the discriminator sees of single steps, (s, a, s' - s), flat ``(N, F)``,
    and which of them count, ``(N,)``."""
    t = trajectories
    moved = (t.next_qpos[..., 0, :] - t.qpos, t.next_qvel[..., 0, :] - t.qvel)
    rows = jnp.concatenate([t.qpos, t.qvel, t.ctrl[..., 0, :], *moved], -1)
    return rows.reshape(-1, rows.shape[-1]), t.weight.reshape(-1)


class _Around:
    """An environment around another."""

    def __init__(self, env: Any) -> None:
        self.env, self.name = env, env.name
        self.obs_size, self.action_size = env.obs_size, env.action_size
        self.episode_length, self.dt = env.episode_length, env.dt


class GroundedEnv(_Around):
    """The simulation behind a transformer; its model is ``(theta, transformer)``."""

    def model(self, given: Any) -> Any:
        return given

    def reset(self, model: Any, key: jax.Array) -> EnvState:
        return self.env.reset(self.env.model(model[0]), key)

    def control(self, state: EnvState, action: jax.Array) -> jax.Array:
        return self.env.control(state, action)

    def step(self, model: Any, state: EnvState, action: jax.Array) -> EnvState:
        theta, transformer = model
        seen = jnp.concatenate([state.obs, action])
        changed = action + act(transformer, seen, deterministic=True)
        return self.env.step(self.env.model(theta), state, jnp.clip(changed, -1.0, 1.0))


class TransformerEnv(_Around):
    """The transformer's task: its actions change the agent's, its reward is to be taken
    for the machine. The model is a `Grounding`.

    Observation: the agent's, and the agent's action ``(obs_size + action_size,)``.
    Action: what is added to the agent's action, ``(action_size,)``. Reward:
    ``-log(1 - D)``.
    """

    judge: critic.CriticConfig

    def __init__(self, env: Any) -> None:
        super().__init__(env)
        self.obs_size = env.obs_size + env.action_size

    def reset(self, model: Grounding, key: jax.Array) -> EnvState:
        k_reset, k_act, k_run = jax.random.split(key, 3)
        inner = self.env.reset(self.env.model(model.theta), k_reset)
        return self._outer(model, inner, k_act, k_run)

    def control(self, state: EnvState, action: jax.Array) -> jax.Array:
        """What the agent meant to send: the transformer is part of the machine."""
        del action
        inner, agents, _ = self._inner(state)
        return self.env.control(inner, agents)

    def step(self, model: Grounding, state: EnvState, action: jax.Array) -> EnvState:
        inner, agents, key = self._inner(state)
        changed = jnp.clip(agents + action, -1.0, 1.0)
        new = self.env.step(self.env.model(model.theta), inner, changed)
        k_act, k_run = jax.random.split(jax.random.wrap_key_data(key))
        old, now = inner.physics, new.physics
        moved = (now.qpos - old.qpos, now.qvel - old.qvel)
        sent = self.env.control(inner, agents)
        row = jnp.concatenate([old.qpos, old.qvel, sent, *moved])
        row = (row - model.mid) / model.std
        likely = critic.score(self.judge, model.critic, row)
        reward = -jnp.log(jnp.maximum(1.0 - likely, _LEAST))
        return replace(self._outer(model, new, k_act, k_run), reward=reward)

    def _outer(
        self, model: Grounding, inner: EnvState, k_act: jax.Array, k_run: jax.Array
    ) -> EnvState:
        agents = act(model.agent, inner.obs, k_act)
        memory = (inner.memory, agents, jax.random.key_data(k_run))
        obs = jnp.concatenate([inner.obs, agents])
        return replace(inner, obs=obs, memory=memory)

    def _inner(self, state: EnvState) -> tuple[EnvState, jax.Array, jax.Array]:
        memory, agents, key = state.memory
        obs = state.obs[: self.env.obs_size]
        return replace(state, obs=obs, memory=memory), agents, key
