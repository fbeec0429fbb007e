"""Old module names that environment files of users import; each hands on the new one.

Modules lay flat in `easi_jax` until version 0.1. An environment file written for it
(``--env my_robot.py``) still runs, with a `DeprecationWarning` that says the new name.
"""

import importlib
import sys
import warnings
from collections.abc import Sequence
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType

# What the templates and the documentation of version 0.1 told users to import.
MOVED = {
    "action_map": "simulation.action_map",
    "configuration": "model.joint_space",
    "constants": "model.set_const",
    "distribution": "model.distribution",
    "drives": "model.torque_speed",
    "effects": "model.effects",
    "env": "simulation.env",
    "machine": "simulation.simulator",
    "methods": "baselines",
    "parameters": "model.parameters",
    "physics": "simulation.step",
    "quantities": "model.quantities",
    "recording": "data.recording",
    "replay": "simulation.open_loop",
    "rollout": "simulation.rollout",
    "runtime": "devices.runtime",
    "search_config": "search.config",
    "segments": "data.segments",
}


# Classes of these modules that have another name now.
RENAMED = {"simulation.simulator": {"Machine": "Simulator"}}


class _Moved(MetaPathFinder, Loader):
    """Finds ``easi_jax.OLD`` and returns the module that took its place."""

    def __init__(self) -> None:
        self._specs: dict[str, ModuleSpec | None] = {}

    def find_spec(
        self,
        fullname: str,
        path: Sequence[str] | None,
        target: ModuleType | None = None,
    ) -> ModuleSpec | None:
        """A spec for names of `MOVED`; None for all others."""
        del path, target
        package, _, name = fullname.partition(".")
        if package == "easi_jax" and name in MOVED:
            return ModuleSpec(fullname, self)
        return None

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        """The module under its new name."""
        place = MOVED[spec.name.partition(".")[2]]
        new = f"easi_jax.{place}"
        warnings.warn(
            f"{spec.name} is now {new}: change the import",
            DeprecationWarning,
            stacklevel=2,
        )
        module = importlib.import_module(new)
        for old, name in RENAMED.get(place, {}).items():
            setattr(module, old, getattr(module, name))
        self._specs[spec.name] = module.__spec__
        return module

    def exec_module(self, module: ModuleType) -> None:
        """The new module has run; importlib has given it the old name's spec."""
        old = module.__spec__
        if old is not None and old.name in self._specs:
            module.__spec__ = self._specs.pop(old.name)


def install() -> None:
    """Lets the old names be imported."""
    if not any(isinstance(finder, _Moved) for finder in sys.meta_path):
        sys.meta_path.append(_Moved())
