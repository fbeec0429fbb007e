"""Measured runs as data of a search: noise, splits, segments, open-loop error."""

import math
from collections.abc import Sequence
from dataclasses import replace

import mujoco
import numpy as np

from easi_jax.data.noise import _JITTER, _USUAL, estimate_noise
from easi_jax.data.recording import Run
from easi_jax.data.resampling import Rows, mean_held, resampled
from easi_jax.data.windows import fitted_velocity, slope_noise
from easi_jax.errors import UserError
from easi_jax.model import addresses
from easi_jax.model.found_effects import EffectEntry
from easi_jax.model.joint_space import tangent_names

_STEPS_AGREE = 1e-3
_AGREES = 0.1
_CHANCE = 3.0  # times the square that noise makes of three gains: 5 % make more
_SHORTEST = 8  # rows, of which velocities can be judged
_NOISIER = 1.3  # times the noise that was estimated, that it may be
_ODD = 20.0  # times the noise
_ODD_ALONE = 3.0  # times the largest of the others
_FEWEST = 5  # rows between two leaps, of which a velocity can be told
_RETURNS = 0.1  # of a spike, which the reading after it is off at most
_ODD_ROWS = 3  # left out at either end, at most
_ODD_MINIMUM = 30  # rows of a run that can tell


def without_odd_ends(
    runs: Sequence[Run], noise: np.ndarray
) -> tuple[list[Run], list[str]]:
    """Runs without first or last rows that the rows beside them cannot follow.

    Recorders often start with a stale or half-initialized reading. An end row is left
    out where its third difference is far beyond the noise ``(2 nv,)`` and beyond every
    other one of the run, at most `_ODD_ROWS` at either end.
    """
    out, odd = [], []
    for run in runs:
        first, last = 0, len(run)
        while first < _ODD_ROWS and _odd_start(run.qpos[first:last], run, noise):
            first += 1
        while len(run) - last < _ODD_ROWS and _odd_start(
            run.qpos[first:last][::-1], run, noise
        ):
            last -= 1
        odd += [f"the first {first} of {run.name}"] * (first > 0)
        odd += [f"the last {len(run) - last} of {run.name}"] * (last < len(run))
        out.append(rows_of(run, first, last))
    if not odd:
        return out, []
    return out, [
        f"rows left out, for the rows beside them do not follow from their "
        f"positions (a stale first reading?): {', '.join(odd)}"
    ]


def _odd_start(qpos: np.ndarray, run: Run, noise: np.ndarray) -> bool:
    """Whether the first row of ``qpos (T, nq)`` stands apart from all others."""
    scalar = run.configuration
    x = qpos[:, list(scalar.scalar_qpos)]
    if len(x) < _ODD_MINIMUM:
        return False
    jerk = np.abs(np.diff(x, 3, axis=0))
    limit = np.maximum(
        _ODD * math.sqrt(20.0) * noise[list(scalar.scalar_qvel)],  # binomial(6, 3)
        _ODD_ALONE * jerk[_ODD_ROWS + 1 : -_ODD_ROWS].max(0),
    )
    return bool(np.any(jerk[0] > limit))


