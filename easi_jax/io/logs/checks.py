"""What can be wrong with the values of a log."""

import math
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

import mujoco
import numpy as np

from easi_jax.data.recording import Run, physics_steps
from easi_jax.data.resampling import Rows, recordings
from easi_jax.errors import UserError
from easi_jax.io.logs.columns import LogColumns
from easi_jax.io.logs.cure import cure, scaled
from easi_jax.model.joint_space import (
    FREE_WIDTH,
    Configuration,
    dofs,
    driven_joint,
    is_hinge,
    is_scalar,
    joint_name,
    one_sign,
    scalar_dofs,
    turns_fully,
    widths,
)
from easi_jax.model.quantities import is_position_servo, linear_drive

_HUGE = 1e8
# Readings so many times as far from the median as all others, in so many rows at most,
# are codes of an error: no shock is a hundred times as strong as the next one.
_CODE, _FEW_CODES = 100.0, 0.01
_MOST_STEPS, _MANY_STEPS = 500, 50
_FEWEST_STEPS, _FEW_STEPS = 0.01, 0.2
_LATEST = 1e11  # s since 1970: the year 5138
_CLOCKS = (("milliseconds", 1e-3), ("microseconds", 1e-6), ("nanoseconds", 1e-9))
# A recorder that stamps two rows alike now and then; more is a coarse clock.
_FEW_REPEATED, _SHARE_REPEATED = 3, 0.01
_ZERO_NORM = 1e-6
# Spread [m, rad] of a base that rests while other joints move by more than the last:
# exactly, and within the noise of a motion capture.
_FIXED, _STILL, _MOVING = 1e-6, 1e-3, 0.1
_NORM_OFF = 0.05
_TURNS = 4
_BEYOND = 0.01  # rad outside of its range, that a reading may be off
_NEAR_ZERO = 0.3  # of w and x in every row, so that a half turn remains
_TURNED = 0.3  # rad in all, from which turning tells the order of a quaternion
_RIGHT_TURN, _WRONG_TURN = 0.3, 0.7  # shares of the measured turning
_DEGREE = 180 / math.pi  # degrees in a radian
_TICKS = 4096  # a common encoder, as an example
_SPEEDS = (("degrees per second", _DEGREE), ("revolutions per minute", 30 / math.pi))
_SPEEDS_OF_SLIDES = (("mm/s", 1e3),)
_TOGETHER = 0.9  # correlation
_UNIT_AGREES, _SERVO_AGREES = 0.1, 0.3  # of a factor; a servo lags behind


def check_sizes(
    path: Path,
    columns: LogColumns,
    qpos: np.ndarray,
    qvel: np.ndarray,
    ctrl: np.ndarray,
    sensors: Mapping[str, np.ndarray],
) -> None:
    """Refuses finite values that no machine has and single precision cannot hold.

    Raises:
        UserError: naming the first row and column.
    """
    for names, values in (
        (columns.qpos, qpos),
        (columns.qvel, qvel),
        (columns.ctrl, ctrl),
        *((columns.sensors[name], values) for name, values in sensors.items()),
    ):
        huge = np.argwhere(np.isfinite(values) & (np.abs(values) > _HUGE))
        if len(huge):
            row, column = huge[0]
            raise UserError(
                f'{path}: row {row + 1}, column "{names[column]}" holds '
                f"{values[row, column]:.3g}, beyond any machine (limit {_HUGE:.0e})"
            )


def without_codes(
    sensors: Mapping[str, np.ndarray],
) -> tuple[dict[str, np.ndarray], list[str]]:
    """Readings ``(T, dim)`` of sensors without codes of errors (-9999, 65535), NaN
    instead, and notes.

    Such a reading stands alone, or beside equal ones; a shock does not.
    """
    out, notes = {}, []
    for name, given in sensors.items():
        code = np.any([_codes(x) for x in given.T], 0)
        out[name] = np.where(code[:, None], np.nan, given)
        if code.any():
            first = int(np.flatnonzero(code)[0])
            value = max(given[first].tolist(), key=abs)
            notes.append(
                f"sensor {name}: {code.sum()} of {len(code)} readings are left out, "
                f"which look like codes of an error (the first, {value:.6g}, is in row "
                f"{first + 1})"
            )
    return out, notes


def _codes(x: np.ndarray) -> np.ndarray:
    """Which of readings ``(T,)`` are codes of an error, bool."""
    code = np.zeros(len(x), bool)
    known = np.flatnonzero(np.isfinite(x))
    read = x[known]
    few = int(_FEW_CODES * len(read))
    if not few:
        return code
    far = np.abs(read - np.median(read))
    order = np.argsort(far)[-few - 1 :]
    with np.errstate(over="ignore"):
        jumps = np.flatnonzero(far[order[1:]] > _CODE * far[order[:-1]])
    if not len(jumps) or not far[order[jumps[0]]]:
        return code
    odd = np.zeros(len(read), bool)
    odd[order[jumps[0] + 1 :]] = True
    # Beside an odd reading of another value it is no code.
    pair = odd[1:] & odd[:-1] & (read[1:] != read[:-1])
    code[known] = odd & ~np.append(pair, False) & ~np.append(False, pair)
    return code


