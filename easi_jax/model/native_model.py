"""A MuJoCo model for the native engine, with the fields that vary as arrays.

`easi_jax.model.mjx_model` and `easi_jax.model.effects` write parameters and effects
into models by name of field. A `NativeModel` has the fields of an `MjModel` under the
names of an `mjx.Model`, so that the same functions write both; what was written is what
`easi_jax.simulation.native` hands to MuJoCo C.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np


class Template:
    """An `MjModel` as a static part of a pytree: equal only to itself.

    Attributes:
        mj: nominal values; physics step in its option.
        limits_speed: whether a joint's speed may have a limit, which MuJoCo lacks.
    """

    def __init__(self, mj: mujoco.MjModel, limits_speed: bool) -> None:
        self.mj = mj
        self.limits_speed = limits_speed


@partial(
    jax.tree_util.register_dataclass,
    data_fields=["changed"],
    meta_fields=["template"],
)
@dataclass(frozen=True)
class NativeModel:
    """Fields of an `MjModel`, some of them replaced by arrays; a pytree.

    Attributes:
        template: the model (static).
        changed: arrays by name of field, such as ``body_mass`` or ``opt.gravity``.
    """

    template: Template
    changed: dict[str, jax.Array] = field(default_factory=dict)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        if name == "opt":
            return _Group(self, "opt")
        return _field(self, name)

    def tree_replace(self, values: Mapping[str, Any]) -> "NativeModel":
        """As `mjx.Model.tree_replace`: values by name of field, dots allowed."""
        return NativeModel(self.template, {**self.changed, **values})

    def replace(self, **values: Any) -> "NativeModel":
        """As `mjx.Model.replace`."""
        return self.tree_replace(values)


class _Group:
    def __init__(self, model: NativeModel, name: str) -> None:
        self._model, self._name = model, name

    def __getattr__(self, name: str) -> Any:
        return _field(self._model, f"{self._name}.{name}")


def _field(model: NativeModel, name: str) -> Any:
    found = model.changed.get(name)
    if found is not None:
        return found
    value = nominal_field(model.template.mj, name)
    kind = np.asarray(value).dtype.kind
    # As in an `mjx.Model`: numbers are arrays, what says how they are used is not.
    return jnp.asarray(value, jnp.result_type(float)) if kind == "f" else value


def as_precise(leaf: jax.Array, other: jax.Array) -> jax.Array:
    """``leaf`` in doubles where ``other`` is, which is to be written into it."""
    return leaf.astype(jnp.promote_types(leaf.dtype, other.dtype))


def nominal_field(m: mujoco.MjModel, name: str) -> Any:
    """A field of a model by name, dots allowed."""
    value: Any = m
    for part in name.split("."):
        value = getattr(value, part)
    return value
