"""Which program simulates: MJX, compiled, or native MuJoCo on all cores.

A command chooses once, by `use`; simulators that are made without an engine of their
own take that choice. ``auto`` decides from the model and the devices, never by timing,
so that a run that is resumed decides alike.
"""

from typing import Literal, get_args

import mujoco

from easi_jax.devices.runtime import on_cpu
from easi_jax.errors import UserError, nearest

Engine = Literal["mjx", "mujoco"]
CHOICES = ("auto", *get_args(Engine))

_chosen: list[str] = ["auto"]


def use(name: str) -> None:
    """Sets the engine of simulators that are made from now on.

    Raises:
        UserError: not one of `CHOICES`.
    """
    if name not in CHOICES:
        raise UserError(
            f'engine "{name}": give one of {", ".join(CHOICES)}{nearest(name, CHOICES)}'
        )
    _chosen[0] = name


def resolved(engine: str | None, m: mujoco.MjModel) -> Engine:
    """The engine for a model: the given one, else the chosen one."""
    name = engine or _chosen[0]
    if name == "auto":
        return automatic(m)[0]
    return name  # type: ignore[return-value]


def automatic(m: mujoco.MjModel) -> tuple[Engine, str]:
    """The engine that ``auto`` takes for a model, and why."""
    if not on_cpu():
        return "mjx", "an accelerator is used"
    return "mjx", "nothing speaks against it"
