"""What the gap workflow found, as values."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
import numpy as np

from easi_jax.estimation.blocks import scattered
from easi_jax.estimation.least_squares import (
    CONVERGED,
    NOT_DETERMINED,
    OUTCOMES,
    inverted,
    result_code,
)
from easi_jax.estimation.posterior import trusted
from easi_jax.estimation.weights import excess
from easi_jax.gap.effect_set import Model
from easi_jax.gap.error_localization import Conditions
from easi_jax.gap.forward_selection import Selector
from easi_jax.gap.gap_metric import Channels
from easi_jax.gap.table import Place
from easi_jax.gap.verdict import Openness
from easi_jax.gap.window_set import WindowSet
from easi_jax.model.parameters import ParameterSpace
from easi_jax.model.results import Outcome as Ended
from easi_jax.model.results import Refitted, Site

# Sizes of differences, that a number without bounds may be off which no data determine.
_ANYTHING = 1e3
_ALIKE = 1e-12  # least eigenvalue of a correlation matrix that is no rounding
_TELLS = 0.5  # of the deviation without data: less, and data determine a number


@dataclass(frozen=True)
class Found:
    """One effect that the model lacks.

    Attributes:
        place: which, and where.
        values: of its parameters, with their standard deviations.
        confidence: probability of this name against its rivals, an unknown effect
            among them.
        indistinguishable: rivals that predict the held-out data as well.
        gap_after: held-out gap with it and those before it.
        fitted: value of each of the place's columns, by its number among them.
        deviations: standard deviations of those that the fit moved.
        sites: of a shared effect (`Place.shared`), where it is seen: like actuators
            together, others by themselves.
        cost: of taking it out [nats for each independent number that was read]
            (`easi_jax.gap.model_comparison.cost`).
        outcome: how the fit of its numbers ended.
        sure: standard errors by which it helps
            (`easi_jax.gap.model_comparison.certainty`).
        odds: of all its rivals together, but its twins.
    """

    place: Place
    values: dict[str, tuple[float, float, str]]
    confidence: float
    indistinguishable: list[str]
    gap_after: float
    fitted: dict[int, float] = field(default_factory=dict)
    deviations: dict[int, float] = field(default_factory=dict)
    sites: tuple[Site, ...] = ()
    cost: float = 0.0
    outcome: Ended = "converged"
    sure: float = 0.0
    odds: float = 0.0


@dataclass(frozen=True)
class Figures:
    """Held-out gap of one model.

    Attributes:
        gap: in units of the motion.
        interval: its 95 % interval, by bootstrap over windows.
        si: RMS error of each degree of freedom, ``(nv,)``.
        square: mean squares of each window, ``(W, nv)``.
        errors: of every step, ``(W, H, nv)``.
        conditions: what was going on in the rows that the errors belong to.
        not_finite: windows whose prediction is not, which count as errors of the
            largest motion.
        first: errors at the start that the gap is measured from, ``(W, nv)``.
    """

    gap: float
    interval: tuple[float, float]
    si: np.ndarray
    square: np.ndarray
    errors: np.ndarray
    conditions: Conditions
    not_finite: int = 0
    first: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))


@dataclass
class Outcome:
    """What the workflow found; see the log format's ``gap.json``.

    Attributes:
        x: the whole vector at the end, and ``active`` its entries that the last fit
            moved.
        disagreeing: runs that the model predicts far worse than the others, with how
            many times.
        floor_is_bound: channels whose noise cannot be told from motion, so that their
            floor may be less, ``(nv,)`` bool.
        open_refit, open_after: errors beside their floor.
        horizon: of the predictions [s].
        start: time on either side of a start that it is fitted to [s].
        known_effects: where laws were found, the held-out gap that the effects of the
            catalog leave without them; else None.
    """

    verdict: str
    found: list[Found]
    refitted: tuple[Refitted, ...]
    before: Figures
    refit: Figures
    after: Figures
    floor: float
    floor_si: np.ndarray
    floor_is_bound: np.ndarray
    open_refit: Openness
    open_after: Openness
    channels: Channels
    held: WindowSet
    x: np.ndarray
    active: list[int]
    notes: list[str] = field(default_factory=list)
    disagreeing: dict[str, float] = field(default_factory=dict)
    seconds: float = 0.0
    law_seconds: float = 0.0
    horizon: float = 0.0
    start: float = 0.0
    known_effects: float | None = None


def last_figures(o: Outcome) -> Figures:
    """Held-out figures of the model at the end."""
    return o.after if o.found else o.refit


class Numbers:
    """What a model was fitted to.

    Args:
        selector: that fitted it.
        model: the fit.
        pulls: as `fit_covariance` takes them.
    """

    def __init__(
        self, selector: Selector, model: Model, pulls: Sequence[np.ndarray] = ()
    ) -> None:
        self.selector, self.model = selector, model
        active = model.fit.active
        std = np.sqrt(np.diag(fit_covariance(selector, model, pulls)))
        self._std = dict(zip(active.tolist(), std.tolist(), strict=True))
        codes = model.fit.codes(selector.bounds)
        told = std < _TELLS * _within_bounds(selector, model)
        codes = np.where((codes == CONVERGED) & ~told, NOT_DETERMINED, codes)
        self._codes = dict(zip(active.tolist(), codes.tolist(), strict=True))

    def fitted(self, place: Place) -> dict[int, float]:
        """Values of a place's columns, by number."""
        index = self.selector.columns(place, fitted=False)
        return dict(enumerate(self.model.fit.x[index].tolist()))

    def deviations(self, place: Place) -> dict[int, float]:
        """Of a place's columns that the fit moved, by number."""
        index = self.selector.columns(place, fitted=False).tolist()
        return {k: self._std[i] for k, i in enumerate(index) if i in self._std}

    def outcome(self, place: Place) -> Ended:
        """How the fit of a place's columns ended."""
        index = self.selector.columns(place, fitted=False).tolist()
        codes = [self._codes[i] for i in index if i in self._codes]
        code = int(result_code(np.array(codes, int), np.isfinite(self.model.fit.cost)))
        return OUTCOMES[code]

    def values(self, place: Place) -> dict[str, tuple[float, float, str]]:
        """Parameters of an effect as the table names them: value, standard deviation,
        unit."""
        index = self.selector.columns(place, fitted=False)
        std = self.deviations(place)
        got = {}
        for k, (i, c) in enumerate(zip(index, place.columns, strict=True)):
            if c.parameter:
                value = c.of * float(self.model.fit.x[i])
                got[c.parameter] = (value, c.of * std.get(k, 0.0), c.unit)
        return dict(place.row.told(got))

    def refitted(self, space: ParameterSpace) -> tuple[Refitted, ...]:
        """The model's own parameters that the fit moved."""
        return tuple(
            Refitted(
                *(address, float(space.parameters[i].nominal)),
                *(float(self.model.fit.x[i]), self._std[i], OUTCOMES[self._codes[i]]),
            )
            for i in self.model.own
            for address in space.parameters[i].addresses
        )


