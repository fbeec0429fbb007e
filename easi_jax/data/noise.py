"""The noise of readings, estimated from a recording itself."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from easi_jax.data.recording import Run
from easi_jax.data.windows import fitted_velocity
from easi_jax.model.joint_space import Configuration, one_sign

_ORDERS = range(2, 13)
_ROWS_PER_ORDER = 8  # at least, of a recording: higher orders would hardly scatter less
_COPIES = 16  # of white noise, interpolated as a run was
_MAD = 1.4826  # median absolute deviation -> standard deviation, Gaussian
_MEAN = math.sqrt(math.pi / 2)  # mean absolute deviation -> the same
_JITTER = 1e-6  # rounding of a written number, as a share of the largest
_USUAL = 98.0  # percentile of steps that is no leap
_WILD = 10.0  # times the usual readings
# Scatter of an order's estimate, times the root of the number of rows (white noise).
_SCATTER = 1.5
_AS_LOW = 0.7  # the same, of an order that is as low as the lowest
_MOTION = 0.1  # of the estimate's square, from which motion in it is told
_SLACK = 0.5  # of the same: scatter from which nothing can be told
_MOVING = 10.0  # times the noise, that a joint moves over a difference in half the rows
_AGREES = 1.2  # of variances of a velocity by itself and beside its positions
_HELD_STEPS = 3.0  # times the resolution, that a sensor which is held moves by
_UNEVEN = 0.5  # of the usual interval between a slow sensor's readings, that one is off
_REGULAR = 0.9  # share of intervals that are even, of a sensor that is held
_BINOMIAL = [math.comb(2 * k, k) for k in _ORDERS]  # variance of white noise there
_TRIM, _TRIMMINGS = 3.0, 8  # standard deviations, rounds
# Variance of what is Gaussian of variance 1 and no farther out.
_TRIMMED = 1 - _TRIM * math.sqrt(2 / math.pi) * math.exp(-(_TRIM**2) / 2) / math.erf(
    _TRIM / math.sqrt(2.0)
)
_JERKS = 0.15  # share of differences with a jerk in them, from which others have some
_JUMPS = 4  # differences in which commands that jump stand out of motion
_FOLLOWS = 0.5  # share of these in the readings, that commands make
_ROWS_PER_COMMAND = 20
_SCALAR = Configuration(1, 1, (0,), (0,), ())


class Noise(NamedTuple):
    """Noise of some channels.

    Attributes:
        std: standard deviations.
        is_bound: where motion and noise cannot be told apart (fast or rough motion for
            the rate, few rows), so that the noise may be less; bool.
    """

    std: np.ndarray
    is_bound: np.ndarray


def noise_of(run: Run) -> Noise:
    """Measurement noise of a run's positions and velocities, ``(2 nv,)``.

    Positions: differences of order 2 to 12, in which smooth motion vanishes and white
    noise grows by ``sqrt(binomial(2k, k))``; the median absolute value keeps jerks
    out, and the order with the least motion left in it counts; where readings are
    coarser than that, their few levels make a median jump, and the mean absolute value
    counts. Never below what the resolution makes, ``step / sqrt(12)``. It is a bound
    where the orders go on falling (`_motion_left`). Velocities: the same where they
    were measured, and a bound unless positions, whose steps they are, agree; else the
    positions' noise through the quadratic fit. Where rows were interpolated, what that
    has smoothed is made up for. What is hidden has no readings: infinite.
    """
    c, kept = run.configuration, _kept_noise(run)
    steps = c.difference(run.qpos[:-1], run.qpos[1:])
    sigma, bound = _estimate(steps, 1, _resolution(run), kept)
    if run.qvel_measured:
        resolution = resolution_of(run.qvel)
        speed, wide = _estimate(run.qvel, 0, resolution, kept)
        agrees = _positions_agree(run, steps, sigma, speed)
        wide |= ~agrees & (speed > resolution / math.sqrt(12.0))
    else:
        speed, wide = sigma * _fit_gain(len(run), run.dt), bound
    hidden = np.tile(run.hidden, 2)
    return Noise(
        np.where(hidden, np.inf, np.concatenate([sigma, speed])),
        np.concatenate([bound, wide]) & ~hidden,
    )


def estimate_noise(run: Run) -> np.ndarray:
    """Standard deviations ``(2 nv,)`` of `noise_of`."""
    return noise_of(run).std


def pooled(runs: Sequence[Run]) -> Noise:
    """Noise ``(2 nv,)`` of runs of one machine; the same must be hidden in all.

    The median over runs that tell motion from noise; where none does, over all. At
    least what the resolution makes of positions (`resolutions`), and of the velocity of
    what never moves.
    """
    std, is_bound = _pooled([noise_of(run) for run in runs])
    least = resolutions(runs) / math.sqrt(12.0)
    still = np.all([np.ptp(run.qvel, axis=0) == 0 for run in runs], axis=0)
    fitted = least * _fit_gain(max(map(len, runs)), runs[0].dt)
    least = np.concatenate([least, np.where(still, fitted, 0.0)])
    return Noise(np.maximum(std, least), is_bound)


def pooled_noise(runs: Sequence[Run]) -> np.ndarray:
    """Standard deviations ``(2 nv,)`` of `pooled`."""
    return pooled(runs).std


def sensor_noise(runs: Sequence[Run]) -> dict[str, Noise]:
    """Noise of each sensor that some run has readings of, ``(dim,)`` each, in its own
    units.

    As for positions, of the rows that have a reading. A sensor that is slower than the
    rows and held between its readings counts where it changes. Commands that jump from
    row to row show at once in some sensors (torques, accelerometers): what is
    proportional to them there is no noise. What else they do at once is not told from
    it.
    """
    found: dict[str, list[Noise]] = {}
    for run in runs:
        for name, given in run.sensors.items():
            given, kept = np.asarray(given, float), _kept_noise(run)
            readings, rows = _fresh(given)
            if len(readings) > min(_ORDERS):
                step = resolution_of(readings)
                readings = _without_commands(readings, run, rows)
                own = _estimate(readings, 0, step, kept)
                found.setdefault(name, []).append(Noise(*own))
    return {name: _pooled(each) for name, each in found.items()}


def _without_commands(readings: np.ndarray, run: Run, rows: np.ndarray) -> np.ndarray:
    """``readings (K, dim)`` in some ``rows (K,)`` less what is proportional to the
    commands of their row and of the one before, where commands make most of their
    jumps."""
    sent = [run.ctrl[rows], run.ctrl[np.maximum(rows - 1, 0)]]
    sent = np.concatenate(sent, 1)
    if len(readings) < _ROWS_PER_COMMAND * max(1, sent.shape[1]):
        return readings
    jumps, cause = (np.diff(x, _JUMPS, axis=0) for x in (readings, sent))
    gain = np.linalg.lstsq(cause, jumps, rcond=None)[0]
    made = 1.0 - ((jumps - cause @ gain) ** 2).sum(0) / np.maximum(
        (jumps**2).sum(0), 1e-300
    )
    return readings - sent @ np.where(made > _FOLLOWS, gain, 0.0)


def _pooled(each: Sequence[Noise]) -> Noise:
    std, bound = (np.array(x) for x in zip(*each, strict=True))
    told = np.asarray(bound.all(0))
    some = np.where(bound & ~told, np.nan, std)
    return Noise(np.nanmedian(some, 0), told)


def _fresh(readings: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Those of ``readings (T, dim)`` that are finite, one of each that is held, with
    one sign of quaternions; and their rows."""
    rows = np.flatnonzero(np.isfinite(readings).all(1))
    x = readings[rows]
    if len(x) < 2:
        return x, rows
    if x.shape[1] == 4 and np.allclose(np.linalg.norm(x, axis=1), 1.0, atol=1e-3):
        x = one_sign(x)
    new = changed(x)
    return (x[new], rows[new]) if _leaps(x, new) else (x, rows)


