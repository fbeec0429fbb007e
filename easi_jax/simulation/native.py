"""Native MuJoCo on all cores, called from compiled programs.

What a program carries across the boundary is `Physics` and the fields of the model that
vary (`easi_jax.model.native_model`). On the other side are numpy and `mujoco.batch`
only: a callback that used jax could wait for itself. Simulations are independent of
each other and of the number of threads.
"""

import threading
import weakref
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax.experimental.buffer_callback import buffer_callback
from mujoco import batch as mujoco_batch

from easi_jax.devices.runtime import cores
from easi_jax.errors import engine_calls
from easi_jax.model.contact_pairs import pair_ids
from easi_jax.model.native_model import NativeModel, Template, nominal_field
from easi_jax.model.quantities import direct_solref

_CTRL = int(mujoco.mjtState.mjSTATE_CTRL)
_ALL = int(mujoco.mjtState.mjSTATE_INTEGRATION)
# Components of the state that `Physics` has no name for, where a model has them.
_REST = (
    mujoco.mjtState.mjSTATE_TIME,
    mujoco.mjtState.mjSTATE_HISTORY,
    mujoco.mjtState.mjSTATE_USERDATA,
    mujoco.mjtState.mjSTATE_PLUGIN,
    mujoco.mjtState.mjSTATE_PLASTIC,
)
_KEPT = 8  # batches kept for each model: chunks of a few sizes, on each device
_KEPT_BYTES = 2**28  # of the models of one batch, beside the batch's own
_RECORDED = 2**25  # numbers recorded at once, 256 MB


def first_rest(m: mujoco.MjModel) -> np.ndarray:
    """The numbers of a first state that `Physics` has no name for, each as two 32-bit
    words: a time that is rounded finds another delayed command. None where there is
    nothing but the time."""
    sizes = [mujoco.mj_stateSize(m, int(part)) for part in _REST]
    if sum(sizes) <= 1:
        return np.zeros(0, np.uint32)
    d, found = mujoco.MjData(m), [np.zeros(size) for size in sizes]
    for part, row in zip(_REST, found, strict=True):
        mujoco.mj_getState(m, d, row, int(part))
    return np.concatenate(found).view(np.uint32)


class _Batch:
    """Simulations on threads, with their models' numbers in place.

    Attributes:
        size: number of simulations.
        fields: names of the fields that vary.
        written: bytes of the fields' values, by name, and of ``which`` simulation has
            which row of them.
        failed: simulations whose model MuJoCo could not complete, ``(size,)`` bool.
    """

    def __init__(self, mj: mujoco.MjModel, size: int, fields: tuple[str, ...]) -> None:
        self.size, self.fields = size, fields
        self.written: dict[str, bytes] = {}
        self.failed = np.zeros(size, bool)
        self._models: list[mujoco.MjModel | None] = [None] * size
        self._keeps = size * mujoco.mj_sizeModel(mj) < _KEPT_BYTES
        self.batch = mujoco_batch.Batch(mj, size, _threads())
        # Set before the first write: rows are shared with what is bound.
        self.first = self.batch.state[:1].copy()

    def expanded(self) -> dict[str, np.ndarray]:
        """Fields that have a row for each simulation; those derived from others have
        where these were not always nominal."""
        found = ((n, self.batch.expanded(n)) for n in mujoco_batch.MODEL_FIELDS)
        return {name: rows for name, rows in found if rows is not None}

    def model(self, i: int) -> mujoco.MjModel:
        """Simulation i's model; kept until what follows from others is written."""
        found = self._models[i]
        if found is None:
            found = self.batch.get_model(i)
            if self._keeps:
                self._models[i] = found
        return found

    def set_written(
        self, written: dict[str, bytes], alone: Sequence[str] | None = None
    ) -> None:
        """Notes what the models' fields are now.

        Args:
            written: as the attribute.
            alone: fields that changed, where no other did: models that are kept get
                them, in a tenth of the time that a copy takes; no model is kept if
                None.
        """
        self.written = written
        if alone is None:
            self._models = [None] * self.size
        rows = {name: self.batch.expand(name) for name in alone or ()}
        for i, m in enumerate(self._models):
            if m is not None:
                for name, values in rows.items():
                    nominal_field(m, name)[...] = values[i]

    def component(self, part: mujoco.mjtState) -> np.ndarray:
        offset, size = self.batch._component(part)
        return self.batch.state[:, offset : offset + size]


