"""Open-loop predictions of measured windows under many models, by one program.

A prediction belongs to a vector of parameters (the model's own, then the columns of
`table.Layout`), a block of windows, and offsets of their start states. Whatever the
workflow asks (errors, derivatives by differences, trial steps, noise pushed through the
model) is a list of such items, and all go through one compiled program in batches of
one size.
"""

import copy
from collections.abc import Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from easi_jax import effects
from easi_jax.gap.table import Layout
from easi_jax.machine import Machine
from easi_jax.mesh import make_mesh, sharded_map
from easi_jax.model import Model
from easi_jax.parameters import ParameterSpace
from easi_jax.physics import Physics
from easi_jax.quantities import direct_solref
from easi_jax.recording import Run
from easi_jax.windows import fitted_velocity, make_windows

_BLOCK = 16  # windows


def opened(m: mujoco.MjModel) -> mujoco.MjModel:
    """A copy whose effects can all be varied once it is put on a device.

    MJX compiles out dry friction that is zero and force limits that are off; contact
    stiffness varies in its direct form.
    """
    out = copy.deepcopy(m)
    scalar = [d for _, d in effects.scalar_joints(m)]
    loss = out.dof_frictionloss
    loss[scalar] = np.maximum(loss[scalar], 1e-9)
    free = out.actuator_forcelimited == 0
    out.actuator_forcerange[free] = [-1e9, 1e9]
    out.actuator_forcelimited[:] = 1
    for solref in (*out.geom_solref, *out.pair_solref):
        if solref[0] > 0:
            solref[:] = -np.asarray(direct_solref(m, solref))
    return out


@dataclass(frozen=True)
class WindowSet:
    """Windows of several runs; all arrays have a leading axis W.

    Attributes:
        run: index of the run.
        row: row of the run where the window starts.
        start_qpos: measured positions at the start and in the rows after it, as far as
            readings can be late, ``(W, R, nq)``.
        start_qvel: fitted velocities there, ``(W, R, nv)``.
        ctrl: ``(W, H, nu)``.
        past: commands before, oldest first, ``(W, D, nu)``; before a run's first row
            its first command.
        target: measured positions after each step, ``(W, H, nq)``.
    """

    run: np.ndarray
    row: np.ndarray
    start_qpos: np.ndarray
    start_qvel: np.ndarray
    ctrl: np.ndarray
    past: np.ndarray
    target: np.ndarray

    def __len__(self) -> int:
        return len(self.run)

    def take(self, index: np.ndarray) -> "WindowSet":
        """Some of the windows."""
        return WindowSet(*(getattr(self, f)[index] for f in self.__dataclass_fields__))


def join(sets: Sequence[WindowSet]) -> WindowSet:
    """All windows of several sets."""
    names = WindowSet.__dataclass_fields__
    return WindowSet(*(np.concatenate([getattr(s, f) for s in sets]) for f in names))


def window_set(
    runs: Sequence[Run], horizon_s: float, past: int, late: int, first_run: int = 0
) -> WindowSet | None:
    """Windows every half horizon, each inside one run; None where there are none.

    Args:
        past: commands before a window.
        late: rows after its start in which a late reading of the start may come.
        first_run: index of the first of ``runs``.
    """
    parts = []
    for i, run in enumerate(runs):
        w = make_windows(run, horizon_s)
        if not len(w.start_row):
            continue
        velocity = fitted_velocity(run.qpos, run.dt, run.configuration)
        after = np.minimum(w.start_row[:, None] + np.arange(late + 1), len(run) - 1)
        before = np.maximum(w.start_row[:, None] + np.arange(-past, 0), 0)
        parts.append(
            WindowSet(
                run=np.full(len(w.start_row), first_run + i),
                row=w.start_row,
                start_qpos=run.qpos[after],
                start_qvel=velocity[after],
                ctrl=w.ctrl,
                past=run.ctrl[before],
                target=w.target_qpos,
            )
        )
    return join(parts) if parts else None


