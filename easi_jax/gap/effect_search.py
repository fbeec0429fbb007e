"""Which effects a model lacks: found in windows of several lengths, one after another.

Short windows show large effects while errors are still nearly linear in them; long ones
show small friction, light damping and drift. Effects are added at each length in turn,
and none is given up because windows of another length say nothing of it. What one
length says is never added to what another does: they share rows.
"""

import math
from collections.abc import Collection, Mapping, Sequence

import mujoco
import numpy as np

from easi_jax.errors import UserError
from easi_jax.gap.candidates import places, ripples
from easi_jax.gap.decisions import DECIDE
from easi_jax.gap.discretization_error import within_a_step
from easi_jax.gap.effect_set import Candidate, Model, keys, last
from easi_jax.gap.fitting import Fitting
from easi_jax.gap.model_comparison import (
    better,
    certainty,
    confidence,
    cost,
    odds_of,
    probability,
    rank,
    simplest,
)
from easi_jax.gap.screening import expanded, screened, shortlist
from easi_jax.gap.table import Place, covered, does
from easi_jax.model import addresses as language
from easi_jax.model.effect_catalog import Scales
from easi_jax.model.found_laws import law_of
from easi_jax.model.joint_space import is_hinge, scalar_dofs
from easi_jax.model.parameter_proposal import like_places
from easi_jax.model.parameters import ParameterSpace
from easi_jax.progress import Tell

RIVALS = 8  # names in the place of another that are followed up
_STAGES = 8  # of adding one and taking out what has become needless
_RIPPLES = [0.75 * k for k in range(3, 27)]  # cycles over the range of a joint
_BEAM = 3  # sets of effects that are followed
_LOST = 0.25  # of the motion: errors of a model that does not follow it
# Nats, of an effect without which predictions are not finite: as with e^20 times the
# squared error.
_BLOWS_UP = 10.0


class Places:
    """Where effects can be in a model.

    Attributes:
        everywhere: but for ripples.
        offered: of these, what the refit of the model's own parameters does not do.
        ripples: at all of their cycles.

    ``only``: keys of those that are offered; None: all.
    """

    def __init__(
        self,
        m: mujoco.MjModel,
        space: ParameterSpace,
        scales: Scales,
        only: Collection[str] | None = None,
    ) -> None:
        self.m = m
        # Laws of an earlier analysis are none of this one's, unless it asks for them.
        self.everywhere = [
            p
            for p in places(m, scales)
            if law_of(p.effect) is None or p.key in (only or ())
        ]
        self.offered = [
            p
            for p in self.everywhere
            if not covered(p, space, m) and (only is None or p.key in only)
        ]
        self.ripples = [
            p
            for j in scalar_dofs(m)
            for p in ripples(m, j, scales, _cycles(m, j, scales))
            if only is None or p.key in only
        ]
        self._dropped: set[str] = set()  # found, and then found to say nothing

    @property
    def known(self) -> dict[str, Place]:
        """All that may be named, by key."""
        return {p.key: p for p in (*self.offered, *self.ripples)}

    def candidates(self, taken: Sequence[Place]) -> list[Candidate]:
        """Every place that is not in a model yet, with its starts."""
        no = {p.key for p in taken} | self._dropped
        return [
            Candidate(p, s)
            for p in (*self.offered, *self.ripples)
            if p.key not in no
            for s in p.starts[: 1 if p.row.is_sine else None]
        ]

    def shapes(self, taken: Sequence[Place]) -> list[Candidate]:
        """The same effects in their other shape: a mass that is spread in place of a
        point."""
        return [
            Candidate(p, s)
            for mine in taken
            for p in self.offered
            if p.key == mine.key and not all(p.fitted) and p.starts != mine.starts
            for s in p.starts
        ]

    def offer(self, addresses: Sequence[str]) -> list[Place]:
        """Offers as effects what some of the model's own parameters would do, and
        returns these."""
        each = [p for a in addresses for p in self.everywhere if does(p, a, self.m)]
        self.offered += each
        return each

    def drop(self, gone: Sequence[Place]) -> None:
        """No longer offers these."""
        self._dropped |= {p.key for p in gone}

    def singles(self, place: Place) -> list[Place]:
        """What an effect of several places is at each of them."""
        each: dict[str, Place] = {}
        for p in self.everywhere:
            mine = p.kind == "actuator" if place.shared else p.at in place.tied
            if mine and p.effect == place.effect and not p.tied and p.at:
                each.setdefault(p.key, p)  # of some shapes the first
        return [*each.values()]

    def groups(self) -> dict[str, tuple[str, ...]]:
        """Names of actuators that are like each other, by their pattern; none by the
        name of one that is like no other."""
        like = like_places(self.m, "actuator")
        grouped = {name for names in like.values() for name in names}
        single = [n for n in language.names(self.m, "actuator") if n not in grouped]
        return like | {name: () for name in single}


