"""Named sensors as channels: what was read, and what a simulation reads."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from mujoco.mjx._src.types import SensorType

from easi_jax.data.noise import resolution_of, sensor_noise
from easi_jax.data.recording import Run
from easi_jax.model.sensors import sensor_columns, sensor_kind, sensor_unit

_OF_NO_MOTION = {"CLOCK", "USER", "PLUGIN"}
_ORIENTATION = {"FRAMEQUAT", "BALLQUAT"}
# That MJX lacks, or has for some models only.
_NOT_ON_MJX = {"CAMPROJECTION", "CONTACT", "RANGEFINDER", "TACTILE"}
_ON_MJX = {kind.name for kind in SensorType} - _NOT_ON_MJX
_ACCELERATION = mujoco.mjtStage.mjSTAGE_ACC


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
    """

    sensor: str
    index: int
    channel: str
    unit: str
    column: int
    kind: str
    of_forces: bool


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
    def orientations(self) -> list[slice]:
        """Where quaternions are among the numbers."""
        return [
            slice(i, i + 4)
            for i, n in enumerate(self)
            if n.kind in _ORIENTATION and n.index == 0
        ]

    def readings(self, run: Run) -> np.ndarray:
        """What was read, ``(T, N)``; quaternions of one sign."""
        parts = [np.asarray(run.sensors[n.sensor], float)[:, n.index] for n in self]
        out = np.stack(parts, 1) if parts else np.zeros((len(run), 0))
        for part in self.orientations:
            q = out[:, part]
            turned = np.sum(q[1:] * q[:-1], axis=1) < 0
            out[:, part] = (
                q * np.cumprod(np.r_[1.0, np.where(turned, -1.0, 1.0)])[:, None]
            )
        return out

    def noise(self, runs: Sequence[Run]) -> tuple[np.ndarray, np.ndarray]:
        """Standard deviations ``(N,)``, and which of them are upper bounds."""
        found = sensor_noise(runs)
        std = np.array([found[n.sensor].std[n.index] for n in self])
        bound = [bool(found[n.sensor].is_bound[n.index]) | n.of_forces for n in self]
        return std, np.array(bound, bool)

    def resolution(self, runs: Sequence[Run]) -> np.ndarray:
        """Smallest step between two readings, ``(N,)``."""
        return np.max([resolution_of(self.readings(run)) for run in runs], axis=0)

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
    """Reads some numbers of ``sensordata`` on either engine."""

    columns: tuple[int, ...]

    def __call__(self, _: Any, data: Any) -> Any:
        return data.sensordata[np.array(self.columns, int)]

    @property
    def native(self) -> "_NativeReading":
        """The same of native MuJoCo (`easi_jax.simulation.native.Reading`)."""
        return _NativeReading(self.columns)


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
    m: mujoco.MjModel, runs: Sequence[Run]
) -> tuple[Sensors, dict[str, str]]:
    """Sensors that can be compared with predictions in all of ``runs``, and why others
    of them are left out, by channel."""
    numbers: list[SensorNumber] = []
    ignored: dict[str, str] = {}
    for i in range(m.nsensor):
        name, dim = m.sensor(i).name, int(m.sensor_dim[i])
        if not any(name in run.sensors for run in runs):
            continue
        why, kind = _why_not(m, i, runs), sensor_kind(m, i)
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
    read = [np.isfinite(np.asarray(run.sensors[name], float)).all(1) for run in runs]
    rows = np.concatenate(read)
    if not rows.all():
        return f"no reading in {(~rows).sum()} of {len(rows)} rows"
    return ""
