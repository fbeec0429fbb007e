"""Readings that disagree with the positions beside them: late, or off by a constant.

They say nothing of the plant, and no prediction of motion shows them: a velocity that a
drive has filtered, and the named sensors of the model whose readings follow from
positions and velocities alone (encoders at another place, gyroscopes, positions of
sites ...).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import sqrt

import mujoco
import numpy as np

from easi_jax.data.cleaning import rows_of
from easi_jax.data.recording import Run
from easi_jax.data.windows import fitted_velocity
from easi_jax.gap.decisions import DECIDE
from easi_jax.model.joint_space import tangent_names, tangent_units
from easi_jax.model.sensors import (
    reads_joints,
    sensor_columns,
    sensor_kind,
    sensor_unit,
)

_LONGEST = 0.1  # s
PIECES = 10
_SAME_STEP = 1e-6
# Rows, and steps [rad, m, rad/s, m/s], in which a sensor's share of what is hidden
# shows beyond rounding.
_TRIED, _TRY, _ROUNDING = 5, 0.1, 1e-9
_NO_NUMBER = {"CLOCK", "USER", "PLUGIN"}
_KINDS = {mujoco.mjtDataType.mjDATATYPE_REAL, mujoco.mjtDataType.mjDATATYPE_POSITIVE}
_STAGES = {mujoco.mjtStage.mjSTAGE_POS, mujoco.mjtStage.mjSTAGE_VEL}


@dataclass(frozen=True)
class ReadingFault:
    """An effect in a reading.

    Attributes:
        effect: ``sensor_delay`` or ``sensor_bias``.
        at: ``qvel.JOINT``, or the sensor's name.
        columns, std: its numbers, by columns of
            `easi_jax.model.found_effects.EffectEntry`.
        parameters: by the table's names: value, standard deviation, unit.
        confidence: share of pieces of the data that show it by themselves, one more of
            either kind counted (Laplace).
    """

    effect: str
    at: str
    columns: Mapping[str, float]
    std: Mapping[str, float]
    parameters: Mapping[str, tuple[float, float, str]]
    confidence: float


def reading_faults(m: mujoco.MjModel, runs: Sequence[Run]) -> list[ReadingFault]:
    """What is wrong with the velocities and the named sensors of ``runs``."""
    out = _of_velocities(m, runs)
    asked = [i for i in range(m.nsensor) if m.sensor(i).name and _follows(m, i)]
    unknown = _of_hidden(m, runs[0])
    asked = [i for i in asked if not unknown[sensor_columns(m, i)].any()]
    named = {m.sensor(i).name for i in asked}
    used = [r for r in runs if abs(r.dt / runs[0].dt - 1) < _SAME_STEP]
    right = [_expected(m, r) if named & set(r.sensors) else np.empty(0) for r in used]
    for i in asked:
        name, part = m.sensor(i).name, sensor_columns(m, i)
        both = [
            (np.asarray(run.sensors[name], float), all_right[:, part])
            for run, all_right in zip(used, right, strict=True)
            if name in run.sensors
        ]
        if both:
            # What joints do not read alone may be off by the model's geometry.
            sure = 1.0 if reads_joints(m, i) else DECIDE.geometry
            out += _faults(m, name, sensor_unit(m, i), both, used[0].dt, sure)
    return out


def _of_velocities(m: mujoco.MjModel, runs: Sequence[Run]) -> list[ReadingFault]:
    """Of measured velocities, beside those that the positions make."""
    measured = [run for run in runs if run.qvel_measured]
    if not measured:
        return []
    fitted = [fitted_velocity(r.qpos, r.dt, r.configuration) for r in measured]
    names, units, out = tangent_names(m), tangent_units(m), []
    for dof in np.flatnonzero(~measured[0].hidden).tolist():
        both = [
            (run.qvel[:, [dof]], right[:, [dof]])
            for run, right in zip(measured, fitted, strict=True)
        ]
        dt, unit = measured[0].dt, f"{units[dof]}/s"
        # A simulation reads speeds half a step late, which is an offset of what speeds
        # up all the time.
        pull = sum(abs(right[-1, 0] - right[0, 0]) for _, right in both)
        pull /= sum(len(right) * dt for _, right in both)
        least = DECIDE.own_steps * m.opt.timestep * pull
        out += [
            fault
            for fault in _faults(m, f"qvel.{names[dof]}", unit, both, dt)
            if fault.effect != "sensor_bias" or abs(fault.columns["bias"]) > least
        ]
    return out


def without_faults(runs: Sequence[Run], faults: Sequence[ReadingFault]) -> list[Run]:
    """Runs whose named sensors read what they would without ``faults``.

    What is late is read as much later, by linear interpolation, in the rows in which a
    sensor was read then; of the last rows, the last reading.
    """
    out = []
    for run in runs:
        sensors = {k: np.array(v, float) for k, v in run.sensors.items()}
        for fault in faults:
            read = sensors.get(fault.at)
            if read is None:
                continue
            bias = [x for k, x in fault.columns.items() if k.startswith("bias")]
            row = np.arange(len(run))
            at = row + fault.columns.get("late", 0.0) / run.dt
            there = np.asarray(np.isfinite(read).all(1))
            if not there.any():
                continue
            moved = [np.interp(at, row[there], x[there]) for x in read.T]
            then = there[np.minimum(np.round(at).astype(int), len(run) - 1)]
            moved = np.where(then[:, None], np.stack(moved, 1), np.nan)
            sensors[fault.at] = moved - (np.array(bias) if bias else 0.0)
        out.append(replace(run, sensors=sensors))
    return out


def _late(at: str, seconds: float, std: float, confidence: float) -> ReadingFault:
    told = {"delay": (seconds, std, "s")}
    columns, stds = {"late": seconds}, {"late": std}
    return ReadingFault("sensor_delay", at, columns, stds, told, confidence)


def _follows(m: mujoco.MjModel, i: int) -> bool:
    """Whether the reading is numbers that positions and velocities determine."""
    return (
        mujoco.mjtStage(int(m.sensor_needstage[i])) in _STAGES
        and mujoco.mjtDataType(int(m.sensor_datatype[i])) in _KINDS
        and sensor_kind(m, i) not in _NO_NUMBER
    )


def _faults(
    m: mujoco.MjModel,
    name: str,
    unit: str,
    both: Sequence[tuple[np.ndarray, np.ndarray]],
    dt: float,
    sure: float = 1.0,
) -> list[ReadingFault]:
    """Of one sensor, from its readings and what they should be, ``(T, dim)`` each;
    ``sure`` that an offset is not the model's."""
    shifts = round(_LONGEST / dt) + 1
    pieces = _pieces(both, shifts)
    if pieces is None:
        return []
    moved, off = pieces
    # A constant is no lateness: `off (rows, shifts, dim)` without its mean.
    middle = np.nanmean(off, 0)
    parts = np.array_split(off - middle, PIECES)
    costs = np.array([np.nansum(p**2, (0, 2)) for p in parts])
    found = []
    least = DECIDE.own_steps * m.opt.timestep
    lag = shift_of(costs.sum(0), dt, least)
    if lag is not None:
        alone = [shift_of(c, dt, least) for c in costs]
        found.append(_late(name, lag, *alike(alone, dt)))
    best = 0 if lag is None else min(round(lag / dt), shifts - 1)
    rest = off[:, best]
    means = np.array([np.nanmean(p, 0) for p in np.array_split(rest, PIECES)])
    bias = middle[best]
    error = np.nanstd(means, 0, ddof=1) / np.sqrt(PIECES)
    large = np.abs(bias) > np.maximum(
        DECIDE.bias_sure * error, DECIDE.bias_small * moved
    )
    large &= bias**2 > 0.5 * np.nanmean(rest**2, 0)
    if large.any():
        shown = np.abs(means) > 0.5 * np.abs(bias)
        share = int((shown & (means * bias > 0))[:, large].all(1).sum())
        sure *= (share + 1) / (PIECES + 2)
        many = len(bias) > 1
        words = [f"bias.{k}" if many else "bias" for k in range(len(bias))]
        value = {w: float(b) for w, b in zip(words, bias, strict=True)}
        std = {w: float(e) for w, e in zip(words, error, strict=True)}
        told = {w: (value[w], std[w], unit) for w in words}
        found.append(ReadingFault("sensor_bias", name, value, std, told, sure))
    return found


