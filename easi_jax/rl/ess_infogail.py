"""Ess-InfoGAIL on PPO: a policy that moves as demonstrations do, skill by skill.

Fu et al. (NeurIPS 2023), the controller of EASI's Go2. Data flow of an iteration: all
environments unroll, each with a skill and a code drawn for its episode; the `Judge`
learns to tell their windows from demonstrated ones; its answer and the task are the
reward; PPO's updates follow. The skill and the code join the observation, as one more
random number of an episode beside its physics (`Coded`).
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import flax.struct
import jax
import jax.numpy as jnp

from easi_jax.errors import UserError
from easi_jax.rl.config import EssInfoGailConfig
from easi_jax.rl.demonstrations import style_of
from easi_jax.rl.episodes import Tested, raw_key
from easi_jax.rl.judge import Batch, Judge, JudgeState
from easi_jax.rl.learner import Info
from easi_jax.rl.networks import PolicyParams, standardize
from easi_jax.rl.ppo import Ppo, PpoState, learning_rate_of
from easi_jax.simulation.env import Env, EnvState, Model


class Codes(NamedTuple):
    """What is drawn for an episode beside its physics.

    Attributes:
        code: the continuous code, ``()``; 0 where there is none.
        gumbel: noise that the skill is drawn by, ``(K,)``.
        skill: the relaxed skill, ``(K,)``.
    """

    code: jax.Array
    gumbel: jax.Array
    skill: jax.Array


class Coded:
    """An environment whose model is ``(model, codes)``, and whose observation ends with
    the codes."""

    def __init__(self, env: Env, config: EssInfoGailConfig) -> None:
        """Wraps ``env``."""
        self.inner, self._config = env, config
        self.name, self.action_size = env.name, env.action_size
        self.obs_size = env.obs_size + config.codes
        self.episode_length = env.episode_length

    def reset(self, model: Model, key: jax.Array) -> EnvState:
        """As `Env.reset`."""
        return self._seen(self.inner.reset(model[0], key), model[1])

    def step(self, model: Model, state: EnvState, action: jax.Array) -> EnvState:
        """As `Env.step`."""
        state = replace(state, obs=state.obs[: self.inner.obs_size])
        return self._seen(self.inner.step(model[0], state, action), model[1])

    def control(self, state: EnvState, action: jax.Array) -> jax.Array:
        """As `Env.control`."""
        state = replace(state, obs=state.obs[: self.inner.obs_size])
        return self.inner.control(state, action)

    def _seen(self, state: EnvState, codes: Codes) -> EnvState:
        tail = self.tail(codes.code, codes.skill)
        return replace(state, obs=jnp.concatenate([state.obs, tail]))

    def tail(self, code: jax.Array, skill: jax.Array) -> jax.Array:
        """What the observation ends with, ``(codes,)``."""
        c = self._config
        first = [code[None]] if c.continuous else []
        return jnp.concatenate([*first, skill if c.skills > 1 else skill[:0]])


class Noted(NamedTuple):
    """Of each step, for the judge.

    Attributes:
        windows: ``(n, features)``, scaled.
        codes: of the episodes.
        failed: where the task ended, ``(n,)`` bool.
    """

    windows: jax.Array
    codes: Codes
    failed: jax.Array


@flax.struct.dataclass
class EssState(PpoState):
    """PPO's state, and the judge's."""

    judge: JudgeState


class EssInfoGail(Ppo):
    """Imitation of demonstrations; the same methods as `easi_jax.rl.sac.Sac`.

    Policies are those of the environment alone: a skill, and the code 0, are built into
    their first layer (`policy`), so that all that takes a policy takes these.
    """

    def __init__(
        self,
        env: Env,
        config: EssInfoGailConfig,
        bind: Callable[[Any], Model],
        draw: Callable[[Any, jax.Array], Any],
        tested: Tested | None = None,
    ) -> None:
        """Builds networks and losses; arguments as for `Ppo`.

        Raises:
            UserError: no demonstrations, or of more skills than the policy has.
        """
        given = config.demonstrations
        if given is None:
            raise UserError(
                "Ess-InfoGAIL imitates: give --demonstrations FILE (python -m "
                "train.demonstrate makes them)"
            )
        if len(given.skills) > config.skills > 1:
            raise UserError(
                f"{given.source} has {len(given.skills)} labels ("
                f"{', '.join(given.skills)}), and skills is {config.skills}: give as "
                "many"
            )
        self._plain, self._ess = env, config
        self._coded = coded = Coded(env, config)
        self._given, self._judge = given, Judge(config, given)
        self._style = style_of(env)
        super().__init__(
            coded,
            config,
            lambda theta: (bind(theta[0]), theta[1]),
            lambda dist, key: _drawn(self._judge, draw, dist, key),
            tested or Tested(env, bind, draw),
        )

    def init(self, key: jax.Array, dist: Any) -> EssState:
        """As `Ppo.init`."""
        k_ppo, k_judge = jax.random.split(jax.random.wrap_key_data(raw_key(key)))
        judge = self._judge.init(k_judge)
        plain = super().init(k_ppo, (dist, judge.prior))
        return EssState(**_fields(plain), judge=judge)

    def continued(self, fresh: Any, old: Any) -> Any:
        """As `Ppo.continued`; the judge goes on, too."""
        judge = replace(fresh.judge, params=old.judge.params, prior=old.judge.prior)
        return replace(super().continued(fresh, old), judge=judge)

    def step(self, state: Any, dist: Any, eval_dist: Any = None) -> tuple[Any, Info]:
        """As `Ppo.step`; ``return`` is of the task alone.

        Tells ``judge_loss``, ``judge_right`` (share of windows it tells apart, before
        an update), ``style`` (mean reward for motion) and, with several skills, the
        least share of the ``prior``, too.
        """
        target = dist if eval_dist is None else eval_dist
        return super().step(state, (dist, state.judge.prior), target)

    def policy(self, state: EssState) -> PolicyParams:
        """The policy of the skill that was asked for."""
        return self.policy_of(state, self._ess.skill)

    def policy_of(self, state: EssState, skill: int, code: float = 0.0) -> PolicyParams:
        """A policy with a skill and a code built in."""
        whole = super().policy(state)
        n = self._plain.obs_size
        tail = self._coded.tail(jnp.asarray(code), jnp.eye(self._ess.skills)[skill])
        layers = dict(whole.network["params"])
        first = layers["hidden_0"]
        layers["hidden_0"] = {
            "kernel": first["kernel"][:n],
            "bias": first["bias"] + tail @ first["kernel"][n:],
        }
        return PolicyParams(whole.mean[:n], whole.std[:n], {"params": layers})

    def prior(self, state: EssState) -> jax.Array:
        """Probabilities of the skills that the training found, ``(K,)``."""
        return self._judge.probabilities(state.judge.prior)

    def _scaled(self, observation: Any, preprocessor_params: Any) -> Any:
        n = self._plain.obs_size
        scaled = standardize(observation, preprocessor_params)
        return jnp.concatenate([scaled[..., :n], observation[..., n:]], -1)

    def _noted(
        self, envs: EnvState, new: EnvState, theta: Any, action: jax.Array
    ) -> Noted:
        style = jax.vmap(self._style)
        before = style(envs.physics.qpos, envs.physics.qvel)
        if self._ess.frames == 2:
            second = style(new.physics.qpos, new.physics.qvel)
        else:
            second = jax.vmap(self.env.control)(envs, action)
        windows = self._given.scaled(jnp.concatenate([before, second], -1))
        return Noted(windows, theta[1], new.terminated > 0)

    def _judged(
        self, state: Any, rows: Any, bonus: jax.Array, key: jax.Array
    ) -> tuple[Any, Any, Info]:
        c, judge = self._ess, self._judge
        extras: Any = rows.extras
        noted: Noted = extras["noted"]
        usable = 1.0 - extras["state_extras"]["truncation"]
        fine = (usable > 0) & jnp.isfinite(noted.windows).all(-1)
        windows = jnp.where(fine[..., None], noted.windows, 0.0)
        flat = jax.tree.map(
            lambda x: x.reshape(-1, *x.shape[2:]),
            Batch(windows, noted.codes.code, fine.astype(windows.dtype)),
        )
        after = state.iteration - c.ramp_start
        ramp = jnp.clip(after / max(c.iterations - c.ramp_start, 1), 0.0, 1.0)
        rate = jnp.asarray(c.judge_learning_rate)
        if c.one_rate:
            rate = learning_rate_of(c, state)
        judged, told = judge.updates(state.judge, flat, key, ramp, rate)
        style = judge.rewards(
            *(judged.params, windows, noted.codes.skill, noted.codes.code),
            *(noted.failed & fine, c.discount),
        )
        reward = jnp.where(fine, style + c.task_reward * rows.reward, 0.0) + bonus
        extras = {k: v for k, v in extras.items() if k != "noted"}
        if c.prior == "gradient" and c.skills > 1:
            paid = rows._replace(reward=reward, extras=extras)
            slope = self._prior_slope(state, paid, noted.codes, judged.prior)
            judged = judge.prior_step(judged, slope)
        told |= {"style": jnp.sum(style * fine) / jnp.maximum(fine.sum(), 1)}
        if c.skills > 1:
            told |= {"least_prior": judge.probabilities(judged.prior).min()}
        state = replace(state, judge=judged)
        return state, rows._replace(reward=reward, extras=extras), told

    def _prior_slope(
        self, state: EssState, rows: Any, codes: Codes, prior: jax.Array
    ) -> jax.Array:
        """Slope ``(K,)`` of the policy's loss by what the prior is kept as, through the
        skills that were drawn (which may be of an older prior: their values stay)."""
        c, n = self._ess, self._plain.obs_size
        order = lambda x: jnp.swapaxes(x, 0, 1)  # noqa: E731
        data = jax.tree.map(order, rows)

        def loss(prior: jax.Array) -> jax.Array:
            now = relaxed(self._judge, prior, codes.gumbel, c.temperature)
            skill = codes.skill + now - jax.lax.stop_gradient(now)
            seen = jax.vmap(jax.vmap(self._coded.tail))(codes.code, skill)
            obs = jnp.concatenate([rows.observation[..., :n], seen], -1)
            batch = data._replace(observation=order(obs))
            given = state.normalizer, state.params, batch, jax.random.key(0)
            return self._loss(*given, of_policy=True)[0]

        return jax.grad(loss)(prior)


def relaxed(
    judge: Judge, prior: jax.Array, gumbel: jax.Array, temperature: float
) -> jax.Array:
    """Relaxed skills ``(..., K)`` by Gumbel noise (Jang et al., 2017)."""
    logits = jnp.log(jnp.maximum(judge.probabilities(prior), 1e-8))
    return jax.nn.softmax((logits + gumbel) / temperature)


def _drawn(
    judge: Judge, draw: Callable[[Any, jax.Array], Any], given: Any, key: jax.Array
) -> Any:
    """Physics and codes of an episode; ``given`` is a distribution and the prior."""
    dist, prior = given
    c = judge.config
    k_theta, k_code, k_skill = jax.random.split(key, 3)
    gumbel = jax.random.gumbel(k_skill, (c.skills,))
    code = jax.random.uniform(k_code, minval=-1.0, maxval=1.0) * c.continuous
    return draw(dist, k_theta), Codes(
        code, gumbel, relaxed(judge, prior, gumbel, c.temperature)
    )


def _fields(state: PpoState) -> dict[str, Any]:
    return {name: getattr(state, name) for name in PpoState.__dataclass_fields__}