def split_at_resets(
    runs: Sequence[Run], noise: np.ndarray
) -> tuple[list[Run], list[str]]:
    """Runs cut where a position leaps from one row to the next, as in a reset.

    A leap lies far outside of the steps before and after it, which neither motion nor
    an impact does: the positions of an impact still follow from each other. Rows with a
    wild velocity are left out as well: one that the next row takes back, and that the
    positions know nothing of. Velocities that were derived are derived again.

    Args:
        noise: of positions and velocities, ``(2 nv,)``.

    Returns:
        The runs, and a note where there are more than before.
    """
    out, cut = [], []
    for run in runs:
        at = _leaps(run, noise)
        pieces = np.split(np.arange(len(run)), at + 1)
        whole = [p for p in pieces if len(p) >= _FEWEST]
        if not len(at) or not whole:
            out.append(run)
            continue
        cut.append(f"{run.name} at {', '.join(f'{t:.6g} s' for t in run.time[at[:3]])}")
        cut[-1] += ", ..." if len(at) > 3 else ""
        derived = _derived(run)
        for k, p in enumerate(whole, 1):
            part = rows_of(run, int(p[0]), int(p[-1]) + 1)
            part = replace(part, before=run.ctrl[:0])  # a reset
            if derived.any():
                speed = fitted_velocity(part.qpos, part.dt, part.configuration)
                part = replace(part, qvel=np.where(derived, speed, part.qvel))
            name = f"{run.name}/{k}" if len(whole) > 1 else run.name
            out.append(replace(part, name=name))
    if not cut:
        return out, []
    return out, [
        "readings leap from one row to the next (a reset, or a bad reading), so runs "
        f"were cut there: {'; '.join(cut)}"
    ]


def _derived(run: Run) -> np.ndarray:
    """Which velocities were derived from the positions, ``(nv,)``."""
    if run.qvel_measured:
        return run.hidden
    return (run.qvel == fitted_velocity(run.qpos, run.dt, run.configuration)).all(0)


def _leaps(run: Run, noise: np.ndarray) -> np.ndarray:
    """Rows after which a position leaps, or a velocity to and fro."""
    if len(run) < _ODD_MINIMUM:
        return np.zeros(0, int)
    scalar = list(run.configuration.scalar_qvel)
    step = run.configuration.difference(run.qpos[:-1], run.qpos[1:])[:, scalar]
    before, after = step[:-2], step[2:]
    high, low = np.maximum(before, after), np.minimum(before, after)
    beyond = np.maximum(step[1:-1] - high, low - step[1:-1])
    usual = np.percentile(np.abs(step), _USUAL, axis=0)
    limit = np.maximum(_ODD * math.sqrt(6.0) * noise[scalar], _ODD_ALONE * usual)
    leaps = np.flatnonzero((beyond > limit).any(1)) + 1
    spikes = _spikes(run, noise[run.qvel.shape[1] :])
    return np.union1d(leaps, np.union1d(spikes - 1, spikes))


def _spikes(run: Run, noise: np.ndarray) -> np.ndarray:
    """Rows whose measured velocity stands apart; ``noise (nv,)`` of velocities."""
    step = np.diff(run.qvel, axis=0)
    there, back = step[:-1], step[1:]
    usual = np.percentile(np.abs(step), _USUAL, axis=0)
    limit = np.maximum(_ODD * math.sqrt(6.0) * noise, _ODD_ALONE * usual)
    moved = run.configuration.difference(run.qpos[:-2], run.qpos[2:]) / (2 * run.dt)
    off = np.abs(run.qvel[1:-1] - moved)
    odd = (np.abs(there) > limit) & (np.abs(there + back) < _RETURNS * np.abs(there))
    return np.flatnonzero((odd & (off > 0.5 * np.abs(there))).any(1)) + 1


def to_common_step(runs: Sequence[Run]) -> tuple[list[Run], list[str]]:
    """Runs at the smallest of their control steps, and notes of what was changed.

    Commands are held, and a step gets the mean of what was held in it; positions and
    velocities are interpolated linearly.
    """
    dt = min(run.dt for run in runs)
    out, notes = [], []
    for run in runs:
        sent = run.ctrl if run.sent is None else run.sent
        if abs(run.dt / dt - 1) <= _STEPS_AGREE:
            out.append(replace(run, dt=dt, ctrl=sent, sent=None))
            continue
        rows = Rows(
            run.time, np.full(len(run), ""), run.qpos, run.qvel, run.ctrl, run.sensors
        )
        even = resampled(rows, dt, run.configuration)
        qvel = even.qvel
        if not run.qvel_measured:
            qvel = fitted_velocity(even.qpos, dt, run.configuration)
        out.append(
            replace(
                run,
                dt=dt,
                time=even.time,
                qpos=even.qpos,
                qvel=qvel,
                ctrl=mean_held(run.time, sent, even.time, dt),
                before=sent[:0],
                sent=None,
                sensors=even.sensors,
                smoothed=True,
            )
        )
        notes.append(
            f"{run.name}: control step of {run.dt:.6g} s brought to {dt:.6g} s, the "
            "smallest of all runs, by interpolation"
        )
    return out, notes


