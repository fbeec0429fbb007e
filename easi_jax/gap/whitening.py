"""Prediction errors with the noise of their start states taken out.

The start of a window is measured too, and its error grows along the prediction. All
errors of a window are one linear function of the noise of a few rows, so their
covariance is known, and dividing by its root leaves independent numbers of size one
where the model is right. Steps are averaged in groups first: noise falls, and little of
what a model does wrong is lost.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from easi_jax.data.recording import Run
from easi_jax.data.windows import (
    FIT_ROWS,
    FIT_SECONDS,
    fitted_velocity,
    velocity_weights,
)
from easi_jax.gap.predictor import Predictor
from easi_jax.gap.window_set import WindowSet

_GROUPS = 12  # of steps in a window, at most


@dataclass(frozen=True)
class Residuals:
    """Turns errors ``(B, W, H, nv)`` into what fits compare.

    Attributes:
        groups: averages over steps, ``(K, H)``.
        scale: of each channel in the gap; infinite for one left out, ``(nv,)``.
        root: inverse root of each window's error covariance, ``(W, n, n)`` with
            ``n = K nv``.
        plain: errors in units of the gap from whitened ones, ``(W, n, n)``.
    """

    groups: np.ndarray
    scale: np.ndarray
    root: np.ndarray
    plain: np.ndarray

    def grouped(self, errors: np.ndarray) -> np.ndarray:
        """Averages over groups of steps, ``(B, W, K, nv)``."""
        return np.einsum("kh,bwhc->bwkc", self.groups, errors, optimize=True)

    def whitened(self, grouped: np.ndarray, at: np.ndarray | None = None) -> np.ndarray:
        """Independent numbers of size one, ``(B, W, n)``; ``at``: which windows these
        are, all where not given."""
        b, w = grouped.shape[:2]
        flat = grouped.reshape(b, w, -1).astype(np.float64)
        root = self.root if at is None else self.root[at]
        return np.einsum("wij,bwj->bwi", root, flat, optimize=True)


def step_groups(steps: int) -> np.ndarray:
    """Averaging of ``steps`` into at most 12 groups, ``(K, H)``."""
    edges = np.unique(
        np.linspace(0, steps, min(_GROUPS, steps) + 1).round().astype(int)
    )
    out = np.zeros((len(edges) - 1, steps))
    for k, (a, b) in enumerate(itertools.pairwise(edges)):
        out[k, a:b] = 1.0 / (b - a)
    return out


def noise_rows(run: Run, row: int, steps: int) -> tuple[int, np.ndarray]:
    """The rows whose noise enters the errors of a window that starts at ``row``.

    Returns:
        Place of the start row among them (its targets are the ``steps`` rows after),
        and the weight of each row in the fitted start velocity, ``(rows,)`` [1/s].
    """
    first, weights = velocity_weights(len(run), row, run.dt)
    low = min(first, 0)
    out = np.zeros(max(steps, first + len(weights) - 1) - low + 1)
    out[first - low : first - low + len(weights)] = weights
    return -low, out


def start_sensitivity(
    predictor: Predictor, x: np.ndarray, noise: np.ndarray, blocks: np.ndarray | None
) -> np.ndarray:
    """Slope of errors with the start state, ``(2 nv, W, H, nv)``, at vector ``x``.

    Args:
        noise: standard deviations of positions and velocities, which set the size of
            the differences, ``(2 nv,)``.
    """
    nv = predictor.nv
    step = np.maximum(3.0 * noise, 1e-5)
    windows = predictor.count(blocks)
    moved = np.zeros((4 * nv, windows, 2 * nv))
    for i in range(2 * nv):
        moved[2 * i, :, i], moved[2 * i + 1, :, i] = step[i], -step[i]
    got = predictor.errors(np.repeat(x[None], 4 * nv, 0), blocks, moved)
    slope = (got[0::2] - got[1::2]) / (2 * step)[:, None, None, None]
    # One prediction in thousands is not finite; it must not spoil all windows.
    return np.where(np.isfinite(slope), slope, 0.0)


def make_residuals(
    windows: WindowSet,
    runs: Sequence[Run],
    slope: np.ndarray,
    noise: np.ndarray,
    extra: np.ndarray,
    floor: np.ndarray,
    scale: np.ndarray,
) -> Residuals:
    """Whitening of the errors of some windows.

    Args:
        windows: W of them.
        runs: that ``windows.run`` counts.
        slope: `start_sensitivity`, ``(2 nv, W, H, nv)``.
        noise: of measured positions, ``(nv,)``.
        extra: what a fitted velocity may be off by besides noise, ``(nv,)``.
        floor: errors of the model that are let pass, ``(nv,)``; keeps a fit from
            hanging on what no model would get right.
        scale: see `Residuals`.
    """
    nv, steps = len(noise), slope.shape[2]
    groups = step_groups(steps)
    k = len(groups)
    used = np.isfinite(scale)
    sq = np.einsum("kh,cwhd->wkdc", groups, slope[:nv], optimize=True)
    sv = np.einsum("kh,cwhd->wkdc", groups, slope[nv:], optimize=True)
    n = k * nv
    root, plain = np.zeros((2, len(windows), n, n))
    unit = np.tile(1.0 / scale, k)
    for w in range(len(windows)):
        run, row = runs[windows.run[w]], int(windows.row[w])
        origin, weights = noise_rows(run, row, steps)
        total = np.zeros((n, n))
        for c in range(nv):
            a = sv[w, :, :, c, None] * weights
            a[:, :, origin] += sq[w, :, :, c]
            a[:, c, origin + 1 : origin + 1 + steps] -= groups
            flat = a.reshape(n, -1)
            total += noise[c] ** 2 * (flat @ flat.T)
        more = (sv[w] * extra).reshape(n, nv)
        total += more @ more.T
        total += np.diag(np.tile(floor**2, k))
        total += np.eye(n) * 1e-14 * max(float(np.trace(total)) / n, 1e-20)
        keep = np.tile(used, k)
        lower = np.linalg.cholesky(total[np.ix_(keep, keep)])
        root[w][np.ix_(keep, keep)] = np.linalg.inv(lower)
        plain[w][np.ix_(keep, keep)] = unit[keep, None] * lower
    return Residuals(groups, scale, root, plain)


def velocity_slack(runs: Sequence[Run], step: float) -> np.ndarray:
    """What the start velocity is off by besides noise, RMS over rows, ``(nv,)``.

    The derivative of a quadratic misses a tenth of the jerk times the squared half
    span; and a semi-implicit step of length ``step`` [s] moves with the velocity of
    half a step later.
    """
    square, count = np.zeros(runs[0].configuration.nv), 0
    for run in runs:
        if len(run) < 8 * FIT_ROWS:
            continue
        v = fitted_velocity(run.qpos, run.dt, run.configuration)
        span = max(FIT_SECONDS, FIT_ROWS // 2 * run.dt)
        # Differences over a wide span keep noise out.
        n = max(2, round(2 * span / run.dt))
        acceleration = (v[n:] - v[:-n]) / (n * run.dt)
        jerk = (acceleration[n:] - acceleration[:-n]) / (n * run.dt)
        square += ((0.5 * step * acceleration[: len(jerk)]) ** 2).sum(0)
        square += ((0.1 * span**2 * jerk) ** 2).sum(0)
        count += len(jerk)
    return np.sqrt(square / max(count, 1))
