"""What a training algorithm offers: the same door for SAC, PPO and Ess-InfoGAIL."""

from collections.abc import Callable
from typing import Any, Protocol

import jax
from jax.sharding import Mesh

from easi_jax.rl.config import EssInfoGailConfig, PpoConfig, SacConfig
from easi_jax.rl.episodes import Tested
from easi_jax.rl.ess_infogail import EssInfoGail
from easi_jax.rl.learner import Info
from easi_jax.rl.networks import PolicyParams
from easi_jax.rl.ppo import Ppo
from easi_jax.rl.sac import Sac
from easi_jax.simulation.env import Env, Model

TrainingConfig = SacConfig | PpoConfig


class Trainer(Protocol):
    """A training as pure functions of its state; see `Sac` for what they do."""

    @property
    def config(self) -> Any: ...

    def over(self, mesh: Mesh) -> "Trainer | None": ...

    def init(self, key: jax.Array, dist: Any) -> Any: ...

    def continued(self, fresh: Any, old: Any) -> Any: ...

    def step(
        self, state: Any, dist: Any, eval_dist: Any = None
    ) -> tuple[Any, Info]: ...

    def run_chunk(
        self, state: Any, dist: Any, n: int, eval_dist: Any = None
    ) -> tuple[Any, Info]: ...

    def train(
        self, key: jax.Array, dist: Any, eval_dist: Any = None
    ) -> tuple[Any, Info]: ...

    def policy(self, state: Any) -> PolicyParams: ...

    def clock(self, state: Any) -> tuple[jax.Array, ...]: ...

    def with_clock(self, state: Any, clock: tuple[jax.Array, ...]) -> Any: ...


def make_trainer(
    env: Env,
    config: TrainingConfig,
    bind: Callable[[Any], Model],
    draw: Callable[[Any, jax.Array], Any],
    tested: Tested | None = None,
) -> Trainer:
    """The algorithm that ``config`` is of; arguments as for `Sac`.

    Raises:
        UserError: imitation without demonstrations, or of other skills than it has.
    """
    if isinstance(config, EssInfoGailConfig):
        return EssInfoGail(env, config, bind, draw, tested)
    if isinstance(config, PpoConfig):
        return Ppo(env, config, bind, draw, tested)
    return Sac(env, config, bind, draw, tested)