def _threads() -> int:
    devices = jax.local_device_count() if jax.default_backend() == "cpu" else 1
    return max(1, cores() // devices)


class _Host:
    """The other side of the boundary, of one template."""

    def __init__(self, template: Template) -> None:
        self.mj = template.mj
        self._lock = threading.Lock()
        self._free: list[_Batch] = []

    @cached_property
    def _pairs(self) -> np.ndarray:
        """The number of each pair of geoms that may touch; one more of others, and in a
        last row and column of what is no geom."""
        pairs = pair_ids(self.mj)
        number = np.full((self.mj.ngeom + 1, self.mj.ngeom + 1), len(pairs))
        for k, (i, j) in enumerate(pairs):
            number[i, j] = number[j, i] = k
        return number

    # Models ------------------------------------------------------------------

    def _taken(
        self, written: dict[str, bytes], size: int, fields: tuple[str, ...]
    ) -> _Batch:
        with self._lock:
            fits = [b for b in self._free if (b.size, b.fields) == (size, fields)]
            same = [b for b in fits if b.written == written]
            if same or fits:
                found = (same or fits)[-1]
                self._free.remove(found)
                return found
        return _Batch(self.mj, size, fields)

    def _back(self, b: _Batch) -> None:
        with self._lock:
            self._free.append(b)
            del self._free[:-_KEPT]

    def ready(
        self, fields: tuple[str, ...], values: Sequence[np.ndarray], which: np.ndarray
    ) -> _Batch:
        """A batch in which simulation i has row ``which[i]`` of values ``(P, ...)``."""
        written = {f: v.tobytes() for f, v in zip(fields, values, strict=True)}
        written["which"] = which.tobytes()
        b = self._taken(written, len(which), fields)
        if b.written == written:
            return b
        count = len(values[0]) if fields else 0
        own = count == b.size and np.array_equal(which, np.arange(count))
        models = b if own or not fields else _Batch(self.mj, count, fields)
        changed, alone = fields, None
        if own and b.written.get("which") == written["which"]:
            changed = alone = [f for f in fields if b.written[f] != written[f]]
        for name, rows in zip(fields, values, strict=True):
            if name in changed:
                models.batch.expand(name)[...] = rows
        if any(name in _SET_CONST or name.startswith("opt.") for name in changed):
            models.failed[:], alone = False, None
            try:
                models.batch.set_const()
            except mujoco_batch.SimulationError as error:
                models.failed[error.ids] = True
        if models is not b:
            found = models.expanded()
            for name in {**b.expanded(), **found}:
                rows = found.get(name)
                nominal = nominal_field(self.mj, name)
                b.batch.expand(name)[...] = nominal if rows is None else rows[which]
            b.failed = models.failed[which]
        b.set_written(written, alone)
        return b

    # Simulation --------------------------------------------------------------

    def steps(
        self,
        b: _Batch,
        state: "_State",
        ctrl: np.ndarray,
        qfrc: np.ndarray | None,
        xfrc: np.ndarray | None,
        every: int,
        edge: np.ndarray | None,
        pairs: np.ndarray | None,
        ends: Mapping[str, np.ndarray],
    ) -> tuple["_State", np.ndarray, np.ndarray]:
        """Physics steps with commands ``ctrl (N, T, nu)``, other forces held; no joint
        is faster than ``edge (N, nv)``, contacts of pairs are changed by ``pairs (N,
        K, 3)``. Fields in ``ends (N, T / every, 2, ...)`` are filled with what the
        first and the last step of each ``every`` compute.

        Returns:
            The state after the last, and positions and velocities after each
            ``every``, ``(N, T / every, ...)``; not a number from where a simulation
            failed.
        """
        batch, n = b.batch, b.size
        self._load(b, state, qfrc, xfrc)
        warned = batch.warning.copy()
        steps, seen = ctrl.shape[1], ctrl.shape[1] // every
        qpos = np.empty((n, seen, self.mj.nq))
        qvel = np.empty((n, seen, self.mj.nv))
        wrong = b.failed.copy()
        try:
            if pairs is not None:
                self._one_by_one(
                    *(b, ctrl, every, edge, pairs, wrong, qpos, qvel, ends)
                )
            elif edge is not None:
                self._clipped(b, ctrl, every, edge, wrong, qpos, qvel, ends)
            elif (
                seen == 1
                and not ends
                and (steps == 1 or not np.ptp(ctrl, axis=1).any())
            ):
                batch.bind("ctrl")[:] = ctrl[:, 0]
                batch.step(nstep=steps)
                qpos[:, 0], qvel[:, 0] = batch.bind("qpos"), batch.bind("qvel")
            else:
                self._roll(b, ctrl, every, qpos, qvel, ends)
        except mujoco_batch.SimulationError as error:
            wrong[error.ids] = True
        wrong |= (batch.warning[:, _BAD] != warned[:, _BAD]).any((1, 2))
        after = self._read(b, state)
        _lost(wrong, *after[:4], qpos, qvel, *ends.values())
        return after, qpos, qvel

    def seen(
        self, b: _Batch, state: "_State"
    ) -> tuple["_State", np.ndarray, np.ndarray]:
        """Nothing moves; what follows from positions and velocities is computed."""
        self._load(b, state)
        b.batch.forward(stage=int(mujoco.mjtStage.mjSTAGE_VEL))
        return state, state.qpos[:, None], state.qvel[:, None]

    def _roll(
        self,
        b: _Batch,
        ctrl: np.ndarray,
        every: int,
        qpos: np.ndarray,
        qvel: np.ndarray,
        ends: Mapping[str, np.ndarray],
    ) -> None:
        """In parts, so that what is recorded of all simulations fits in memory."""
        more = sum(int(np.prod(x.shape[3:], dtype=int)) for x in ends.values())
        width = max(1, b.size * (self.mj.nq + self.mj.nv + more) * every)
        record = ("qpos", "qvel", *ends)
        part = every * max(1, _RECORDED // width)
        for at in range(0, ctrl.shape[1], part):
            some = ctrl[:, at : at + part]
            got = b.batch.rollout(some.shape[1], some, _CTRL, record=record)
            rows = slice(at // every, at // every + some.shape[1] // every)
            qpos[:, rows] = got["qpos"][:, every - 1 :: every]
            qvel[:, rows] = got["qvel"][:, every - 1 :: every]
            for name, x in ends.items():
                x[:, rows, 0] = got[name][:, ::every]
                x[:, rows, 1] = got[name][:, every - 1 :: every]

    def _clipped(
        self,
        b: _Batch,
        ctrl: np.ndarray,
        every: int,
        edge: np.ndarray,
        wrong: np.ndarray,
        qpos: np.ndarray,
        qvel: np.ndarray,
        ends: Mapping[str, np.ndarray],
    ) -> None:
        """Step by step: MuJoCo has no limit of a joint's speed."""
        speeds, step = b.batch.bind("qvel"), b.batch.bind("ctrl")
        for t in range(ctrl.shape[1]):
            step[:] = ctrl[:, t]
            try:
                b.batch.step(nstep=1)
            except mujoco_batch.SimulationError as error:
                wrong[error.ids] = True
            np.clip(speeds, -edge, edge, out=speeds)
            for name, x in ends.items():
                if t % every == 0:
                    x[:, t // every, 0] = b.batch.bind(name)
                x[:, t // every, 1] = b.batch.bind(name)
            if (t + 1) % every == 0:
                qpos[:, t // every], qvel[:, t // every] = b.batch.bind("qpos"), speeds

    def _one_by_one(
        self,
        b: _Batch,
        ctrl: np.ndarray,
        every: int,
        edge: np.ndarray | None,
        pairs: np.ndarray,
        wrong: np.ndarray,
        qpos: np.ndarray,
        qvel: np.ndarray,
        ends: Mapping[str, np.ndarray],
    ) -> None:
        """Simulation by simulation, half a step at a time: contacts are changed where
        they are made."""
        d, row = mujoco.MjData(self.mj), np.empty(b.batch.nstate)
        one = np.ones((len(pairs), 1, pairs.shape[2]))
        pairs = np.concatenate([pairs, one], 1)
        for i in np.flatnonzero(~wrong).tolist():
            m = b.model(i)
            mujoco.mj_setState(m, d, b.batch.state[i], _ALL)
            warned = [d.warning[w].number for w in _BAD]
            for t in range(ctrl.shape[1]):
                d.ctrl[:] = ctrl[i, t]
                mujoco.mj_step1(m, d)
                _change_contacts(m, d, pairs[i], self._pairs)
                mujoco.mj_step2(m, d)
                if edge is not None:
                    np.clip(d.qvel, -edge[i], edge[i], out=d.qvel)
                k, at = divmod(t, every)
                for name, x in ends.items():
                    now = np.reshape(getattr(d, name), x.shape[3:])
                    if at == 0:
                        x[i, k, 0] = now
                    x[i, k, 1] = now
                if at == every - 1:
                    qpos[i, k], qvel[i, k] = d.qpos, d.qvel
            mujoco.mj_getState(m, d, row, _ALL)
            b.batch.state[i] = row
            wrong[i] = warned != [d.warning[w].number for w in _BAD]

    def _load(
        self,
        b: _Batch,
        state: "_State",
        qfrc: np.ndarray | None = None,
        xfrc: np.ndarray | None = None,
    ) -> None:
        b.batch.state[:] = b.first
        b.batch.bind("qpos")[:] = state.qpos
        b.batch.bind("qvel")[:] = state.qvel
        b.batch.bind("act")[:] = state.act
        b.batch.bind("qacc_warmstart")[:] = state.warmstart
        if qfrc is not None:
            b.batch.bind("qfrc_applied")[:] = qfrc
        if xfrc is not None:
            b.batch.bind("xfrc_applied")[:] = xfrc
        at = 0
        words = np.ascontiguousarray(state.rest)
        rest = words.view(np.float64) if words.shape[1] else words
        for part in _REST if words.shape[1] else ():
            rows = b.component(part)
            rows[:] = rest[:, at : at + rows.shape[1]]
            at += rows.shape[1]

    def _read(self, b: _Batch, before: "_State") -> "_State":
        rest = before.rest
        if rest.shape[1]:
            parts = [b.component(part) for part in _REST]
            rest = np.concatenate(parts, 1).view(np.uint32)
        bind = b.batch.bind
        return _State(
            bind("qpos").copy(),
            bind("qvel").copy(),
            bind("act").copy(),
            bind("qacc_warmstart").copy(),
            rest,
        )


class Reading(Protocol):
    """What an environment reads of the last physics step.

    Attributes:
        fields: names of fields of `mujoco.MjData`.
        size: how many numbers it makes of them.
    """

    fields: tuple[str, ...]
    size: int

    def __call__(self, *given: np.ndarray) -> np.ndarray:
        """Numbers ``(N, size)`` of fields ``(N, ...)``; numpy only."""
        ...


class _State(NamedTuple):
    """Arrays of many simulations, a row each."""

    qpos: np.ndarray
    qvel: np.ndarray
    act: np.ndarray
    warmstart: np.ndarray
    rest: np.ndarray


def _lost(wrong: np.ndarray, *arrays: np.ndarray) -> None:
    """Simulations that failed are not numbers."""
    for x in arrays:
        x[wrong] = np.nan


def _change_contacts(
    m: mujoco.MjModel, d: mujoco.MjData, factors: np.ndarray, number: np.ndarray
) -> None:
    """As `easi_jax.model.effects.pair_contacts`, between both halves of a step; the
    last of ``factors (K + 1, 3)`` are of other pairs."""
    if not d.ncon:
        return
    contact = d.contact
    geoms, solref = contact.geom, contact.solref
    factor = factors[number[geoms[:, 0], geoms[:, 1]]]
    contact.friction[:, :2] *= factor[:, :1]
    for i in np.flatnonzero(solref[:, 0] > 0).tolist():
        stiffness, damping = direct_solref(m, solref[i])
        solref[i] = -stiffness, -damping
    solref *= factor[:, 1:]
    mujoco.mj_makeConstraint(m, d)
    mujoco.mj_island(m, d)
    mujoco.mj_projectConstraint(m, d)
    mujoco.mj_referenceConstraint(m, d)


PLACES = ("xipos", "subtree_com", "cvel")


def bodies(model: NativeModel, state: Any) -> tuple[jax.Array, ...]:
    """`PLACES` of a state: where bodies and subtrees are, ``(nbody, 3)`` each, and how
    fast bodies move, ``(nbody, 6)``."""
    at_rest = jnp.zeros((1, model.template.mj.nu), state.qpos.dtype)
    flat = run(model, state, at_rest, read=_Places(model.template.mj), stage="velocity")
    n = model.template.mj.nbody
    return tuple(x.reshape(n, -1) for x in jnp.split(flat[2], [3 * n, 6 * n]))


class _Places:
    """Reads `PLACES`."""

    fields = PLACES

    def __init__(self, m: mujoco.MjModel) -> None:
        self.size = 12 * m.nbody

    def __call__(self, *given: np.ndarray) -> np.ndarray:
        return np.concatenate([x.reshape(len(x), -1) for x in given], 1)


# Warnings after which a state means nothing.
_BAD = [
    int(getattr(mujoco.mjtWarning, f"mjWARN_BAD{what}"))
    for what in ("QPOS", "QVEL", "QACC")
]
_SET_CONST = frozenset(mujoco.MjModel._setconst_inputs)
_hosts: "weakref.WeakKeyDictionary[Template, _Host]" = weakref.WeakKeyDictionary()
_hosts_lock = threading.Lock()


def _host(template: Template) -> _Host:
    with _hosts_lock:
        if template not in _hosts:
            _hosts[template] = _Host(template)
        return _hosts[template]


# Axes of its own that each argument of a call has, behind those of a batch.
_OWN = {
    **dict.fromkeys(("qpos", "qvel", "act", "warmstart", "rest", "qfrc", "edge"), 1),
    **dict.fromkeys(("ctrl", "xfrc", "pairs"), 2),
    "count": 0,
}


def _rows(x: np.ndarray, own: int, lead: tuple[int, ...]) -> np.ndarray:
    """``(N, ...)`` of what has ``own`` axes of its own behind those of a batch."""
    shape = x.shape[x.ndim - own :] if own else ()
    count = int(np.prod(lead, dtype=int))
    return np.broadcast_to(x, (*lead, *shape)).reshape(count, *shape)


def _together(args: dict[str, np.ndarray], own: dict[str, int]) -> tuple[int, ...]:
    """Axes of the batch that some arguments make together."""
    leads = (x.shape[: x.ndim - own[name]] for name, x in args.items())
    return np.broadcast_shapes(*leads)


def _words(x: jax.Array) -> jax.Array:
    """Doubles as pairs of 32-bit words ``(..., 2)``: where jax's doubles are off, a
    callback would be given them in single precision."""
    double = x.dtype == jnp.float64
    return jax.lax.bitcast_convert_type(x, jnp.uint32) if double else x


@dataclass(frozen=True)
class _Call:
    """What is the same in every call from one place of a program; called by it.

    Attributes:
        template: of the model.
        words: names of arguments that come as `_words`.
        out: shapes and types of the results, of one simulation; doubles go as words.
        every, read, each, stage: as for `run`.
    """

    template: Template
    words: frozenset[str]
    out: tuple[jax.ShapeDtypeStruct, ...]
    every: int
    read: Any
    each: bool
    stage: str

    @property
    def crossing(self) -> tuple[jax.ShapeDtypeStruct, ...]:
        """``out`` as it comes back to the program."""
        return tuple(jax.eval_shape(_words, like) for like in self.out)

    def __call__(
        self, values: dict[str, np.ndarray], given: dict[str, np.ndarray]
    ) -> tuple[np.ndarray, ...]:
        """Results ``(..., *shape)`` of arguments with axes of a batch before theirs.

        Args:
            values: fields of the model.
            given: the others, those of `_OWN`.
        """
        args = self._numbers(values), self._numbers(given)
        if not engine_calls.failures:
            try:
                return self._called(*args)
            except Exception as error:
                if not engine_calls.watched:
                    raise
                engine_calls.failures.append(error)
        return self._missing(*args)

    def _lead(
        self, values: dict[str, np.ndarray], given: dict[str, np.ndarray]
    ) -> tuple[tuple[int, ...], dict[str, int]]:
        """Axes of the batch, and those that each field has of its own."""
        mj = self.template.mj
        fields = {name: np.ndim(nominal_field(mj, name)) for name in values}
        return _together({**values, **given}, {**fields, **_OWN}), fields

    def _missing(
        self, values: dict[str, np.ndarray], given: dict[str, np.ndarray]
    ) -> tuple[np.ndarray, ...]:
        """Results of a call that failed: no numbers."""
        lead, _ = self._lead(values, given)
        filled = (
            np.nan if np.issubdtype(x.dtype, np.floating) else 0 for x in self.out
        )
        return tuple(
            _crossing(np.full((*lead, *x.shape), value, x.dtype), x)
            for x, value in zip(self.out, filled, strict=True)
        )

    def _called(
        self, values: dict[str, np.ndarray], given: dict[str, np.ndarray]
    ) -> tuple[np.ndarray, ...]:
        lead, fields = self._lead(values, given)
        of_models = _together(values, fields)
        of_models = (1,) * (len(lead) - len(of_models)) + of_models
        number = np.arange(int(np.prod(of_models, dtype=int))).reshape(of_models)
        which = np.broadcast_to(number, lead).reshape(-1)
        models = [
            _rows(x, fields[name], of_models).astype(np.float64)
            for name, x in values.items()
        ]
        host = _host(self.template)
        b = host.ready(tuple(values), models, which)
        bound = [b.batch.bind(name) for name in self.read.fields] if self.read else []
        rows = {name: _rows(x, _OWN[name], lead) for name, x in given.items()}
        seen = rows["ctrl"].shape[1] // self.every
        shape = (b.size, seen, 2) if self.each else (b.size,)
        ends = {}
        if self.read and (self.each or "pairs" in rows):
            named = zip(self.read.fields, bound, strict=True)
            size = b.size, seen, 2
            ends = {name: np.zeros((*size, *x.shape[1:])) for name, x in named}
        after, qpos, qvel = self._simulated(host, b, rows, ends)
        if self.each:
            bound = [x.reshape(-1, *x.shape[3:]) for x in ends.values()]
        elif ends:
            bound = [x[:, -1, 1] for x in ends.values()]
        sensed = self.read(*bound) if self.read else np.zeros((b.size, 0))
        sensed = sensed.reshape(*shape, self.read.size if self.read else 0)
        host._back(b)
        results = zip((*after, qpos, qvel, sensed), self.out, strict=True)
        return tuple(_crossing(x.reshape(*lead, *x.shape[1:]), to) for x, to in results)

    def _numbers(self, args: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Arguments by name, in order, words put together again."""
        out = {name: np.asarray(args[name]) for name in sorted(args)}
        for name in self.words & out.keys():
            whole = np.ascontiguousarray(out[name])
            out[name] = whole.view(np.float64).reshape(whole.shape[:-1])
        return out

    def _simulated(
        self,
        host: _Host,
        b: _Batch,
        rows: dict[str, np.ndarray],
        ends: dict[str, np.ndarray],
    ) -> tuple[_State, np.ndarray, np.ndarray]:
        state = _State(*(rows[name] for name in _State._fields))
        if self.stage == "velocity":
            return host.seen(b, state)
        ctrl = rows["ctrl"].astype(np.float64)
        forces = rows.get("qfrc"), rows.get("xfrc")
        more = (*forces, self.every, rows.get("edge"), rows.get("pairs"), ends)
        if "count" not in rows:
            return host.steps(b, state, ctrl, *more)
        count = int(rows["count"][0])
        if (rows["count"] != count).any():
            raise ValueError("simulations of one call end after as many steps")
        after, *seen = host.steps(b, state, ctrl[:, :count], *more)
        steps = ctrl.shape[1] // self.every
        qpos, qvel = (
            np.repeat(start[:, None].astype(np.float64), steps, 1)
            for start in (state.qpos, state.qvel)
        )
        qpos[:, : count // self.every], qvel[:, : count // self.every] = seen
        return after, qpos, qvel


def _crossing(x: np.ndarray, like: jax.ShapeDtypeStruct) -> np.ndarray:
    """As `_Call.crossing` says."""
    x = np.ascontiguousarray(x, like.dtype)
    if like.dtype != np.float64:
        return x
    return x.view(np.uint32).reshape(*x.shape, 2)


@dataclass(frozen=True)
class _InPlace:
    """A call that writes its results into a program's own memory."""

    call: _Call

    def __call__(self, _: Any, out: Sequence[Any], *given: Any) -> None:
        for to, x in zip(out, self.call(*given), strict=True):
            np.asarray(to)[...] = x


def _calling(call: _Call, *args: Any) -> tuple[jax.Array, ...]:
    """The call in a program. `jax.pure_callback` puts each argument on a device first,
    which takes as long as hundreds of steps of a small robot; on a CPU numpy sees the
    program's memory."""
    if jax.default_backend() != "cpu":
        return jax.pure_callback(call, call.crossing, *args, vmap_method="expand_dims")
    calling = buffer_callback(_InPlace(call), call.crossing, vmap_method="expand_dims")
    return calling(*args)


def run(
    model: NativeModel,
    state: Any,
    ctrl: jax.Array,
    qfrc: jax.Array | None = None,
    xfrc: jax.Array | None = None,
    every: int | None = None,
    read: Any = None,
    pairs: jax.Array | None = None,
    stage: str = "step",
    count: jax.Array | None = None,
    edge: jax.Array | None = None,
    each: bool = False,
) -> tuple[tuple[jax.Array, ...], tuple[jax.Array, jax.Array], jax.Array]:
    """Physics steps of MuJoCo C; may be traced, and mapped over any argument.

    Numbers are as precise as those of ``state``, doubles also where jax's are off.

    Args:
        state: `easi_jax.simulation.step.Physics`.
        ctrl: what reaches the actuators in each physics step, ``(T, nu)``.
        qfrc, xfrc: forces on joints ``(nv,)`` and bodies ``(nbody, 6)``, held.
        every: physics steps between what is returned of the motion; T where None.
        read: see `Reading`; None for nothing.
        pairs: factors on friction, stiffness and damping of the contacts of pairs of
            geoms (`easi_jax.model.contact_pairs`), ``(K, 3)``; simulations one by one
            then, since MuJoCo has no number to write them into.
        stage: "step"; "velocity": nothing moves, and ``read`` sees the state itself.
        count: physics steps that are taken, ``()``, the same for all that are mapped
            over; T where None. Of later ones the motion is that of the start.
        edge: speeds that joints are clipped to after each physics step, ``(nv,)``.
        each: ``read`` sees the first and the last step of each ``every``, in place of
            the last of all.

    Returns:
        qpos, qvel, act, warm start and rest after the last step; qpos and qvel after
        each ``every``, ``(T / every, ...)``; what ``read`` made of the last step, or
        of two of each ``every``, ``(T / every, 2, size)``.
        Not a number where a simulation failed.
    """
    m = model.template.mj
    every = every or ctrl.shape[0]
    given = {name: getattr(state, name) for name in _State._fields} | {"ctrl": ctrl}
    more = {"qfrc": qfrc, "xfrc": xfrc, "pairs": pairs, "count": count, "edge": edge}
    given |= {name: x for name, x in more.items() if x is not None}
    seen, size = ctrl.shape[0] // every, read.size if read is not None else 0
    shapes = (seen, m.nq), (seen, m.nv), (seen, 2, size) if each else (size,)
    out = [jax.ShapeDtypeStruct(given[x].shape, given[x].dtype) for x in _State._fields]
    out += [jax.ShapeDtypeStruct(shape, state.qpos.dtype) for shape in shapes]
    args = model.changed | given
    call = _Call(
        model.template,
        frozenset(name for name, x in args.items() if x.dtype == jnp.float64),
        tuple(out),
        every,
        read,
        each,
        stage,
    )
    crossed = _calling(call, *jax.tree.map(_words, (model.changed, given)))
    *physics, qpos, qvel, sensed = (
        jax.lax.bitcast_convert_type(x, to.dtype) if to.dtype == jnp.float64 else x
        for x, to in zip(crossed, out, strict=True)
    )
    return tuple(physics), (qpos, qvel), sensed