def plausible_times(path: Path, time: np.ndarray) -> tuple[np.ndarray, list[str]]:
    """Times [s] ``(T,)`` with NaN where no clock can have been, and notes.

    Raises:
        UserError: most of them are such.
    """
    size = np.abs(time[np.isfinite(time)])
    usual = float(np.median(size)) if len(size) else 0.0
    if usual > _LATEST:
        hint = ""
        for unit, factor in _CLOCKS:
            if usual * factor <= _LATEST:
                hint = f"; if it counts {unit} since 1970, {scaled('time', factor)}"
                break
        raise UserError(
            f'{path}: column "time" holds {usual:.3g}, which no clock shows in '
            f"seconds{hint}"
        )
    absurd = np.abs(time) > _LATEST
    if not np.any(absurd & np.isfinite(time)):
        return time, []
    first = int(np.flatnonzero(absurd)[0])
    return np.where(absurd, np.nan, time), [
        f'column "time" holds what no clock shows in {np.sum(absurd)} rows (the first '
        f"is row {first + 1}, {time[first]:.3g} s)"
    ]


def repeated_stamps(time: np.ndarray) -> np.ndarray:
    """Rows that repeat the time stamp of the row before them, of ``time (T,)``; none
    where so many do that the clock must be coarser than the rows."""
    rows = np.flatnonzero(np.diff(time) == 0) + 1
    few = max(_FEW_REPEATED, _SHARE_REPEATED * len(time))
    return rows if len(rows) <= few else rows[:0]


