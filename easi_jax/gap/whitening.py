"""Prediction errors with what is not known of their start taken out.

The start of a window is known by the window's own rows alone. All errors of a window
are one linear function of the noise of its rows and of its start, so their covariance
is known, and dividing by its root leaves independent numbers of size one where the
model is right: the start is integrated out. Steps are averaged in groups first: noise
falls, and little of what a model does wrong is lost.
"""

import itertools
from dataclasses import dataclass

import numpy as np

from easi_jax.estimation.starts import Starts

_GROUPS = 12  # of the rows that follow those of the start, at most
_FIRST = 6  # of the rows that the start is fitted to, at most


@dataclass(frozen=True)
class Residuals:
    """Turns errors ``(B, W, T, c)`` into what fits compare.

    Attributes:
        groups: averages over rows, ``(K, T)``.
        root: inverse root of each window's error covariance, ``(W, m, n)`` with
            ``n = K c`` and m of them that hold a reading in some window.
        plain: errors in units of the gap, starts fitted anew, from whitened ones,
            ``(W, n, m)``; the mean of their squares is the gap's, squared.
        floor: that mean as noise alone makes it, of each window, ``(W,)``.
        live: which numbers hold a reading, ``(W, m)`` bool.
    """

    groups: np.ndarray
    root: np.ndarray
    plain: np.ndarray
    floor: np.ndarray
    live: np.ndarray

    def of(self, errors: np.ndarray, at: np.ndarray | None = None) -> np.ndarray:
        """What fits compare of errors, ``(B, W, m)``; ``at`` as in `whitened`."""
        return self.whitened(self.grouped(errors), at)

    def grouped(self, errors: np.ndarray) -> np.ndarray:
        """Averages over groups of rows, ``(B, W, K, c)``."""
        return np.einsum("kh,bwhc->bwkc", self.groups, errors, optimize=True)

    def gap(self, whitened: np.ndarray) -> float:
        """The gap of whitened errors ``(W, m)``, starts fitted anew."""
        plain = np.einsum("wij,wj->wi", self.plain, whitened)
        return float(np.sqrt((plain**2).mean()))

    def whitened(self, grouped: np.ndarray, at: np.ndarray | None = None) -> np.ndarray:
        """Independent numbers of size one, ``(B, W, m)``; ``at``: which windows these
        are, all where not given."""
        b, w = grouped.shape[:2]
        flat = grouped.reshape(b, w, -1).astype(np.float64)
        root = self.root if at is None else self.root[at]
        return np.einsum("wij,bwj->bwi", root, flat, optimize=True)


def row_groups(rows: int, start: int) -> np.ndarray:
    """Averaging of ``rows``, of which the first ``start`` decide on the start state,
    ``(K, rows)``: at most 6 groups of those, 12 of the others."""
    first = np.linspace(0, start, min(_FIRST, start) + 1)
    rest = np.linspace(start, rows, min(_GROUPS, rows - start) + 1)
    edges = np.unique(np.concatenate([first, rest]).round().astype(int))
    out = np.zeros((len(edges) - 1, rows))
    for k, (a, b) in enumerate(itertools.pairwise(edges)):
        out[k, a:b] = 1.0 / (b - a)
    return out


def make_residuals(
    starts: Starts, lead: int, misfit: np.ndarray, scale: np.ndarray
) -> Residuals:
    """Whitening of the errors of some windows.

    Args:
        starts: of the windows, linearized.
        lead: rows before the start that the gap is measured from.
        misfit: errors of the model that are let pass, ``(c,)``; keeps a fit from
            hanging on what no model would get right.
        scale: of channels that speak of more than starts, in the gap; infinite for one
            that is left out, ``(c,)``.
    """
    size, count, rows, nv = starts.slope.shape
    share = np.ones(nv)
    share[: starts.compared] = starts.share(lead + 1)
    scale = np.pad(scale, (0, nv - len(scale)), constant_values=np.inf)
    groups = row_groups(rows, starts.rows)
    k = len(groups)
    n = k * nv
    keep = np.tile(np.isfinite(scale) | np.isfinite(starts.noise), k)
    keep &= np.tile(np.isfinite(starts.noise), k)
    slope = np.einsum("kh,swhc->wkcs", groups, starts.slope, optimize=True)
    slope = slope.reshape(count, n, size)
    each = np.broadcast_to(starts.noises**2, (count, rows, nv))
    white = np.einsum("kh,whc->wkc", groups**2, each)
    keep &= (white > 0).any(0).reshape(-1)
    free = slope * starts.spread
    spread = (white + misfit**2).reshape(count, n)
    kept = np.flatnonzero(keep)
    root, plain = np.zeros((count, len(kept), n)), np.zeros((count, n, len(kept)))
    floor = np.zeros(count)
    unit = _unit(groups, lead, scale * np.sqrt(share))
    near = groups[:, starts.rows :].sum(1) == 0
    weight = np.where(near[:, None] & (white > 0), 1.0 / np.maximum(white, 1e-300), 0.0)
    weight = weight.reshape(count, n)
    some = np.ix_(kept, kept)
    for w in range(count):
        total = np.diag(spread[w]) + free[w] @ free[w].T
        total += np.eye(n) * 1e-14 * max(float(np.trace(total)) / n, 1e-20)
        lower = np.linalg.cholesky(total[some])
        root[w][:, kept] = np.linalg.inv(lower)
        seen = free[w] * weight[w][:, None]
        normal = free[w].T @ seen + np.eye(size)
        refit = np.eye(n) - free[w] @ np.linalg.solve(normal, seen.T)
        refit = unit[:, None] * refit
        plain[w][kept] = refit[some] @ lower
        left = (refit**2) @ white[w].reshape(-1) + ((refit @ free[w]) ** 2).sum(1)
        floor[w] = left[keep].sum() / n
    live = white.reshape(count, n)[:, kept] > 0
    return Residuals(groups, root, plain, floor, live)


def _unit(groups: np.ndarray, lead: int, scale: np.ndarray) -> np.ndarray:
    """Weight of each group and channel such that the mean over all of squares is the
    mean square over the gap's rows and channels, ``(K nv,)``."""
    rows = (groups[:, lead + 1 :] > 0).sum(1)
    share = np.sqrt(len(groups) * rows / rows.sum())
    used = np.isfinite(scale)
    each = np.where(used, 1.0 / np.where(used, scale, 1.0), 0.0)
    each *= np.sqrt(len(scale) / max(used.sum(), 1))
    return (share[:, None] * each).reshape(-1)