def _pieces(
    both: Sequence[tuple[np.ndarray, np.ndarray]], shifts: int
) -> tuple[np.ndarray, np.ndarray] | None:
    """How much the reading should move ``(dim,)``, and what it is off by, for each
    shift by which it may be late, ``(rows, shifts, dim)``; None where too little."""
    expected, off = [], []
    for read, right in both:
        told = read[shifts:]
        n = len(told)
        if n < shifts:
            continue
        late = [told - right[shifts - s : shifts - s + n] for s in range(shifts)]
        expected.append(right)
        off.append(np.stack(late, 1))
    if not off:
        return None
    every = np.concatenate(off)
    every = every[np.isfinite(every).all((1, 2))]
    if len(every) < 2 * PIECES:
        return None
    return np.concatenate(expected).std(0), every


def _of_hidden(m: mujoco.MjModel, run: Run) -> np.ndarray:
    """Numbers of sensors that what is hidden has a part in, ``(nsensordata,)`` bool."""
    if not run.hidden.any():
        return np.zeros(m.nsensordata, bool)
    part = rows_of(run, 0, min(len(run), _TRIED))
    step = np.random.default_rng(0).normal(size=(2, *part.qvel.shape)) * run.hidden
    c = run.configuration
    moved = replace(part, qpos=c.integrate(part.qpos, _TRY * step[0]))
    others = _expected(m, moved), _expected(m, part, _TRY * step[1])
    off = np.abs(np.array(others) - _expected(m, part))
    return np.any(off > _ROUNDING, axis=(0, 1))


