"""Effects that are in a model's own numbers, and how it is without them.

A model's text keeps both as custom numbers: who varies such an effect, as
`easi_jax.export.randomization` does, must not add it to itself.
"""

import copy
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import reduce
from typing import Any

import mujoco
import numpy as np

from easi_jax.errors import UserError
from easi_jax.model.addresses import split
from easi_jax.model.effect_numbers import field_of, fields_that_act

# Places of names and files in tables of bytes.
_NO_NUMBERS = re.compile(
    r"names(_map)?|paths|.*adr$|.*_adr|signature|nbuffer|nnames|npaths"
)
_WITHOUT = "without_effects."  # and a field of the model: its numbers without them
_WITH = "with_effects."  # and the address of an effect: its value


@dataclass(frozen=True)
class Undo:
    """What undoes effects in the numbers of a model.

    Attributes:
        without: the same model without them.
        values: of the effects, by address.
    """

    without: mujoco.MjModel
    values: Mapping[str, float]


def is_written(address: str) -> bool:
    """Whether it is an effect that is numbers of the model."""
    kind, _, quantity = split(address)
    return kind == "effect" and field_of(quantity) in fields_that_act("model")


def forget(spec: mujoco.MjSpec) -> None:
    """Takes out of ``spec`` what an earlier export wrote of how it is without
    effects."""
    for old in [x for x in spec.numerics if x.name.startswith((_WITHOUT, _WITH))]:
        spec.delete(old)


def keep(spec: mujoco.MjSpec, m: mujoco.MjModel, undo: Undo) -> None:
    """Writes into ``spec``, of which ``m`` was compiled, how it is without effects."""
    theirs = dict(numbers(undo.without))
    for name, value in numbers(m):
        other = np.asarray(theirs[name])
        alike = np.shape(value) == other.shape and other.dtype.kind in "fb"
        if alike and other.size and not np.array_equal(value, other):
            data = other.astype(float).ravel()
            spec.add_numeric(name=_WITHOUT + name, data=data, size=data.size)
    for address, value in undo.values.items():
        spec.add_numeric(name=_WITH + address, data=[value], size=1)


def undone(m: mujoco.MjModel) -> Undo:
    """The model without effects that its numbers have, and these.

    Raises:
        UserError: a model that was exported is part of another one now.
    """
    out, values = copy.deepcopy(m), dict[str, float]()
    for i in range(m.nnumeric):
        kept = m.numeric(i)
        if kept.name.startswith(_WITH):
            values[kept.name.removeprefix(_WITH)] = float(kept.data[0])
        elif kept.name.startswith(_WITHOUT):
            *path, last = kept.name.removeprefix(_WITHOUT).split(".")
            target = getattr(reduce(getattr, path, out), last)
            if np.size(kept.data) != np.size(target):
                raise UserError(
                    f"{kept.name}: the model has other parts than that of train.export "
                    "whose effects it holds; give that one alone"
                )
            target[:] = np.reshape(kept.data, np.shape(target))
        elif _WITH in kept.name or _WITHOUT in kept.name:
            raise UserError(
                f"{kept.name}: a model of train.export is attached; give that one alone"
            )
    return Undo(out, values)


def numbers(m: mujoco.MjModel) -> Iterator[tuple[str, Any]]:
    """Name and value of every number and array that a simulation may use: not names,
    and not ``stat`` and ``vis``, which are for drawing."""
    for prefix, owner in (("", m), ("opt.", m.opt)):
        for name in dir(owner):
            value = None if name[0] == "_" else getattr(owner, name)
            number = isinstance(value, int | float | np.ndarray)
            if number and not _NO_NUMBERS.fullmatch(name):
                yield prefix + name, value
