"""Least squares of many candidates in lockstep, each over its own few numbers.

A candidate is a set of active entries of the long vector. Derivatives are differences
of a visible size, which also see effects that have no slope at zero (play, deadband,
lag, saturation). Every round asks for all predictions of all candidates at once.
"""

from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from easi_jax.estimation.least_squares import (
    Damping,
    bounded_step,
    flag_codes,
    is_settled,
)
from easi_jax.estimation.weights import huber
from easi_jax.gap.effect_vector import Layout
from easi_jax.model.parameters import ParameterSpace

_ROUNDS = 12
_TRIED = np.array([1.0, 30.0, 1000.0])  # dampings, relative to the last one
_DAMPING = Damping(falls=0.2, rises=1.0, least=1e-6)
_PAYS = 0.05  # relative gain of a round that lets slopes be followed further
_FOLLOWED = 0.05  # sizes, that a move is at least whose change says a slope
_SETTLED = 5e-3  # relative gain of a round below which a fit is done
_HUBER = 3.0
_DIM = 1e-2  # least curvature that damping assumes, of the largest
_UNSEEN = 1e-7  # curvature along an entry that counts as none, of the largest
_AT = 1e-3  # of a value from a bound, that counts as at it

Simulate = Callable[[np.ndarray], np.ndarray]
Asks = Generator[np.ndarray, np.ndarray, "Fitted"]


@dataclass(frozen=True)
class Bounds:
    """Of the whole vector: limits and sizes of differences, ``(n,)`` each."""

    low: np.ndarray
    high: np.ndarray
    size: np.ndarray


@dataclass(frozen=True)
class Fitted:
    """A fit's end.

    Attributes:
        x: the whole vector, ``(n,)``.
        active: its fitted entries.
        residual: whitened errors there, ``(W, m)``.
        slope: their derivatives with the active entries, ``(W, m, a)``.
        cost: half the weighted sum of squares.
    """

    x: np.ndarray
    active: np.ndarray
    residual: np.ndarray
    slope: np.ndarray
    cost: float

    def codes(self, bounds: Bounds) -> np.ndarray:
        """Of each active entry, as `easi_jax.estimation.least_squares.flag_codes`
        tells them, ``(a,)``."""
        x = self.x[self.active]
        seen = np.einsum("wma,wma->a", self.slope, self.slope)
        seen *= bounds.size[self.active] ** 2
        low, high = bounds.low[self.active], bounds.high[self.active]
        known = seen > _UNSEEN * seen.max(initial=0.0)
        return flag_codes(x, low, high, known, _AT * np.abs(x))

    def arrays(self) -> list[tuple[str, np.ndarray]]:
        """Its parts by name, to be kept; `of` makes it again, to the last bit."""
        return [(k, np.asarray(getattr(self, k))) for k in self.__dataclass_fields__]

    @classmethod
    def of(cls, arrays: Mapping[str, np.ndarray]) -> "Fitted":
        """From `arrays`."""
        return cls(**{**arrays, "cost": float(arrays["cost"])})


def bounds_of(space: ParameterSpace, layout: Layout) -> Bounds:
    """Of a whole vector: the model's own parameters, then the columns of effects."""
    low, high = space.bounds
    nominal, columns = np.asarray(space.nominal, float), layout.columns
    least, most = (np.asarray(edge, float) for edge in space.initial)
    typical = np.where(nominal == 0, most - least, np.abs(nominal))
    return Bounds(
        np.r_[low, [c.low for c in columns]],
        np.r_[high, [c.high for c in columns]],
        np.r_[0.05 * typical, [c.size for c in columns]],
    )


def window_weights(residual: np.ndarray) -> np.ndarray:
    """Huber's weight of each window ``(W,)``: less than 1 beyond 3 median errors."""
    return huber(np.sqrt(np.mean(residual**2, axis=1)), _HUBER)