def _expected(
    m: mujoco.MjModel, run: Run, faster: np.ndarray | float = 0.0
) -> np.ndarray:
    """What positions and speeds, ``faster`` than fitted, make of all sensors, ``(T,
    nsensordata)``."""
    speed = fitted_velocity(run.qpos, run.dt, run.configuration) + faster
    data = mujoco.MjData(m)
    out = np.zeros((len(run), m.nsensordata))
    for row in range(len(run)):
        data.qpos, data.qvel = run.qpos[row], speed[row]
        mujoco.mj_fwdPosition(m, data)
        mujoco.mj_sensorPos(m, data)
        mujoco.mj_fwdVelocity(m, data)
        mujoco.mj_sensorVel(m, data)
        out[row] = data.sensordata
    return out


def alike(alone: Sequence[float | None], dt: float) -> tuple[float, float]:
    """Standard error and confidence of a lag, from those of single pieces."""
    late = [x for x in alone if x is not None]
    spread = float(np.std(late, ddof=1)) if len(late) > 1 else dt
    std = max(spread, 0.1 * dt) / sqrt(max(len(late), 1))
    return std, (len(late) + 1) / (len(alone) + 2)


def shift_of(cost: np.ndarray, dt: float, least: float) -> float | None:
    """The shift of least cost [s]; None where it is no better than none.

    Args:
        cost: squared differences by shift, ``(shifts,)``.
        least: what is no news [s].
    """
    best = int(np.argmin(cost))
    lag = float(best)
    if 0 < best < len(cost) - 1:
        a, b, c = cost[best - 1 : best + 2]
        lag += 0.5 * (a - c) / max(a - 2 * b + c, 1e-300)
    enough = lag * dt > max(DECIDE.late, 0.5 * dt, least)
    return (
        float(lag * dt)
        if enough and cost[best] < DECIDE.late_explains * cost[0]
        else None
    )
