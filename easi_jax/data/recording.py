"""Recordings of a machine: uninterrupted runs at one control step."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import mujoco
import numpy as np

from easi_jax.errors import UserError
from easi_jax.model.checks import checked_array
from easi_jax.model.joint_space import Configuration

# A logger's clock is no better than this, and half the physics step for a control
# step of 1.0003 times the model's would double the work for nothing.
_CLOCK_ERROR = 1e-3


@dataclass(frozen=True, eq=False)
class Run:
    """One uninterrupted recording, one row per control step.

    Attributes:
        name: unique among the runs that were read together.
        source: the file it came from.
        dt: control step, s.
        time: measured time, s, ``(T,)``.
        qpos: positions, m, rad and unit quaternions (w x y z), ``(T, nq)``.
        qvel: velocities, m/s and rad/s, ``(T, nv)``.
        qvel_measured: True where velocities come from the log, hidden ones aside, but
            in a few rows; those that are missing are derived from the positions.
        ctrl: command sent from this row to the next, ``(T, nu)``.
        sensors: readings by sensor name, ``(T, dim)``; NaN where there was none.
        configuration: where quaternions lie in ``qpos``.
        hidden: degrees of freedom that nobody measured, ``(nv,)`` bool; whole joints.
            Their ``qpos`` and ``qvel`` are a guess (`easi_jax.data.unmeasured`). None
            are hidden where it is not given.
        before: commands sent in the rows before the first, oldest first, ``(D, nu)``;
            none where nothing is known of them.
        part_of: name of the recording that the run was cut out of; empty where it is
            whole.
        stamps: times of the rows as they were recorded [s]; None where they were even,
            and nothing was interpolated.
        smoothed: whether rows were interpolated once more, after their noise was told.
        sent: mean over each step of the commands held in it, ``(T, nu)``; None where
            it is ``ctrl``.
    """

    name: str
    source: str
    dt: float
    time: np.ndarray
    qpos: np.ndarray
    qvel: np.ndarray
    qvel_measured: bool
    ctrl: np.ndarray
    configuration: Configuration
    sensors: Mapping[str, np.ndarray] = field(default_factory=dict)
    stamps: np.ndarray | None = None
    sent: np.ndarray | None = None
    hidden: np.ndarray = field(default_factory=lambda: np.zeros(0, bool))
    before: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))
    part_of: str = ""
    smoothed: bool = False

    def __post_init__(self) -> None:
        if not len(self.hidden):
            nothing = np.zeros(self.configuration.nv, bool)
            object.__setattr__(self, "hidden", nothing)
        if not len(self.before):
            object.__setattr__(self, "before", self.ctrl[:0])

    def __len__(self) -> int:
        """Number of rows, T."""
        return len(self.time)

    @property
    def recording(self) -> str:
        """Name of the recording that the run is, or was cut out of."""
        return self.part_of or self.name

    @property
    def sent_until(self) -> np.ndarray:
        """Commands of all rows, and of those `before` them, ``(D + T, nu)``."""
        return np.concatenate([self.before, self.ctrl])


@dataclass(frozen=True, eq=False)
class Log:
    """All runs that were read together.

    Attributes:
        runs: in the order of the files and, inside a file, of their first row.
        notes: what a user should know of the reading, one line each: columns
            ignored, rows dropped, runs split, velocities estimated, and values
            that look wrong.
    """

    runs: tuple[Run, ...]
    notes: tuple[str, ...]


def check_run(run: Run, mj_model: mujoco.MjModel) -> None:
    """Checks a run that may have been made by hand.

    Raises:
        UserError: an array whose shape is not that of ``mj_model`` and of the other
            rows, or that is not finite; a control step that is not above 0.
    """
    sizes = {"time": (), "qpos": (mj_model.nq,), "qvel": (mj_model.nv,)}
    for name, size in {**sizes, "ctrl": (mj_model.nu,)}.items():
        checked_array(f"{run.name}: {name}", getattr(run, name), (len(run), *size))
    size = len(run.before), mj_model.nu
    checked_array(f"{run.name}: before", run.before, size)
    hidden = np.asarray(run.hidden)
    if hidden.shape != (mj_model.nv,) or hidden.dtype != bool:
        raise UserError(
            f"{run.name}: hidden has shape {hidden.shape} and type {hidden.dtype}: "
            f"give ({mj_model.nv},) of bool"
        )
    if hidden.all():
        raise UserError(f"{run.name}: no joint is measured: nothing can be determined")
    if not (math.isfinite(run.dt) and run.dt > 0):
        raise UserError(f"{run.name}: control step is {run.dt} s: give one above 0")


def physics_steps(control_step: float, timestep: float) -> int:
    """Physics steps in one control step.

    The smallest whole number that brings ``control_step`` (s) to ``timestep`` (s)
    or below; an excess of 0.1 %, which is clock error, is let pass. The physics
    step is then ``control_step / physics_steps(control_step, timestep)``.
    """
    return max(1, math.ceil(control_step / timestep * (1.0 - _CLOCK_ERROR)))