def rows_of(run: Run, first: int, last: int) -> Run:
    """Some rows of a run, with the commands that were sent before them."""
    part = slice(first, last)
    return replace(
        run,
        before=np.concatenate([run.before, run.ctrl[:first]]),
        time=run.time[part],
        qpos=run.qpos[part],
        qvel=run.qvel[part],
        ctrl=run.ctrl[part],
        sent=None if run.sent is None else run.sent[part],
        sensors={k: v[part] for k, v in run.sensors.items()},
    )


def true_readings(
    m: mujoco.MjModel, runs: Sequence[Run], entries: Sequence[EffectEntry]
) -> list[Run]:
    """Runs rid of what ``entries`` say of the readings: offsets and delays of joints.

    A late reading is that of some time ago, so rows are read as much later, by linear
    interpolation; the last rows, which nothing follows, are left out. Of velocities
    that are read (``qvel.JOINT``) the offset is taken off; how late they are shows
    beside the positions (`easi_jax.data.velocity_lag`).

    Raises:
        UserError: a joint that the model lacks, or that is no hinge or slide.
    """
    bias, late, faster = np.zeros(m.nv), np.zeros(m.nv), np.zeros(m.nv)
    names = [f"qvel.{name}" for name in tangent_names(m)]
    for e in entries:
        if e.at.startswith("qvel."):
            if "bias" in e.columns and e.at not in names:
                raise UserError(
                    f"{e.effect}@{e.at}: the model has no such velocity (known: "
                    f"{', '.join(names)})"
                )
            if e.at in names:
                faster[names.index(e.at)] += e.columns.get("bias", 0.0)
            continue
        named = mujoco.mj_name2id(m, mujoco.mjtObj.mjOBJ_SENSOR, e.at) >= 0
        own = e.kind == "sensor" and named
        if not e.of_readings or own:  # those are not used
            continue
        (place,) = addresses.places(m, f"joint.{e.at}.damping")
        dof = int(m.jnt_dofadr[place[2]])
        bias[dof] += e.columns.get("bias", 0.0)
        late[dof] += e.columns.get("late", 0.0)
    if not (bias.any() or late.any() or faster.any()):
        return list(runs)
    out = []
    for run in runs:
        count = len(run) - math.ceil(late.max() / run.dt - _JITTER)
        qpos = run.qpos.copy()
        qvel = run.qvel - (faster if run.qvel_measured else 0.0)
        for q, d in zip(
            run.configuration.scalar_qpos, run.configuration.scalar_qvel, strict=True
        ):
            row = np.arange(len(run))
            at = row + late[d] / run.dt
            qpos[:, q] = np.interp(at, row, run.qpos[:, q]) - bias[d]
            qvel[:, d] = np.interp(at, row, qvel[:, d])
        smoothed = run.smoothed or bool(late.any())
        read = replace(run, qpos=qpos, qvel=qvel, smoothed=smoothed)
        out.append(rows_of(read, 0, max(count, 2)))
    return out


