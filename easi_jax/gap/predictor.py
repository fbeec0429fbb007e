"""Open-loop predictions of measured windows under many models, by one program.

A prediction belongs to a vector of parameters (the model's own, then the columns of
`table.Layout`), a block of windows, and offsets of their start states. Whatever the
workflow asks (errors, derivatives by differences, trial steps, noise pushed through the
model) is a list of such items, and all go through one compiled program in batches of
one size.
"""

import copy
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax.sharding import NamedSharding, PartitionSpec

from easi_jax.data.sensor_channels import NO_SENSORS, Sensors
from easi_jax.data.windows import start_rows
from easi_jax.devices.distributed import started
from easi_jax.devices.mesh import make_mesh, sharded_map
from easi_jax.devices.runtime import fast_loops, on_cpu, quick_compile
from easi_jax.gap.effect_vector import Layout
from easi_jax.gap.window_set import Rows, WindowSet
from easi_jax.model import backlash, effects
from easi_jax.model.backlash import MotorState
from easi_jax.model.contact_pairs import pair_ids
from easi_jax.model.effect_numbers import EFFECT_TABLE, fields_that_act
from easi_jax.model.effects import Effects
from easi_jax.model.joint_space import dofs, scalar_places, turns_fully
from easi_jax.model.mjx_model import Model, for_every_effect
from easi_jax.model.own_laws import reading_offsets
from easi_jax.model.parameters import ParameterSpace
from easi_jax.progress import Wait, at_once
from easi_jax.simulation import native_step
from easi_jax.simulation.compile_time import expected
from easi_jax.simulation.engine import Engine
from easi_jax.simulation.logged import Logged
from easi_jax.simulation.open_loop import first_steps
from easi_jax.simulation.simulator import Simulator
from easi_jax.simulation.step import Physics, arrived_sensed, arrived_step

BLOCK = 16  # windows


class Window(NamedTuple):
    """One of a `WindowSet`, or some, on devices; what it has there, as simulated:
    turns of hinges without limits counted, sensors that are predicted alone."""

    start_qpos: jax.Array
    start_act: jax.Array
    ctrl: jax.Array
    past: jax.Array
    past_qpos: jax.Array
    past_qvel: jax.Array
    read: jax.Array
    speed: jax.Array
    read_speed: jax.Array
    led: jax.Array
    sensed: jax.Array
    known: jax.Array
    last: jax.Array
    time: jax.Array
    hidden: jax.Array


_ITEMS = 4  # that a core works on together: many requests ask for few
_STEPPED = 16  # likewise, where each physics step is a call: most of it is the calling
_ACCELERATOR_ITEMS = 256
_ROW = 0.01  # s of it at a time
_ROUNDED = 1e-5  # rows that a time may be off by rounding in single precision
_PASSES = 3  # by which a reading is undone: each leaves a tenth of what is left


def opened(m: mujoco.MjModel) -> mujoco.MjModel:
    """A copy whose effects can all be varied once it is put on a device.

    MJX compiles out dry friction that is zero and force limits that are off; contact
    stiffness varies in its direct form.
    """
    out = copy.deepcopy(m)
    count = {"joint": m.njnt, "actuator": m.nu, "body": m.nbody, "model": 1}
    count["geom"] = len(pair_ids(m))
    for row in EFFECT_TABLE.values():
        for i in range(count[row.on]):
            if row.refuse(m, i) is None:
                row.open(out, i)
    return out


_PLAY = fields_that_act("drive")
# What is left out of a program, the quickest one first: a window takes the first that
# holds all that it has. On native MuJoCo a window is one call unless something depends
# on the state; drag of bodies is one more call a physics step, and simulations go one
# by one where contacts of single pairs differ.
_LEFT_OUT = {
    "mjx": (_PLAY, ()),
    "mujoco": (
        native_step.SLOW,
        native_step.STATE_DEPENDENT,
        (*_PLAY, "resistance"),
        _PLAY,
        ("resistance", *native_step.AT_PAIRS),
        (),
    ),
}
# Numbers that do nothing where the others of their effect are neutral.
_DETAILS = ("rotor", "cycles", "phase", "stribeck")


def _fields(layout: Layout) -> tuple[str, ...]:
    """Of `Effects`, those that predictions reckon with: all others stay neutral."""
    varied = {c.field for c in layout.columns}
    return tuple(f for f in Effects.__dataclass_fields__ if f in varied)