class Predictor:
    """Errors of open-loop predictions of a fixed set of windows.

    Attributes:
        machine: the model with its own parameters.
        layout: columns of the effects.
        windows: what is predicted.
        own: number of the model's own parameters; they come first in a vector.
        neutral: the vector of the model as given.
        wrapped: hinges without limits, whose errors are wrapped, ``(nv,)`` bool.
    """

    def __init__(
        self,
        mj_model: mujoco.MjModel,
        space: ParameterSpace,
        layout: Layout,
        windows: WindowSet,
        dt: float,
    ) -> None:
        self.machine = Machine(opened(mj_model), space, dt)
        self.layout, self.windows = layout, windows
        self.own = len(space.nominal)
        self.neutral = np.concatenate([np.asarray(space.nominal), layout.neutral])
        m, nv = mj_model, mj_model.nv
        self.nv, self.steps = nv, windows.ctrl.shape[1]
        self.wrapped = np.zeros(nv, bool)
        for j in range(m.njnt):
            hinge = m.jnt_type[j] == mujoco.mjtJoint.mjJNT_HINGE
            if hinge and not m.jnt_limited[j]:
                self.wrapped[m.jnt_dofadr[j]] = True
        self._mesh = make_mesh()
        n = len(windows)
        self.blocks = -(-n // _BLOCK)
        pad = np.minimum(np.arange(self.blocks * _BLOCK), n - 1)
        padded = windows.take(pad)

        def blocks(x: np.ndarray) -> jax.Array:
            return jnp.asarray(
                x.reshape(self.blocks, _BLOCK, *x.shape[1:]), jnp.float32
            )

        self._data = tuple(
            blocks(x)
            for x in (
                padded.start_qpos,
                padded.start_qvel,
                padded.ctrl,
                padded.past,
                padded.target,
            )
        )
        # Items that a device works on together.
        self._batch = max(1, self.machine.batch // _BLOCK)
        self._delay_steps = windows.past.shape[1]
        self._program = jax.jit(self._sharded)

    def model(self, x: jax.Array) -> Model:
        """The model of a vector ``(n,)``; pure."""
        e = self.layout.effects(x[self.own :])
        model = self.machine.model(x[: self.own])
        return model.replace(
            mjx=effects.with_effects(model.mjx, e),
            effects=e,
            delay_steps=self._delay_steps,
        )

    def _sharded(self, x: jax.Array, block: jax.Array, moved: jax.Array) -> jax.Array:
        def local(items: tuple[jax.Array, ...], *data: jax.Array) -> jax.Array:
            return jax.vmap(lambda *i: self._block(data, *i))(*items)

        return sharded_map(local, self._mesh, (x, block, moved), *self._data)

    def _block(
        self,
        data: tuple[jax.Array, ...],
        x: jax.Array,
        block: jax.Array,
        moved: jax.Array,
    ) -> jax.Array:
        model = self.model(x)
        return jax.vmap(lambda w, d: self._window(model, w, d))(
            tuple(a[block] for a in data), moved
        )

    def _window(self, model: Model, window: tuple, moved: jax.Array) -> jax.Array:
        """Readings less measurements after each step, ``(H, nv)``."""
        start_q, start_v, ctrl, past, target = window
        machine, e, nv = self.machine, model.effects, self.nv
        assert e is not None
        q, v = self._true_start(e, start_q, start_v)
        physics = machine.start(machine.move(q, moved[:nv]), v + moved[nv:])
        memory = effects.first_memory(self._delay_steps, ctrl.shape[1])

        def warm(memory: effects.CommandMemory, u: jax.Array) -> tuple:
            _, memory = effects.commands(e, memory, u, machine.dt, machine.substeps)
            return memory, None

        memory, _ = jax.lax.scan(warm, memory, past)
        physics = physics.replace(memory=memory)

        def step(state: Physics, u: jax.Array) -> tuple:
            state = machine.step(model, state, u)
            return state, (state.qpos, state.qvel)

        _, (qs, vs) = jax.lax.scan(step, physics, ctrl)
        qs = jnp.concatenate([physics.qpos[None], qs])
        vs = jnp.concatenate([physics.qvel[None], vs])
        # From the start, so that readings are plain numbers also where q is not.
        zero = jnp.zeros_like(v)
        difference = jax.vmap(machine.difference, (None, None, 0, None))
        path = difference(start_q[0], zero, qs, zero)[:, :nv]
        measured = jnp.concatenate([start_q[:1], target])
        seen = difference(start_q[0], zero, measured, zero)[:, :nv]
        told = effects.reading(e, seen, path, vs, machine.dt)
        error = told - seen[1:]
        turn = 2 * jnp.pi
        near = error - turn * jnp.round(error / turn)
        return jnp.where(self.wrapped, near, error)

    def _true_start(
        self, e: effects.Effects, q: jax.Array, v: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """The state at the start from readings that are late and biased.

        What is late is read in the rows after the start, ``q (R, nq)``.
        """
        m = self.machine.mj_model
        at, dof = (
            np.array(k, int) for k in zip(*effects.scalar_joints(m), strict=True)
        )
        when = e.late[dof] / self.machine.dt
        row = jnp.clip(jnp.floor(when), 0, max(q.shape[0] - 2, 0)).astype(jnp.int32)
        s = when - row
        after = jnp.minimum(row + 1, q.shape[0] - 1)
        qd = (1 - s) * q[row, at] + s * q[after, at]
        vd = (1 - s) * v[row, dof] + s * v[after, dof]
        return q[0].at[at].set(qd - e.bias[dof]), v[0].at[dof].set(vd)

    def errors(
        self,
        x: np.ndarray,
        windows: np.ndarray | None = None,
        moved: np.ndarray | None = None,
    ) -> np.ndarray:
        """Predicted readings less measured ones, ``(B, W, H, nv)``.

        Args:
            x: vectors, ``(B, n)``.
            windows: which blocks of windows, sorted; all where None. See `blocks_of`.
            moved: offsets of start positions and velocities, ``(B, W, 2 nv)``.
        """
        blocks = np.arange(self.blocks) if windows is None else np.asarray(windows)
        count, nb = len(x), len(blocks)
        items = count * nb
        vectors = np.repeat(x, nb, 0).astype(np.float32)
        which = np.tile(blocks, count).astype(np.int32)
        shape = (items, _BLOCK, 2 * self.nv)
        if moved is None:
            offsets = np.zeros(shape, np.float32)
        else:
            whole = np.zeros((count, nb * _BLOCK, 2 * self.nv), np.float32)
            whole[:, : moved.shape[1]] = moved
            offsets = whole.reshape(shape)
        batch = self._batch * self._mesh.size
        out = np.empty((items, _BLOCK, self.steps, self.nv), np.float32)
        for first in range(0, items, batch):
            part = np.minimum(np.arange(first, first + batch), items - 1)
            got = self._program(vectors[part], which[part], offsets[part])
            keep = min(batch, items - first)
            out[first : first + keep] = np.asarray(got)[:keep]
        out = out.reshape(count, nb * _BLOCK, self.steps, self.nv)
        if windows is None:
            out = out[:, : len(self.windows)]
        return out
