"""Named sensors as channels: what was read, and what a simulation reads."""

import copy
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco.mjx._src.types import SensorType

from easi_jax.data.noise import finest, resolution_of, sensor_noise
from easi_jax.data.recording import Run
from easi_jax.model.joint_space import one_sign
from easi_jax.model.sensors import sensor_columns, sensor_kind, sensor_unit

_OF_NO_MOTION = {"CLOCK", "USER", "PLUGIN"}
_ORIENTATION = {"FRAMEQUAT", "BALLQUAT"}
# That MJX lacks, or has for some models only.
_NOT_ON_MJX = {"CAMPROJECTION", "CONTACT", "RANGEFINDER", "TACTILE"}
_ON_MJX = {kind.name for kind in SensorType} - _NOT_ON_MJX
_ACCELERATION = mujoco.mjtStage.mjSTAGE_ACC
_EARLY = 0.8  # of the squared error otherwise: readings of before their row's command
_FEWEST = 20  # readings of a run that say something of a model
_EXPLAINED = 2.0  # times the squared noise: predicted but for that


@dataclass(frozen=True)
class SensorNumber:
    """One number of a named sensor.

    Attributes:
        sensor: name; ``index`` of this among its numbers.
        channel: as columns of logs are called.
        unit: SI; empty where it has none.
        column: place in ``sensordata``.
        kind: type, as MuJoCo names it.
        of_forces: whether commands show in it at once, as in torques.
        at_end: whether it was read before the command of its row was sent, at the end
            of the step before.
    """

    sensor: str
    index: int
    channel: str
    unit: str
    column: int
    kind: str
    of_forces: bool
    at_end: bool = False


@dataclass(frozen=True)
class Sensors:
    """Numbers of named sensors that are compared, N of them."""

    numbers: tuple[SensorNumber, ...] = ()

    def __len__(self) -> int:
        return len(self.numbers)

    def __iter__(self) -> Iterator[SensorNumber]:
        return iter(self.numbers)

    @property
    def columns(self) -> tuple[int, ...]:
        """Places in ``sensordata``."""
        return tuple(n.column for n in self)

    @property
    def at_end(self) -> np.ndarray:
        """Which were read at the end of the step before their row, ``(N,)`` bool."""
        return np.array([n.at_end for n in self], bool)

    @property
    def orientations(self) -> list[slice]:
        """Where quaternions are among the numbers."""
        return [
            slice(i, i + 4)
            for i, n in enumerate(self)
            if n.kind in _ORIENTATION and n.index == 0
        ]

    @property
    def reading(self) -> "SensorReading":
        """What a simulation reads."""
        first = tuple(part.start for part in self.orientations)
        return SensorReading(self.columns, first, tuple(self.at_end.tolist()))

    def ending(self, names: Sequence[str]) -> "Sensors":
        """The same, those of some sensors `SensorNumber.at_end`."""
        return Sensors(tuple(replace(n, at_end=n.sensor in names) for n in self))

    def known(self, run: Run) -> np.ndarray:
        """Rows in which each was read, ``(T, N)`` bool."""
        there = {n.sensor: _read(run, n.sensor) for n in self}
        parts = [there[n.sensor] for n in self]
        return np.stack(parts, 1) if parts else np.zeros((len(run), 0), bool)

    def readings(self, run: Run) -> np.ndarray:
        """What was read, ``(T, N)``; quaternions of one sign. Between readings by
        linear interpolation; zero in a run without any."""
        kinds = {n.sensor: n.kind in _ORIENTATION for n in self}
        filled = {name: _filled(run, name, turns) for name, turns in kinds.items()}
        parts = [filled[n.sensor][:, n.index] for n in self]
        return np.stack(parts, 1) if parts else np.zeros((len(run), 0))

    def read(self, run: Run) -> np.ndarray:
        """`readings`, NaN where there is none."""
        return np.where(self.known(run), self.readings(run), np.nan)

    def noise(self, runs: Sequence[Run]) -> tuple[np.ndarray, np.ndarray]:
        """Standard deviations ``(N,)``, and which of them are upper bounds."""
        found = sensor_noise(runs)
        std = np.array([found[n.sensor].std[n.index] for n in self])
        bound = [bool(found[n.sensor].is_bound[n.index]) | n.of_forces for n in self]
        return std, np.array(bound, bool)

    def finest(self, runs: Sequence[Run]) -> np.ndarray:
        """Smallest step between two readings of a run, ``(N,)``
        (`easi_jax.data.noise.finest`)."""
        return finest([resolution_of(self.read(run)) for run in runs])

    def spread(self, runs: Sequence[Run]) -> np.ndarray:
        """Standard deviation of all readings, ``(N,)``."""
        return np.nanstd(np.concatenate([self.read(run) for run in runs]), 0)

    def simulated_by(self, engine: str) -> tuple["Sensors", dict[str, str]]:
        """Those that an engine has, and why others are left out, by channel."""
        if engine == "mujoco":
            return self, {}
        left = {
            n.channel: f"MJX does not simulate this kind of sensor ({n.kind}); "
            "--engine mujoco does"
            for n in self
            if n.kind not in _ON_MJX
        }
        return Sensors(tuple(n for n in self if n.channel not in left)), left


