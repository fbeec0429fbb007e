"""Windows of measured runs with what predictions need of the time around them."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from easi_jax.data.activations import activation_guess
from easi_jax.data.drive_forces import exertion
from easi_jax.data.law_states import law_states, times
from easi_jax.data.recording import Run
from easi_jax.data.sensor_channels import NO_SENSORS, Sensors
from easi_jax.data.windows import (
    fitted_velocity,
    lead_rows,
    window_rows,
    window_steps,
)

_BEFORE = 0.6  # s before a window in which a drive with play finds its side
_EXTREME = 4  # for so many, one more that has large forces or speeds


@dataclass(frozen=True)
class WindowSet:
    """Windows of several runs; all arrays have a leading axis W.

    A window begins `easi_jax.data.windows.lead_rows` before the start that it is
    measured from: its state there is fitted to the rows on either side of the start.

    Attributes:
        run: index of the run.
        row: row of the run where the window begins.
        start_qpos: measured positions there, ``(W, nq)``.
        start_act: activations there as far as commands tell, ``(W, na)``.
        ctrl: ``(W, H, nu)``.
        past: commands before, oldest first, ``(W, D, nu)``; before a run's first
            known command that command.
        past_qpos: positions in those rows, ``(W, D, nq)``.
        past_qvel: fitted velocities there, ``(W, D, nv)``; at rest before a run.
        read: way from the start to the positions of the rows from ``L + 1`` before it
            to ``H + L`` after, tangents ``(W, 2 L + 2 + H, nv)``, where readings can be
            L rows late; beyond a run its first or last.
        speed: fitted velocities from ``L + 1`` rows before the start to L after,
            ``(W, 2 L + 2, nv)``; at rest before a run.
        read_speed: velocities of the log in the rows of ``read``,
            ``(W, 2 L + 2 + H, nv)``.
        led: whether the run has as many rows before the window as readings can be late.
        sensed: readings of N numbers of sensors in the rows of ``read``,
            ``(W, 2 L + 2 + H, N)``.
        known: which of these there are, 1 or 0.
        last: command of the row after the last step, which sensors of forces may read
            there, ``(W, nu)``.
        time: of the row where the window begins, ``(W,)`` [s].
        hidden: what laws remember there (`easi_jax.data.law_states`), ``(W, S)``.
    """

    run: np.ndarray
    row: np.ndarray
    start_qpos: np.ndarray
    start_act: np.ndarray
    ctrl: np.ndarray
    past: np.ndarray
    past_qpos: np.ndarray
    past_qvel: np.ndarray
    read: np.ndarray
    speed: np.ndarray
    read_speed: np.ndarray
    led: np.ndarray
    sensed: np.ndarray
    known: np.ndarray
    last: np.ndarray
    time: np.ndarray
    hidden: np.ndarray

    def __len__(self) -> int:
        return len(self.run)

    def take(self, index: np.ndarray) -> "WindowSet":
        """Some of the windows."""
        return WindowSet(*(getattr(self, f)[index] for f in self.__dataclass_fields__))


@dataclass(frozen=True)
class Rows:
    """Rows of a run, to the nearest, that predictions of windows are about; some may
    lie beyond its ends.

    Attributes:
        readings: those of each degree of freedom, ``(W, H + 1, nv)``.
        commands: that act in the meantime, ``(W, H)``.
    """

    readings: np.ndarray
    commands: np.ndarray


def join(sets: Sequence[WindowSet]) -> WindowSet:
    """All windows of several sets."""
    names = WindowSet.__dataclass_fields__
    return WindowSet(*(np.concatenate([getattr(s, f) for s in sets]) for f in names))


def window_set(
    m: mujoco.MjModel,
    runs: Sequence[Run],
    horizon_s: float,
    longest: float,
    first_run: int = 0,
    sensors: Sensors = NO_SENSORS,
    rows: Sequence[np.ndarray] | None = None,
) -> WindowSet | None:
    """Windows every half horizon, each inside one run; None where there are none.

    Args:
        m: the model that was recorded.
        longest: delay of commands and readings that predictions allow for [s].
        first_run: index of the first of ``runs``.
        sensors: whose readings all of ``runs`` have.
        rows: of each run, in which those begin that are wanted; all if not given.
    """
    sets = [
        _windows_of(
            *(m, run, first_run + i, horizon_s, longest, sensors),
            None if rows is None else rows[i],
        )
        for i, run in enumerate(runs)
    ]
    sets = [s for s in sets if len(s)]
    return join(sets) if sets else None


def _windows_of(
    m: mujoco.MjModel,
    run: Run,
    number: int,
    horizon_s: float,
    longest: float,
    sensors: Sensors,
    rows: np.ndarray | None,
) -> WindowSet:
    late = math.ceil(longest / run.dt - 1e-9)
    past = math.ceil(max(2 * longest, _BEFORE) / run.dt) + 2
    lead = lead_rows(run.dt)
    first = window_rows(run, horizon_s, lead=lead) if rows is None else rows
    start, steps = first[:, None], window_steps(run.dt, horizon_s) + lead
    velocity = fitted_velocity(run.qpos, run.dt, run.configuration)

    def inside(rows: np.ndarray) -> np.ndarray:
        return np.clip(rows, 0, len(run) - 1)

    def moving(rows: np.ndarray) -> np.ndarray:
        return np.where(rows[..., None] < 0, 0.0, velocity[inside(rows)])

    before = start + np.arange(-past, 0)
    seen = start + np.arange(-late - 1, steps + late + 1)
    return WindowSet(
        run=np.full(len(first), number),
        row=first,
        start_qpos=run.qpos[first],
        start_act=activation_guess(m, run)[first],
        ctrl=run.ctrl[start + np.arange(steps)],
        past=run.sent_until[np.maximum(len(run.before) + before, 0)],
        past_qpos=run.qpos[inside(before)],
        past_qvel=moving(before),
        read=run.configuration.difference(run.qpos[start], run.qpos[inside(seen)]),
        speed=moving(start + np.arange(-late - 1, late + 1)),
        read_speed=run.qvel[inside(seen)],
        led=first >= late,
        sensed=sensors.readings(run)[inside(seen)],
        known=1.0 * sensors.known(run)[inside(seen)],
        last=run.ctrl[first + steps],
        time=times(run)[first],
        hidden=law_states(m, run)[first],
    )


def reach(
    m: mujoco.MjModel, runs: Sequence[Run], rows: Sequence[np.ndarray], steps: int
) -> np.ndarray:
    """Largest drive forces and speeds in windows of so many steps that begin in some
    ``rows`` of each run, ``(W, nu + nv)``."""
    out = []
    for run, begin in zip(runs, rows, strict=True):
        size = exertion(m, run)
        out += [size[row : row + steps + 1].max(0) for row in begin]
    return np.array(out)


def spread(most: int, reach: np.ndarray) -> np.ndarray:
    """Indices of ``most`` windows at even distances, and of some more with the largest
    forces and speeds ``reach (W, nu + nv)``, where limits show; all where there are no
    more."""
    count = len(reach)
    if count <= most:
        return np.arange(count)
    chosen = set(np.linspace(0, count - 1, most).round().astype(int).tolist())
    whole = min(count, most + most // _EXTREME)
    for largest in np.argsort(-reach, axis=0, kind="stable"):
        for window in largest.tolist():
            if len(chosen) < whole:
                chosen.add(window)
    return np.array(sorted(chosen))