def windows_in(blocks: np.ndarray) -> np.ndarray:
    """Places of the windows of some blocks, ``(nb * BLOCK,)``; those of a last one that
    is not full, too."""
    return (BLOCK * blocks[:, None] + np.arange(BLOCK)).reshape(-1)


class Predictor:
    """Errors of open-loop predictions of a fixed set of windows.

    Attributes:
        simulator: the model with its own parameters.
        layout: columns of the effects.
        windows: what is predicted.
        own: number of the model's own parameters; they come first in a vector.
        neutral: the vector of the model as given.
        wrapped: hinges in whose range a full turn fits, whose errors are wrapped,
            ``(nv,)`` bool.
        sensors: whose readings are predicted as well, N numbers; ``unpredicted`` says
            of others why not, by channel.
        early: which of them were read before the command of their row was sent,
            ``(N,)`` bool; the first row of a window is then not compared.
        speeds: whether velocities are compared with those of the log in the rows that
            a start is fitted to; they are the last ``nv`` channels then.
        channels: numbers that are compared: ``nv + N``, and velocities.
        largest: motion that was measured in a window, ``(channels,)``.
        steps: control steps of a window, those before its start counted.
        length: those that programs have room for; shorter windows are filled up.
        data: the windows in blocks, on all devices of ``mesh``.
        programs: others' that were compiled for windows like these.
        size: of a start state: positions, velocities, activations, ``2 nv + na``.
    """

    def __init__(
        self,
        mj_model: mujoco.MjModel,
        space: ParameterSpace,
        layout: Layout,
        windows: WindowSet,
        dt: float,
        fixed: Mapping[str, float] | None = None,
        logged: Logged | None = None,
        wait: Wait = at_once,
        sensors: Sensors = NO_SENSORS,
        engine: Engine | None = None,
        speeds: bool = False,
        length: int = 0,
    ) -> None:
        """``fixed``: what the machine has and MJCF cannot say, by address; ``logged``:
        states of the log that the windows are from; ``wait`` shows what compiles;
        ``sensors``: that ``windows.sensed`` are of; ``length``: control steps of the
        longest windows that will be predicted, if longer than ``windows``."""
        self._wait, self.speeds = wait, speeds
        self.simulator = Simulator(
            opened(mj_model), space, dt, fixed=fixed, logged=logged, engine=engine
        )
        self.sensors, self.unpredicted = sensors.simulated_by(self.simulator.engine)
        if self.sensors:
            self.simulator = self.simulator.sensing(self.sensors)
        self.early = np.zeros(len(self.sensors), bool)
        self._sensed = np.array([n in self.sensors.numbers for n in sensors], bool)
        # Centers of mass move.
        base = self.simulator.base
        self.simulator.base = base.replace(mjx=for_every_effect(base.mjx))
        self.layout = layout
        self.own = len(space.nominal)
        self.neutral = np.concatenate([np.asarray(space.nominal), layout.neutral])
        m, nv = mj_model, mj_model.nv
        self.nv, self.size = nv, 2 * nv + m.na
        self.wrapped = np.zeros(nv, bool)
        for j in range(m.njnt):
            self.wrapped[dofs(m, j)] = turns_fully(m, j)
        self.channels = nv + len(self.sensors) + nv * speeds
        self._started = start_rows(dt)
        self._scalar = scalar_places(m).T
        self.mesh = make_mesh()
        native = self.simulator.engine == "mujoco"
        self._items = _ITEMS if on_cpu() or native else _ACCELERATOR_ITEMS
        self._more = _STEPPED if native else self._items
        latest = sum(
            max((c.high for c in layout.columns if c.field == name), default=0.0)
            for name in ("delay", "late")
        )
        self._delay_steps = math.ceil(latest / dt - 1e-9) + 1
        self._fields = _fields(layout)
        # Columns that each program has not, but for the details of effects.
        self._without: dict[tuple[str, ...], np.ndarray] = {}
        for left_out in reversed(_LEFT_OUT[self.simulator.engine]):
            told = [
                self.own + i
                for i, c in enumerate(layout.columns)
                if c.field in left_out and c.field not in _DETAILS
            ]
            # Where a program is no quicker than the next, it is not made.
            if not left_out or told:
                self._without[left_out] = np.array(told, int)
        self._without = dict(reversed(self._without.items()))
        self._take(windows, length)

    def _take(self, windows: WindowSet, length: int = 0) -> None:
        """Predicts these windows, by programs of their own."""
        self.windows, self.steps = windows, windows.ctrl.shape[1]
        self.length = max(self.steps, length)
        self.largest = self._largest(windows)
        # By powers of two, so that the program of one log often serves the next.
        self._room = 1 << (self.blocks - 1).bit_length()
        self.data = self._placed(windows)
        self._compiled: dict[tuple[tuple[str, ...], int], Callable[[], Any]] = {}
        self.programs: dict[Any, Any] = {}

    def _largest(self, windows: WindowSet) -> np.ndarray:
        """Motion that was measured in a window, ``(channels,)``."""
        moved = np.abs(self._unwrapped(windows.read)).max((0, 1))
        moved = np.where(self.wrapped, np.minimum(moved, np.pi), moved)
        span = np.ptp(self._sensors_of(windows.sensed), axis=(0, 1))
        fastest = np.abs(windows.read_speed).max((0, 1))
        return np.concatenate([moved, span, fastest])[: self.channels]

    @property
    def _compared(self) -> np.ndarray:
        """Places of `channels` in what a program returns."""
        count, joints = len(self.sensors), np.arange(self.nv)
        sensed = self.nv + np.arange(count) + count * self.early
        fast = self.nv + 2 * count + joints
        return np.concatenate([joints, sensed, fast])[: self.channels]

    def of_positions(self) -> "Predictor":
        """The same predictions, of positions alone."""
        other = copy.copy(self)  # the compiled programs are of both
        other.channels, other.largest = self.nv, self.largest[: self.nv]
        return other

    def _placed(self, windows: WindowSet) -> Window:
        """The windows in blocks, on all devices; the last is repeated to fill them."""
        fill = np.minimum(np.arange(self._room * BLOCK), len(windows) - 1)
        padded = windows.take(fill)
        read = self._unwrapped(padded.read)
        sensed = self._sensors_of(padded.sensed)
        known = self._sensors_of(padded.known, 1.0)
        whole = NamedSharding(self.mesh, PartitionSpec())

        def blocks(x: np.ndarray) -> jax.Array:
            shape = (self._room, BLOCK, *x.shape[1:])
            return jax.device_put(np.asarray(x, np.float32).reshape(shape), whole)

        given = {f: getattr(padded, f) for f in Window._fields}
        more = self.length - windows.ctrl.shape[1]
        given |= {
            "ctrl": np.append(padded.ctrl, np.repeat(padded.last[:, None], more, 1), 1),
            "read": _filled(read, more),
            "read_speed": _filled(padded.read_speed, more),
            "sensed": _filled(sensed, more),
            "known": _filled(known, more),
        }
        if not self.speeds:
            given["read_speed"] = given["read_speed"][..., :0]
        return Window(**{name: blocks(x) for name, x in given.items()})

    def _sensors_of(self, each: np.ndarray, planned: float = 0.0) -> np.ndarray:
        """Of numbers of sensors ``(W, T, ...)`` those that are predicted, ``(W, T,
        N)``; ``planned`` of planned motion, which has none."""
        if each.shape[-1]:
            return each[..., self._sensed]
        return np.full((*each.shape[:2], len(self.sensors)), planned)

    @property
    def read(self) -> np.ndarray:
        """Which of the numbers that are compared there are, 1 or 0, ``(W, H + 1,
        channels)``."""
        begin = self.windows.speed.shape[1] // 2  # its row in `WindowSet.known`
        known = self.windows.known[:, begin : begin + self.steps + 1]
        sensed = self._sensors_of(known, 1.0)
        motion = np.ones((*sensed.shape[:2], self.nv))
        fast = motion * (np.arange(self.steps + 1) < self._started)[:, None]
        return np.concatenate([motion, sensed, fast], 2)[..., : self.channels]

    def motion(self, errors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Of errors ``(..., channels)`` those of positions, and those of velocities,
        ``(..., nv)``; zero where they are not compared."""
        positions = errors[..., : self.nv]
        if self.compares_speeds:
            return positions, errors[..., -self.nv :]
        return positions, np.zeros_like(positions)

    @property
    def compares_speeds(self) -> bool:
        """Whether velocities are among `channels`."""
        return self.channels > self.nv + len(self.sensors)

    def whole(self, positions: np.ndarray, speeds: np.ndarray) -> np.ndarray:
        """Differences of predictions ``(..., T, nv)``, those of sensors unknown and so
        zero, as differences of what is compared, ``(..., T, channels)``."""
        fast = speeds * (np.arange(speeds.shape[-2]) < self._started)[:, None]
        none = np.zeros((*positions.shape[:-1], len(self.sensors)))
        return np.concatenate([positions, none, fast], -1)[..., : self.channels]

    def _unwrapped(self, read: np.ndarray) -> np.ndarray:
        """``WindowSet.read`` with the turns of hinges without limits counted."""
        return np.where(self.wrapped, np.unwrap(read, axis=1), read)

    @property
    def felt_inertia(self) -> np.ndarray:
        """That a torque at each degree of freedom alone meets, ``(nv,)``."""
        return np.asarray(self.layout.none.effective_inertia)

    @property
    def devices(self) -> int:
        """That share the work."""
        return self.mesh.size

    @property
    def blocks(self) -> int:
        """Of `BLOCK` windows each; the last may not be full."""
        return -(-len(self.windows) // BLOCK)

    @property
    def capacity(self) -> int:
        """Windows that the compiled program has room for."""
        return self._room * BLOCK

    def on(self, windows: WindowSet) -> "Predictor":
        """The same predictions of other windows: by the programs that are compiled
        where those are no longer, with as much before and after their starts, and no
        more than `capacity`."""
        mine, theirs = (
            [getattr(w, f).shape[1:] for f in ("past", "speed")]
            for w in (self.windows, windows)
        )
        other, steps = copy.copy(self), windows.ctrl.shape[1]
        fits = steps <= self.length and len(windows) <= self.capacity
        if mine != theirs or not fits:
            other._take(windows, self.length)
        else:
            other.windows, other.steps = windows, steps
            other.largest = other._largest(windows)
            other.data = other._placed(windows)
        return other

    def model(
        self, x: jax.Array, left_out: tuple[str, ...] = (), more: tuple[str, ...] = ()
    ) -> Model:
        """The model of a vector ``(n,)``, fields ``left_out`` neutral in it; pure.
        Fields ``more`` may be changed in it."""
        e = self.layout.effects(x[self.own :])
        model = self.simulator.model(x[: self.own])
        there = dict.fromkeys((*self._fields, *more))
        present = tuple(f for f in there if f not in left_out)
        return model.replace(
            mjx=effects.with_effects(model.mjx, e, present),
            effects=e,
            present=present,
            delay_steps=self._delay_steps,
        )

    def rows(self, x: np.ndarray, windows: WindowSet) -> Rows:
        """What the predictions of some windows under a vector are about.

        Where readings are late they are those of other times than the window's.
        """
        late, early = self._late(x, windows.led)
        start, step = windows.row[:, None] - early, np.arange(self.steps + 1)
        readings = (start + late)[:, None] + step[:, None]
        commands = start + step[:-1]
        ahead = np.ceil(readings - _ROUNDED)  # as readings are compared
        return Rows(ahead.astype(int), np.round(commands).astype(int))

    def later(self, x: np.ndarray, led: np.ndarray) -> np.ndarray:
        """How many rows after what is simulated the rows are that it is compared with,
        less than one, ``(W, nv)``; ``led (W,)`` of these windows."""
        late, early = self._late(x, led)
        rows = late - early
        return np.maximum(np.ceil(rows - _ROUNDED) - rows, 0.0)

    def _late(self, x: np.ndarray, led: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """By how many rows joints read late, ``(nv,)``, and simulations of windows that
        are ``led (W,)`` begin early, ``(W, 1)``."""
        e = self.layout.effects(jnp.asarray(x[self.own :], jnp.float32))
        late = np.asarray(e.late, float) / self.simulator.dt
        return late, led[:, None] * late.max(initial=0.0)

    def _program(self, left_out: tuple[str, ...], batch: int) -> Any:
        """A compiled one. For an arm MJX's take a minute each, so side by side."""
        if (left_out, batch) not in self._compiled:
            like = (
                np.zeros((batch, len(self.neutral)), np.float32),
                np.zeros(batch, np.int32),
                np.zeros((batch, BLOCK, self.size), np.float32),
                np.int32(self.length),
            )
            for out in self._without if self.simulator.engine == "mjx" else [left_out]:
                # Play is for few predictions.
                quick = quick_compile() | (fast_loops() if out else {})
                program = jax.jit(partial(self._sharded, out), compiler_options=quick)
                lowered = program.lower(*like, *self.data)
                self._compiled[out, batch] = started(lowered.compile)
            self._wait(self._compiled[left_out, batch], expected(self.simulator))
        return self._compiled[left_out, batch]()

    def _sharded(
        self,
        left_out: tuple[str, ...],
        x: jax.Array,
        block: jax.Array,
        moved: jax.Array,
        steps: jax.Array,
        *windows: jax.Array,
    ) -> jax.Array:
        def local(items: tuple[jax.Array, ...], steps: Any, *data: jax.Array) -> Any:
            return jax.vmap(lambda *i: self._block(left_out, data, steps, *i))(*items)

        return sharded_map(local, self.mesh, (x, block, moved), steps, *windows)

    def _block(
        self,
        left_out: tuple[str, ...],
        data: tuple[jax.Array, ...],
        steps: jax.Array,
        x: jax.Array,
        block: jax.Array,
        moved: jax.Array,
    ) -> jax.Array:
        model = self.model(x, left_out)
        some = jax.tree.map(lambda a: a[block], Window(*data))
        return jax.vmap(lambda w, d: self._window(model, w, d, steps))(some, moved)

    def _window(
        self, model: Model, window: Window, moved: jax.Array, steps: jax.Array
    ) -> jax.Array:
        """Readings less measurements at each row, ``(length + 1, nv + 2 N)``: those of
        sensors where a row's step begins, then where the step before it ends; zero in
        rows in which a sensor was not read. With ``speeds`` then those of velocities,
        ``nv`` more; zero after the rows that a start is fitted to. Rows after the
        control ``steps`` that are simulated are no predictions.

        Where readings are late, the simulation begins by the longest delay earlier, so
        that it starts from what was read until the window's start. Each joint is
        compared with the readings of the times that are simulated: as far from its
        start as without delays. Where a run only begins, all is later by that delay.
        What is simulated is interpolated at the times of readings, never the readings:
        between two rows their noise would be less.
        """
        simulator, e, nv = self.simulator, model.effects, self.nv
        assert e is not None
        q, read, physics, arrived = self.begun(model, window, moved)
        early, now = self._when(window, e)

        def step(state: Physics, u: jax.Array) -> tuple:
            if not self.sensors:
                state = arrived_step(model, state, u)
                return state, (state.qpos, state.qvel, ())
            state, each = arrived_sensed(model, state, u)
            return state, (state.qpos, state.qvel, each)

        at_once = None
        if simulator.engine == "mujoco":
            at_once = native_step.replay(model, physics, arrived, steps)
        nothing = jnp.zeros((2, len(self.sensors))) if self.sensors else ()
        still = physics.qpos, physics.qvel, nothing
        qs, vs, readings = at_once or first_steps(step, physics, arrived, still, steps)
        # From the start, so that readings are plain numbers also where q is not.
        zero = jnp.zeros(nv)
        difference = jax.vmap(simulator.difference, (None, None, 0, None))
        count = len(window.ctrl)
        qs = jnp.concatenate([q[None], qs[:count]])
        vs = jnp.concatenate([physics.qvel[None], vs[:count]])
        path = difference(window.start_qpos, zero, qs, zero)[:, :nv]
        row, after = _ahead(now)
        path = _later(path + self._misread(model, window, qs, vs), after)
        error = path + e.bias - read
        turn = 2 * jnp.pi
        near = error - turn * jnp.round(error / turn)
        out = [jnp.where(self.wrapped, near, error)]
        if self.sensors:
            out.append(self._sensor_errors(window, early, readings))
        if self.speeds:
            begun = slice(self._started + 1)
            fast = vs[begun] + self._misread_speed(model, window, qs[begun], vs[begun])
            fast = _later(fast, after)[: self._started]
            row += jnp.arange(self._started)[:, None]
            fast -= _at(window.read_speed, row)
            out.append(jnp.pad(fast, [(0, len(vs) - len(fast)), (0, 0)]))
        return jnp.concatenate(out, 1)

    def _when(self, window: Window, e: Effects) -> tuple[jax.Array, jax.Array]:
        """How much earlier than the window's start a simulation begins [s], and the row
        of ``window.read`` in which joints read where they are then, ``(nv,)``."""
        early = window.led * jnp.max(e.late)
        start = len(window.speed) // 2  # its row in both
        return early, start - (early - e.late) / self.simulator.dt

    def _sensor_errors(
        self, window: Window, early: jax.Array, readings: jax.Array
    ) -> jax.Array:
        """Of `_window`, those of sensors, ``(length + 1, 2 N)``, from the simulated
        ``readings (length + 1, 2, N)``."""
        start = len(window.speed) // 2
        first = start - early / self.simulator.dt
        row, after = _ahead(first)
        row += jnp.arange(self.length + 1)
        read = jnp.broadcast_to(row[:, None], (len(row), len(self.sensors)))
        known = _at(window.known, read) > 0
        read = _at(window.sensed, read)
        readings = self.sensors.reading.alike(readings, read[:, None])
        flat = readings.reshape(len(readings), -1)
        flat = _later(flat, jnp.broadcast_to(after, flat.shape[1:]))
        readings = flat.reshape(readings.shape)
        begins, ends = readings[:, 0] - read, readings[:-1, 1] - read[1:]
        each = jnp.concatenate([begins, jnp.pad(ends, [(1, 0), (0, 0)])], 1)
        return jnp.where(jnp.tile(known, 2), each, 0.0)

    def _misread(
        self, model: Model, window: Window, qs: jax.Array, vs: jax.Array
    ) -> jax.Array:
        """What owners' effects add to the readings of some rows from the start on,
        positions ``(T, nq)``, ``(T, nv)``."""
        e, dt = model.effects, self.simulator.dt
        if e is None or not effects.has_own(e, model.present):
            return jnp.zeros_like(vs)
        sent = jnp.concatenate([window.ctrl, window.last[None]])[: len(qs)]
        time = window.time + dt * jnp.arange(len(qs))
        of_row = partial(reading_offsets, e.own, e.laws)
        return jax.vmap(of_row)(qs, vs, sent, time)

    def _misread_speed(
        self, model: Model, window: Window, qs: jax.Array, vs: jax.Array
    ) -> jax.Array:
        """How fast `_misread` changes, ``(T, nv)``: velocities are read where positions
        are."""
        if not effects.has_own(model.effects, model.present):
            return jnp.zeros_like(vs)
        at, dof = self._scalar
        along = jnp.zeros_like(qs).at[:, at].set(vs[:, dof])

        def off(q: jax.Array) -> jax.Array:
            return self._misread(model, window, q, vs)

        return jax.jvp(off, (qs,), (along,))[1]

    def _true(
        self, model: Model, window: Window, qpos: jax.Array, qvel: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Where joints are, and how fast, whose readings at the start are these."""
        if not effects.has_own(model.effects, model.present):
            return qpos, qvel
        at, dof = self._scalar

        def off(q: jax.Array) -> jax.Array:
            return self._misread(model, window, q[None], qvel[None])[0]

        q, v = qpos, qvel
        for _ in range(_PASSES):
            along = jnp.zeros_like(q).at[at].set(v[dof])
            position, speed = jax.jvp(off, (q,), (along,))
            q, v = self.simulator.move(qpos, -position), qvel - speed
        return q, v

    def begun(
        self, model: Model, window: Window, moved: jax.Array
    ) -> tuple[jax.Array, jax.Array, Physics, jax.Array]:
        """Where a window begins ``(nq,)``, what its joints are compared with ``(H + 1,
        nv)``, its first state, and what reaches the actuators in the physics steps of
        each of the H rows after it, ``(H, substeps, nu)``, one more with sensors; H is
        `length`."""
        w, simulator, e, nv = window, self.simulator, model.effects, self.nv
        assert e is not None
        early, now = self._when(w, e)
        row = _ahead(now)[0] + jnp.arange(self.length + 1)[:, None]
        read = _at(w.read, row)
        first, v = (_between(x, now[None])[0] for x in (w.read, w.speed))
        q, v = self._true(model, w, simulator.move(w.start_qpos, first - e.bias), v)
        q = simulator.move(q, moved[:nv])
        physics = simulator.start(q, v + moved[nv : 2 * nv], model)
        physics = physics.replace(memory=(), act=w.start_act + moved[2 * nv :])
        if effects.has_own(e, model.present):
            physics = physics.replace(time=w.time - early, hidden=w.hidden)
        # Sensors are read where a step begins, the last of them after the last step.
        sent = [w.past, w.ctrl, w.last[None]] if self.sensors else [w.past, w.ctrl]
        arrived = effects.command_sequence(
            e.replace(delay=e.delay + early),
            jnp.concatenate(sent),
            self._delay_steps,
            simulator.dt,
            simulator.substeps,
        )
        if effects.has_backlash(model.present):
            before = (w.past_qpos, w.past_qvel)
            physics = self._turned(model, physics, arrived[: len(w.past)], *before)
        return q, read, physics, arrived[len(w.past) :]

    def _turned(
        self, model: Model, first: Physics, arrived: Any, qpos: Any, qvel: Any
    ) -> Physics:
        """The first state with drives as they turned before, while their joints moved
        as measured."""
        simulator, e = self.simulator, model.effects
        assert e is not None
        drives = backlash.geared(model.mjx)
        if not drives:
            return first
        at, dof = self._scalar
        still = jnp.full(self.nv, 1e6)  # as heavy as what is not moved
        # Rows of a millisecond would only cost time.
        every = max(1, round(_ROW / simulator.dt))
        count = len(qpos) // every
        rows = len(qpos) - every * np.arange(count, 0, -1)
        q = jnp.zeros((count + 1, self.nv))
        q = q.at[:-1, dof].set(qpos[rows][:, at]).at[-1, dof].set(first.qpos[at])
        v = jnp.concatenate([qvel[rows], first.qvel[None]])
        sent = arrived[len(qpos) - every * count :]
        sent = sent.reshape(count, -1, sent.shape[-1]).mean(1)

        def row(rotor: MotorState, now: tuple) -> tuple:
            u, q, v, before = now
            return backlash.pushes(
                *(model.mjx, drives, rotor.replace(joint=before), e.width, e.rotor),
                *(still, (q, v), backlash.sent(model.mjx, u, first.act)),
                jnp.asarray(every * simulator.dt),
            ), None

        begin = first.rotor.replace(angle=q[0], speed=v[0])
        # Speeds a row earlier, such that each row ends at the next one's speed.
        before = 2 * v[:-1] - v[1:]
        rotor, _ = jax.lax.scan(row, begin, (sent, q[:-1], v[:-1], before))
        # Teeth as softly as these steps need would spring back in shorter ones.
        twist = jnp.clip(rotor.angle - q[-1], -0.5 * e.width, 0.5 * e.width)
        return first.replace(
            rotor=rotor.replace(
                angle=q[-1] + twist, push=jnp.zeros(self.nv), joint=first.qvel
            )
        )

    def errors(
        self,
        x: np.ndarray,
        windows: np.ndarray | None = None,
        moved: np.ndarray | None = None,
        rows: int | None = None,
    ) -> np.ndarray:
        """Predicted readings less measured ones, ``(B, W, rows, channels)``: at the
        start, and after each step. Where readings are late, those of the last two rows
        lie between rows that are simulated beyond them, with the last command held, or
        at the end of `length` on a parabola.

        Args:
            x: vectors, ``(B, n)``.
            windows: which blocks of `BLOCK` windows, sorted; all where None.
            moved: offsets of start positions, velocities and activations,
                ``(B, W, 2 nv + na)``.
            rows: the first of a window, at least those that a start is fitted to; all
                ``H + 1`` where None.
        """
        wanted = self.steps + 1 if rows is None else rows
        blocks = np.arange(self.blocks) if windows is None else np.asarray(windows)
        count, nb = len(x), len(blocks)
        items = count * nb
        vectors = np.repeat(x, nb, 0).astype(np.float32)
        which = np.tile(blocks, count).astype(np.int32)
        shape = (items, BLOCK, self.size)
        if moved is None:
            offsets = np.zeros(shape, np.float32)
        else:
            whole = np.zeros((count, nb * BLOCK, self.size), np.float32)
            whole[:, : moved.shape[1]] = moved
            offsets = whole.reshape(shape)
        shape = items, BLOCK, wanted, self.channels
        out = np.empty(shape, np.float32)
        steps = self._steps_of(vectors, wanted)
        for left_out, chosen in self.by_program(vectors):
            at_once = left_out == next(iter(self._without))
            for part in self._batches(chosen, at_once):
                program = self._program(left_out, len(part))
                args = vectors[part], which[part], offsets[part]
                got = np.asarray(program(*args, steps, *self.data))
                out[part] = got[..., :wanted, self._compared]
        out = out.reshape(count, nb * BLOCK, *shape[2:])
        return out[:, : self.count(windows)]

    def _steps_of(self, vectors: np.ndarray, rows: int) -> np.ndarray:
        """Control steps that are simulated for the first rows of windows, ``()``: with
        sensors one more, and where readings are late those that they are interpolated
        between."""
        columns = enumerate(self.layout.columns, self.own)
        late = [i for i, c in columns if c.field == "late"]
        more = bool(self.sensors) + 2 * bool(vectors[:, late].any())
        return np.asarray(
            min(rows - 1 + more, self.length + bool(self.sensors)), np.int32
        )

    def by_program(
        self, vectors: np.ndarray
    ) -> Iterator[tuple[tuple[str, ...], np.ndarray]]:
        """What the quickest program leaves out that has all of them, and which of the
        vectors ``(B, n)`` go through it."""
        vectors = vectors.astype(np.float32)
        neutral, left = self.neutral.astype(np.float32), np.ones(len(vectors), bool)
        for left_out, columns in self._without.items():
            fits = left & (vectors[:, columns] == neutral[columns]).all(1)
            left &= ~fits
            if fits.any():
                yield left_out, np.flatnonzero(fits)

    def _batches(self, chosen: np.ndarray, at_once: bool) -> list[np.ndarray]:
        """Items by batches of one size, or two where windows are not predicted
        ``at_once``; the last item fills the last of them."""
        few, most = (n * self.mesh.size for n in (self._items, self._more))
        parts = []
        if not at_once:
            whole = len(chosen) // most * most
            parts, chosen = list(chosen[:whole].reshape(-1, most)), chosen[whole:]
        batch = few if at_once or 2 * len(chosen) <= most else most
        filled = np.concatenate([chosen, np.repeat(chosen[-1:], -len(chosen) % batch)])
        return [*parts, *filled.reshape(-1, batch)]

    def count(self, windows: np.ndarray | None) -> int:
        """Number of windows in some blocks; all where None."""
        return len(self.windows) if windows is None else len(windows) * BLOCK


def _filled(x: np.ndarray, rows: int) -> np.ndarray:
    """``x (W, T, n)`` with its last row so many more times."""
    return np.append(x, np.repeat(x[:, -1:], rows, 1), 1)


def _between(x: jax.Array, row: jax.Array) -> jax.Array:
    """Columns of ``x (T, n)`` at rows ``(K, n)`` that need not be whole, from 1 on.

    Catmull and Rom's cubic: exact at whole rows.
    """
    x = jnp.concatenate([x, 2 * x[-1:] - x[-2:-1], 3 * x[-1:] - 2 * x[-2:-1]])
    whole = jnp.floor(row)
    near = [_at(x, whole + k) for k in (-1, 0, 1, 2)]
    return _cubic(near, row - whole)


def _at(x: jax.Array, row: jax.Array) -> jax.Array:
    """Columns of ``x (T, n)`` at whole rows ``(K, n)``."""
    return x[row.astype(jnp.int32), jnp.arange(x.shape[1])]


def _cubic(near: Sequence[jax.Array], s: jax.Array) -> jax.Array:
    """Between the second and the third of four values, a share ``s`` of the way."""
    a, b, c, d = near
    slope_b, slope_c = (c - a) / 2, (d - b) / 2
    third = 2 * (b - c) + slope_b + slope_c
    second = 3 * (c - b) - 2 * slope_b - slope_c
    return b + s * (slope_b + s * (second + s * third))


def _ahead(now: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The first row that is not before ``now``, but for rounding, and how many rows
    later it is, at least none."""
    row = jnp.ceil(now - _ROUNDED)
    return row, jnp.maximum(row - now, 0.0)


def _later(x: jax.Array, rows: jax.Array) -> jax.Array:
    """Columns of ``x (T, n)`` so many rows later, ``(n,)``, less than one: of what is
    smooth, as simulations are; before and after them it goes on as a parabola."""
    first, last = x[:3], x[:-4:-1]

    def beyond(near: jax.Array) -> list[jax.Array]:
        a, b, c = near
        return [(3 * (a - b) + c)[None], (6 * a - 8 * b + 3 * c)[None]]

    whole = jnp.concatenate([beyond(first)[0], x, *beyond(last)])
    return _cubic([whole[k : k + len(x)] for k in range(4)], rows)