NO_SENSORS = Sensors()


@dataclass(frozen=True)
class SensorReading:
    """Reads N numbers of ``sensordata`` on either engine.

    Attributes:
        columns: their places there.
        quaternions: where quaternions begin among them.
        at_end: which are compared at the end of a control step, not where it begins.
    """

    columns: tuple[int, ...]
    quaternions: tuple[int, ...]
    at_end: tuple[bool, ...]

    def __call__(self, _: Any, data: Any) -> Any:
        return data.sensordata[np.array(self.columns, int)]

    @property
    def native(self) -> "_NativeReading":
        """The same of native MuJoCo (`easi_jax.simulation.native.Reading`)."""
        return _NativeReading(self.columns)

    def alike(self, simulated: Any, read: Any) -> Any:
        """Numbers ``(..., N)`` of a simulation, quaternions of the sign that is nearer
        to what was ``read (..., N)``."""
        for first in self.quaternions:
            part = slice(first, first + 4)
            mine = simulated[..., part]
            product = jnp.sum(mine * read[..., part], -1, keepdims=True)
            sign = jnp.where(product < 0, -1, 1)
            simulated = simulated.at[..., part].set(sign * mine)
        return simulated

    def chosen(self, each: Any) -> Any:
        """Of numbers where steps begin and where they end ``(..., 2, N)``, those that
        are compared, ``(..., N)``."""
        return jnp.where(np.array(self.at_end), each[..., 1, :], each[..., 0, :])


def only_read(m: mujoco.MjModel, sensors: Sensors) -> mujoco.MjModel:
    """A copy of a model in which other sensors read nothing but the time."""
    out, named = copy.deepcopy(m), {n.sensor for n in sensors}
    for i in range(m.nsensor):
        if m.sensor(i).name not in named:
            out.sensor_type[i] = mujoco.mjtSensor.mjSENS_CLOCK
            out.sensor_needstage[i] = mujoco.mjtStage.mjSTAGE_POS
    return out


def read_at_end(sensors: Sensors, begins: np.ndarray, ends: np.ndarray) -> list[str]:
    """Names of sensors that were read before the command of their row was sent: nearly
    all of their readings are predicted so, or they are where readings jump.

    Args:
        begins, ends: errors of a model in units of the noise, ``(W, T, N)``, readings
            compared where steps begin and where the step before ends; NaN where there
            are none.
    """

    def squares(errors: np.ndarray) -> np.ndarray:
        """Of windows with any; NaN where none has."""
        square = errors.astype(float) ** 2
        known = np.isfinite(square)
        count = known.sum(1)
        mean = np.where(known, square, 0.0).sum(1) / np.maximum(count, 1)
        each = zip(mean.T, count.T, strict=True)
        return np.array([np.median(m[n > 0]) if n.any() else np.nan for m, n in each])

    of = np.array([n.sensor for n in sensors])
    names = []
    for name in dict.fromkeys(of.tolist()):
        after, before = (squares(e[..., of == name]).mean() for e in (begins, ends))
        # What a wrong model errs by is smooth.
        rough, smooth = (
            squares(np.diff(e[..., of == name], 3, axis=1)).mean()
            for e in (begins, ends)
        )
        told = before < min(_EARLY * after, _EXPLAINED)
        if told or smooth < _EARLY * rough:
            names.append(name)
    return names


@dataclass(frozen=True)
class _NativeReading:
    columns: tuple[int, ...]
    fields = ("sensordata",)

    @property
    def size(self) -> int:
        return len(self.columns)

    def __call__(self, sensordata: np.ndarray) -> np.ndarray:
        return sensordata[:, list(self.columns)]