def trusted_velocities(runs: Sequence[Run]) -> np.ndarray:
    """Which measured velocities are the derivatives of the positions in all of
    ``runs``, ``(nv,)`` bool; none that is hidden, or not measured in one of them.

    They agree with the fitted velocity within a tenth of its RMS or three times its
    noise; or, for what swings as fast as rows follow each other escapes the fit, their
    means from row to row are off the steps of the positions by no more than that tenth
    beyond what noise makes. And of the latter no more than a tenth of the motion goes
    with velocity and acceleration, as it does of what is scaled, late, filtered or
    nothing at all; in no run more than two tenths.
    """
    step, nv = runs[0].dt, runs[0].qvel.shape[1]
    seen = ~np.any([run.hidden for run in runs], 0)
    measured = all(run.qvel_measured for run in runs)
    runs = [run for run in runs if len(run) > _SHORTEST]
    if not (runs and measured):
        return np.zeros(nv, bool)
    fitted = [fitted_velocity(r.qpos, r.dt, r.configuration) for r in runs]
    usual = _rms(np.concatenate(fitted))
    noise = np.median([estimate_noise(run) for run in runs], 0)
    slack = 3 * slope_noise(step) * noise[:nv]
    off = _rms(np.concatenate([r.qvel - x for r, x in zip(runs, fitted, strict=True)]))
    agrees = off <= np.maximum(_AGREES * usual, slack)
    moved = [_mean_velocity(run, 1) for run in runs]
    between = [0.5 * (run.qvel[:-1] + run.qvel[1:]) for run in runs]
    apart = [a - b for a, b in zip(between, moved, strict=True)]
    made = np.hypot(math.sqrt(2.0) * noise[:nv] / step, noise[nv:] / math.sqrt(2.0))

    def tenth(moved: np.ndarray) -> np.ndarray:
        """Of the motion itself."""
        square = _rms(moved) ** 2 - 2.0 * (noise[:nv] / step) ** 2
        return _AGREES * np.sqrt(np.maximum(square, 0.0))

    least = tenth(np.concatenate(moved))
    agrees |= _rms(np.concatenate(apart)) <= np.hypot(least, _NOISIER * made)
    agrees &= _going_with_motion(runs, apart, _CHANCE) <= least
    for run, off, own in zip(runs, apart, moved, strict=True):
        most = 2.0 * np.maximum(least, tenth(own))
        agrees &= _going_with_motion([run], [off], 2 * _CHANCE) <= most
    return agrees & seen


def _going_with_motion(
    runs: Sequence[Run], apart: Sequence[np.ndarray], chance: float
) -> np.ndarray:
    """RMS ``(nv,)`` of what in ``apart (T - 1, nv)`` goes with velocity and
    acceleration, beyond ``chance`` times what it would of noise.

    By the measured velocities of the rows on either side, and by the positions there:
    noise of these rows has no part in what is apart.
    """
    left = np.concatenate([x[1:-1] for x in apart])
    before = np.concatenate([run.qvel[:-3] for run in runs])
    after = np.concatenate([run.qvel[3:] for run in runs])
    across = np.concatenate([_mean_velocity(run, 3) for run in runs])
    out = np.zeros(left.shape[1])
    for d in range(len(out)):
        goes = np.stack([before[:, d] + after[:, d], after[:, d] - before[:, d]], 1)
        goes = np.column_stack([goes, across[:, d]])
        gain = np.linalg.lstsq(goes, left[:, d], rcond=None)[0]
        noise = goes.shape[1] * np.mean(left[:, d] ** 2) / len(left)
        square = np.mean((goes @ gain) ** 2) - chance * noise
        out[d] = np.sqrt(max(square, 0.0))
    return out


def _mean_velocity(run: Run, steps: int) -> np.ndarray:
    """Over so many steps, by the positions, ``(T - steps, nv)``."""
    moved = run.configuration.difference(run.qpos[:-steps], run.qpos[steps:])
    return moved / (steps * run.dt)


def velocities(run: Run, trusted: np.ndarray) -> np.ndarray:
    """Velocities ``(T, nv)``: those measured of ``trusted (nv,)``, the others from the
    positions, and of the guess where hidden."""
    fitted = fitted_velocity(run.qpos, run.dt, run.configuration)
    return np.where(trusted, run.qvel, fitted)


def _rms(x: np.ndarray) -> np.ndarray:
    return np.sqrt(np.mean(x**2, 0))
