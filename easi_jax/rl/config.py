"""Settings of SAC (defaults: EASI's reference on Cartpole) and of PPO."""

from dataclasses import dataclass
from typing import Any

from easi_jax.errors import UserError


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

    discount: float = 0.99
    """Per control step."""

    gae_lambda: float = 0.95
    """Of the generalized advantages."""

    clipping: float = 0.2
    """Change of an action's probability beyond which there is nothing to gain."""

    entropy_cost: float = 1e-3
    """Weight of the entropy."""

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
            none_or_more=("evaluate_every", "entropy_cost"),
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
