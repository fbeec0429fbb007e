"""What each effect promises, from one Gauss-Newton step of a model that has it.

Where predictions are simulated by native MuJoCo, what is a torque is reckoned
(`easi_jax.gap.linear_response`), which takes a tenth of the time; the most promising
names are then simulated like the rest, so that none is fitted, or left out in favor of
another, for an error of the recursion.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from easi_jax.gap.batched_least_squares import difference
from easi_jax.gap.effect_set import Candidate, Model
from easi_jax.gap.forward_selection import Selector
from easi_jax.gap.linear_response import LinearResponse
from easi_jax.gap.model_comparison import contains, rank
from easi_jax.gap.table import Place
from easi_jax.io.runs.step_cache import Arrays

_SHORTLIST = 7  # names that are fitted in full at each stage
# The same where something sticks and slips, so that a step promises little: a weak
# drive of a sliding foot promised half of what it does (benchmarks.floor).
_MORE = 14
_STARTS = 2  # of each
_HOPELESS = 4.0  # times the best promise; beyond, only the first few are fitted
_FEW = 2  # blocks of windows that effects are first tried on, of a larger robot ...
_LONG = 0.5  # ... or in windows of more than so many seconds
_SIMULATED = 20  # names that are simulated after all have been reckoned
_HOLDS = 0.5  # of the windows, in which torques are linear, for any to be reckoned
_AT_ONCE = 256  # vectors


class _Asked(NamedTuple):
    """Vectors of a candidate: at its start, and moved by differences."""

    vectors: np.ndarray
    columns: np.ndarray
    step: np.ndarray


class _Promise(NamedTuple):
    """Cost after the step, and the vector where it leads."""

    cost: float
    end: np.ndarray


class Screening:
    """One model that effects are added to.

    Args:
        selector: that fits it.
        base: the model.
    """

    def __init__(self, selector: Selector, base: Model) -> None:
        self.selector, self.base = selector, base
        self.some = selector.blocks
        p = selector.predictor
        # A short list of names needs no more, where it takes minutes as it is.
        if p.simulator.wide or p.steps * p.simulator.dt > _LONG:
            self.some = self.some[:: max(1, len(self.some) // _FEW)]
        self.seen = selector.windows_of(self.some)
        self.weight = selector.weight[self.seen]
        self.linear = self._linearized()
        if self.linear is not None:
            self.weight = self.weight * self.linear.holds
            # As whitened now: the fit may be older.
            self.first = selector.simulate(base.fit.x[None], self.some)[0]

    def _linearized(self) -> LinearResponse | None:
        """None where everything has to be simulated."""
        s = self.selector
        if s.predictor.simulator.engine != "mujoco" or s.predictor.sensors:
            return None
        x, moved = s.plain(self.base.fit.x), s.moved[self.seen]
        found = LinearResponse(s.predictor, x, self.some, moved)
        return found if found.holds.mean() >= _HOLDS else None

    def promises(self, candidates: Sequence[Candidate]) -> Arrays:
        """Costs ``(K,)`` of the candidates whose predictions are finite, ``which`` they
        are, and the vectors ``end (K, n)`` where a step leads."""
        asked = [self._asked(c) for c in candidates]
        reckoned = np.zeros(len(asked), bool)
        if self.linear is not None:
            plain = self.selector.plain
            reckoned[:] = [self.linear.covers(plain(a.vectors)).all() for a in asked]
        found = self._promised(candidates, asked, reckoned)
        if reckoned.any():
            self._simulate_best(candidates, asked, reckoned, found)
        which = sorted(found)
        ends = [found[i].end for i in which]
        return {
            "cost": np.array([found[i].cost for i in which]),
            "which": np.array(which, int),
            "end": np.reshape(ends, (len(ends), len(self.base.fit.x))),
        }

    def _simulate_best(
        self,
        candidates: Sequence[Candidate],
        asked: Sequence[_Asked],
        reckoned: np.ndarray,
        found: dict[int, _Promise],
    ) -> None:
        """In ``found``, of the names that promise most, the best starts simulated; the
        others of these names that were reckoned go."""
        starts: dict[str, list[int]] = {}
        for i in sorted(found, key=lambda i: found[i].cost):
            starts.setdefault(candidates[i].place.key, []).append(i)
        best = [*starts.values()][:_SIMULATED]
        again = [i for mine in best for i in mine[:_STARTS] if reckoned[i]]
        some = [candidates[i] for i in again], [asked[i] for i in again]
        true = self._promised(*some, np.zeros(len(again), bool))
        for i in [i for mine in best for i in mine if reckoned[i]]:
            del found[i]
        found.update({again[k]: promise for k, promise in true.items()})

    def _asked(self, c: Candidate) -> _Asked:
        y = self.selector.started(self.base.fit.x, c)
        columns = self.selector.columns(c.place)
        if c.place.row.is_sine:
            columns = columns[[0, 2]]  # amplitude and phase; cycles come from the grid
        moved, step = difference(y, columns, self.selector.bounds)
        return _Asked(np.concatenate([y[None], moved]), columns, step)

    def _promised(
        self,
        candidates: Sequence[Candidate],
        asked: Sequence[_Asked],
        reckoned: np.ndarray,
    ) -> dict[int, _Promise]:
        """By number, those whose predictions are finite."""
        if not asked:
            return {}
        counts = [len(a.vectors) for a in asked]
        whole = np.concatenate([a.vectors for a in asked])
        # Many begin as the model is without them.
        _, first, same = np.unique(
            whole, axis=0, return_index=True, return_inverse=True
        )
        errors = self._whitened(whole[first], np.repeat(reckoned, counts)[first])
        parts = np.split(errors[same.reshape(-1)], np.cumsum(counts)[:-1])
        out = {}
        for i, (c, a, part) in enumerate(zip(candidates, asked, parts, strict=True)):
            if np.isfinite(part).all():
                out[i] = self._promise(c, a, part)
        return out

    def _promise(self, c: Candidate, a: _Asked, errors: np.ndarray) -> _Promise:
        active, bounds = self.base.fit.active, self.selector.bounds
        known = self.base.fit.slope[self.seen] * bounds.size[active]
        new = np.moveaxis((errors[1:] - errors[0]) / a.step[:, None, None], 0, -1)
        slope = np.concatenate([known, new * np.abs(a.step)], -1)
        cost, move = _step(errors[0], slope, self.weight)
        index = np.concatenate([active, a.columns])
        end = a.vectors[0].copy()
        end[index] += move * np.concatenate([bounds.size[active], np.abs(a.step)])
        if c.place.row.is_sine:
            end[a.columns] = as_sine(a.vectors[0][a.columns], end[a.columns])
        # Not the others: a force limit that is off lies outside its bounds.
        end[index] = np.clip(end[index], bounds.low[index], bounds.high[index])
        return _Promise(cost, end)

    def _whitened(self, x: np.ndarray, reckoned: np.ndarray) -> np.ndarray:
        """Whitened errors of vectors ``(B, n)``, ``(B, W, m)``."""
        out = np.empty((len(x), *self.base.fit.residual[self.seen].shape))
        with self.selector.progress("trying effects", len(x)) as shown:
            for way, chosen in ((self._simulated, ~reckoned), (self._linear, reckoned)):
                at = np.flatnonzero(chosen)
                for i in range(0, len(at), _AT_ONCE):
                    part = at[i : i + _AT_ONCE]
                    out[part] = way(x[part])
                    shown.advance(len(part))
        return out

    def _simulated(self, x: np.ndarray) -> np.ndarray:
        return self.selector.simulate(x, self.some)

    def _linear(self, x: np.ndarray) -> np.ndarray:
        assert self.linear is not None
        s, at = self.selector, self.seen
        # Of short windows fits see the first rows.
        changes = self.linear.changes(s.plain(x))[:, :, : s.rows]
        return self.first + s.residuals.of(changes, at)


def as_sine(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Amplitude and phase where a step from a small sine of phase 0 leads: it is linear
    in the sine's and the cosine's share, not in the phase."""
    cosine = start[0] * (end[1] - start[1])
    return np.array([np.hypot(end[0], cosine), np.arctan2(cosine, end[0])])


