"""Measured runs as data of a search: noise, splits, segments, open-loop error."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from easi_jax import addresses, replay
from easi_jax.configuration import Configuration
from easi_jax.errors import UserError
from easi_jax.found_effects import EffectEntry
from easi_jax.io.log_rows import Rows, mean_held, resampled
from easi_jax.machine import Machine
from easi_jax.recording import Run
from easi_jax.segments import Segments, cut, join
from easi_jax.windows import fitted_velocity

_ORDERS = range(2, 7)
_COPIES = 16  # of white noise, interpolated as a run was
_MAD = 1.4826  # median absolute deviation -> standard deviation, Gaussian
_JITTER = 1e-6  # rounding of a written number, as a share of the largest
_STEPS_AGREE = 1e-3
_AGREES = 0.1
_ODD = 20.0  # times the noise
_ODD_ALONE = 3.0  # times the largest of the others
_USUAL = 98.0  # percentile of steps that is no leap
_FEWEST = 5  # rows between two leaps, of which a velocity can be told
_WILD = 10.0  # times the usual readings
_RETURNS = 0.1  # of a spike, which the reading after it is off at most
_ODD_ROWS = 3  # left out at either end, at most
_ODD_MINIMUM = 30  # rows of a run that can tell
_SCALAR = Configuration(1, 1, (0,), (0,), ())


def estimate_noise(run: Run) -> np.ndarray:
    """Measurement noise of a run, standard deviations ``(2 nv,)``.

    Positions: differences of order 2 to 6, in which smooth motion vanishes and white
    noise grows by ``sqrt(binomial(2k, k))``; the median absolute value keeps jerks
    out, and the order with the least motion left in it counts; where readings are
    coarser than that, their few levels make a median jump, and the mean absolute value
    counts. Never below what the resolution makes, ``step / sqrt(12)``. Velocities: the
    same where they were measured, else the positions' noise through the quadratic fit.
    Where rows were interpolated, what that has smoothed is made up for.
    """
    steps = run.configuration.difference(run.qpos[:-1], run.qpos[1:])
    sigma = _difference_noise(steps, 1, np.median, _MAD)
    mean = _difference_noise(steps, 1, np.mean, math.sqrt(math.pi / 2))
    scalar = list(run.configuration.scalar_qvel)
    readings = run.qpos[:, list(run.configuration.scalar_qpos)]
    resolution = _resolution(readings)
    coarse = resolution > sigma[scalar]
    sigma[scalar] = np.where(coarse, mean[scalar], sigma[scalar])
    sigma[scalar] = np.maximum(sigma[scalar], resolution / math.sqrt(12.0))
    kept = _kept_noise(run)
    sigma = sigma / kept
    if run.qvel_measured:
        speed = np.maximum(
            _difference_noise(run.qvel, 0, np.median, _MAD) / kept,
            _resolution(run.qvel) / math.sqrt(12.0),
        )
    else:
        speed = sigma * _fit_gain(len(run), run.dt)
    return np.concatenate([sigma, speed])


def _difference_noise(
    x: np.ndarray, done: int, middle: Callable[..., np.ndarray], factor: float
) -> np.ndarray:
    """Noise of ``x (T, n)``, which was differenced ``done`` times already, from a
    ``middle`` of absolute values and the ``factor`` that makes it a deviation."""
    found = []
    for order in _ORDERS:
        if len(x) - (order - done) < 3:
            break
        d = np.diff(x, order - done, axis=0)
        found.append(
            factor * middle(np.abs(d), 0) / math.sqrt(math.comb(2 * order, order))
        )
    return np.min(found, axis=0) if found else np.zeros(x.shape[1])


def _kept_noise(run: Run) -> float:
    """Share of white noise that is found after the rows' interpolation in time."""
    if run.stamps is None:
        return 1.0
    noise = np.random.default_rng(0).normal(size=(_COPIES, len(run.stamps)))
    rows = np.stack([np.interp(run.time, run.stamps, x) for x in noise], 1)
    return float(np.median(_difference_noise(rows, 0, np.median, _MAD)))


def _resolution(x: np.ndarray) -> np.ndarray:
    """Smallest step between two readings of each column of ``x (T, n)``."""
    out = np.zeros(x.shape[1])
    for i, column in enumerate(x.T):
        gaps = np.asarray(np.diff(np.unique(column)), float)
        size = np.abs(column)
        largest, usual = float(size.max()), float(np.percentile(size, _USUAL))
        if 0.0 < usual < largest / _WILD:  # wild readings
            largest = usual
        gaps = gaps[gaps > _JITTER * max(largest, 1e-300)]
        out[i] = gaps.min() if gaps.size else 0.0
    return out


