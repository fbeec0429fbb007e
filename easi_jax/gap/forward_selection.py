"""Which effects a model lacks: forward selection, backward elimination, rivals.

Every candidate is fitted together with the model's own parameters and the effects found
so far. Candidates are judged by what they predict of blocks of windows left out of the
fit (by the fit's own derivatives, which for least squares needs no fit anew), never by
the fitting error, and never by the held-out data.
"""

from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np

from easi_jax.gap.batched_least_squares import (
    Asks,
    Bounds,
    Fitted,
    least_squares,
    lockstep,
)
from easi_jax.gap.decisions import DECIDE
from easi_jax.gap.effect_set import Candidate, Model
from easi_jax.gap.gap_metric import finite
from easi_jax.gap.model_comparison import better, contains
from easi_jax.gap.predictor import BLOCK, Predictor, windows_in
from easi_jax.gap.table import Place
from easi_jax.gap.whitening import Residuals
from easi_jax.io.runs.step_cache import Arrays, Journal
from easi_jax.model.mujoco_warnings import warnings_to
from easi_jax.progress import Progress, silent

_LOST = 0.5  # of the windows not finite: beyond, a vector predicts nothing


class Selector:
    """Fits sets of effects to some windows.

    Its ``residuals`` have to be set before it fits, and ``floor``, the gap of a perfect
    model, before it chooses. ``journal`` keeps what takes long.

    ``steps``, where set, is an error of all predictions ``(count, T, c)`` of which a
    share is nobody's fault. That share is one number more at the end of the vectors.
    ``moved (count, s)`` are offsets of the windows' starts; ``sticks`` says that errors
    bend with these.

    Args:
        predictor: predictions, of the fitted windows in its first blocks.
        bounds: of the whole vector.
        group: block of cross-validation that each fitted window is in, ``(count,)``.
        progress: told how far long stages are.
        rows: of a window that are compared; all where None.
    """

    def __init__(
        self,
        predictor: Predictor,
        bounds: Bounds,
        group: np.ndarray,
        progress: Progress = silent,
        rows: int | None = None,
    ) -> None:
        self.predictor, self.progress, self.rows = predictor, progress, rows
        self.residuals: Residuals
        self.floor = 0.0
        self.journal = Journal()
        self.bounds, self.group, self.count = bounds, group, len(group)
        self.blocks = np.arange(-(-self.count // BLOCK))
        self.own = tuple(range(predictor.own))
        self.weight = np.ones(self.count)
        self.steps: np.ndarray | None = None
        self.sticks = False
        self.moved = np.zeros((self.count, predictor.size))

    @property
    def neutral(self) -> np.ndarray:
        """The vector of the model as given."""
        more = [] if self.steps is None else [0.0]
        return np.r_[self.predictor.neutral, more]

    def plain(self, x: np.ndarray) -> np.ndarray:
        """Vectors without the share."""
        return x[..., : len(self.predictor.neutral)]

    def errors(
        self,
        x: np.ndarray,
        some: np.ndarray | None = None,
        moved: np.ndarray | None = None,
    ) -> np.ndarray:
        """Errors of the fitted windows under vectors ``(B, n)``, ``(B, W, T, c)``;
        ``some``: of those in some of the blocks; ``moved (count, s)``: other offsets of
        starts.

        Single windows whose prediction is not finite count as the largest motion; of a
        vector that loses most windows they stay as they are, and no fit takes it."""
        every = self.blocks if some is None else some
        at = self.windows_of(every)
        begun = self.moved if moved is None else moved
        moved = np.broadcast_to(begun[at], (len(x), len(at), begun.shape[1]))
        given = self.plain(x), every, moved, self.rows
        found = self.predictor.errors(*given)[:, : len(at)]
        bounded, lost = finite(found, self.predictor.largest)
        few = lost.mean(1) <= _LOST
        found = np.where(few[:, None, None, None], bounded, found)
        if self.steps is not None:
            found -= x[:, -1, None, None, None] * self.steps[at]
        return found

    def rows_once(self) -> np.ndarray:
        """What each fitted window counts where each row of a log counts once,
        ``(count,)``: windows overlap."""
        windows, length = self.predictor.windows, self.residuals.groups.shape[1]
        at = windows_in(self.blocks)[: self.count]
        run, row = windows.run[at], windows.row[at]
        rows = row[:, None] + np.arange(length)
        key = run[:, None] * (row.max() + length) + rows
        _, at, count = np.unique(key, return_inverse=True, return_counts=True)
        return (1.0 / count[at].reshape(rows.shape)).mean(1)

    def windows_of(self, some: np.ndarray) -> np.ndarray:
        """Fitted windows in some of the blocks; the last block may not be full."""
        at = windows_in(some)
        return at[at < self.count]

    def simulate(self, x: np.ndarray, some: np.ndarray | None = None) -> np.ndarray:
        """Whitened errors ``(B, W, m)`` of vectors ``(B, n)``; ``some`` as in
        `errors`."""
        at = None if some is None else self.windows_of(some)
        with warnings_to():  # what a trial does to MuJoCo is nobody's fault
            return self.residuals.of(self.errors(x, some), at)

    def columns(self, place: Place, fitted: bool = True) -> np.ndarray:
        """Entries of the whole vector that belong to a place."""
        index = self.predictor.layout.where(place) + self.predictor.own
        return index[np.array(place.fitted)] if fitted else index

    def active(self, places: Sequence[Place]) -> list[int]:
        """Entries that a fit of these effects moves."""
        found = [int(i) for p in places for i in self.columns(p)]
        share = [] if self.steps is None else [len(self.predictor.neutral)]
        return sorted({*self.own, *found, *share})

    def started(self, x: np.ndarray, candidate: Candidate) -> np.ndarray:
        """A vector with a candidate at its starting values."""
        out = x.copy()
        out[self.columns(candidate.place, fitted=False)] = candidate.start
        return out

    def without(self, x: np.ndarray, place: Place, kept: Sequence[Place]) -> np.ndarray:
        """A vector with an effect taken out, shared columns of ``kept`` left."""
        mine = set(self.columns(place, fitted=False).tolist())
        for other in kept:
            mine -= set(self.columns(other, fitted=False).tolist())
        out = x.copy()
        index = sorted(mine)
        out[index] = self.predictor.neutral[index]
        return out

    def model(self, places: list[Place], fit: Fitted, possible: bool = True) -> Model:
        """A fit with its cross-validated loss; infinite where no machine can be so, if
        it is to be ``possible``."""
        numbers = [fit.x[self.columns(p, fitted=False)] for p in places]
        unlikely = sum(map(Place.unlikely, places, numbers))
        windows = self.cross_validated(fit)
        if possible and not all(map(Place.possible, places, numbers)):
            windows = np.full_like(windows, np.inf)
        loss, gap = self._of_blocks(windows)
        felt = {p.key: self._felt(p, fit) for p in places}
        return Model(places, fit, loss, gap, self.own, unlikely, windows, felt)

    def _felt(self, place: Place, fit: Fitted) -> int:
        """Fitted numbers of an effect that change predictions at all."""
        at = np.searchsorted(fit.active, self.columns(place))
        change = np.sqrt((fit.slope[..., at] ** 2).sum((0, 1)))
        change = change * self.bounds.size[self.columns(place)]
        if not np.isfinite(change).all() or not change.any():
            return sum(place.fitted)
        return int((change > DECIDE.felt * change.max()).sum())

    def fit(self, places: list[Place], x: np.ndarray, possible: bool = True) -> Model:
        """The best fit of some effects from ``x``; ``possible`` as of `model`."""
        problem = least_squares(x[None], self.active(places), self.bounds, self.weight)
        return self.model(places, self._solved([problem])[0], possible)

    def _solved(self, problems: Sequence[Asks]) -> list[Fitted]:
        def solve() -> Arrays:
            name = "fitting effects" if len(problems) > 1 else "fitting"
            with self.progress(name, len(problems)) as shown:
                found = lockstep(problems, self.simulate, ended=shown.advance)
            return {f"{i}.{k}": v for i, f in enumerate(found) for k, v in f.arrays()}

        kept = self.journal.remember(solve)
        return [
            Fitted.of({k: kept[f"{i}.{k}"] for k in Fitted.__dataclass_fields__})
            for i in range(len(problems))
        ]

    def cross_validated(self, fit: Fitted) -> np.ndarray:
        """Squared error of each window by a fit without its block, weighted,
        ``(2, W)``: of whitened errors, and in units of the gap; inf where a prediction
        is not finite.

        One Gauss-Newton step from the whole fit, exact where errors are linear.
        """
        w, r, j = self.weight, fit.residual, fit.slope
        if not (np.isfinite(r).all() and np.isfinite(j).all()):
            return np.full((2, len(w)), np.inf)
        a = j.shape[-1]
        out = np.zeros((2, len(w)))
        size = self.bounds.size[fit.active]
        j = j * size
        normal = np.einsum("w,wma,wmb->ab", w, j, j, optimize=True)
        gradient = np.einsum("w,wma,wm->a", w, j, r, optimize=True)
        ridge = 1e-9 * np.diag(np.diag(normal) + 1e-30)
        x = fit.x[fit.active]
        stuck = (x <= self.bounds.low[fit.active]) | (x >= self.bounds.high[fit.active])
        free = ~stuck
        for b in range(int(self.group.max()) + 1):
            at = self.group == b
            jb, rb, wb = j[at], r[at], w[at]
            if a and free.any():
                left = normal - np.einsum("w,wma,wmb->ab", wb, jb, jb, optimize=True)
                pull = gradient - np.einsum("w,wma,wm->a", wb, jb, rb, optimize=True)
                inner = (left + ridge)[np.ix_(free, free)]
                move = np.zeros(a)
                move[free] = -np.linalg.lstsq(inner, pull[free], rcond=1e-10)[0]
                rb = rb + jb @ move
            raw = np.einsum("wij,wj->wi", self.residuals.plain[at], rb)
            out[:, at] = np.stack([wb * (e**2).mean(1) for e in (rb, raw)])
        return out

    def _of_blocks(self, windows: np.ndarray) -> np.ndarray:
        """Means over each block, ``(2, blocks)``, of weighted ``(2, W)``."""
        total = np.maximum(np.bincount(self.group, self.weight), 1e-30)
        return np.array([np.bincount(self.group, x) / total for x in windows])

    # -- stages ----------------------------------------------------------------

    def fitted(
        self, places: list[Place], base: Fitted, chosen: Sequence[Candidate]
    ) -> list[Model]:
        """Each candidate beside ``places``, the best of its starts, by name; but what
        no machine can have. ``base``: a fit of these places, or of more."""
        problems = [
            least_squares(
                np.array([self.started(base.x, c), *([c.ends] if c.ends else [])]),
                self.active([*places, c.place]),
                self.bounds,
                self.weight,
                near=base,
            )
            for c in chosen
        ]
        fits = self._solved(problems)
        best: dict[str, tuple[float, Place, Fitted]] = {}
        for c, f in zip(chosen, fits, strict=True):
            key = c.place.key
            if key not in best or f.cost < best[key][0]:
                best[key] = (f.cost, c.place, f)
        models = [self.model([*places, p], f) for _, p, f in best.values()]
        return [m for m in models if np.isfinite(m.loss).all()]

    def richer(self, model: Model, candidates: Sequence[Candidate]) -> Model:
        """The model with effects replaced by ones that contain them and do better."""
        for place in list(model.places):
            more = [c for c in candidates if contains(c.place, place)]
            best = self._replaced(model, place, more)
            # Of one nature at one place: also a small gain says which.
            if best is not None and better(best, model, 0.0):
                model = best
        return model

    def shaped(
        self,
        model: Model,
        shapes: Sequence[Candidate],
        spared: Collection[str] = (),
    ) -> Model:
        """The model with effects in another shape where that does better, or needs
        fewer others: which one they have shows only once the others are in. A mass that
        is spread, less some inertia, is a point.

        Args:
            spared: as of `needed`.
        """
        for place in list(model.places):
            if place not in model.places:  # needless beside another shape
                continue
            other = [c for c in shapes if c.place.key == place.key]
            best = self._replaced(model, place, other)
            if best is None:
                continue
            less = self.needed(best, spared)
            fewer = len(less.places) < len(model.places)
            if fewer and not better(model, less, self.floor):
                model = less
            elif best.loss.mean() < model.loss.mean():
                model = best
        return model

    def _replaced(
        self, model: Model, place: Place, candidates: Sequence[Candidate]
    ) -> Model | None:
        """The model with the best of some candidates in the place of an effect; None
        where there is none."""
        if not candidates:
            return None
        kept = [p for p in model.places if p is not place]
        found = self.fitted(kept, model.fit, candidates)
        if not found:
            return None
        best = min(found, key=lambda m: m.loss.mean())
        order = [best.places[-1] if p is place else p for p in model.places]
        return replace(best, places=order)

    def needed(self, model: Model, spared: Collection[str] = ()) -> Model:
        """The model less the effects that it predicts as well without, but those that
        are ``spared``."""
        while len(model.places) > 1:
            shorter = []
            for place in model.places:
                if place.key in spared:
                    continue
                kept = [p for p in model.places if p is not place]
                shorter.append(self.fit(kept, self.without(model.fit.x, place, kept)))
            best = min(shorter, key=lambda m: m.loss.mean(), default=None)
            if best is None or better(model, best, self.floor):
                break
            model = best
        return model