def rate(path: Path, dt: float, timestep: float, counts: bool = False) -> str:
    """Compares the control step ``dt`` with the model's ``timestep``, both s.

    ``counts``: whether the times go up by ones, as numbers of rows do.

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
    unit, factor = next(
        (
            (unit, factor)
            for unit, factor in _CLOCKS
            if _FEW_STEPS <= ratio * factor <= _MANY_STEPS
        ),
        _CLOCKS[0],
    )
    hint = f"if time is in {unit} and not in seconds, {scaled('time', factor)}"
    if counts:
        hint = (
            f"if time counts rows of {timestep:.6g} s, {scaled('time', timestep)}, and "
            "so for another step"
        )
    if not _FEWEST_STEPS <= ratio <= _MOST_STEPS:
        raise UserError(f"{path}: wrong rate, {text}; {hint}")
    if ratio > _MANY_STEPS:
        steps = physics_steps(dt, timestep)
        return f"{text}: {steps} physics steps a control step; {hint}"
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
        start = int(model.jnt_qposadr[i])
        name = joint_name(model, i)
        if turns_fully(model, i):
            unrolled, jumps = _unrolled(model, i, qpos[rows, start], label[rows])
            if jumps:
                qpos[rows, start] = unrolled
                notes.append(
                    f"joint {name}: jumps by a whole turn were unrolled ({jumps} in "
                    f'column "qpos.{name}")'
                )
        if is_scalar(model, i):
            continue
        start += widths(model, i)[0] - 4  # after a free joint's position
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
        qpos[rows, start : start + 4] = one_sign(quaternion)
    return qpos, notes


def _unrolled(
    model: mujoco.MjModel, joint: int, values: np.ndarray, label: np.ndarray
) -> tuple[np.ndarray, int]:
    """Angles without jumps by a whole turn, and how many there were.

    Of a joint with limits each recording that jumps is moved by the whole turns that
    bring it into them.
    """
    out, jumps = values.copy(), 0
    for _, rows in recordings(label):
        step = np.diff(values[rows])
        jump = np.sign(step) * (np.abs(np.abs(step) - 2 * np.pi) < np.pi / 2)
        if not jump.any():
            continue
        jumps += int(np.sum(jump != 0))
        out[rows[1:]] -= 2 * np.pi * np.cumsum(jump)
        if model.jnt_limited[joint]:
            low, high = model.jnt_range[joint]
            middle = 0.5 * (out[rows].min() + out[rows].max())
            beyond = max(low - out[rows].min(), out[rows].max() - high)
            if beyond > _BEYOND:
                turns = np.round((0.5 * (low + high) - middle) / (2 * np.pi))
                out[rows] += 2 * np.pi * turns
    return out, jumps


def quaternion_orders(
    path: Path,
    model: mujoco.MjModel,
    rows: Rows,
    stated: Collection[str],
    hidden: Collection[int] = (),
) -> list[str]:
    """Notes on quaternions that look as if written x y z w.

    Args:
        path: the file, for messages.
        model: the machine.
        rows: those that are used.
        stated: joints of which the user has said the order.
        hidden: joints that nobody measured.

    Raises:
        UserError: measured velocities agree with that order alone.
    """
    notes: list[str] = []
    for i in range(model.njnt):
        name = joint_name(model, i)
        known = i in hidden or name in stated
        if is_scalar(model, i) or known or len(rows.time) < 2:
            continue
        first = widths(model, i)[0] - 4
        at, dof = int(model.jnt_qposadr[i]) + first, dofs(model, i)[-3]
        given = rows.qpos[:, at : at + 4]
        given = given / np.linalg.norm(given, axis=1, keepdims=True)
        columns = f"qpos.{name}.{first} to .{first + 3}"
        line = cure(f"quaternions: {{{name}: xyzw}}")
        ours = _turning_error(rows, given, dof)
        theirs = _turning_error(rows, given[:, [3, 0, 1, 2]], dof)
        if ours > _WRONG_TURN and theirs < _RIGHT_TURN:
            raise UserError(
                f"{path}: joint {name}: the measured angular velocities fit {columns} "
                f"if these are written x y z w, not w x y z; {line}"
            )
        known = ours < _RIGHT_TURN
        if not known and np.abs(given[:, :2]).max() < _NEAR_ZERO:
            notes.append(
                f"joint {name}: w and x of the quaternion ({columns}) are near 0 in "
                "every row, as of a body turned by half a turn, or where it is written "
                f"x y z w; if so, {line}; if not, 'quaternions: {{{name}: wxyz}}' says "
                "that"
            )
    return notes


def _turning_error(rows: Rows, quaternion: np.ndarray, dof: int) -> float:
    """How far the turning of ``quaternion (T, 4)`` is from measured velocities, as a
    share of these; NaN where there are none or the body hardly turns."""
    step = np.diff(rows.time)
    ball = Configuration(4, 3, (), (), ((0, 0),))
    turn = ball.difference(quaternion[:-1], quaternion[1:])
    speed = rows.qvel[:, dof : dof + 3]
    mean = 0.5 * (speed[:-1] + speed[1:])
    used = np.isfinite(mean).all(1) & (rows.label[1:] == rows.label[:-1])
    used &= (step > 0) & (step < 3 * np.median(step))
    moved = (mean * step[:, None])[used]
    if np.linalg.norm(moved, axis=1).sum() < _TURNED:
        return math.nan
    return float(np.linalg.norm(turn[used] - moved) / np.linalg.norm(moved))


def units_of_motion(
    model: mujoco.MjModel,
    qpos: np.ndarray,
    qvel: np.ndarray,
    ctrl: np.ndarray,
    fitted: np.ndarray,
) -> list[str]:
    """Notes on velocities and commands that follow the positions by the factor of
    another unit.

    Args:
        model: the machine.
        qpos: ``(T, nq)``.
        qvel: as logged, ``(T, nv)``; NaN where it was not.
        ctrl: ``(T, nu)``.
        fitted: velocities of the positions, ``(T, nv)``.
    """
    notes: list[str] = []
    for j, (_, d) in scalar_dofs(model).items():
        slope = _slope(fitted[:, d], qvel[:, d])
        for unit, factor in _SPEEDS if is_hinge(model, j) else _SPEEDS_OF_SLIDES:
            if abs(slope / factor - 1) < _UNIT_AGREES:
                column = f"qvel.{joint_name(model, j)}"
                notes.append(
                    f'column "{column}" is {slope:.3g} times the speed of its '
                    f"positions: in {unit}? {scaled(column, 1 / factor)}"
                )
    for a in range(model.nu):
        j = driven_joint(model, a)
        if j is None or not is_hinge(model, j):
            continue
        if not is_position_servo(model, a):
            continue
        target = ctrl[:, a] / model.actuator_gear[a, 0]
        angle = qpos[:, int(model.jnt_qposadr[j])]
        slope = _slope(angle - angle.mean(), target - target.mean())
        ours, theirs = f"ctrl.{model.actuator(a).name}", f"qpos.{joint_name(model, j)}"
        for column, factor in ((ours, slope), (theirs, 1 / slope if slope else 0.0)):
            if abs(factor / _DEGREE - 1) < _SERVO_AGREES:
                notes.append(
                    f'column "{column}" moves {factor:.3g} times as far as '
                    f'"{theirs if column == ours else ours}", although one follows the '
                    f"other: in degrees? {scaled(column, 1 / _DEGREE)}"
                )
    return notes


def _slope(x: np.ndarray, y: np.ndarray) -> float:
    """Of ``y`` over ``x`` through zero; 0 where they do not go together."""
    known = np.isfinite(x) & np.isfinite(y)
    x, y = x[known], y[known]
    size = float(np.linalg.norm(x) * np.linalg.norm(y))
    if not size or abs(x @ y) < _TOGETHER * size:
        return 0.0
    return float(x @ y / (x @ x))


def ranges(
    model: mujoco.MjModel,
    qpos: np.ndarray,
    ctrl: np.ndarray,
    hidden: Collection[int] = (),
) -> list[str]:
    """Notes on positions beyond joint ranges and commands beyond control ranges.

    Args:
        model: the machine.
        qpos: rows that are used, ``(T, nq)``.
        ctrl: ``(T, nu)``.
        hidden: joints that nobody measured.
    """
    notes: list[str] = []
    if not len(qpos):
        return notes
    for i, (q, _) in scalar_dofs(model).items():
        if i in hidden:
            continue
        hinge, name = is_hinge(model, i), joint_name(model, i)
        values, column = qpos[:, q], f"qpos.{joint_name(model, i)}"
        unit = "rad" if hinge else "m"
        low, high = (float(x) for x in model.jnt_range[i])
        spans = f"{values.min():.4g} to {values.max():.4g} {unit}"
        if not model.jnt_limited[i]:
            turns = np.ptp(values) / (2 * np.pi)
            if hinge and turns > _TURNS:
                notes.append(
                    f"joint {name} moves through {turns:.0f} turns; "
                    f"{_another_unit(column, values, hinge)}"
                )
            continue
        beyond = max(low - values.min(), values.max() - high)
        if beyond > high - low:
            notes.append(
                f"joint {name}: {spans} is far beyond its range of {low:.4g} to "
                f"{high:.4g} {unit}; {_another_unit(column, values, hinge)}"
            )
        elif beyond > 0.1 * (high - low):
            notes.append(
                f"joint {name}: {spans} leaves the model's range of {low:.4g} to "
                f"{high:.4g} {unit}"
            )
    for i in range(model.nu):
        if not model.actuator_ctrllimited[i]:
            continue
        low, high = (float(x) for x in model.actuator_ctrlrange[i])
        slack = 1e-6 * (high - low)
        outside = (ctrl[:, i] < low - slack) | (ctrl[:, i] > high + slack)
        if not outside.any():
            continue
        name = model.actuator(i).name
        beyond = max(low - ctrl[:, i].min(), ctrl[:, i].max() - high)
        far = beyond > high - low and is_position_servo(model, i)
        hinge = linear_drive(model, i) is False
        unit = f"; {_another_unit(f'ctrl.{name}', ctrl[:, i], hinge)}" if far else ""
        notes.append(
            f"actuator {name}: {np.sum(outside)} commands beyond its control range of "
            f"{low:.4g} to {high:.4g}, which MuJoCo clamps{unit}"
        )
    return notes


def _another_unit(column: str, values: np.ndarray, hinge: bool) -> str:
    """What ``column`` may be in, and the line that says so."""
    whole = bool(np.all(values == np.round(values)) and np.ptp(values) > 0)
    if not hinge:
        ticks = ", or scale by m per tick if these are encoder ticks" if whole else ""
        return f"if it is in mm, {scaled(column, 1e-3)}{ticks}"
    if not whole:
        return f"if it is in degrees, {scaled(column, 1 / _DEGREE)}"
    return (
        "its readings are whole numbers: if they are encoder ticks, "
        f"{scaled(column, 2 * math.pi / _TICKS)} for {_TICKS} a turn (2 pi / ticks); "
        f"if degrees, {scaled(column, 1 / _DEGREE)}"
    )


def still_base(path: Path, model: mujoco.MjModel, runs: Sequence[Run]) -> str:
    """A note where a free base rests in all ``runs`` while its joints move, else "".

    Raises:
        UserError: it does not move at all, so it was held.
    """
    root = model.body_rootid[model.jnt_bodyid]
    qpos = np.concatenate([run.qpos for run in runs])
    spread = np.ptp(qpos, axis=0)
    hidden = np.any([run.hidden for run in runs], axis=0)
    for j in range(model.njnt):
        at = int(model.jnt_qposadr[j])
        others = [
            int(model.jnt_qposadr[k])
            for k in range(model.njnt)
            if k != j and root[k] == root[j] and is_scalar(model, k)
        ]
        free = widths(model, j)[0] == FREE_WIDTH
        free &= not hidden[model.jnt_dofadr[j]]
        if not free or not others or spread[others].max() < _MOVING:
            continue
        most = spread[at : at + FREE_WIDTH].max()
        text = (
            f'the base "{joint_name(model, j)}" does not move in this log: remove its '
            "free joint, or give --held-base"
        )
        if most < _FIXED:
            raise UserError(f"{path}: {text}")
        if most < _STILL:
            return f"{text} (where it was held)"
    return ""