def _fit_gain(rows: int, dt: float) -> float:
    """Noise of a fitted velocity per unit of position noise [1/s]."""
    impulse = np.zeros((rows, 1))
    impulse[rows // 2] = 1.0
    return float(np.linalg.norm(fitted_velocity(impulse, dt, _SCALAR)))


def pooled_noise(runs: Sequence[Run]) -> np.ndarray:
    """Median over runs of `estimate_noise`, ``(2 nv,)``."""
    return np.median([estimate_noise(run) for run in runs], axis=0)


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
        return np.zeros(run.qvel.shape[1], bool)
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
                sent=None,
                sensors=even.sensors,
            )
        )
        notes.append(
            f"{run.name}: control step of {run.dt:.6g} s brought to {dt:.6g} s, the "
            "smallest of all runs, by interpolation"
        )
    return out, notes


def rows_of(run: Run, first: int, last: int) -> Run:
    part = slice(first, last)
    return replace(
        run,
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
    interpolation; the last rows, which nothing follows, are left out.

    Raises:
        UserError: a joint that the model lacks, or that is no hinge or slide.
    """
    bias, late = np.zeros(m.nv), np.zeros(m.nv)
    for e in entries:
        named = mujoco.mj_name2id(m, mujoco.mjtObj.mjOBJ_SENSOR, e.at) >= 0
        own = e.kind == "sensor" and named
        if not e.of_readings or own or e.at.startswith("qvel."):  # such are not used
            continue
        (place,) = addresses.places(m, f"joint.{e.at}.damping")
        dof = int(m.jnt_dofadr[place[2]])
        bias[dof] += e.columns.get("bias", 0.0)
        late[dof] += e.columns.get("late", 0.0)
    if not bias.any() and not late.any():
        return list(runs)
    out = []
    for run in runs:
        count = len(run) - math.ceil(late.max() / run.dt - _JITTER)
        qpos, qvel = run.qpos.copy(), run.qvel.copy()
        for q, d in zip(
            run.configuration.scalar_qpos, run.configuration.scalar_qvel, strict=True
        ):
            row = np.arange(len(run))
            at = row + late[d] / run.dt
            qpos[:, q] = np.interp(at, row, run.qpos[:, q]) - bias[d]
            qvel[:, d] = np.interp(at, row, run.qvel[:, d])
        out.append(rows_of(replace(run, qpos=qpos, qvel=qvel), 0, max(count, 2)))
    return out


def trusted_velocity(run: Run) -> np.ndarray:
    """Velocities ``(T, nv)``: those measured where they are the positions' derivative,
    else that derivative.

    They are where they agree with the fitted one (within a tenth of its RMS or three
    times its noise), or where they integrate to the positions from row to row (within
    a tenth): what swings as fast as rows follow each other escapes the fit.
    """
    fitted = fitted_velocity(run.qpos, run.dt, run.configuration)
    if not run.qvel_measured:
        return fitted
    nv = run.qvel.shape[1]
    slack = 3 * estimate_noise(replace(run, qvel_measured=False))[nv:]
    off = _rms(run.qvel - fitted)
    agrees = off <= np.maximum(_AGREES * _rms(fitted), slack)
    moved = run.configuration.difference(run.qpos[:-1], run.qpos[1:]) / run.dt
    between = 0.5 * (run.qvel[:-1] + run.qvel[1:])
    agrees |= _rms(between - moved) <= _AGREES * _rms(moved)
    return np.where(agrees, run.qvel, fitted)


def _rms(x: np.ndarray) -> np.ndarray:
    return np.sqrt(np.mean(x**2, 0))


def visible_steps(
    runs: Sequence[Run], noise: np.ndarray, most: int, ratio: float
) -> int:
    """Fewest steps over which motion stands out of the noise, at most ``most``.

    RMS change of every position and velocity, at least ``ratio``
    times its noise ``(2 nv,)``: in shorter pieces a search would see mostly noise.
    """
    states = [(run, trusted_velocity(run)) for run in runs]
    for steps in range(1, most):
        square, rows = np.zeros(len(noise)), 0
        for run, qvel in states:
            if len(run) <= steps:
                continue
            moved = run.configuration.difference(run.qpos[:-steps], run.qpos[steps:])
            change = np.concatenate([moved, qvel[steps:] - qvel[:-steps]], 1)
            square += (change**2).sum(0)
            rows += len(change)
        rms = np.sqrt(square / max(rows, 1))
        if np.all(rms >= ratio * noise):
            return steps
    return most


def segments_from_runs(
    machine: Machine,
    runs: Sequence[Run],
    horizon: int,
    every: int,
    fitted: bool = False,
) -> Segments:
    """Segments of ``horizon`` control steps, none across two runs.

    Args:
        machine: its control step is that of the runs.
        every: steps from one start to the next.
        fitted: take all velocities from the positions, measured ones too, as the
            error measure of the log format does.

    Raises:
        UserError: no run is longer than ``horizon`` steps.
        ValueError: a run of another control step.
    """
    parts = []
    for run in runs:
        if abs(run.dt / machine.dt - 1) > _STEPS_AGREE:
            raise ValueError(f"{run.name}: control step {run.dt}, not {machine.dt}")
        qvel = (
            fitted_velocity(run.qpos, run.dt, run.configuration)
            if fitted
            else trusted_velocity(run)
        )
        parts.append(cut(run.qpos, qvel, run.ctrl, horizon, every, machine.past_steps))
    whole = [p for p in parts if p is not None]
    if not whole:
        longest = max(runs, key=len)
        raise UserError(
            f"no run is longer than {horizon} steps ({horizon * machine.dt:g} s); the "
            f"longest, {longest.name}, has {len(longest)} rows: record more, or "
            "shorten --horizon"
        )
    return join(whole)


def open_loop_error(machine: Machine, model: Any, segments: Segments) -> jax.Array:
    """RMS over all steps of all segments of the position error, ``(nv,)``."""
    nv = machine.mj_model.nv
    return _rms_of_steps(replay.errors(machine, model, segments)[..., :nv])


def errors_and_floor(
    machine: Machine,
    model: Any,
    held: Segments,
    fit: Segments,
    noise: jax.Array,
    key: jax.Array,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """`open_loop_error` on ``held``, on ``fit``, and what the first would be for a
    perfect model, ``(nv,)`` each.

    For the floor noise ``(2 nv,)`` is drawn for starts and targets and pushed through
    the model.
    """
    nv = machine.mj_model.nv
    k_start, k_end = jax.random.split(key)
    z = noise * jax.random.normal(k_start, (held.count, 2 * nv))
    moved = replace(
        held,
        qpos=jax.vmap(machine.move)(held.qpos, z[:, :nv]),
        qvel=held.qvel + z[:, nv:],
    )
    # One simulation, since compiling it takes longer than running it.
    every = jax.tree.map(lambda *x: jnp.concatenate(x), held, fit, moved)
    states = replay.predict(machine, model, every)
    target = (every.next_qpos, every.next_qvel)
    error = replay.innovations(machine, states, target)[..., :nv]
    sharp, noisy = (
        jax.tree.map(lambda x, at=at: x[at], states)
        for at in (slice(held.count), slice(held.count + fit.count, None))
    )
    shift = replay.innovations(machine, sharp, noisy)[..., :nv]
    shift = shift + noise[:nv] * jax.random.normal(k_end, shift.shape)
    first, second = error[: held.count], error[held.count : held.count + fit.count]
    return _rms_of_steps(first), _rms_of_steps(second), _rms_of_steps(shift)


def _rms_of_steps(error: jax.Array) -> jax.Array:
    return jnp.sqrt(jnp.mean(error**2, axis=(0, 1)))


def misfit_of(error: jax.Array, noise: jax.Array, weight: jax.Array) -> jax.Array:
    """What a model errs by beyond the noise, standard deviations ``(2 nv,)``.

    Errors of a model hang together within a segment, so that its steps count for less
    than as many independent ones: the variance is scaled up by the number of steps
    that count as one, ``H var(mean of a segment) / var(step)``.

    Args:
        error: ``(M, H, 2 nv)``.
        weight: of each segment, ``(M,)``.
    """
    share = weight / weight.sum()
    square = jnp.einsum("m,mhc->c", share, error**2) / error.shape[1]
    together = error.shape[1] * (share @ error.mean(1) ** 2)
    alike = jnp.clip(together / jnp.maximum(square, 1e-30), 1.0, error.shape[1])
    return jnp.sqrt(jnp.maximum(square - noise**2, 0.0) * alike)


def outlier_weights(
    error: jax.Array, noise: jax.Array, misfit: jax.Array, limit: float
) -> jax.Array:
    """Weight of each segment ``(M,)``: 1, or less beyond ``limit`` median errors.

    Huber's weight on the RMS over a segment of the error in units of its expectation.
    """
    expected = noise**2 + misfit**2
    size = jnp.sqrt((error**2 / expected).mean((1, 2)))
    return jnp.minimum(1.0, limit * jnp.median(size) / jnp.maximum(size, 1e-30))
