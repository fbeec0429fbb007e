"""Policy training: SAC, PPO, evaluation."""

from easi_jax.rl.config import PpoConfig, SacConfig
from easi_jax.rl.evaluate import evaluate
from easi_jax.rl.networks import PolicyParams, act
from easi_jax.rl.ppo import Ppo, PpoState
from easi_jax.rl.sac import Sac, SacState
from easi_jax.rl.seeds import init_seeds, run_seeds, train_seeds
from easi_jax.rl.trainer import Trainer, make_trainer

__all__ = [
    "PolicyParams",
    "Ppo",
    "PpoConfig",
    "PpoState",
    "Sac",
    "SacConfig",
    "SacState",
    "Trainer",
    "act",
    "evaluate",
    "init_seeds",
    "make_trainer",
    "run_seeds",
    "train_seeds",
]
