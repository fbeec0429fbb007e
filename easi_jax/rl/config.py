"""Settings of SAC (defaults: EASI's reference on Cartpole), PPO and Ess-InfoGAIL."""

from dataclasses import dataclass, field
from typing import Any

from easi_jax.errors import UserError
from easi_jax.rl.demonstrations import Demonstrations


@dataclass(frozen=True)
class SacConfig:
    """Soft actor-critic. Raises UserError for values that cannot work."""

    env_steps: int = 500_000
    """Environment steps in all, the random ones included."""

    num_envs: int = 200
    """Environments that step together."""

    random_steps: int = 10_000
    """Environment steps with uniform actions and without updates, at the start."""

    updates_per_step: int = 10
    """Gradient updates after each step of all environments."""

    batch_size: int = 256
    """Transitions of a gradient update."""

    buffer_size: int = 1_000_000
    """Transitions kept for replay, rounded up to a multiple of `num_envs`."""

    hidden: tuple[int, ...] = (256, 256)
    """Hidden layer sizes of policy and critics."""

    critic_layer_norm: bool = False
    """Layer normalization in the critics."""

    learning_rate: float = 3e-4
    """Of Adam, for policy, critics and temperature."""

    learning_rate_decay: float = 1.0
    """Factor on the learning rate that is reached at `env_steps`, linearly."""

    discount: float = 0.99
    """Per control step."""

    tau: float = 0.005
    """Share by which the target critics follow the critics at each update."""

    reward_scaling: float = 1.0
    """Factor on rewards inside the losses; reported returns are unscaled."""

    target_entropy: float = -1.0
    """Of the policy, per action dimension [nat]."""

    initial_temperature: float = 1.0
    """Weight of the entropy at the start; learned afterwards."""

    normalize_observations: bool = True
    """Standardize observations by running statistics."""

    evaluate_every: int = 0
    """Evaluate the policy after every so many steps of all environments; 0: never."""

    eval_envs: int = 32
    """Episodes of an evaluation."""

    def __post_init__(self) -> None:
        whole = ("env_steps", "num_envs", "updates_per_step", "batch_size", "eval_envs")
        _check(
            self,
            "SAC",
            counts=(*whole, "buffer_size"),
            none_or_more=("random_steps", "evaluate_every"),
            positive=("learning_rate", "learning_rate_decay", "initial_temperature"),
            shares=("discount", "tau"),
        )
        if self.random_steps >= self.env_steps:
            need = f"needs less than env_steps={self.env_steps}"
            _refuse(self, "SAC", "random_steps", need)

    @property
    def iterations(self) -> int:
        """Steps of all environments that ``env_steps`` takes, rounded up."""
        return -(-self.env_steps // self.num_envs)

    @property
    def steps_per_iteration(self) -> int:
        """Environment steps of one of them."""
        return self.num_envs

    @property
    def random_iterations(self) -> int:
        """Those of them that act at random, at least one to fill the buffer."""
        return max(1, -(-self.random_steps // self.num_envs))

    @property
    def capacity(self) -> int:
        """Transitions that the buffer holds; never more than are collected."""
        wanted = min(self.buffer_size, self.iterations * self.num_envs)
        return -(-wanted // self.num_envs) * self.num_envs


@dataclass(frozen=True)
class PaperSacConfig(SacConfig):
    """SAC as the paper's reference trains it: the values of `SacConfig`."""


@dataclass(frozen=True)
class PpoConfig:
    """Proximal policy optimization. Raises UserError for values that cannot work."""

    env_steps: int = 1_000_000
    """Environment steps in all."""

    num_envs: int = 256
    """Environments that step together."""

    unroll: int = 20
    """Control steps between updates."""

    minibatches: int = 4
    """Parts that the environments are split into; each makes a gradient update."""

    epochs: int = 4
    """Times that each unroll is gone through."""

    hidden: tuple[int, ...] = (64, 64)
    """Hidden layer sizes of policy and value."""

    learning_rate: float = 1e-3
    """Of Adam."""

    learning_rate_decay: float = 1.0
    """Factor on the learning rate that is reached at `env_steps`, linearly."""

    max_gradient: float = 1.0
    """Norm that gradients are cut to."""

    clip_apart: bool = False
    """Policy and value are each cut to it; else both together, where the gradient of a
    value that errs by much leaves the policy's next to nothing."""

    discount: float = 0.99
    """Per control step."""

    gae_lambda: float = 0.95
    """Of the generalized advantages."""

    clipping: float = 0.2
    """Change of an action's probability beyond which there is nothing to gain."""

    entropy_cost: float = 1e-3
    """Weight of the entropy."""

    value_cost: float = 0.5
    """Weight of the value's squared error, halved, beside the policy's loss."""

    target_kl: float = 0.0
    """Divergence of an update that the learning rate is steered to: 1.5 times slower
    beyond twice as much, 1.5 times faster below half, within 1e-5 and 1e-2; 0: the
    learning rate is as above."""

    reward_scaling: float = 1.0
    """Factor on rewards inside the losses; reported returns are unscaled."""

    normalize_observations: bool = True
    """Standardize observations by running statistics."""

    evaluate_every: int = 0
    """Evaluate the policy after every so many unrolls; 0: never."""

    eval_envs: int = 32
    """Episodes of an evaluation."""

    def __post_init__(self) -> None:
        _check(
            self,
            "PPO",
            counts=(
                *("env_steps", "num_envs", "unroll", "minibatches"),
                *("epochs", "eval_envs"),
            ),
            none_or_more=("evaluate_every", "entropy_cost", "value_cost", "target_kl"),
            positive=("learning_rate", "learning_rate_decay", "max_gradient"),
            shares=("discount", "gae_lambda", "clipping"),
        )
        if self.num_envs % self.minibatches:
            need = f"needs a divisor of num_envs={self.num_envs}"
            _refuse(self, "PPO", "minibatches", need)

    @property
    def iterations(self) -> int:
        """Unrolls of all environments that ``env_steps`` takes, rounded up."""
        return -(-self.env_steps // self.steps_per_iteration)

    @property
    def steps_per_iteration(self) -> int:
        """Environment steps of one of them."""
        return self.num_envs * self.unroll


@dataclass(frozen=True)
class EssInfoGailConfig(PpoConfig):
    """Ess-InfoGAIL on PPO. Raises UserError for values that cannot work.

    The authors' later form (conditional entropy alone, prior as a running mean of the
    posterior), its defects mended; `PaperEssInfoGailConfig` is as published. Each
    defect has its own switch.
    """

    demonstrations: Demonstrations | None = field(default=None, repr=False)
    """What is imitated."""

    skills: int = 1
    """Categories that the policy is given one of for an episode."""

    skill: int = 0
    """The one that a finished policy plays."""

    continuous: bool = False
    """A continuous code, uniform in -1 and 1, is given to the policy, too."""

    frames: int = 2
    """What the discriminator sees: 2: how the robot holds itself and moves before and
    after a step; 1: before it, and the command that was sent."""

    judge_hidden: tuple[int, ...] = (100, 100)
    """Hidden layer sizes of the discriminator and its other heads, tanh."""

    judge_updates: int = 10
    """Gradient updates of it after each unroll."""

    judge_batch: int = 1024
    """Demonstrated, and as many simulated, windows of such an update."""

    judge_learning_rate: float = 3e-4
    """Of Adam, for discriminator and posterior."""

    skill_learning_rate: float = 1e-2
    """Of the posterior, where `shared_trunk_twice` gives it an optimizer of its own."""

    judge_decay: float = 1e-3
    """Decoupled weight decay beside it."""

    real_cost: float = 10.0
    """Weight of the two cross entropies of the discriminator."""

    code_cost: float = 1.0
    """Weight of the continuous code's error."""

    code_error: str = "squared"
    """Its form: squared or absolute."""

    gradient_penalty: float = 0.1
    """Weight of the discriminator's squared slope at demonstrations."""

    logit_cost: float = 0.25
    """Weight of the squared weights of its last layer."""

    weight_cost: float = 5e-4
    """Weight of all squared weights."""

    label_cost: float = 4.0
    """Weight of the cross entropy of labelled demonstrations."""

    conditional_cost: float = 2.0
    """Weight of the skills' entropy given a window, of those without a label: every
    window is of one skill."""

    marginal_cost: float = 0.0
    """Weight of the entropy of their mean, which is driven up."""

    prior_cost: float = 0.0
    """Weight of the cross entropy between their mean and the prior."""

    ramp_start: int = 20
    """Unrolls before the last three act; they then grow linearly to their weights at
    the training's end."""

    prior: str = "mean"
    """How the prior over skills is found: mean (running, of the posterior on
    demonstrations), gradient (of PPO's loss through the skill that was given) or fixed
    (all alike)."""

    prior_rate: float = 1e-3
    """Share of the running mean that is new at an update, or Adam's learning rate."""

    temperature: float = 0.1
    """Of the relaxed skill (Gumbel-softmax) that the policy is given."""

    style_reward: float = 1.0
    """Weight of the discriminator's reward."""

    code_reward: float = 0.2
    """Weight of the continuous code that can be read off, by the error's negative."""

    skill_reward: float = 0.2
    """Weight of the skill that can be read off, by its log probability."""

    task_reward: float = 0.01
    """Weight of the environment's own reward."""

    style_form: str = "score"
    """Of the discriminator's reward at its logit d: score: d itself, cut to -5 and 5, a
    task that ends being worth the least of it for good; positive: -log(1 - sigma(d)),
    which pays a robot for living on."""

    double_softmax: bool = False
    """A defect: the labels' cross entropy takes probabilities for logits."""

    one_rate: bool = False
    """A defect: the discriminator takes the policy's learning rate."""

    shared_trunk_twice: bool = False
    """A defect: the layers that discriminator and posterior share are in the
    optimizers of both, which take turns; else one optimizer descends both losses."""

    def __post_init__(self) -> None:
        """Raises UserError for values that cannot work."""
        super().__post_init__()
        costs = ("real", "code", "logit", "weight", "label", "conditional", "prior")
        _check(
            self,
            "Ess-InfoGAIL",
            counts=("skills", "judge_batch"),
            none_or_more=(
                "skill",
                *(f"{name}_cost" for name in costs),
                *("marginal_cost", "gradient_penalty", "judge_updates", "judge_decay"),
                *("ramp_start", "prior_rate"),
                *("style_reward", "code_reward", "skill_reward", "task_reward"),
            ),
            positive=("judge_learning_rate", "skill_learning_rate", "temperature"),
            shares=(),
        )
        if self.skill >= self.skills:
            need = f"counts from 0, and there are skills={self.skills}"
            _refuse(self, "Ess-InfoGAIL", "skill", need)
        if self.style_form == "score" and self.discount >= 1:
            need = "is below 1 where style_form is score"
            _refuse(self, "Ess-InfoGAIL", "discount", need)
        for name, known in _CHOICES.items():
            if getattr(self, name) not in known:
                _refuse(
                    self,
                    "Ess-InfoGAIL",
                    name,
                    f"is one of {', '.join(map(str, known))}",
                )

    @property
    def codes(self) -> int:
        """Numbers that the policy is given beside the observation."""
        return int(self.continuous) + (self.skills if self.skills > 1 else 0)

    def acting(self) -> PpoConfig:
        """PPO whose policies have the same form: a skill is built into these."""
        return PpoConfig(env_steps=self.env_steps, hidden=self.hidden)


@dataclass(frozen=True)
class PaperEssInfoGailConfig(EssInfoGailConfig):
    """Ess-InfoGAIL as published, its code's defects included.

    Facts of the authors' public code. What still differs: the policy's network is
    brax's (ReLU, a spread that depends on the observation), many environments unroll in
    place of one, the discriminator sees what is imitated (`easi_jax.rl.demonstrations`)
    and not the observation, always in standard deviations of the demonstrations, and
    its weight decay is apart from Adam's moments.
    """

    frames: int = 1
    continuous: bool = True
    epochs: int = 20
    minibatches: int = 1
    learning_rate: float = 3e-3
    target_kl: float = 0.01
    entropy_cost: float = 0.0
    value_cost: float = 2.5  # 5, halved, beside a policy's loss that counts 4 times
    judge_updates: int = 50
    judge_batch: int = 1000
    judge_learning_rate: float = 5e-3
    code_error: str = "absolute"
    conditional_cost: float = 3.0
    marginal_cost: float = 0.05
    prior_cost: float = 0.5
    prior: str = "gradient"
    prior_rate: float = 3e-3
    style_form: str = "positive"
    code_reward: float = 0.1
    skill_reward: float = 0.1
    task_reward: float = 0.005
    double_softmax: bool = True
    one_rate: bool = True
    shared_trunk_twice: bool = True


_CHOICES: dict[str, tuple[Any, ...]] = {
    "frames": (1, 2),
    "code_error": ("squared", "absolute"),
    "prior": ("mean", "gradient", "fixed"),
    "style_form": ("score", "positive"),
}


def _check(
    config: Any,
    kind: str,
    counts: tuple[str, ...],
    none_or_more: tuple[str, ...],
    positive: tuple[str, ...],
    shares: tuple[str, ...],
) -> None:
    rules = (
        (counts, lambda x: x >= 1, "needs at least 1"),
        (none_or_more, lambda x: x >= 0, "needs 0 or more"),
        (positive, lambda x: x > 0, "needs a number above 0"),
        (shares, lambda x: 0 <= x <= 1, "needs a number from 0 to 1"),
        (
            ("hidden",),
            lambda x: bool(x) and min(x) >= 1,
            "needs at least one layer of at least one unit",
        ),
    )
    for names, holds, need in rules:
        for name in names:
            if not holds(getattr(config, name)):
                _refuse(config, kind, name, need)


def _refuse(config: Any, kind: str, name: str, need: str) -> None:
    raise UserError(f"{kind} setting {name}={getattr(config, name)}: it {need}")
