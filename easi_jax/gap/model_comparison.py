"""Whether a set of effects is better than another, by their cross-validated losses."""

from collections.abc import Sequence
from math import erf, sqrt

import numpy as np

from easi_jax.gap.decisions import DECIDE
from easi_jax.gap.effect_set import Model
from easi_jax.gap.table import Place

_TINY = 1e-300
_UNLIKELY = 1e-6  # probability of a name beside a rival, that odds are never beyond


def advantage(a: np.ndarray, b: np.ndarray) -> float:
    """By how many standard errors losses ``a`` are below ``b``, block by block."""
    return _in_errors(b - a, 1e-12 * max(abs(b.mean()), 1e-30))


def _in_errors(d: np.ndarray, least: float) -> float:
    """A mean in standard errors, which are at ``least`` so large; of what is infinite,
    infinite."""
    mean = float(d.mean())
    if not np.isfinite(mean) or len(d) < 2:
        return mean * np.inf if mean else 0.0
    return mean / max(float(d.std(ddof=1)) / sqrt(len(d)), least)


def rank(model: Model) -> float:
    """Cross-validated loss, with a handicap for what machines rarely have, and an
    advantage for what nearly all have."""
    return float(model.loss.mean()) * (1.0 + DECIDE.rare) ** model.unlikely


def better(model: Model, base: Model, floor: float) -> bool:
    """Whether a model predicts better than a smaller one by more than chance.

    Losses are compared in units of the noise and of the gap. On average over both the
    gain has to be sure, and in one of them as large as the share that each number of
    the model has to earn, in the other a third of that. With an effect that machines
    rarely have, both have to be sure, and twice as large, since such effects mend a
    little of everything. A large gain may also be sure by its ratios: where a few
    blocks hold most of the error, differences scatter as much as they are large.
    Where the gap is all but closed, small gains count for nothing: no machine quite
    follows any physics.

    An effect that acts in a few windows only, such as a force limit, leaves most blocks
    as they are; it has to help in those windows, one by one.

    Args:
        floor: the gap of a perfect model.
    """
    helps = DECIDE.helps * max(1, len(model.fit.active) - len(base.fit.active))
    if base.gap.mean() < (DECIDE.open_from * floor) ** 2:
        helps *= DECIDE.helps_when_closed
    known = {p.key for p in base.places}
    rare = any(p.rarity > 0 for p in model.places if p.key not in known)
    both = ((model.loss, base.loss), (model.gap, base.gap))
    gain = [1 - a.mean() / max(b.mean(), 1e-300) for a, b in both]
    large = min(gain) > DECIDE.large_gain
    sure = [_sure(a, b, large) for a, b in both]
    acting = _acting(model, base)
    if len(acting):
        single = zip(model.windows[:, acting], base.windows[:, acting], strict=True)
        # Windows overlap by a half.
        ones = [_sure(a, b, large) / sqrt(2) for a, b in single]
        sure = [max(pair) for pair in zip(sure, ones, strict=True)]
    if rare:
        return min(sure) > DECIDE.sure and min(gain) > 2 * helps
    likely = min(sure) > DECIDE.likely and sum(sure) > 2 * DECIDE.sure
    return likely and max(gain) > helps and min(gain) > helps / 3


def _sure(a: np.ndarray, b: np.ndarray, by_ratio: bool) -> float:
    """`advantage` of losses, or of their logarithms where that is more."""
    plain = advantage(a, b)
    if not by_ratio:
        return plain
    return max(plain, advantage(np.log(a + _TINY), np.log(b + _TINY)))


def _acting(model: Model, base: Model) -> np.ndarray:
    """Windows whose predictions differ by more than noise, where they are few; else
    none."""
    mine, other = model.fit.residual, base.fit.residual
    if mine.shape != other.shape or not mine.size:
        return np.zeros(0, int)
    return _few(((mine - other) ** 2).mean(-1) > 1.0)


def _few(windows: np.ndarray) -> np.ndarray:
    """Indices of windows ``(W,)``, where those are few that can tell; else none."""
    found = np.flatnonzero(windows)
    few = DECIDE.least_windows <= len(found) <= DECIDE.few_windows * len(windows)
    return found if few else found[:0]


def size_of(model: Model) -> int:
    """Fitted numbers of its last effect that can be felt."""
    place = model.places[-1]
    return model.felt.get(place.key, sum(place.fitted))


def contains(a: Place, b: Place) -> bool:
    """Whether effect ``a`` is ``b`` and more, at the same place."""
    return (a.at, a.kind, a.row.contains) == (b.at, b.kind, b.effect)


def _within(a: Model, b: Model) -> bool:
    """Whether a model is another with one effect less general."""
    mine, theirs = ({p.key: p for p in x.places} for x in (a, b))
    only = [p for k, p in mine.items() if k not in theirs]
    rest = [p for k, p in theirs.items() if k not in mine]
    return len(only) == len(rest) == 1 and contains(rest[0], only[0])