def _step(
    residual: np.ndarray, slope: np.ndarray, weight: np.ndarray
) -> tuple[float, np.ndarray]:
    """Cost after a Gauss-Newton step, and the step."""
    root = np.sqrt(weight)[:, None]
    r = (root * residual).reshape(-1)
    j = (root[..., None] * slope).reshape(-1, slope.shape[-1])
    normal, gradient = j.T @ j, j.T @ r
    curvature = np.diag(normal)
    ridge = 1e-6 * np.diag(curvature + curvature.max() + 1e-30)
    step = -np.linalg.solve(normal + ridge, gradient)
    return float(0.5 * r @ r + 0.5 * gradient @ step), step


def screened(
    selector: Selector, base: Model, candidates: Sequence[Candidate]
) -> list[tuple[float, Candidate]]:
    """Candidates with the cost that one Gauss-Newton step promises, best first."""
    if not candidates:
        return []
    kept = selector.journal.remember(
        lambda: Screening(selector, base).promises(candidates)
    )
    out = [
        (float(cost), replace(candidates[i], ends=tuple(end)))
        for cost, i, end in zip(kept["cost"], kept["which"], kept["end"], strict=True)
    ]
    return sorted(out, key=lambda item: item[0])


def expanded(
    selector: Selector, base: Model, candidates: Sequence[Candidate]
) -> tuple[list[Model], list[str]]:
    """A model with one effect more, the most promising ones, best first; and the
    names of all by what they promise."""
    tried = screened(selector, base, candidates)
    short = shortlist(tried, selector.sticks)
    models = selector.fitted(base.places, base.fit, short)
    names = dict.fromkeys(c.place.key for _, c in tried)
    return sorted(models, key=rank), [*names]


def shortlist(
    screened: Sequence[tuple[float, Candidate]], sticks: bool = False
) -> list[Candidate]:
    """The most promising names with the best starts of each; and the special cases of
    those names, and what like places have alike, which promise less but ask for less.

    Args:
        screened: with what each promises, best first.
        sticks: whether something sticks and slips: promises are rough.
    """
    chosen = _promising(screened, _MORE if sticks else _SHORTLIST)
    general = [mine[0].place for mine in chosen.values()]
    for _, c in screened:
        if any(contains(g, c.place) or _is_one_of(g, c.place) for g in general):
            mine = chosen.setdefault(c.place.key, [])
            if c not in mine and len(mine) < _STARTS:
                mine.append(c)
    return [c for mine in chosen.values() for c in mine]


def _is_one_of(single: Place, alike: Place) -> bool:
    """Whether an effect is at one of the places that have it alike."""
    same = (single.effect, single.kind) == (alike.effect, alike.kind)
    return same and single.at in alike.tied


def _promising(
    screened: Sequence[tuple[float, Candidate]], most: int
) -> dict[str, list[Candidate]]:
    chosen: dict[str, list[Candidate]] = {}
    first = screened[0][0] if screened else 0.0
    for cost, c in screened:
        mine = chosen.get(c.place.key)
        if mine is None:
            hopeless = cost > _HOPELESS * first and len(chosen) >= most // 2
            if len(chosen) == most or hopeless:
                continue
            mine = chosen.setdefault(c.place.key, [])
        if len(mine) < _STARTS:
            mine.append(c)
    return chosen
