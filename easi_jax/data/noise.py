"""The noise of readings, estimated from a recording itself."""

import math
from collections.abc import Callable, Sequence

import numpy as np

from easi_jax.data.recording import Run
from easi_jax.data.windows import fitted_velocity
from easi_jax.model.joint_space import Configuration

_ORDERS = range(2, 7)
_COPIES = 16  # of white noise, interpolated as a run was
_MAD = 1.4826  # median absolute deviation -> standard deviation, Gaussian
_JITTER = 1e-6  # rounding of a written number, as a share of the largest
_USUAL = 98.0  # percentile of steps that is no leap
_WILD = 10.0  # times the usual readings
_SCALAR = Configuration(1, 1, (0,), (0,), ())


def estimate_noise(run: Run) -> np.ndarray:
    """Measurement noise of a run, standard deviations ``(2 nv,)``.

    Positions: differences of order 2 to 6, in which smooth motion vanishes and white
    noise grows by ``sqrt(binomial(2k, k))``; the median absolute value keeps jerks
    out, and the order with the least motion left in it counts; where readings are
    coarser than that, their few levels make a median jump, and the mean absolute value
    counts. Never below what the resolution makes, ``step / sqrt(12)``. Velocities: the
    same where they were measured, else the positions' noise through the quadratic fit.
    Where rows were interpolated, what that has smoothed is made up for. What is hidden
    has no readings: infinite.
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
    return np.where(np.tile(run.hidden, 2), np.inf, np.concatenate([sigma, speed]))


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
    """Median over runs of `estimate_noise`, ``(2 nv,)``; the same must be hidden in
    all of them."""
    return np.median([estimate_noise(run) for run in runs], axis=0)
