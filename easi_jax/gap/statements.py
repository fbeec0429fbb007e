"""What is said of a model and of the effects that joined, by the held-out data."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from easi_jax.estimation.blocks import too_few
from easi_jax.gap import gap_metric as measure
from easi_jax.gap.decisions import DECIDE
from easi_jax.gap.effect_search import RIVALS, EffectSearch
from easi_jax.gap.effect_set import Model, last
from easi_jax.gap.fitting import Fitting
from easi_jax.gap.held_out import HeldOut
from easi_jax.gap.model_comparison import confidence, odds_of
from easi_jax.gap.result import Figures, Found, Numbers, Outcome, score_of
from easi_jax.gap.table import Place
from easi_jax.gap.verdict import Openness, openness, surely_better, verdict_of
from easi_jax.model.parameters import ParameterSpace
from easi_jax.model.results import Site

_AS_IF_ALL = (
    "standard deviations of what is named count as if nothing else were missing; what "
    "is may have moved the values by more"
)


@dataclass
class _Look:
    """Held-out figures of a model beside those of a perfect one.

    Attributes:
        model: that was looked at.
        figures: of it.
        noise: mean squares of a perfect model, ``(c,)``.
        scale: of each channel, ``(c,)``.
        open: the one beside the other.
    """

    model: Model
    figures: Figures
    noise: np.ndarray
    scale: np.ndarray
    open: Openness


@dataclass
class _Looks:
    """A model as given, refitted, and with effects (without any, the refit again)."""

    given: Figures
    refit: _Look
    end: _Look

    @property
    def undone(self) -> bool:
        """Whether the refit predicts worse than the model as given."""
        return surely_better(self.given.square, self.refit.figures.square, self._scale)

    @property
    def fine(self) -> bool:
        """Whether the effects only make up for a refit that went wrong, which is
        nothing that is missing."""
        given = openness(self.given.square, self.refit.noise, self._scale)
        return self.undone and not given.is_open.any()

    @property
    def shown(self) -> bool:
        """Whether data show the effects."""
        least = self.given if self.undone else self.refit.figures
        better = surely_better(self.end.figures.square, least.square, self._scale)
        return better and not self.fine

    @property
    def _scale(self) -> np.ndarray:
        return self.refit.scale


def stated(
    search: EffectSearch,
    held_out: HeldOut,
    judges: HeldOut,
    space: ParameterSpace,
    base: Model,
    model: Model,
    rivals: Mapping[str, Sequence[Model]],
    step: float,
) -> Outcome:
    """What the held-out data say of the refit, and of the effects that joined.

    Args:
        judges: the held-out data in windows as long as those that effects come from:
            these say what is named, whatever length figures are reported at.
        base: the refit of the model's own parameters.
        model: with the effects.
        rivals: of each effect, best first.
        step: of the physics [s].
    """
    at, scale = search.at, held_out.channels.scale
    notes: list[str] = []
    looks = _looks(at, held_out, base, model)
    judged = looks if judges is held_out else _looks(at, judges, base, model)
    refit, end, undone = looks.refit, looks.end, judged.undone
    found: list[Found] = []
    numbers: Numbers | None = None
    if model.places:
        # With one noise that all tell: the refit beside the better floor.
        refit.open = openness(refit.figures.square, end.noise, scale)
        if judged.shown:
            judge = _Judge(search, held_out, judges, base, end)
            found, numbers = judge.found(rivals), judge.numbers
        else:
            notes.append(_not_named(model, judged.fine))
    if undone and not found:
        notes.append(
            "refitted to the fitting data, the model's own parameters predict the "
            "held-out data worse than as given, so they are left as given"
        )
        base = at.refit([])
    if not found and (undone or model.places):
        # Also of the noise nothing is kept that they made of it.
        at.whiten(base.fit.x)
        held_out.starts.noise = at.starts.noise
        refit = end = _looked(at, held_out, base)
    x = end.model.fit.x
    fair = held_out.figures(at.plain(x), at.share(x)).gap
    if fair < DECIDE.steps_told * end.figures.gap:
        notes.append(
            f"the model's physics step of {1000 * step:.3g} ms makes much of "
            f"the gap itself: {end.figures.gap:.3g} would be {fair:.3g} without "
            "its error; a smaller timestep in the model takes it away"
        )
    verdict = verdict_of(bool(found), refit.open, end.open)
    notes += _on_deviations(len(at.windows), verdict) if found else []
    data, x = at.data, at.plain(x)
    return Outcome(
        verdict=verdict,
        found=found,
        refitted=(numbers or _numbers(at, end.model)).refitted(space),
        before=looks.given,
        refit=refit.figures,
        after=end.figures,
        floor=float(measure.gap(end.noise, scale)),
        floor_si=np.sqrt(end.noise),
        floor_is_bound=data.noise_is_bound & at.noise_as_told,
        open_refit=refit.open,
        open_after=end.open,
        channels=held_out.channels,
        held=held_out.windows,
        x=x,
        active=[i for i in model.fit.active.tolist() if i < len(x)],
        notes=notes,
        horizon=(held_out.predictor.steps - data.lead) * data.dt,
        start=data.lead * data.dt,
    )


def _on_deviations(windows: int, verdict: str) -> list[str]:
    left = [_AS_IF_ALL] if verdict == "unexplained" else []
    return [*too_few(windows, "windows"), *left]


def _numbers(at: Fitting, model: Model) -> Numbers:
    pulls = [at.pull_of_starts(model)]
    if at.unseen_steps is not None:
        pulls.append(score_of(at.selector, model, at.unseen_steps))
    return Numbers(at.selector, model, pulls)


def _looked(at: Fitting, held_out: HeldOut, model: Model) -> _Look:
    x, scale = at.plain(model.fit.x), held_out.channels.scale
    figures, noise = held_out.look(x), held_out.floor(x)
    return _Look(model, figures, noise, scale, openness(figures.square, noise, scale))


def _looks(at: Fitting, held_out: HeldOut, base: Model, model: Model) -> _Looks:
    held_out.starts.noise = at.starts.noise
    given, refit = held_out.look(at.plain(at.neutral)), _looked(at, held_out, base)
    end = _looked(at, held_out, model) if model.places else refit
    return _Looks(given, refit, end)


class _Judge:
    """Says of each effect how sure it is, and what else it may be; without the error
    of own steps.

    Args:
        held_out: whose figures are told, and ``judges``, that say which names and
            places do as well as others.
        base: the model without effects.
        end: with all of them.
    """

    def __init__(
        self,
        search: EffectSearch,
        held_out: HeldOut,
        judges: HeldOut,
        base: Model,
        end: _Look,
    ) -> None:
        self.search, self.held_out, self.judges = search, held_out, judges
        self.at, self.model, self.end = search.at, end.model, end
        self.whole, self.base = self._fair(end.model), self._fair(base)
        self.numbers = _numbers(self.at, self.model)

    def _fair(self, model: Model) -> Figures:
        x = model.fit.x
        return self.judges.figures(self.at.plain(x), self.at.share(x))

    def found(self, rivals: Mapping[str, Sequence[Model]]) -> list[Found]:
        """All effects, what it costs most to take out first."""
        numbers, each = self.numbers, self.search.missed(self.model)
        costs = {key: lost for key, (lost, _) in each.items()}
        places = sorted(self.model.places, key=lambda p: -costs[p.key])
        found = []
        for k, place in enumerate(places):
            model, figures = self.model, self.end.figures
            if k + 1 < len(places):
                model = self.at.without(self.model, places[k + 1 :])
                figures = self.held_out.figures(self.at.plain(model.fit.x))
            odds, same = self._odds(last(self.model, place), rivals[place.key])
            sites = self._sites(model.fit.x, place, figures) if place.shared else ()
            at = {place.at, *(name for s in sites for name in (s.at, *s.names))}
            mine = {f"{place.effect}@{name}" for name in at}
            found.append(
                Found(
                    place,
                    numbers.values(place),
                    confidence(costs[place.key], odds),
                    [k for k in dict.fromkeys(same) if k not in mine],
                    figures.gap,
                    numbers.fitted(place),
                    numbers.deviations(place),
                    sites,
                    costs[place.key],
                    numbers.outcome(place),
                    each[place.key][1],
                    odds,
                )
            )
        return found

    def _odds(self, mine: Model, rivals: Sequence[Model]) -> tuple[float, list[str]]:
        """Odds of an effect's rivals but its twins, and the names of those that predict
        held-out data as well."""
        same: list[str] = []
        for rival in rivals[:RIVALS]:
            if self._as_good(self.whole.square, self._fair(rival).square):
                other = rival.places[-1]
                groups = self.search.offered.groups() if other.shared else [other.at]
                same += [f"{other.effect}@{at}" for at in groups]
        return odds_of(mine, rivals[:RIVALS], self.at.windows.led), same

    def _sites(self, x: np.ndarray, place: Place, whole: Figures) -> tuple[Site, ...]:
        """Where a shared effect is seen: without it there the held-out data are
        predicted worse. What moves them most comes first. Where all actuators are like
        others and all have it, they are one site.

        Args:
            x: vector with the effect.
            whole: its figures.
        """
        single = {p.at: p for p in self.search.offered.singles(place)}
        groups = self.search.offered.groups()

        def only(kept: Sequence[str]) -> np.ndarray:
            names = [name for at in kept for name in groups[at] or (at,)]
            return self.search.each(x, place, [single[name] for name in names])

        every = list(groups)
        judges, scale = self.judges, self.judges.channels.scale
        parted = [only([k for k in every if k != at]) for at in every]
        squares = self._squares(judges, parted)
        (mine,) = self._squares(judges, [x])
        order = np.argsort(-np.asarray(measure.gap(squares.mean(1), scale)))
        ranked = [every[i] for i in order]
        worse = [every[i] for i in order if not self._as_good(mine, squares[i])]
        seen = worse or ranked
        if 1 < len(every) == len(seen) and all(groups.values()):
            return (Site("*", whole.gap, tuple(single)),)
        parted = [only(seen[:k]) for k in range(1, len(seen))]
        some, scale = self._squares(self.held_out, parted), self.held_out.channels.scale
        gaps = [*(float(measure.gap(s.mean(0), scale)) for s in some), whole.gap]
        return tuple(map(Site, seen, gaps, (groups[at] for at in seen)))

    def _squares(self, windows: HeldOut, vectors: Sequence[np.ndarray]) -> np.ndarray:
        """Mean squares of each held-out window, ``(B, W, c)``."""
        return windows.squares(np.array([self.at.plain(x) for x in vectors]))

    def _as_good(self, mine: np.ndarray, theirs: np.ndarray) -> bool:
        """Whether the difference of two held-out gaps may be none, or is in favor;
        from mean squares of each window, ``(W, c)``."""
        scale = self.judges.channels.scale
        weights = measure.resampled(len(mine), 1)
        d = measure.gap(weights @ theirs, scale) - measure.gap(weights @ mine, scale)
        # Twins differ by rounding alone.
        gap = measure.gap(mine.mean(0), scale)
        return bool(np.quantile(d, 0.025) <= DECIDE.no_difference * gap)


def _not_named(model: Model, fine: bool) -> str:
    """A note on effects of which the held-out data show nothing; ``fine``: nor that
    anything is missing."""
    names = ", ".join(p.key for p in model.places)
    why = (
        "the model as given predicts the held-out data as well as a perfect one"
        if fine
        else "the held-out data are predicted no better with it"
    )
    return (
        f"{names}: seen in the fitting data, but {why}, so it is not named; the "
        "recordings differ, or are too few"
    )
