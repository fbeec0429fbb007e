"""Policy training: SAC, evaluation, and probes that tell which part is broken."""

from easi_jax.rl.config import SacConfig
from easi_jax.rl.evaluate import evaluate
from easi_jax.rl.networks import PolicyParams, act
from easi_jax.rl.sac import Sac, SacState
from easi_jax.rl.seeds import init_seeds, run_seeds, train_seeds

__all__ = [
    "PolicyParams",
    "Sac",
    "SacConfig",
    "SacState",
    "act",
    "evaluate",
    "init_seeds",
    "run_seeds",
    "train_seeds",
]
