"""Whether what a model leaves stands out of what a perfect one would."""

from dataclasses import dataclass
from statistics import NormalDist

import numpy as np

from easi_jax.gap import gap_metric as measure
from easi_jax.gap.decisions import DECIDE

_MISSED = 1e-12  # of a floor that errors are divided by


@dataclass(frozen=True)
class Openness:
    """Errors of each compared channel, then of all together, in units of their floor.

    Attributes:
        ratio: ``(nv + 1,)``.
        low, high: simultaneous 95 % intervals, ``(nv + 1,)``.
        judged: all but channels that are left out, ``(nv + 1,)`` bool.
    """

    ratio: np.ndarray
    low: np.ndarray
    high: np.ndarray
    judged: np.ndarray

    @property
    def is_open(self) -> np.ndarray:
        """Surely beyond `Decisions.open_from`, ``(nv + 1,)`` bool."""
        return self.judged & (self.low > DECIDE.open_from)

    @property
    def undecided(self) -> np.ndarray:
        """Perhaps beyond `Decisions.open_from`, ``(nv + 1,)`` bool: more data would
        tell."""
        return self.judged & (self.high > DECIDE.open_from) & ~self.is_open


def openness(square: np.ndarray, floor: np.ndarray, scale: np.ndarray) -> Openness:
    """Errors beside their floor, by bootstrap over blocks of time.

    Args:
        square: mean squares of each held-out window, ``(W, nv)``.
        floor: mean squares of a perfect model, ``(nv,)``.
        scale: of each channel; infinite where left out, ``(nv,)``.
    """
    used = np.isfinite(scale)
    safe = np.maximum(floor, (_MISSED * np.where(used, scale, 1.0)) ** 2)
    weights = measure.resampled(len(square), 2)

    def ratios(mean: np.ndarray) -> np.ndarray:
        each = np.sqrt(mean / safe)
        whole = measure.gap(mean, scale) / measure.gap(safe, scale)
        return np.concatenate([each, whole[..., None]], -1)

    ratio, drawn = ratios(square.mean(0)), ratios(weights @ square)
    spread = np.log(np.maximum(drawn, 1e-300)).std(0)
    # Of many intervals that are to hold together (Bonferroni).
    count = int(used.sum()) + 1
    times = NormalDist().inv_cdf(1 - (1 - DECIDE.interval) / 2 / count)
    low, high = (ratio * np.exp(sign * times * spread) for sign in (-1.0, 1.0))
    return Openness(ratio, low, high, np.append(used, True))


def verdict_of(found: bool, refit: Openness, after: Openness) -> str:
    """``explained``, ``no_gap`` or ``unexplained``, as the log format has it.

    Args:
        found: whether effects joined.
        refit: with the model's own parameters refitted.
        after: with the effects that joined.
    """
    last = after if found else refit
    if last.is_open.any():
        return "unexplained"
    return "explained" if found else "no_gap"


def surely_better(after: np.ndarray, before: np.ndarray, scale: np.ndarray) -> bool:
    """Whether held-out errors fell by more than chance; mean squares ``(W, nv)``."""
    weights = measure.resampled(len(after), 3)
    fell = measure.gap(weights @ after, scale) - measure.gap(weights @ before, scale)
    return bool(np.quantile(fell, DECIDE.interval) < 0)