def _cost(residual: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """``(B,)`` of residuals ``(B, W, m)``."""
    value = 0.5 * np.einsum("w,bwm->b", weight, residual**2)
    return np.where(np.isfinite(value), value, np.inf)


def difference(
    x: np.ndarray, active: np.ndarray, bounds: Bounds
) -> tuple[np.ndarray, np.ndarray]:
    """Vectors moved by one size each, ``(a, n)``, inside the bounds, and the moves."""
    step = bounds.size[active].copy()
    step = np.where(x[active] + step > bounds.high[active], -step, step)
    out = np.repeat(x[None], len(active), 0)
    out[np.arange(len(active)), active] += step
    return out, step


def least_squares(
    starts: np.ndarray,
    chosen: Sequence[int],
    bounds: Bounds,
    weight: np.ndarray,
    rounds: int = _ROUNDS,
    near: Fitted | None = None,
) -> Asks:
    """Steps of `easi_jax.estimation.least_squares` to a best fit, as a generator.

    It yields vectors ``(B, n)`` and is sent their whitened errors ``(B, W, m)``.
    Between two rounds of differences, slopes follow from the steps taken (Broyden,
    *Math. Comp.* 19, 1965, eq. 4.5).

    Args:
        starts: vectors to start from, ``(S, n)``; the best is taken.
        chosen: entries to fit.
        rounds: at most.
        near: a fit of fewer entries, whose slopes serve for the first step.
    """
    active = np.asarray(chosen, int)
    found = yield np.asarray(starts, np.float64)
    costs = _cost(found, weight)
    best = int(np.argmin(costs))
    x, residual, cost = starts[best].astype(float).copy(), found[best], costs[best]
    size = bounds.size[active]
    slope = np.zeros((*residual.shape, len(active)))
    damping, fresh, measured = 1e-2, False, False
    if near is not None and np.isfinite(cost):
        old = np.isin(active, near.active)
        new = ~old
        slope[..., old] = near.slope[..., np.isin(near.active, active)]
        if new.any():
            moved, step = difference(x, active[new], bounds)
            got = yield moved
            slope[..., new] = _between(residual, got, step)
        slope, fresh = slope * size, True
    for _ in range(rounds if len(active) and np.isfinite(cost) else 0):
        if not fresh:
            moved, step = difference(x, active, bounds)
            got = yield moved
            slope = _between(residual, got, step) * size  # per size
            measured = True
        gain = 0.0
        # One step is enough nearly always; more damped ones are tried together.
        for factors in (_TRIED[:1], _TRIED[1:]):
            moves = _steps(
                slope, residual, weight, damping * factors, x, active, bounds
            )
            trials = np.repeat(x[None], len(moves), 0)
            trials[:, active] += moves * size
            found = yield trials
            costs = _cost(found, weight)
            best = int(np.argmin(costs))
            if costs[best] < cost:
                gain = cost - costs[best]
                damping = float(_DAMPING.after(damping * factors[best], True))
                slope = _followed(slope, found[best] - residual, moves[best])
                x, residual, cost = trials[best], found[best], costs[best]
                break
        before = cost + gain
        if measured and is_settled(gain, before, 0.0, _SETTLED):
            break
        # Slopes are measured anew where following them no longer pays.
        fresh, measured = not is_settled(gain, before, 0.0, _PAYS), False
    return Fitted(x, active, residual, slope / size, float(cost))


def _between(residual: np.ndarray, others: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Slopes ``(W, m, a)`` to residuals ``(a, W, m)`` steps ``(a,)`` away; zero where
    they are not finite."""
    slope = np.moveaxis((others - residual) / step[:, None, None], 0, -1)
    return np.where(np.isfinite(slope), slope, 0.0)


def _steps(
    slope: np.ndarray,
    residual: np.ndarray,
    weight: np.ndarray,
    damping: np.ndarray,
    x: np.ndarray,
    active: np.ndarray,
    bounds: Bounds,
) -> np.ndarray:
    """Steps of the active entries in their sizes, one of each ``damping (B,)``,
    ``(B, a)``."""
    normal = np.einsum("w,wma,wmb->ab", weight, slope, slope, optimize=True)
    gradient = np.einsum("w,wma,wm->a", weight, slope, residual, optimize=True)
    # What the data do not see stays where it is.
    unseen = max(_UNSEEN * np.diag(normal).max(), 1e-30)
    low, high = (
        (edge[active] - x[active]) / bounds.size[active]
        for edge in (bounds.low, bounds.high)
    )
    return bounded_step(
        normal + unseen * np.eye(len(active)),
        gradient,
        np.ones(len(active), bool),
        damping,
        within=(low, high),
        dim=_DIM,
    )


def _followed(slope: np.ndarray, change: np.ndarray, move: np.ndarray) -> np.ndarray:
    """Slopes ``(W, m, a)`` that say what a ``move (a,)`` in sizes did change,
    ``(W, m)``. Over a short one that is rounding for the most part."""
    length = float(move @ move)
    if not length > _FOLLOWED**2:
        return slope
    return slope + (change - slope @ move)[..., None] * move / length


def lockstep(
    problems: Sequence[Asks],
    simulate: Simulate,
    most: int = 512,
    ended: Callable[[], None] = lambda: None,
) -> list[Fitted]:
    """Runs all problems to their ends; each round is one call of ``simulate``.

    ``simulate`` takes vectors ``(B, n)`` and returns whitened errors ``(B, W, m)``;
    ``ended`` is called at the end of each.
    """
    asks = {i: next(p) for i, p in enumerate(problems)}
    done: dict[int, Fitted] = {}
    while asks:
        order, count = [], 0
        for i in asks:
            if order and count + len(asks[i]) > most:
                break
            order.append(i)
            count += len(asks[i])
        got = simulate(np.concatenate([asks[i] for i in order]))
        at = 0
        for i in order:
            part = got[at : at + len(asks[i])]
            at += len(asks.pop(i))
            try:
                asks[i] = problems[i].send(part)
            except StopIteration as end:
                done[i] = end.value
                ended()
    return [done[i] for i in range(len(problems))]
