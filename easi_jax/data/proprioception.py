"""What a robot measures of itself: numbers that a log and a simulation both have.

A legged robot logs its joints and an inertial unit; nobody measures where its base is.
Here a row of a log and a state of a simulation become the same channels: positions and
speeds of measured joints, and readings of sensors that no heading or place enters. Of
an orientation the direction of gravity is left, which is what an inertial unit knows;
of a touch sensor whether it touches.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from easi_jax.data.noise import sensor_noise
from easi_jax.data.recording import Run
from easi_jax.data.sensor_channels import Sensors, measured_sensors
from easi_jax.data.unmeasured import hidden_in_any
from easi_jax.errors import UserError
from easi_jax.model.joint_space import (
    driven_joint,
    joint_name,
    scalar_dofs,
    tangent_units,
)

_GRAVITY, _TOUCH = "gravity", "touch"
_READ = 0.95  # share of rows in which a sensor that is compared was read
# Sensors whose readings a heading or a place in the world does not enter.
_OWN = {
    *("GYRO", "ACCELEROMETER", "VELOCIMETER", "FORCE", "TORQUE", "TOUCH", "FRAMEQUAT"),
    *("JOINTPOS", "JOINTVEL", "JOINTACTFRC", "ACTUATORPOS", "ACTUATORVEL"),
    *("ACTUATORFRC", "TENDONPOS", "TENDONVEL", "TENDONACTFRC", "RANGEFINDER"),
}
_TOUCHING = 0.02  # of a robot's weight, from which a foot counts as on the ground
_FEWEST = 16  # rows of a run that noise can be told from
_UNITS = {"rad": "rad/s", "m": "m/s"}


@dataclass(frozen=True)
class _Part:
    """Numbers of one sensor.

    Attributes:
        name: of the sensor.
        at: where they are among `Proprioception.sensors`.
        how: `_GRAVITY`, `_TOUCH`, or empty for the numbers as they are.
        channels, unit: of what they become.
    """

    name: str
    at: slice
    how: str
    channels: tuple[str, ...]
    unit: str


@dataclass(frozen=True)
class Proprioception:
    """Channels of a robot, C of them: positions, speeds, readings of sensors.

    Attributes:
        positions: places of measured joints in ``qpos``, and ``dofs`` of theirs.
        speeds: degrees of freedom whose speeds were measured; none of them where the
            log has them from positions.
        sensors: what is read of a simulation, N numbers, and ``parts``: what is made
            of them.
        names, units: of the channels.
        weight: of the robot [N].
    """

    positions: tuple[int, ...]
    dofs: tuple[int, ...]
    speeds: tuple[int, ...]
    sensors: Sensors
    parts: tuple[_Part, ...]
    names: tuple[str, ...]
    units: tuple[str, ...]
    weight: float

    def __len__(self) -> int:
        return len(self.names)

    @cached_property
    def of_sensor(self) -> dict[str, slice]:
        """Channels of each sensor."""
        out, at = {}, len(self.positions) + len(self.speeds)
        for part in self.parts:
            out[part.name] = slice(at, at + len(part.channels))
            at += len(part.channels)
        return out

    @cached_property
    def touches(self) -> np.ndarray:
        """Channels that say whether something touches, ``(C,)`` bool."""
        out = np.zeros(len(self), bool)
        for part in self.parts:
            out[self.of_sensor[part.name]] = part.how == _TOUCH
        return out

    @cached_property
    def kinds(self) -> dict[str, slice]:
        """Channels that are read alike: positions, speeds, and each sensor."""
        p, v = len(self.positions), len(self.speeds)
        own = {"qpos": slice(0, p), "qvel": slice(p, p + v)}
        return {k: at for k, at in own.items() if at.start < at.stop} | self.of_sensor

    def channels(self, qpos: jax.Array, qvel: jax.Array, read: Any) -> jax.Array:
        """Channels ``(..., C)`` of states ``(..., nq)``, ``(..., nv)`` and of what
        sensors read there, ``(..., N)``."""
        own = [qpos[..., np.array(self.positions, int)]]
        if self.speeds:
            own.append(qvel[..., np.array(self.speeds)])
        made = (_made(p.how, read[..., p.at], self.weight) for p in self.parts)
        return jnp.concatenate([*own, *made], -1)

    def of_run(self, run: Run) -> np.ndarray:
        """Channels ``(T, C)`` of a recording."""
        given = run.qpos, run.qvel, self.sensors.readings(run)
        return np.asarray(self.channels(*map(jnp.asarray, given)))

    def noise(self, noise: np.ndarray, runs: Sequence[Run]) -> np.ndarray:
        """Standard deviations ``(C,)`` of readings; whether a foot touches has none.

        Args:
            noise: of positions and speeds, ``(2 nv,)``.
            runs: the recordings.
        """
        nv = len(noise) // 2
        own = noise[[*self.dofs, *(nv + d for d in self.speeds)]]
        made = []
        for run in (r for r in runs if len(r) >= _FEWEST):
            read = self.of_run(run)
            named = {name: read[:, at] for name, at in self.of_sensor.items()}
            made.append(replace(run, sensors=named))
        found = sensor_noise(made)
        out = np.concatenate([own, np.zeros(len(self) - len(own))])
        for part in self.parts:
            if part.how != _TOUCH and part.name in found:
                out[self.of_sensor[part.name]] = found[part.name].std
        return out


def _made(how: str, x: jax.Array, weight: float) -> jax.Array:
    """What becomes of readings ``(..., n)``."""
    if how == _GRAVITY:
        w, i, j, k = jnp.moveaxis(x, -1, 0)
        up = 2 * (i * k - w * j), 2 * (j * k + w * i), 1 - 2 * (i * i + j * j)
        return -jnp.stack(up, -1)
    if how == _TOUCH:
        return (x > _TOUCHING * weight).astype(x.dtype)
    return x


def proprioception(
    m: mujoco.MjModel, runs: Sequence[Run], engine: str
) -> tuple[Proprioception, list[str]]:
    """What recordings hold that a simulation of the robot has, too; and notes on what
    of it is left out.

    Args:
        m: the model.
        runs: recordings in which the same joints are measured.
        engine: that simulates.

    Raises:
        UserError: nothing is left to compare.
    """
    hidden, notes = hidden_in_any(runs), []
    at = {j: p for j, p in scalar_dofs(m).items() if not hidden[p[1]]}
    units = tangent_units(m)
    channels = [(f"qpos.{joint_name(m, j)}", units[d]) for j, (_, d) in at.items()]
    speeds: tuple[int, ...] = ()
    if all(run.qvel_measured for run in runs):
        named = {d: joint_name(m, j) for j, (_, d) in at.items()}
        speeds = tuple(named)
        channels += [(f"qvel.{named[d]}", _UNITS[units[d]]) for d in speeds]
    known, why = measured_sensors(m, runs)
    known, unsimulated = known.simulated_by(engine)
    # Interpolated readings would be too smooth beside a simulation's.
    read = np.min([known.known(run).mean(0) for run in runs], axis=0)
    few = {n.sensor for n, share in zip(known, read, strict=True) if share < _READ}
    slow = {n.channel: "it misses too many rows" for n in known if n.sensor in few}
    known, why = Sensors(tuple(n for n in known if n.sensor not in few)), why | slow
    own = Sensors(tuple(n for n in known if n.kind in _OWN))
    notes += [f"{c} is left out: {text}" for c, text in {**why, **unsimulated}.items()]
    left = dict.fromkeys(n.sensor for n in known if n.kind not in _OWN)
    notes += [f"sensor {name} is left out: it depends on the heading" for name in left]
    parts = _parts(own)
    for part in parts:
        channels += [(c, part.unit) for c in part.channels]
    if not channels:
        raise UserError("the logs hold no joint and no sensor that can be compared")
    positions, dofs = zip(*at.values(), strict=True) if at else ((), ())
    names, units_of = zip(*channels, strict=True)
    weight = _driven_mass(m) * float(np.linalg.norm(m.opt.gravity))
    found = (positions, dofs, speeds, own, parts, names, units_of, weight)
    return Proprioception(*found), notes


def _driven_mass(m: mujoco.MjModel) -> float:
    """Of the trees that drives act on [kg]; of all bodies where that is not known."""
    joints = [driven_joint(m, a) for a in range(m.nu)]
    driven = {m.body_rootid[m.jnt_bodyid[j]] for j in joints if j is not None}
    mine = np.isin(m.body_rootid, [*driven]) if driven else np.ones(m.nbody, bool)
    return float(m.body_mass[mine].sum())


def _parts(sensors: Sensors) -> tuple[_Part, ...]:
    parts = []
    for name in dict.fromkeys(n.sensor for n in sensors):
        mine = [i for i, n in enumerate(sensors) if n.sensor == name]
        numbers = [sensors.numbers[i] for i in mine]
        at, first = slice(mine[0], mine[-1] + 1), numbers[0]
        if first.kind == "FRAMEQUAT":
            channels = tuple(f"gravity.{name}.{axis}" for axis in "xyz")
            parts.append(_Part(name, at, _GRAVITY, channels, ""))
            continue
        touches = first.kind == "TOUCH"
        channels = tuple(n.channel for n in numbers)
        how, unit = (_TOUCH, "") if touches else ("", first.unit)
        parts.append(_Part(name, at, how, channels, unit))
    return tuple(parts)