def measured_sensors(
    m: mujoco.MjModel, runs: Sequence[Run], fit: Sequence[Run] = ()
) -> tuple[Sensors, dict[str, str]]:
    """Sensors that can be compared with predictions in all of ``runs``, and have a
    noise in those to ``fit`` (all where not given); and why others are left out, by
    channel."""
    noises = sensor_noise(fit or runs)
    numbers: list[SensorNumber] = []
    ignored: dict[str, str] = {}
    for i in range(m.nsensor):
        name, dim = m.sensor(i).name, int(m.sensor_dim[i])
        if not any(name in run.sensors for run in runs):
            continue
        why, kind = _why_not(m, i, runs), sensor_kind(m, i)
        if not why and name not in noises:
            why = "hardly any readings in the data that are fitted"
        first = sensor_columns(m, i).start
        for k in range(dim):
            channel = f"sensor.{name}" if dim == 1 else f"sensor.{name}.{k}"
            if why:
                ignored[channel] = why
                continue
            of_forces = mujoco.mjtStage(int(m.sensor_needstage[i])) == _ACCELERATION
            unit = sensor_unit(m, i)
            numbers.append(
                SensorNumber(name, k, channel, unit, first + k, kind, of_forces)
            )
    return Sensors(tuple(numbers)), ignored


def moving_sensors(
    m: mujoco.MjModel, runs: Sequence[Run], engine: str
) -> tuple[Sensors, list[str]]:
    """Sensors that say something of a model's parameters, and notes on which these are
    and why others are not among them."""
    known, ignored = measured_sensors(m, runs)
    sensors, unpredicted = known.simulated_by(engine)
    read = np.concatenate([sensors.read(run) for run in runs])
    moves = np.nanmax(read, 0) > np.nanmin(read, 0)
    moving = {n.sensor for n, move in zip(sensors, moves, strict=True) if move}
    sensors = Sensors(tuple(n for n in sensors if n.sensor in moving))
    names = dict.fromkeys(n.sensor for n in sensors)
    notes = [f"sensors that are fitted as well: {', '.join(names)}"] if names else []
    why = {_owner(m, c): text for c, text in {**ignored, **unpredicted}.items()}
    notes += [f"sensor {name} is not fitted: {text}" for name, text in why.items()]
    return sensors, notes


def _owner(m: mujoco.MjModel, channel: str) -> str:
    """The sensor of a channel; names may have dots."""
    name = channel.removeprefix("sensor.")
    known = {m.sensor(i).name for i in range(m.nsensor)}
    return name if name in known else name.rpartition(".")[0]


def _why_not(m: mujoco.MjModel, i: int, runs: Sequence[Run]) -> str:
    """Why a sensor is not compared; empty where it is."""
    name, kind = m.sensor(i).name, sensor_kind(m, i)
    if kind in _OF_NO_MOTION:
        return f"no simulation predicts this kind of sensor ({kind})"
    if m.sensor_delay[i] or m.sensor_interval[i].any() or m.sensor_history[i].any():
        return (
            "the model gives it a delay or an interval of its own, which needs what "
            "came before a prediction"
        )
    without = [run.name for run in runs if name not in run.sensors]
    if without:
        return f"not recorded in {', '.join(without)}"
    for recording in dict.fromkeys(run.recording for run in runs):
        mine = [run for run in runs if run.recording == recording]
        count, rows = sum(int(_read(r, name).sum()) for r in mine), sum(map(len, mine))
        if count < min(_FEWEST, rows):
            return f"{count} readings in the {rows} rows of {recording}"
    return ""


def _filled(run: Run, name: str, turns: bool) -> np.ndarray:
    """Readings of a sensor, and what lies between them, ``(T, dim)``; of an orientation
    that ``turns`` quaternions of one sign."""
    given, there = np.array(run.sensors[name], float), _read(run, name)
    x, row = given[there], np.arange(len(run))
    if not len(x):
        return np.zeros_like(given)
    x = one_sign(x) if turns else x
    return np.stack([np.interp(row, row[there], column) for column in x.T], 1)


def _read(run: Run, name: str) -> np.ndarray:
    """Rows in which a sensor was read, ``(T,)`` bool."""
    return np.asarray(np.isfinite(np.asarray(run.sensors[name], float)).all(1))