def without_held(run: Run) -> Run:
    """A run without the rows in which a sensor that is slower than the rows is held:
    no readings there, NaN.

    Such a sensor changes at regular intervals, by more than its resolution. One that
    rests now and then (a touch sensor in the air), or changes where commands do, reads
    in every row.
    """
    sensors = dict(run.sensors)
    for name, given in run.sensors.items():
        x = np.asarray(given, float)
        there = np.asarray(np.isfinite(x).all(1))
        new = changed(x[there])
        if not _leaps(x[there], new):
            continue
        apart = np.diff(np.flatnonzero(new))
        usual = np.median(apart)
        # A torque may be what it is told, and commands are held.
        sent = changed(run.ctrl) if run.ctrl.shape[1] else ~there
        told = (sent | np.append(False, sent[:-1]))[there][new].mean()
        if told > _REGULAR and sent.mean() < 0.5:
            continue
        even = np.mean(np.abs(apart - usual) <= _UNEVEN * usual)
        if usual < 2 or even < _REGULAR:
            continue
        held = np.flatnonzero(there)[~new]
        sensors[name] = x.copy()
        sensors[name][held] = np.nan
    return replace(run, sensors=sensors)


def changed(x: np.ndarray) -> np.ndarray:
    """Rows of ``x (T, dim)`` that are not like the one before, ``(T,)`` bool."""
    first = np.ones(min(len(x), 1), bool)
    return np.concatenate([first, (np.diff(x, axis=0) != 0).any(1)])


