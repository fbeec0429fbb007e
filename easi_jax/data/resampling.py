"""Rows of a log as arrays, and their even spacing in time."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from easi_jax.model.joint_space import Configuration

# Rows nearer than this share of a step to an even grid are taken as they are:
# interpolating them would smooth noise here and not there.
EVEN = 0.01
_RATE_AGREES = 1e-3


class Rows(NamedTuple):
    """Rows of a file, or of a part of it: T rows, NaN where a column is missing."""

    time: np.ndarray
    label: np.ndarray
    qpos: np.ndarray
    qvel: np.ndarray
    ctrl: np.ndarray
    sensors: Mapping[str, np.ndarray]

    def take(self, rows: np.ndarray) -> "Rows":
        """The given rows, in the given order."""
        return Rows(
            *(part[rows] for part in self[:5]),
            sensors={name: values[rows] for name, values in self.sensors.items()},
        )


def recordings(label: np.ndarray) -> list[tuple[str, np.ndarray]]:
    """Labels ``(T,)`` in the order of their first rows, and the rows of each."""
    names, first, index = np.unique(label, return_index=True, return_inverse=True)
    rows = np.split(
        np.argsort(index, kind="stable"), np.cumsum(np.bincount(index))[:-1]
    )
    return [(str(names[i]), rows[i]) for i in np.argsort(first)]


def is_even(time: np.ndarray, dt: float) -> bool:
    """Whether ``time`` (s, ``(T,)``) ticks evenly by ``dt`` (s)."""
    count = len(time)
    mean = (time[-1] - time[0]) / (count - 1)
    off = time - time[0] - mean * np.arange(count)
    return bool(np.abs(off).max() <= EVEN * dt and abs(mean / dt - 1) <= _RATE_AGREES)


def resampled(rows: Rows, dt: float, configuration: Configuration) -> Rows:
    """``rows`` at multiples of ``dt`` (s) from the first row's time.

    Commands are held; positions, velocities and sensors interpolated linearly,
    orientations along the shorter arc. A velocity that one of the two neighbors lacks
    is the nearer one's; of a sensor only in the row that is next to the reading.
    """
    span = rows.time[-1] - rows.time[0]
    time = rows.time[0] + dt * np.arange(int(span / dt + EVEN) + 1)
    held = np.searchsorted(rows.time, time + EVEN * dt, side="right") - 1
    before = np.searchsorted(rows.time, time, side="right") - 1
    before = np.clip(before, 0, len(rows.time) - 2)
    share = (time - rows.time[before]) / np.diff(rows.time)[before]
    share = np.clip(share, 0.0, 1.0)[:, None]

    def between(values: np.ndarray) -> np.ndarray:
        a, b = values[before], values[before + 1]
        nearest = np.where(share < 0.5, a, b)
        both = np.isfinite(a) & np.isfinite(b)
        return np.where(both, a + share * (b - a), nearest)

    def beside(values: np.ndarray) -> np.ndarray:
        a, b = np.isfinite(values[before]), np.isfinite(values[before + 1])
        near = np.where(
            share < 0.5, rows.time[before, None], rows.time[before + 1, None]
        )
        far = np.abs(time[:, None] - near) > (0.5 + EVEN) * dt
        return np.where((a != b) & far, np.nan, between(values))

    turn = configuration.difference(rows.qpos[before], rows.qpos[before + 1])
    return Rows(
        time=time,
        label=rows.label[held],
        qpos=configuration.integrate(rows.qpos[before], share * turn),
        qvel=between(rows.qvel),
        ctrl=rows.ctrl[held],
        sensors={name: beside(v) for name, v in rows.sensors.items()},
    )


def mean_held(
    time: np.ndarray, ctrl: np.ndarray, at: np.ndarray, dt: float
) -> np.ndarray:
    """Means over ``[at, at + dt]`` of commands ``(T, nu)`` that are held from ``time``
    on: a command that changes within a step acts for a part of it."""
    given = np.concatenate([[0.0], np.diff(time)])[:, None]
    sent = np.cumsum(given * np.concatenate([ctrl[:1], ctrl[:-1]]), axis=0)

    def until(t: np.ndarray) -> np.ndarray:
        row = np.clip(np.searchsorted(time, t, side="right") - 1, 0, None)
        return sent[row] + (t - time[row])[:, None] * ctrl[row]

    return (until(at + dt) - until(at)) / dt
