"""EASI-JAX: simulator identification and repair in JAX.

The names below are the public API; README shows them at work. Modules behind them may
move between versions, these names stay.

    read_model, read_parameters, read_log   what is known of a machine
    search_parameters                       EASI: parameters from unpaired motion
    estimate_parameters                     least squares, with uncertainty
    find_effects                            the physics that the model lacks
    train_policy                            a policy under what was found
    export_model, export_policy             files for other programs
    BraxEnv, GymnasiumEnv                   robots for brax's and for own loops
    OwnEffect, Number                       an effect of your own, for find_effects
    UserError                               a mistake that a user can mend
"""

import importlib
from typing import TYPE_CHECKING, Any

from easi_jax import _moved
from easi_jax.devices import runtime
from easi_jax.version import __version__

_moved.install()
runtime.prepare()

if TYPE_CHECKING:
    from easi_jax.api import (
        Estimated,
        Policy,
        Searched,
        estimate_parameters,
        export_model,
        export_policy,
        find_effects,
        read_log,
        read_model,
        read_parameters,
        search_parameters,
        train_policy,
    )
    from easi_jax.errors import UserError
    from easi_jax.model.own_effects import Number, OwnEffect
    from easi_jax.rl.brax_env import BraxEnv
    from easi_jax.rl.gymnasium_env import GymnasiumEnv

__all__ = [
    "BraxEnv",
    "Estimated",
    "GymnasiumEnv",
    "Number",
    "OwnEffect",
    "Policy",
    "Searched",
    "UserError",
    "__version__",
    "estimate_parameters",
    "export_model",
    "export_policy",
    "find_effects",
    "read_log",
    "read_model",
    "read_parameters",
    "search_parameters",
    "train_policy",
]

_ELSEWHERE = {
    "BraxEnv": "rl.brax_env",
    "GymnasiumEnv": "rl.gymnasium_env",
    "Number": "model.own_effects",
    "OwnEffect": "model.own_effects",
    "UserError": "errors",
}


def __getattr__(name: str) -> Any:
    """A public name, imported at its first use, so that the package imports quickly."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    place = importlib.import_module(f"{__name__}.{_ELSEWHERE.get(name, 'api')}")
    value = globals()[name] = getattr(place, name)
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
