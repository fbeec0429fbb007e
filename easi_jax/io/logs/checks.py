"""What can be wrong with the values of a log."""

from pathlib import Path

import mujoco
import numpy as np

from easi_jax.data.recording import physics_steps
from easi_jax.data.resampling import recordings
from easi_jax.errors import UserError
from easi_jax.io.logs.columns import LogColumns

_HUGE = 1e8
_MOST_STEPS, _MANY_STEPS = 500, 50
_FEWEST_STEPS, _FEW_STEPS = 0.01, 0.2
_ZERO_NORM = 1e-6
_NORM_OFF = 0.05
_TURNS = 4


def check_sizes(
    path: Path,
    columns: LogColumns,
    qpos: np.ndarray,
    qvel: np.ndarray,
    ctrl: np.ndarray,
) -> None:
    """Refuses finite values that no machine has and single precision cannot hold.

    Raises:
        UserError: naming the first row and column.
    """
    for names, values in (
        (columns.qpos, qpos),
        (columns.qvel, qvel),
        (columns.ctrl, ctrl),
    ):
        huge = np.argwhere(np.isfinite(values) & (np.abs(values) > _HUGE))
        if len(huge):
            row, column = huge[0]
            raise UserError(
                f'{path}: row {row + 1}, column "{names[column]}" holds '
                f"{values[row, column]:.3g}, beyond any machine (limit {_HUGE:.0e})"
            )


def rate(path: Path, dt: float, timestep: float) -> str:
    """Compares the control step ``dt`` with the model's ``timestep``, both s.

    Returns:
        A note where they are oddly far apart, else ``""``.

    Raises:
        UserError: they are so far apart that time must be in another unit.
    """
    ratio = dt / timestep
    text = (
        f"a control step of {dt:.6g} s is {ratio:.3g} times the model's timestep of "
        f"{timestep:.6g} s"
    )
    if not _FEWEST_STEPS <= ratio <= _MOST_STEPS:
        raise UserError(
            f"{path}: wrong rate, {text}; if time is not in seconds, scale it in a "
            'mapping file ("scale: {time: 0.001}" for milliseconds)'
        )
    if ratio > _MANY_STEPS:
        return f"{text}: {physics_steps(dt, timestep)} physics steps a control step"
    if ratio < _FEW_STEPS:
        return f"{text}: the physics step is the control step"
    return ""


def normalized(
    path: Path,
    model: mujoco.MjModel,
    qpos: np.ndarray,
    label: np.ndarray,
    good: np.ndarray,
) -> tuple[np.ndarray, list[str]]:
    """Brings quaternions to length one and one sign, and unrolls wrapped hinges.

    Args:
        path: the file, for messages.
        model: the machine.
        qpos: ``(T, nq)``.
        label: recording of each row, ``(T,)``.
        good: rows that are used, ``(T,)`` bool; the others are left alone.

    Returns:
        The positions, and notes.

    Raises:
        UserError: a quaternion without length.
    """
    qpos = qpos.copy()
    notes: list[str] = []
    rows = np.flatnonzero(good)
    for i in range(model.njnt):
        kind, start = model.jnt_type[i], int(model.jnt_qposadr[i])
        name = model.joint(i).name
        if kind == mujoco.mjtJoint.mjJNT_HINGE and not model.jnt_limited[i]:
            turns = _wraps(qpos[rows, start], label[rows])
            if turns.any():
                qpos[rows, start] -= 2 * np.pi * turns
                notes.append(f"joint {name}: jumps by a whole turn were unrolled")
        if kind == mujoco.mjtJoint.mjJNT_FREE:
            start += 3
        elif kind != mujoco.mjtJoint.mjJNT_BALL:
            continue
        quaternion = qpos[rows, start : start + 4]
        norm = np.linalg.norm(quaternion, axis=1)
        zero = np.flatnonzero(norm < _ZERO_NORM)
        if len(zero):
            raise UserError(
                f"{path}: row {rows[zero[0]] + 1} has a zero quaternion for joint "
                f"{name}; write 1 0 0 0 for no rotation"
            )
        off = np.abs(norm - 1).max(initial=0.0)
        if off > _NORM_OFF:
            notes.append(
                f"joint {name}: quaternions up to {100 * off:.0f} % off unit length "
                "were normalized"
            )
        quaternion /= norm[:, None]
        turned = np.sum(quaternion[1:] * quaternion[:-1], axis=1) < 0
        sign = np.cumprod(np.concatenate([[1.0], np.where(turned, -1.0, 1.0)]))
        qpos[rows, start : start + 4] = quaternion * sign[: len(rows), None]
    return qpos, notes


def _wraps(values: np.ndarray, label: np.ndarray) -> np.ndarray:
    """Whole turns by which each row has jumped since its recording began."""
    turns = np.zeros(len(values))
    for _, rows in recordings(label):
        step = np.diff(values[rows])
        jump = np.sign(step) * (np.abs(np.abs(step) - 2 * np.pi) < np.pi / 2)
        turns[rows[1:]] = np.cumsum(jump)
    return turns


def ranges(model: mujoco.MjModel, qpos: np.ndarray, ctrl: np.ndarray) -> list[str]:
    """Notes on positions beyond joint ranges and commands beyond control ranges.

    Args:
        model: the machine.
        qpos: rows that are used, ``(T, nq)``.
        ctrl: ``(T, nu)``.
    """
    notes: list[str] = []
    if not len(qpos):
        return notes
    for i in range(model.njnt):
        hinge = model.jnt_type[i] == mujoco.mjtJoint.mjJNT_HINGE
        if not hinge and model.jnt_type[i] != mujoco.mjtJoint.mjJNT_SLIDE:
            continue
        values = qpos[:, int(model.jnt_qposadr[i])]
        name = model.joint(i).name
        if not model.jnt_limited[i]:
            turns = np.ptp(values) / (2 * np.pi)
            if hinge and turns > _TURNS:
                notes.append(
                    f"joint {name} moves through {turns:.0f} turns; if the log is in "
                    "degrees, scale it by 0.0174533 in a mapping file"
                )
            continue
        low, high = (float(x) for x in model.jnt_range[i])
        beyond = max(low - values.min(), values.max() - high)
        unit = "rad" if hinge else "m"
        spans = f"{values.min():.4g} to {values.max():.4g}"
        if beyond > high - low:
            other = "degrees (scale 0.0174533)" if hinge else "mm (scale 0.001)"
            notes.append(
                f"joint {name}: {spans} {unit} is far beyond its range of {low:.4g} to "
                f"{high:.4g} {unit}; is the log in {other}?"
            )
        elif beyond > 0.1 * (high - low):
            notes.append(
                f"joint {name}: {spans} {unit} leaves the model's range of {low:.4g} "
                f"to {high:.4g} {unit}"
            )
    for i in range(model.nu):
        if not model.actuator_ctrllimited[i]:
            continue
        low, high = (float(x) for x in model.actuator_ctrlrange[i])
        slack = 1e-6 * (high - low)
        outside = (ctrl[:, i] < low - slack) | (ctrl[:, i] > high + slack)
        if outside.any():
            notes.append(
                f"actuator {model.actuator(i).name}: {np.sum(outside)} commands beyond "
                f"its control range of {low:.4g} to {high:.4g}, which MuJoCo clamps"
            )
    return notes
