"""Parameters in an `MjModel`, for those who simulate with MuJoCo C."""

import copy
import dataclasses
from collections.abc import Iterator
from functools import reduce
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from easi_jax.model.addresses import open_gates, resolve
from easi_jax.simulation.simulator import Simulator

# What `mj_setConst` computes, and the compiler.
_DERIVED = {
    *("body_subtreemass", "body_invweight0", "dof_invweight0", "dof_M0"),
    *("tendon_invweight0", "actuator_acc0", "cam_poscom0", "stat.meaninertia"),
}
_MOVE = 0.1  # of an initial range, which shows what a parameter sets


class InMujoco:
    """A machine's parameters written into copies of its `MjModel`.

    Numbers are those of `easi_jax.model.mjx_model.with_parameters`, in double
    precision: finite differences of MuJoCo C need it. What MJCF has no word for is not
    there: a joint's speed limit, and of the effects all but those that are numbers of
    the model (masses, armature, limits, contacts).

    Attributes:
        base: the model with the machine's fixed values and physics step.
        reaches: which parameters MuJoCo C has a word for, ``(n,)`` bool.
    """

    def __init__(self, simulator: Simulator) -> None:
        # A space of its own: jax keeps arrays that it has once seen as doubles.
        space = dataclasses.replace(simulator.space)
        every = (*space.addresses, *((a,) for a in simulator.fixed))
        self.base = open_gates(simulator.mj_model, [a for p in every for a in p])
        with jax.enable_x64(True):
            double = simulator.rebuilt(space=space)
            first = double.base.mjx
            unit = jnp.full(space.size, 0.5)
            moved = double.model(space.to_si(unit)).mjx
            names = [n for n in _leaves(moved) if n not in _DERIVED]
            changed = [n for n in names if _get(moved, n) is not _get(first, n)]

            def written(unit: jax.Array) -> dict[str, jax.Array]:
                low, high = space.bounds
                si = jnp.clip(space.to_si(unit), low, high)
                model = double.model(si).mjx
                return {n: _get(model, n) for n in changed}

            self._written = jax.jit(written)
            _set(self.base, {n: _get(first, n) for n in names})
            ways = np.concatenate([np.zeros((1, space.size)), np.eye(space.size)])
            tried = [self._values(0.5 + _MOVE * way) for way in ways]
        self.reaches = np.array(
            [
                any(np.any(tried[0][n] != other[n]) for n in changed)
                for other in tried[1:]
            ],
            bool,
        )
        for w in resolve(simulator.mj_model, space.addresses):
            # MuJoCo C, too, leaves out of such a body's inertia what is zero.
            if w.row.moves_center and _simple(simulator.mj_model, w):
                self.reaches[w.parameter] = False

    def at(self, unit: np.ndarray) -> mujoco.MjModel:
        """The model at unit coordinates ``(n,)``, inside the physical bounds."""
        m = copy.copy(self.base)
        with jax.enable_x64(True):
            _set(m, self._values(unit))
        return m

    def _values(self, unit: np.ndarray) -> dict[str, np.ndarray]:
        found = self._written(jnp.asarray(unit, jnp.float64))
        return {n: np.asarray(v) for n, v in found.items()}


def _leaves(tree: Any, prefix: str = "") -> Iterator[str]:
    """Names of the arrays of an `mjx.Model` that an `MjModel` has, too."""
    for field in dataclasses.fields(tree):
        value, name = getattr(tree, field.name), prefix + field.name
        if field.name == "_impl":
            continue
        if dataclasses.is_dataclass(value):
            yield from _leaves(value, f"{name}.")
        elif isinstance(value, jax.Array):
            yield name


def _get(tree: Any, name: str) -> Any:
    return reduce(getattr, name.split("."), tree)


def _set(m: mujoco.MjModel, values: dict[str, Any]) -> None:
    """Writes numbers, and computes again what follows from them."""
    for name, value in values.items():
        *path, last = name.split(".")
        owner = reduce(getattr, path, m)
        old = getattr(owner, last)
        new = np.asarray(value).reshape(np.shape(old))
        if np.array_equal(old, new):  # some of what never changes is read-only
            continue
        if new.ndim:
            old[:] = new
        else:
            setattr(owner, last, new.item())
    mujoco.mj_setConst(m, mujoco.MjData(m))
    m.stat.meaninertia = m.dof_M0.mean()  # `mj_setConst` leaves it


def _simple(m: mujoco.MjModel, w: Any) -> bool:
    body = w.body(m)
    start, count = int(m.body_dofadr[body]), int(m.body_dofnum[body])
    return bool(count and np.any(m.dof_simplenum[start : start + count]))