def _leaps(x: np.ndarray, new: np.ndarray) -> bool:
    """Whether ``x (T, dim)`` changes in few rows, ``new (T,)``, and leaps there: coarse
    readings repeat, too, but go on by single steps of their resolution."""
    step = np.abs(np.diff(x[new], axis=0))
    if 2 * new.sum() > len(x) or not len(step):
        return False
    return bool(np.median(step.max(1)) > _HELD_STEPS * resolution_of(x).max())


def _estimate(
    x: np.ndarray, done: int, resolution: np.ndarray, kept: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Noise of readings ``x (T, n)``, which were differenced ``done`` times already,
    and whether it is a bound, ``(n,)`` each."""
    usual = _by_order(x, done, np.median, _MAD)
    if not len(usual):
        return resolution / math.sqrt(12.0), np.ones(x.shape[1], bool)
    coarse = resolution > usual.min(0)
    mean = _by_order(x, done, np.mean, _MEAN)
    found = np.where(coarse, mean, usual) / kept[: len(usual), None]
    scatter = _SCATTER / math.sqrt(len(x))
    # The least of several estimates would be too low: the first that is as low.
    low = (1 + _AS_LOW / math.sqrt(len(x))) * found.min(0)
    first = np.argmax(found <= low, axis=0)
    sigma = np.take_along_axis(found, first[None], 0)[0]
    bound = _motion_left(found, len(x))
    for i in np.flatnonzero(~coarse):
        k = int(first[i])
        order = _ORDERS[k] - done
        raw = np.diff(x[:, i], order) / math.sqrt(_BINOMIAL[k]) / kept[k]
        path = np.cumsum(x[:, i]) if done else x[:, i]
        moved = np.abs(path[order:] - path[: len(path) - order])
        trimmed, jerks = _trimmed_std(raw, sigma[i])
        sigma[i] = min(trimmed, (1 + scatter) * sigma[i])
        bound[i] |= jerks > _JERKS
        # White noise does not know how fast a joint is.
        if np.median(moved) > _MOVING * sigma[i]:
            slow = moved <= np.median(moved)
            parts = [_trimmed_std(raw[part], sigma[i])[0] for part in (slow, ~slow)]
            bound[i] |= min(parts) < (1 - 2 * scatter) * sigma[i]
    floor = resolution / math.sqrt(12.0)
    return np.maximum(sigma, floor), bound & (sigma > floor)


def _trimmed_std(x: np.ndarray, start: float) -> tuple[float, float]:
    """Standard deviation of ``x (T,)`` without outliers, which scatters half as much as
    the median deviation ``start``; and the share of outliers."""
    sigma, inside = start, np.ones(len(x), bool)
    for _ in range(_TRIMMINGS):
        inside = np.abs(x) <= _TRIM * sigma
        if not inside.any():
            break
        sigma = math.sqrt(float(np.mean(x[inside] ** 2)) / _TRIMMED)
    return sigma, 1.0 - float(inside.mean())


def _by_order(
    x: np.ndarray, done: int, middle: Callable[..., np.ndarray], factor: float
) -> np.ndarray:
    """Noise by each order of differences, ``(K, n)``, from a ``middle`` of absolute
    values and the ``factor`` that makes it a deviation."""
    found = []
    for order in _ORDERS:
        rows = len(x) - (order - done)
        if rows < 3 or (found and rows < _ROWS_PER_ORDER * order):
            break
        d = np.diff(x, order - done, axis=0)
        found.append(
            factor * middle(np.abs(d), 0) / math.sqrt(math.comb(2 * order, order))
        )
    return np.array(found)


def _motion_left(found: np.ndarray, rows: int) -> np.ndarray:
    """Whether motion may be more than a tenth of the squared noise, ``(n,)`` bool.

    Smooth motion falls by a factor from order to order, white noise not at all. The
    slowest to fall is the motion under an acceleration that jumps at every row, held
    in between, or, in a simulation that logs its own steps, acting at once: what orders
    fall by bounds how much of that is left in the last one.

    Args:
        found: noise by order, ``(K, n)``.
        rows: of the recording.
    """
    last = len(found) - 1
    if last < 1:
        return np.ones(found.shape[1], bool)
    square = found**2 / np.maximum(found[-1] ** 2, 1e-300)
    out = np.zeros(found.shape[1], bool)
    for rough, must_be_excluded in ((_held(), True), (_at_once(), False)):
        share = rough[last] / (rough[:last] - rough[last])
        left = np.maximum(square[:last] - 1.0, 0.0) * share[:, None]
        slack = (2 * _SCATTER / math.sqrt(rows) * share)[:, None] + 0 * left
        best = np.argmin(left + slack, axis=0)[None]
        left, slack = (np.take_along_axis(a, best, 0)[0] for a in (left, slack))
        out |= left > _MOTION + slack
        if must_be_excluded:
            out |= slack > _SLACK
    # Orders that rise again hold jerks in every difference.
    rise = square.min(0) < 1.0 / (1.0 + _MOTION + 4 * _SCATTER / math.sqrt(rows))
    return out | rise


def _held() -> np.ndarray:
    """Squares by order of motion under accelerations that are held from row to row."""
    return np.array([_at(k, 2) - _at(k, 1) / 4 for k in _ORDERS])


def _at_once() -> np.ndarray:
    """The same where each acceleration moves the very next row by all it has."""
    return np.array([_at(k, 2) for k in _ORDERS])


def _at(k: int, done: int) -> float:
    """Square of the order ``k`` of what is white after ``done`` differences."""
    return math.comb(2 * (k - done), k - done) / math.comb(2 * k, k)


def _positions_agree(
    run: Run, steps: np.ndarray, sigma: np.ndarray, speed: np.ndarray
) -> np.ndarray:
    """Whether measured velocities are off the steps ``(T - 1, nv)`` of the positions by
    as much as noise ``sigma`` of these and ``speed`` of those make, ``(nv,)`` bool.

    An acceleration that jumps at every row makes velocities jump as noise does, and the
    positions with them. Where positions are too noisy for that, nothing is known.
    """
    off = steps / run.dt - 0.5 * (run.qvel[:-1] + run.qvel[1:])
    square = 2.0 * (_MAD * np.median(np.abs(off - np.median(off, 0)), 0)) ** 2
    apart = square - 4.0 * (sigma / run.dt) ** 2
    known = 2 * _SCATTER / math.sqrt(len(off)) * square <= (_AGREES - 1) * speed**2
    return known & (speed**2 <= _AGREES * apart)


def _kept_noise(run: Run) -> np.ndarray:
    """Share of white noise that each order finds after the rows' interpolation in time,
    ``(K,)``."""
    if run.stamps is None:
        return np.ones(len(_ORDERS))
    noise = np.random.default_rng(0).normal(size=(_COPIES, len(run.stamps)))
    rows = np.stack([np.interp(run.time, run.stamps, x) for x in noise], 1)
    orders = _by_order(rows, 0, np.median, _MAD)
    return np.median(orders, 1) if len(orders) else np.ones(len(_ORDERS))


def resolutions(runs: Sequence[Run]) -> np.ndarray:
    """Smallest step between two readings of each degree of freedom, ``(nv,)``; 0 for
    orientations. A joint whose reading never changes has that of the finest other one:
    how far it moves unseen is not told by itself."""
    c = runs[0].configuration
    out, scalar = np.zeros(c.nv), list(c.scalar_qvel)
    found = finest([_resolution(run) for run in runs])[scalar]
    others = found[found > 0]
    out[scalar] = np.where(found > 0, found, others.min() if len(others) else 0.0)
    return out


def _resolution(run: Run) -> np.ndarray:
    """As `resolutions`, of a run by itself; 0 where nothing changes."""
    c = run.configuration
    out = np.zeros(c.nv)
    out[list(c.scalar_qvel)] = resolution_of(run.qpos[:, list(c.scalar_qpos)])
    return out


def resolution_of(x: np.ndarray) -> np.ndarray:
    """Smallest step between two readings of each column of ``x (T, n)``; what is not
    finite is none."""
    out = np.zeros(x.shape[1])
    for i, given in enumerate(x.T):
        column = given[np.isfinite(given)]
        if not len(column):
            continue
        gaps = np.asarray(np.diff(np.unique(column)), float)
        size = np.abs(column)
        largest, usual = float(size.max()), float(np.percentile(size, _USUAL))
        if 0.0 < usual < largest / _WILD:  # wild readings
            largest = usual
        gaps = gaps[gaps > _JITTER * max(largest, 1e-300)]
        out[i] = gaps.min() if gaps.size else 0.0
    return out


def finest(each: Sequence[np.ndarray]) -> np.ndarray:
    """Least of the resolutions ``(n,)`` of several runs: values of a short one are far
    apart by chance. Zero where none tells any, as where nothing moves."""
    steps = np.array(each)
    least = np.where(steps > 0, steps, np.inf).min(0)
    return np.where(np.isfinite(least), least, 0.0)


def _fit_gain(rows: int, dt: float) -> float:
    """Noise of a fitted velocity per unit of position noise [1/s]."""
    impulse = np.zeros((rows, 1))
    impulse[rows // 2] = 1.0
    return float(np.linalg.norm(fitted_velocity(impulse, dt, _SCALAR)))
