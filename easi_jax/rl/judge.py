"""Ess-InfoGAIL's discriminator, with heads that read the skill and the code off motion.

Fu et al., *Ess-InfoGAIL: Semi-supervised Imitation Learning from Imbalanced
Demonstrations* (NeurIPS 2023): BCE GAIL (Ho and Ermon, 2016) with a gradient penalty on
demonstrations, InfoGAIL's posterior (Li et al., 2017), and regularized information
maximization (Krause et al., 2010) where nothing is labelled.
"""

from dataclasses import replace
from typing import Any, NamedTuple

import flax.linen as nn
import flax.struct
import jax
import jax.numpy as jnp
import optax

from easi_jax.rl.config import EssInfoGailConfig
from easi_jax.rl.demonstrations import Demonstrations
from easi_jax.rl.learner import Info


class Read(NamedTuple):
    """What the network says of windows ``(..., features)``.

    Attributes:
        real: logit of being demonstrated, ``(...)``.
        skill: logits, ``(..., skills)``.
        code: the continuous code, ``(...)``.
    """

    real: jax.Array
    skill: jax.Array
    code: jax.Array


class Network(nn.Module):
    """Tanh layers and three linear heads."""

    hidden: tuple[int, ...]
    skills: int

    @nn.compact
    def __call__(self, x: jax.Array) -> Read:
        for k, width in enumerate(self.hidden):
            x = nn.tanh(nn.Dense(width, name=f"layer_{k}")(x))
        real = nn.Dense(1, name="real")(x)[..., 0]
        code = nn.Dense(1, name="code")(x)[..., 0]
        return Read(real, nn.Dense(self.skills, name="skill")(x), code)


@flax.struct.dataclass
class JudgeState:
    """What its updates change.

    Attributes:
        params: weights.
        optimizer: of discriminator and code, or of all (`Judge`).
        skill_optimizer: of the posterior, where it has its own.
        prior: of the skills, ``(K,)``: probabilities, or with ``gradient`` numbers
            whose exponentials' softmax they are.
        prior_optimizer: of the latter.
    """

    params: Any
    optimizer: Any
    skill_optimizer: Any
    prior: jax.Array
    prior_optimizer: Any


class Batch(NamedTuple):
    """Simulated windows ``(n, features)`` and what the policy was given in them.

    Attributes:
        windows: scaled as the demonstrations are.
        code: ``(n,)``.
        weight: 0 where a window does not count, ``(n,)``.
    """

    windows: jax.Array
    code: jax.Array
    weight: jax.Array