def _cycles(m: mujoco.MjModel, j: int, scales: Scales) -> list[float]:
    """Cycles per revolution that a ripple is looked for at."""
    span = float(scales.span[int(m.jnt_dofadr[j])])
    slow = 1 if is_hinge(m, j) else 2
    return [slow * k * 2 * math.pi / span for k in _RIPPLES]


class EffectSearch:
    """Adds effects to a model while they help.

    Args:
        lengths: windows of several lengths, the shortest first.
        settles: which of them decides on names where none found more than it.
        offered: what may be added.
        tell: takes a line on how far it is.

    Attributes:
        at: the windows that what was found is fitted to at the end.
    """

    def __init__(
        self, lengths: Sequence[Fitting], settles: int, offered: Places, tell: Tell
    ) -> None:
        self.lengths, self.settles, self.offered = lengths, settles, offered
        self.tell = tell
        self.at = lengths[settles]
        self._likely: set[str] = set()  # promised most at any stage, or came in since

    def select(self, start: Model) -> Model:
        """A model of `at`'s windows with the effects that windows of any length show;
        ``start`` is one of the windows that decide, with or without effects.

        Shorter windows come first where the model does not follow longer ones at all:
        what it does there is not linear in what it lacks. Longer ones are asked for
        what shorter ones cannot show, once nothing is left open in those.
        """
        self.at, found = self.lengths[self.settles], start
        fitted_to = self.at
        homes: dict[str, Fitting] = {}
        spared: set[str] = set()  # shown by windows of other lengths
        for k, length in enumerate(self.lengths):
            if k < self.settles and self.at.gap < _LOST:
                continue
            if k > self.settles:
                # Where feet stick and slip, what is long is not linear in what lacks.
                before = self.lengths[k - 1]
                if before.sticks or not before.closed_by(found):
                    break
            known = {p.key for p in found.places}
            seconds = (length.steps - length.data.lead) * length.data.dt
            self.tell(f"windows of {seconds:.3g} s:")
            found = found if length is fitted_to else length.again(found)
            found = self._added(length, found, spared)
            fitted_to, spared = length, {p.key for p in found.places}
            new = {p.key for p in found.places} - known
            homes |= dict.fromkeys(new, length)
            if new and k > self.settles:
                self.at = length
        if fitted_to is not self.at:
            found = self.at.again(found)
        return self._needed_anywhere(found, homes)

    def beside(self, base: Model, model: Model) -> Model:
        """``base`` with those effects of ``model`` that it needs, in the windows that
        decide."""
        at = self.lengths[self.settles]
        if not model.places:
            return base
        x, found = base.fit.x.copy(), at.vector(self.at.plain(model.fit.x))
        for place in model.places:
            columns = at.selector.columns(place, fitted=False)
            x[columns] = found[columns]
        at.whiten(x)
        kept = at.weighed(at.selector.fit(model.places, x))
        return at.selector.needed(kept)

    def _needed_anywhere(self, found: Model, homes: Mapping[str, Fitting]) -> Model:
        """The model less what neither its windows nor those that found it need."""
        for place in list(found.places):
            home = homes.get(place.key, self.at)
            if home is self.at or len(found.places) == 1:
                continue
            for length in (self.at, home):
                whole = found if length is self.at else length.again(found)
                if better(whole, length.without(whole, [place]), length.floor):
                    break
            else:
                self.tell(f"- {place.key}: windows of no length need it")
                found = self.at.without(found, [place])
        return found

    def _added(self, at: Fitting, start: Model, spared: Collection[str]) -> Model:
        """A model with the effects that some windows show, none of the ``spared`` taken
        out.

        The few best sets of effects go on side by side: two effects together may be
        what one alone, and wrong, does nearly as well.
        """
        chosen, model, beam = at.selector, start, [start]
        for _ in range(_STAGES):
            if len(model.places) >= DECIDE.most:
                break
            model = at.weighed(model)
            if at.closed(model.fit.x):
                break
            found: dict[frozenset[str], Model] = {}
            # What was taken out of the best may still be in the others.
            beam = [b for b in beam if len(b.places) <= len(model.places)]
            likely: set[str] = set()  # to be tried beside all sets but the first
            for parent in beam:
                if parent is not beam[0]:
                    parent = chosen.fit(parent.places, parent.fit.x)
                more = [
                    c
                    for c in self.offered.candidates(parent.places)
                    if not likely or c.place.key in likely
                ]
                models, names = expanded(chosen, parent, more)
                names = {*names[: DECIDE.tried], *(p.key for p in model.places)}
                self._likely |= names
                likely = likely or names
                for m in models:
                    key = keys(m)
                    if key not in found or m.loss.mean() < found[key].loss.mean():
                        found[key] = m
            tried = sorted(found.values(), key=rank)
            for m in tried[:4]:
                self.tell(f"  {_named(m)} (without {_figures(model)})")
            good = [m for m in tried if better(m, model, at.floor)]
            if not good:
                break
            best = simplest(good, model)
            self.tell(f"+ {' + '.join(p.key for p in best.places)}")
            beam = [best, *[m for m in good if m is not best][: _BEAM - 1]]
            model = best
            if len(model.places) > 1:
                at.whiten(model.fit.x)
                model = chosen.fit(model.places, model.fit.x)
                model = chosen.needed(model, spared)
                beam[0] = model
        if model.places:
            at.whiten(model.fit.x)
            model = chosen.fit(model.places, model.fit.x)
            model = chosen.richer(model, self.offered.candidates(model.places))
            model = chosen.shaped(model, self.offered.shapes(model.places), spared)
        return model

    def offer(self, addresses: Sequence[str]) -> None:
        """Offers as effects what some of the model's own parameters would do."""
        self._likely |= {p.key for p in self.offered.offer(addresses)}

    def rivals(self, model: Model, place: Place) -> list[Model]:
        """Other names refitted in the place of one effect, best first."""
        chosen = self.at.selector
        without = self.at.without(model, [place])
        others = [
            c
            for c in self.offered.candidates(model.places)
            if c.place.key != place.key and c.place.key in self._likely
        ]
        short = shortlist(screened(chosen, without, others), chosen.sticks)
        out = chosen.fitted(without.places, without.fit, short)
        return sorted(out, key=lambda m: m.loss.mean())

    def exchanged(self, model: Model) -> tuple[Model, dict[str, list[Model]]]:
        """The model with effects replaced by what does better in their place, and the
        rivals of each effect, best first.

        What was the best alone may not be the best beside what came later.
        """
        seen = {keys(model)}
        while True:
            rivals = {p.key: self.rivals(model, p) for p in model.places}
            swaps = []
            for place in model.places:
                mine = last(model, place)
                for rival in rivals[place.key][:RIVALS]:
                    p = probability(mine, rival)
                    most = 1 + DECIDE.helps
                    if _body_for_joint(place, rival.places[-1]):
                        # Its three numbers do what one does, where there is one joint.
                        most = 1 / most
                    close = rank(rival) <= most * rank(mine)
                    if p < DECIDE.replaced_below and close and keys(rival) not in seen:
                        swaps.append((p, place, rival))
            if not swaps:
                return model, rivals
            _, place, rival = min(swaps, key=lambda swap: swap[0])
            new = rival.places[-1]
            order = [new if p is place else p for p in model.places]
            self.tell(f"{place.key} -> {new.key}: {_figures(rival)}")
            self.at.whiten(rival.fit.x)
            model = self.at.selector.fit(order, rival.fit.x)
            seen.add(keys(model))

    def needful(
        self, model: Model, step: float
    ) -> tuple[Model, dict[str, list[Model]], list[str]]:
        """The model less what says nothing of the machine, with the rivals of what is
        left, and notes; ``step`` is that of the physics [s]."""
        model, rivals = self.exchanged(model)
        notes: list[str] = []
        for _ in range(DECIDE.most):
            brief = [p for p in model.places if self._brief(model, p, step)]
            idle = [p for p in model.places if p not in brief and self._idle(model, p)]
            spare = [] if brief or idle else self._spare(model, rivals)
            gone = [*brief, *idle, *spare]
            if not gone:
                break
            self._tell_gone(brief, "less than a physics step")
            self._tell_gone(idle, "does nothing")
            self._tell_gone(spare, "nothing is open without it, nor is it probable")
            notes += [_of_a_step(p, step) for p in brief]
            notes += [_spared(p) for p in spare]
            self.offered.drop([*brief, *spare])
            less = self.at.without(model, gone)
            self.at.whiten(less.fit.x)
            less = self.at.selector.fit(less.places, less.fit.x)
            model, rivals = self.exchanged(less)
        return *self._apart(model, rivals), notes

    def _brief(self, model: Model, place: Place, step: float) -> bool:
        first = self.at.selector.columns(place, fitted=False)[0]
        return within_a_step(place, float(model.fit.x[first]), step)

    def _spare(
        self, model: Model, rivals: Mapping[str, Sequence[Model]]
    ) -> list[Place]:
        """The effect that is missed least, of those that are not probable and without
        which nothing is open; none else."""
        x = model.fit.x
        idle = [
            p
            for p in model.places
            if not self.at.misses(x, self.at.without(model, [p]).fit.x)
        ]
        if not idle:
            return []
        # What is not open may be of any cause.
        each = self.missed(model, DECIDE.open_from)
        for place in sorted(idle, key=lambda p: each[p.key]):
            among = rivals[place.key][:RIVALS]
            odds = odds_of(last(model, place), among, self.at.windows.led)
            if confidence(each[place.key][0], odds) < DECIDE.probable:
                return [place]
        return []

    def missed(
        self, model: Model, within: float = DECIDE.closed
    ) -> dict[str, tuple[float, float]]:
        """What it costs to take each effect of a model out, and how sure that is, in
        windows of the length that shows it most.

        Nothing is added across lengths, which share rows. Where feet stick and slip,
        what is long is not linear in what lacks, and has no say.

        Args:
            model: of the windows `at`.
            within: as of `cost`.

        Returns:
            `cost` and `certainty` by the effect's key.
        """
        found: dict[str, list[tuple[float, float]]] = {p.key: [] for p in model.places}
        for length in self.lengths:
            with length.as_before():
                mine = _in_windows(length, self.at, model)
                if mine is None:
                    continue
                for place in model.places:
                    less = length.without(mine, [place], possible=False)
                    finite = np.isfinite(less.loss).all()
                    lost = cost(mine, less, within) if finite else _BLOWS_UP
                    found[place.key].append((lost, certainty(mine, less)))
        return {key: max(each, default=(0.0, 0.0)) for key, each in found.items()}

    def _tell_gone(self, places: Sequence[Place], why: str) -> None:
        for place in places:
            self.tell(f"- {place.key}: {why}")

    def _idle(self, model: Model, place: Place) -> bool:
        """Whether an effect was fitted to nothing: predictions are as without it."""
        chosen, kept = self.at.selector, [p for p in model.places if p is not place]
        x = chosen.without(model.fit.x, place, kept)
        mine, other = chosen.errors(np.stack([model.fit.x, x])).astype(float)
        return (
            float(np.abs(mine - other).max()) < DECIDE.does_nothing * np.abs(mine).max()
        )

    def _apart(
        self, model: Model, rivals: dict[str, list[Model]]
    ) -> tuple[Model, dict[str, list[Model]]]:
        """The model with what each place has in place of what all have, where one of
        them differs."""
        named = {p.key for p in model.places}
        for place in [p for p in model.places if p.shared or p.tied]:
            singles = self.offered.singles(place)
            new = [p for p in singles if p.key not in named]
            if len(new) == len(singles):
                continue
            x = self.each(model.fit.x, place, singles)
            order = [q for p in model.places for q in (new if p is place else [p])]
            model = self.at.selector.fit(order, x)
            rivals = rivals | {p.key: rivals[place.key] for p in new}
        return model, rivals

    def each(self, x: np.ndarray, place: Place, singles: Sequence[Place]) -> np.ndarray:
        """A vector in which these places have by themselves what all had."""
        out, columns = x.copy(), self.at.selector.columns
        shared = columns(place)
        out[shared] = self.at.neutral[shared]
        for single in singles:
            out[columns(single)] += x[shared] - out[shared]
        return out