def simplest(models: Sequence[Model], base: Model) -> Model:
    """The best of models sorted by loss, or a simpler one that is as good: with fewer
    numbers, or with what like places have alike in place of what one has.

    One that the best contains as a special case comes first also where it is only
    nearly as good: the rest is asked for once other effects are in (`Selector.richer`).
    """
    best = models[0]
    for m in models[1:]:
        if _within(m, best):
            whole = base.loss.mean() - best.loss.mean()
            if base.loss.mean() - m.loss.mean() > DECIDE.nearly * whole:
                best = m
        elif len(m.fit.active) < len(best.fit.active) or _tied(m) > _tied(best):
            close = m.loss.mean() < (1 + DECIDE.helps) * best.loss.mean()
            if close and advantage(best.loss, m.loss) < DECIDE.as_good:
                best = m
    return best


def _tied(model: Model) -> int:
    """Effects that like places have alike."""
    return sum(bool(p.tied) for p in model.places)


def probability(model: Model, rival: Model) -> float:
    """That a model is better than a rival, by their cross-validated losses.

    In units of the noise and of the gap, on average over both, as `better` asks; where
    only a few windows tell the two apart, also by those, one by one. What fits as well
    with more numbers is less likely by a half standard error for each, and so is what
    fewer machines have; what only adds to the model counts less, however well it does.
    """
    t = 0.0
    for mine, theirs in ((model.loss, rival.loss), (model.gap, rival.gap)):
        # Of numbers whose spread nobody knows, the log density is that of the spread.
        d = np.log(theirs + _TINY) - np.log(mine + _TINY)
        t += 0.5 * _in_errors(d, DECIDE.says_nothing)
    apart = _few(np.abs(model.windows - rival.windows).max(0, initial=0.0) > 1.0)
    if len(apart):
        mine, theirs = (np.log(x.windows[:, apart] + _TINY) for x in (model, rival))
        # Windows overlap by a half.
        single = np.mean(list(map(advantage, mine, theirs))) / sqrt(2)
        t = max(t, float(single), key=abs)
    t += 0.5 * (size_of(rival) - size_of(model) + rival.unlikely - model.unlikely)
    if contains(rival.places[-1], model.places[-1]):
        t = max(t, -1.0) + 1.0
    return 0.5 * (1 + erf(t / sqrt(2)))


def cost(model: Model, less: Model, within: float = DECIDE.closed) -> float:
    """What is left open without an effect, by what is left open with it: half the
    logarithm, so nats for each independent number that was read.

    Open is what a cross-validated loss exceeds the noise by, whose own is 1 or a little
    less. What is within ``within`` times the noise counts as left open by both: so well
    is the noise known. Blocks of time are averaged before or after the logarithm,
    whichever is more: what acts seldom shows in few of them.
    """
    anyway = within**2 - 1.0
    mine, theirs = (np.maximum(m.loss - 1.0, 0.0) + anyway for m in (model, less))
    each = np.mean(np.log(theirs / mine))
    return 0.5 * float(max(each, np.log(theirs.mean() / mine.mean())))


def certainty(model: Model, less: Model) -> float:
    """By how many standard errors between blocks an effect helps: by its share of what
    is left without it."""
    mine, theirs = (np.log(x.loss + _TINY) for x in (model, less))
    return advantage(mine, theirs)


def confidence(
    lost: float, odds: float, even: float = DECIDE.even, steep: float = DECIDE.steep
) -> float:
    """Probability that an effect of this name acts at this place.

    What closes little beside what is left may mend a little of what no effect is: so it
    was in generated machines, known effects beside unknown ones among them
    (`benchmarks.gap_confidence`).

    Args:
        lost: its `cost`.
        odds: of all its rivals together, but its twins.
        even: cost of what is as often named wrongly as rightly [nats], and how
            ``steep`` that is in its logarithm.
    """
    if lost <= 0:
        return 0.0
    return 1.0 / (1.0 + (even / lost) ** steep) / (1.0 + odds)


def odds_of(mine: Model, rivals: Sequence[Model], led: np.ndarray) -> float:
    """Of all rivals of a model together, but its twins; ``led`` as in `are_twins`."""
    each = [probability(mine, r) for r in rivals if not are_twins(mine, r, led)]
    return sum((1 - p) / max(p, _UNLIKELY) for p in each)


def are_twins(model: Model, rival: Model, led: np.ndarray) -> bool:
    """Whether two models predict the same, so that no such data tell them apart; but
    where a run begins, before which nothing is known: there a late command and a late
    reading differ.

    Args:
        led: windows with as many rows before them as readings can be late, ``(W,)``.
    """
    mine, theirs = model.fit.residual, rival.fit.residual
    each = ((mine - theirs) ** 2).mean(-1)
    return bool(np.sqrt(each[led if led.any() else ~led].mean()) < DECIDE.twins)
