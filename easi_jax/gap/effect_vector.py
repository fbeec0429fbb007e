"""The long vector of all effects at all places, and how it becomes physics."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from easi_jax.gap.table import Column, Place
from easi_jax.model import effects
from easi_jax.model.effects import Effects


class Layout:
    """The long vector of all columns, and how it becomes `Effects`.

    Attributes:
        columns: its numbers.
        none: no effect.
        neutral: the vector of that.
    """

    def __init__(self, m: mujoco.MjModel, found: Sequence[Place]) -> None:
        self.columns: list[Column] = []
        self._index: dict[object, int] = {}
        for place in found:
            for c in place.columns:
                key = _key(c)
                if key not in self._index:
                    self._index[key] = len(self.columns)
                    self.columns.append(c)
        self.none = effects.none(m)
        self.neutral = np.array([c.neutral for c in self.columns], np.float64)

    def __len__(self) -> int:
        return len(self.columns)

    def where(self, place: Place) -> np.ndarray:
        """Indices of a place's columns in the vector."""
        return np.array([self._index[_key(c)] for c in place.columns], int)

    def effects(self, x: jax.Array) -> Effects:
        """The effects of a vector ``(n,)``; pure.

        A number without an index in a field of several is what all of them, or those
        that it is among, have on top of their own.
        """
        changed = {}
        by_field: dict[str, list[int]] = {}
        for i, c in enumerate(self.columns):
            by_field.setdefault(c.field, []).append(i)
        for name, rows in by_field.items():
            leaf = jnp.asarray(getattr(self.none, name), jnp.float32)
            values = x[np.array(rows)].astype(jnp.float32)
            own = [k for k, i in enumerate(rows) if self.columns[i].index]
            if own:
                of_each = [self.columns[rows[k]].index for k in own]
                index = tuple(np.array(k) for k in zip(*of_each, strict=True))
                leaf = leaf.at[index].set(values[np.array(own)])
            for k in {*range(len(rows))} - {*own}:
                column = self.columns[rows[k]]
                same = values[k] - column.neutral
                if column.among:
                    leaf = leaf.at[tuple(np.array(column.among).T)].add(same)
                else:
                    leaf = leaf + same if leaf.ndim else values[k]
            changed[name] = leaf
        return self.none.replace(**changed)  # type: ignore[attr-defined]


def _key(c: Column) -> object:
    return c.field, c.index, c.among