class Judge:
    """Losses and updates for one set of demonstrations."""

    def __init__(self, config: EssInfoGailConfig, given: Demonstrations) -> None:
        """Keeps the demonstrations, scaled."""
        self.config = config
        self.network = Network(config.judge_hidden, config.skills)
        self.real = jnp.asarray(given.scaled(given.windows), jnp.float32)
        at = given.labels >= 0
        self.labelled = self.real[at] if at.any() else self.real[:0]
        # All where each has a label: then what has one stands for what has none.
        self.unlabelled = self.real if at.all() else self.real[~at]
        self.labels = jnp.asarray(given.labels[at])
        # A rate of one: updates are scaled by the rate that holds.
        self._optimizer = optax.adamw(1.0, weight_decay=config.judge_decay)
        self._adam = optax.adam(1.0)

    def init(self, key: jax.Array) -> JudgeState:
        """Fresh networks; all skills alike."""
        c = self.config
        params = self.network.init(key, self.real[0])
        prior = jnp.full(c.skills, 1.0 / c.skills)
        return JudgeState(
            params=params,
            optimizer=self._optimizer.init(params),
            skill_optimizer=(
                self._optimizer.init(params) if c.shared_trunk_twice else ()
            ),
            prior=prior,
            prior_optimizer=self._adam.init(prior) if c.prior == "gradient" else (),
        )

    def read(self, params: Any, windows: jax.Array) -> Read:
        """The network's answer."""
        out = self.network.apply(params, windows)
        assert isinstance(out, Read)
        return out

    def probabilities(self, prior: jax.Array) -> jax.Array:
        """Of the skills, ``(K,)``, of what a state keeps."""
        if self.config.prior == "gradient":
            return jax.nn.softmax(jnp.exp(prior))
        return prior

    def rewards(
        self,
        params: Any,
        windows: jax.Array,
        skill: jax.Array,
        code: jax.Array,
        ended: jax.Array,
        discount: float,
    ) -> jax.Array:
        """What the policy is paid for its motion, without its task, ``(...)``.

        Args:
            params: of the network.
            windows: ``(..., features)``, scaled.
            skill: relaxed skill that the policy was given, ``(..., K)``.
            code: continuous code, ``(...)``.
            ended: where the task failed, ``(...)`` bool.
            discount: per step, for what comes after such an end.
        """
        c, read = self.config, self.read(params, windows)
        if c.style_form == "positive":
            style = -jnp.log(jnp.maximum(jax.nn.sigmoid(-read.real), _LEAST))
        else:
            style = jnp.clip(read.real, -_CUT, _CUT)
            # An absorbing state is never demonstrated (Kostrikov et al., 2019).
            style = jnp.where(ended, -_CUT / (1.0 - discount), style)
        total = c.style_reward * style
        if c.continuous:
            total -= c.code_reward * self._error(read.code, code)
        if c.skills > 1:
            said = jnp.sum(skill * jax.nn.log_softmax(read.skill), -1)
            total += c.skill_reward * said
        return total

    def updates(
        self,
        state: JudgeState,
        fake: Batch,
        key: jax.Array,
        ramp: jax.Array,
        rate: jax.Array,
    ) -> tuple[JudgeState, Info]:
        """``judge_updates`` of them on ``fake`` windows ``(n, ...)``.

        Args:
            state: before them.
            fake: of the last unroll.
            key: for batches.
            ramp: of the terms without labels, 0 to 1.
            rate: learning rate.
        """
        n = self.config.judge_updates

        def one(state: JudgeState, key: jax.Array) -> tuple[JudgeState, Info]:
            return self._update(state, fake, key, ramp, rate)

        state, told = jax.lax.scan(one, state, jax.random.split(key, n))
        return state, jax.tree.map(jnp.mean, told)

    def prior_step(self, state: JudgeState, slope: jax.Array) -> JudgeState:
        """The prior after a step down the slope of PPO's loss, ``(K,)``."""
        step, opt = self._adam.update(slope, state.prior_optimizer)
        assert isinstance(step, jax.Array)
        rate = self.config.prior_rate
        return replace(state, prior=state.prior + rate * step, prior_optimizer=opt)

    def _update(
        self, state: JudgeState, fake: Batch, key: jax.Array, ramp: Any, rate: Any
    ) -> tuple[JudgeState, Info]:
        c = self.config
        k_real, k_fake, k_label, k_free = jax.random.split(key, 4)
        real = self.real[_drawn(k_real, c.judge_batch, len(self.real))]
        at = _drawn(k_fake, c.judge_batch, len(fake.windows))
        fake = Batch(*(x[at] for x in fake))
        labelled, labels = self.labelled, self.labels
        if len(labelled) > c.judge_batch:
            at = _drawn(k_label, c.judge_batch, len(labelled))
            labelled, labels = labelled[at], labels[at]
        prior = jax.lax.stop_gradient(self.probabilities(state.prior))

        def judged(params: Any) -> tuple[jax.Array, Info]:
            return self._real_loss(params, real, fake)

        at = _drawn(k_free, c.judge_batch, len(self.unlabelled))
        free = self.unlabelled[at]

        def skilled(params: Any) -> tuple[jax.Array, jax.Array]:
            return self._skill_loss(params, free, labelled, labels, prior, ramp)

        params = state.params
        if c.shared_trunk_twice:
            slope, told = jax.grad(judged, has_aux=True)(params)
            params, opt = self._descend(slope, state.optimizer, params, rate)
            slope, mean = jax.grad(skilled, has_aux=True)(params)
            own = state.skill_optimizer, params, c.skill_learning_rate
            params, second = self._descend(slope, *own)
        else:

            def both(params: Any) -> Any:
                first, told = judged(params)
                second, mean = skilled(params)
                return first + second, (told, mean)

            slope, (told, mean) = jax.grad(both, has_aux=True)(params)
            params, opt = self._descend(slope, state.optimizer, params, rate)
            second = state.skill_optimizer
        new_prior = state.prior
        if c.prior == "mean":
            new_prior = (1 - c.prior_rate) * new_prior + c.prior_rate * mean
        state = replace(
            state, params=params, optimizer=opt, skill_optimizer=second, prior=new_prior
        )
        return state, told

    def _descend(self, slope: Any, opt: Any, params: Any, rate: Any) -> Any:
        step, opt = self._optimizer.update(slope, opt, params)
        return optax.apply_updates(params, jax.tree.map(lambda x: rate * x, step)), opt

    def _error(self, said: jax.Array, code: jax.Array) -> jax.Array:
        off = said - code
        return jnp.abs(off) if self.config.code_error == "absolute" else off**2

    def _real_loss(
        self, params: Any, real: jax.Array, fake: Batch
    ) -> tuple[jax.Array, Info]:
        c = self.config
        weight = fake.weight / jnp.maximum(fake.weight.sum(), 1.0)
        on_real, on_fake = self.read(params, real), self.read(params, fake.windows)
        entropy = -jnp.mean(jax.nn.log_sigmoid(on_real.real))
        entropy -= jnp.sum(weight * jax.nn.log_sigmoid(-on_fake.real))
        slope = jax.vmap(jax.grad(lambda x: self.read(params, x).real))(real)
        loss = c.real_cost * entropy
        loss += c.gradient_penalty * jnp.mean(jnp.sum(slope**2, -1))
        weights = params["params"]
        loss += c.logit_cost * jnp.sum(weights["real"]["kernel"] ** 2)
        kernels = [layer["kernel"] for layer in weights.values()]
        loss += c.weight_cost * sum(jnp.sum(w**2) for w in kernels)
        if c.continuous:
            error = self._error(on_fake.code, fake.code)
            loss += c.code_cost * jnp.sum(weight * error)
        right = 0.5 * (
            jnp.mean(on_real.real > 0) + jnp.sum(weight * (on_fake.real <= 0))
        )
        return loss, {"judge_loss": loss, "judge_right": right}

    def _skill_loss(
        self,
        params: Any,
        free: jax.Array,
        labelled: jax.Array,
        labels: jax.Array,
        prior: jax.Array,
        ramp: jax.Array,
    ) -> tuple[jax.Array, jax.Array]:
        """The posterior's loss, and its mean over windows without a label ``(K,)``."""
        c = self.config
        if c.skills == 1:
            return jnp.zeros(()), jnp.ones(1)
        log_q = jax.nn.log_softmax(self.read(params, free).skill)
        q = jnp.exp(log_q)
        mean = q.mean(0)
        log_mean = jnp.log(jnp.maximum(mean, 1e-8))
        loss = c.conditional_cost * -jnp.mean(jnp.sum(q * log_q, -1))
        loss -= c.marginal_cost * -jnp.sum(mean * log_mean)
        loss += c.prior_cost * -jnp.sum(mean * jnp.log(jnp.maximum(prior, 1e-8)))
        loss *= ramp
        if len(labelled):
            logits = self.read(params, labelled).skill
            if c.double_softmax:
                logits = jax.nn.softmax(logits)
            loss += c.label_cost * jnp.mean(
                optax.softmax_cross_entropy_with_integer_labels(logits, labels)
            )
        return loss, jax.lax.stop_gradient(mean)


# Least probability inside the logarithm of the positive reward, so that it is at most
# 9.2 (the authors' code), and size that the score is cut to.
_LEAST, _CUT = 1e-4, 5.0


def _drawn(key: jax.Array, n: int, of: int) -> jax.Array:
    return jax.random.randint(key, (n,), 0, of)
