"""Methods that EASI is compared with, and EASI itself, behind one interface.

Each is a frozen dataclass of its settings; the published ones and their source are in
its docstring. A `Method` finds a distribution over parameters: ``fit(task,
demonstrations, budget, key)``. A `PolicyMethod` (UDR, Oracle, FineTune, GARAT) learns a
policy: ``fit(practice, demonstrations, budget, key)``.
"""

from easi_jax.baselines.dropo import Dropo
from easi_jax.baselines.easi import Easi
from easi_jax.baselines.garat import Garat
from easi_jax.baselines.mujoco_sysid import MujocoSysid
from easi_jax.baselines.npe import NeuralPosterior
from easi_jax.baselines.policies import (
    FineTune,
    Learned,
    Oracle,
    PolicyMethod,
    Practice,
    Udr,
)
from easi_jax.baselines.replay_cma_es import PairedCmaEs, RandomSearch
from easi_jax.baselines.simopt import SimOpt
from easi_jax.baselines.task import Budget, Identified, Method, Task

__all__ = [
    "Budget",
    "Dropo",
    "Easi",
    "FineTune",
    "Garat",
    "Identified",
    "Learned",
    "Method",
    "MujocoSysid",
    "NeuralPosterior",
    "Oracle",
    "PairedCmaEs",
    "PolicyMethod",
    "Practice",
    "RandomSearch",
    "SimOpt",
    "Task",
    "Udr",
]
