"""Parameters in an `MjModel`, for those who simulate with MuJoCo C."""

import copy
import dataclasses
from functools import reduce
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from easi_jax.model.addresses import open_gates, resolve
from easi_jax.simulation.simulator import Simulator

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
        m, fixed = simulator.mj_model, simulator.fixed
        # MuJoCo C leaves out of a simple body's inertia what is zero.
        lost = {
            w.parameter
            for w in resolve(m, (*simulator.space.addresses, *((a,) for a in fixed)))
            if w.row.moves_center and _simple(m, w)
        }
        count = simulator.space.size
        self._kept = [k for k in range(count) if k not in lost]
        names = [simulator.space.names[k] for k in self._kept]
        # A space of its own: jax keeps arrays that it has once seen as doubles.
        space = dataclasses.replace(simulator.space.select(names))
        lasting = [a for k, a in enumerate(fixed) if count + k not in lost]
        every = [a for given in simulator.space.addresses for a in given]
        self.base = open_gates(m, [*every, *fixed])
        with jax.enable_x64(True):
            double = Simulator(
                *(m, space, simulator.dt),
                fixed={a: fixed[a] for a in lasting},
                engine="mujoco",
            )
            self.base.opt.timestep = double.base.mjx.template.mj.opt.timestep
            _set(self.base, double.base.mjx.changed)

            def written(unit: jax.Array) -> dict[str, jax.Array]:
                low, high = space.bounds
                return double.model(jnp.clip(space.to_si(unit), low, high)).mjx.changed

            # Compiled: one by one the same writes are hundreds of small programs.
            self._written = jax.jit(written)
            ways = np.concatenate([np.zeros((1, count)), np.eye(count)])
            first, *tried = [self._values(0.5 + _MOVE * way) for way in ways]
        self.reaches = np.array(
            [any(np.any(first[n] != x) for n, x in other.items()) for other in tried],
            bool,
        )

    def at(self, unit: np.ndarray) -> mujoco.MjModel:
        """The model at unit coordinates ``(n,)``, inside the physical bounds."""
        m = copy.copy(self.base)
        with jax.enable_x64(True):
            _set(m, self._values(unit))
        return m

    def _values(self, unit: np.ndarray) -> dict[str, np.ndarray]:
        found = self._written(jnp.asarray(unit[self._kept], jnp.float64))
        return {n: np.asarray(v) for n, v in found.items()}


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