def _in_windows(length: Fitting, at: Fitting, model: Model) -> Model | None:
    """A model of the windows ``at`` in those of another length; None where these say
    nothing of it."""
    if length is at:
        return model
    if at.sticks and length.steps > at.steps:
        return None
    try:
        mine = length.again(model)
    except UserError:  # most predictions that long are not finite
        return None
    return None if length.sticks or not np.isfinite(mine.loss).all() else mine


def _of_a_step(place: Place, step: float) -> str:
    return (
        f"{place.key}: what looked like it is shorter than the model's physics "
        f"step of {1000 * step:.3g} ms, which shifts commands by half of "
        "itself; not named. With a smaller timestep in the model the data could "
        "tell."
    )


def _spared(place: Place) -> str:
    return (
        f"{place.key}: the data are predicted a little better with it, but nothing is "
        "open without it, and so little may be of another cause; not named"
    )


def _body_for_joint(old: Place, new: Place) -> bool:
    """Whether one effect would move from a joint to a body."""
    return old.effect == new.effect and (old.kind, new.kind) == ("joint", "body")


def _figures(model: Model) -> str:
    return f"loss {model.loss.mean():.4g}, gap {model.gap.mean() ** 0.5:.3g}"


def _named(model: Model) -> str:
    return f"{' + '.join(p.key for p in model.places)}: {_figures(model)}"