def _within_bounds(selector: Selector, model: Model) -> np.ndarray:
    """Standard deviations of a fit's active entries where they may be anything within
    bounds, ``(a,)``."""
    bounds, active = selector.bounds, model.fit.active
    width = bounds.high[active] - bounds.low[active]
    most = _ANYTHING * bounds.size[active]
    return np.where(np.isfinite(width), width / np.sqrt(12.0), most)


def fit_covariance(
    selector: Selector, model: Model, pulls: Sequence[np.ndarray] = ()
) -> np.ndarray:
    """Covariance of a fit's active entries ``(a, a)``, by the rules of a fit of
    parameters (`easi_jax.estimation.posterior`): each row counts once, values scatter
    between blocks of windows, and what the model errs by beyond the noise hides a part
    of itself in them. What the data do not determine may be anything within bounds.

    Args:
        pulls: scores, by size of a difference of each active entry, ``(a,)`` each, that
            are there though the model is right: by what they move values, these are in
            doubt.
    """
    f, bounds = model.fit, selector.bounds
    size = bounds.size[f.active]
    weight = selector.weight * selector.rows_once()
    j = f.slope * size
    normal = np.einsum("w,wma,wmb->ab", weight, j, j, optimize=True)
    score = np.einsum("w,wma,wm->wa", weight, j, f.residual, optimize=True)
    costs = 0.5 * weight * (f.residual**2).sum(1)
    counts = (weight[:, None] * selector.residuals.live)[..., None]
    with jax.enable_x64(True):
        left = scattered(*map(jnp.asarray, (normal, normal, score)))
        left *= trusted(excess(jnp.asarray(costs), jnp.asarray(counts)))
    prior = (size / _within_bounds(selector, model)) ** 2
    cov = inverted(np.asarray(left), prior, _ALIKE)[0]
    scores = np.reshape(pulls, (len(pulls), len(size)))
    moved = inverted(normal, prior, _ALIKE)[0] @ scores.T
    return (cov + moved @ moved.T) * np.outer(size, size)


def score_of(selector: Selector, model: Model, error: np.ndarray) -> np.ndarray:
    """What an error of all predictions ``(W, T, c)`` adds to the score of a fit, by
    size of a difference of each active entry, ``(a,)``."""
    weight, residuals = selector.weight * selector.rows_once(), selector.residuals
    off = residuals.of(error[None])[0]
    score = np.einsum("w,wma,wm->a", weight, model.fit.slope, off, optimize=True)
    return score * selector.bounds.size[model.fit.active]
