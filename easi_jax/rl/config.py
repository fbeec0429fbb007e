"""Settings of SAC; the defaults are those of EASI's reference on Cartpole."""

from dataclasses import dataclass

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
        for name in (*whole, "buffer_size"):
            if getattr(self, name) < 1:
                self._refuse(name, "needs at least 1")
        for name in ("random_steps", "evaluate_every"):
            if getattr(self, name) < 0:
                self._refuse(name, "needs 0 or more")
        for name in ("learning_rate", "learning_rate_decay", "initial_temperature"):
            if not getattr(self, name) > 0:
                self._refuse(name, "needs a number above 0")
        for name in ("discount", "tau"):
            if not 0 <= getattr(self, name) <= 1:
                self._refuse(name, "needs a number from 0 to 1")
        if not self.hidden or min(self.hidden) < 1:
            self._refuse("hidden", "needs at least one layer of at least one unit")
        if self.random_steps >= self.env_steps:
            self._refuse("random_steps", f"needs less than env_steps={self.env_steps}")

    def _refuse(self, name: str, need: str) -> None:
        raise UserError(f"SAC setting {name}={getattr(self, name)}: it {need}")

    @property
    def iterations(self) -> int:
        """Steps of all environments that ``env_steps`` takes, rounded up."""
        return -(-self.env_steps // self.num_envs)

    @property
    def random_iterations(self) -> int:
        """Those of them that act at random, at least one to fill the buffer."""
        return max(1, -(-self.random_steps // self.num_envs))

    @property
    def capacity(self) -> int:
        """Transitions that the buffer holds; never more than are collected."""
        wanted = min(self.buffer_size, self.iterations * self.num_envs)
        return -(-wanted // self.num_envs) * self.num_envs
