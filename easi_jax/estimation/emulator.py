"""Parameters by a linear emulator of what sensors read next.

The end of a search on logs that pair with no simulation
(`easi_jax.search.unpaired`). Individuals near the search's mean are simulated, and what
they read next is regressed on what they read before, alone and times how far their
parameters are from the middle: a prediction of the next reading that is linear in the
parameters. Least squares on the measured pieces then gives the parameters, their
information, and what is left. This is indirect inference (Gourieroux, Monfort and
Renault 1993) with a linear auxiliary model, both sides with the same noise, so that
what noise does to a regression is the same in both.

Slopes are estimated, too, and their noise would count as information. Two halves of the
individuals give two estimates of them, and only what both agree on counts, as in
two-sample instrumental variables.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np

from easi_jax.progress import Tell
from easi_jax.search.unpaired import (
    Pieces,
    Simulations,
    linear_prediction,
)

ROUNDS = 5  # of simulation and fit: two approach, the others are averaged
_AVERAGED = 3
_INDIVIDUALS = 512  # of a round
_NARROWEST, _NARROWER = 0.1, 0.7  # spread of a round, unit coordinates; from the last
_WIDER = 3.0  # standard deviations of what is known, that a round spreads
_FARTHEST = 1.5  # spreads of a round, that its fit may move: linear no farther
_RIDGES = (1e-3, 1e-2, 1e-1, 1.0)  # of which one half chooses what predicts the other
_RIDGE = 1e-5  # of the regression without parameters, which has rows in plenty
_OUTLIER = 4.0  # standard deviations
_BLOCKS = 20  # of the log, whose scatter says how sure the fit is
BEYOND = 0.5  # of the initial range, that a round may lie outside of it
_LEAST = 0.1  # share of what an information says, that scores scatter
_CHANCE = 0.05  # of a right model, that its channels are taken to disagree
_UNITS = 2  # rounds in which a fit learns how much it leaves
PRIOR = 12.0  # information of a uniform initial range, unit coordinates


@dataclass(frozen=True)
class Known:
    """What is known of parameters before a log is read, unit coordinates.

    Attributes:
        mean: ``(n,)``.
        information: ``(n, n)``.
    """

    mean: np.ndarray
    information: np.ndarray

    def beside(self, more: int) -> "Known":
        """The same, and ``more`` numbers of which the initial range is known."""
        n = len(self.mean)
        information = PRIOR * np.eye(n + more)
        information[:n, :n] = self.information
        return Known(np.r_[self.mean, np.full(more, 0.5)], information)


NOTHING = Known(np.zeros(0), np.zeros((0, 0)))


@dataclass(frozen=True)
class Matched:
    """Parameters that a fit found, unit coordinates of the search's space.

    Attributes:
        mean, cov: with what was known before, ``(n,)``, ``(n, n)``.
        excess: mean square of what the emulator leaves of the log, in units of what it
            leaves of simulations; about 1 where the robot is like the model.
        lost: individuals that did not stay finite and on their feet.
        disagree: whether channels surely ask for different values, so that what is
            stated is widened by it.
    """

    mean: np.ndarray
    cov: np.ndarray
    excess: float
    disagree: bool = False
    lost: int = 0


@dataclass(frozen=True)
class _Emulator:
    """A prediction of the next reading that is linear in the parameters.

    Attributes:
        middle: of the parameters, ``(n,)``.
        shown, left: of `_regressed`.
        slopes: two estimates of how what is left changes with them, ``(n, F, C)``.
        known: of the parameters before.
    """

    middle: np.ndarray
    shown: Callable[[np.ndarray], np.ndarray]
    left: Callable[[np.ndarray, np.ndarray], np.ndarray]
    slopes: list[np.ndarray]
    known: Known

    @staticmethod
    def of(
        unit: np.ndarray, read: Pieces, sound: np.ndarray, known: Known
    ) -> "_Emulator | None":
        """Of individuals ``unit (N, n)``, what they ``read (N, K, ...)`` and which are
        ``sound (N,)``; None where too few are."""
        weight = read.weight * sound[:, None]
        of_each = weight.sum(1)
        if (of_each > 0).sum() < 2 * unit.shape[1] + 2:
            return None
        shown, left = _regressed(read.before, read.change, weight)
        middle = of_each @ unit / of_each.sum()
        given = shown(read.before), left(read.before, read.change), weight
        return _Emulator(middle, shown, left, _slopes(unit - middle, *given), known)

    def fit(self, pieces: Pieces) -> Matched:
        """The parameters of ``pieces (K, ...)`` by least squares."""
        x, r = self.shown(pieces.before), self.left(pieces.before, pieces.change)
        counts = pieces.weight
        one, other = (
            np.einsum("kf,afc->kac", x, v, optimize=True) for v in self.slopes
        )
        both = 0.5 * (one + other)

        def products(v: np.ndarray, w: np.ndarray) -> np.ndarray:
            return np.einsum("kac,kbc,k->ab", v, w, counts, optimize=True)

        agreed, whole = products(one, other), products(both, both)
        values, vectors = np.linalg.eigh(0.5 * (agreed + agreed.T))
        agreed = (vectors * np.maximum(values, 0.0)) @ vectors.T
        # A score that slopes make which are noise varies as much as one that slopes
        # make which are not, and says nothing: it counts by the share that is agreed.
        share = agreed @ np.linalg.pinv(whole, rcond=1e-9, hermitian=True)
        score = np.einsum("kac,kc,k->ka", both, r, counts, optimize=True) @ share.T
        information = 0.5 * (share @ agreed + agreed @ share.T)
        prior, off = self.known.information, self.known.mean - self.middle
        # In units of what is left of these pieces, not of those of individuals, in
        # which their different parameters are, too.
        excess = 1.0
        for _ in range(_UNITS):
            inverse = np.linalg.inv(information / excess + prior)
            step = inverse @ (score.sum(0) / excess + prior @ off)
            rest = r - np.einsum("kac,a->kc", both, step, optimize=True)
            excess = float((counts @ rest**2).sum() / (counts.sum() * r.shape[1]))
            excess = max(excess, 1e-12)
        of_channels = np.einsum("kac,kc,k->ca", both, rest, counts, optimize=True)
        of_channels -= of_channels.mean(0)  # the pull of what was known before
        scores = score / excess, of_channels @ share.T / excess
        scatter, disagree = _scattered(*scores, information / excess)
        cov = inverse @ (scatter + prior) @ inverse
        return Matched(self.middle + step, cov, excess, disagree)


def _scattered(
    score: np.ndarray, of_channels: np.ndarray, information: np.ndarray
) -> tuple[np.ndarray, bool]:
    """Covariance ``(n, n)`` of the sum of scores ``(K, n)`` of pieces: along each
    principal direction of their ``information`` as much as sums over blocks of the log
    scatter, or those ``of_channels (C, n)`` at the fit where these scatter surely more;
    and whether they do.

    Blocks scatter less than the information where noise of readings is what is left,
    since what a row is off by the next one takes back. Channels disagree where the
    model errs the same way all the time, which blocks do not show.
    """
    values, vectors = np.linalg.eigh(information)
    count = min(_BLOCKS, len(score))
    blocks = np.array([b.sum(0) for b in np.array_split(score, count)])
    along = ((blocks - blocks.mean(0)) @ vectors).var(0, ddof=1) * count
    along = np.maximum(along, _LEAST * values)
    apart = ((of_channels @ vectors) ** 2).sum(0)
    # Of chi-squares of two numbers, one for each direction.
    more = apart > np.log(len(values) / _CHANCE) * along
    return (vectors * np.where(more, apart, along)) @ vectors.T, bool(more.any())


def matched(
    simulated: Simulations,
    pieces: Pieces,
    mean: np.ndarray,
    key: jax.Array,
    tell: Tell = lambda _: None,
    known: Known = NOTHING,
) -> Matched:
    """The fit, from where a search has ended.

    The last rounds are averaged, and corrected by what they say of simulations of the
    very parameters that they found: so the estimate on the log is that on simulations,
    which is what indirect inference asks for.

    Args:
        simulated: individuals of the search.
        pieces: of the log.
        mean: where the search has ended, unit coordinates, ``(n,)``.
        key: of the individuals and their simulations.
        tell: takes a line on how far it is.
        known: of the first parameters; of the others the initial range is known.
    """
    real = jax.tree.map(lambda x: np.asarray(x, float), pieces)
    low, high = (np.asarray(x, float) for x in simulated.search.space.unit_bounds)
    low, high = np.maximum(low, -BEYOND), np.minimum(high, 1 + BEYOND)
    center = np.clip(np.asarray(mean, float), low, high)
    n, spread = len(center), np.full(len(center), PRIOR**-0.5)
    found, lost = list[tuple[_Emulator, Matched]](), 0
    known = known.beside(n - len(known.mean))
    for k in range(ROUNDS):
        k_draw, k_roll = jax.random.split(jax.random.fold_in(key, k))
        z = np.asarray(jax.random.normal(k_draw, (_INDIVIDUALS, n)), float)
        unit = np.clip(center + spread * z, low, high)
        read, sound = simulated(unit, k_roll)
        lost += int((~sound).sum())
        emulator = _Emulator.of(unit, read, sound, known)
        if emulator is None:
            break
        fit = emulator.fit(real)
        found.append((emulator, fit))
        tell(f"linear emulator: round {k + 1} of {ROUNDS}")
        moved = np.clip(fit.mean - center, -_FARTHEST * spread, _FARTHEST * spread)
        center = np.clip(center + moved, low, high)
        wide = _WIDER * np.sqrt(np.diag(fit.cov))
        spread = np.clip(wide, _NARROWEST, np.maximum(_NARROWER * spread, _NARROWEST))
    if not found:
        nan = np.full((n, n), np.nan)
        return Matched(nan[0], nan, np.nan, lost=lost)
    last = found[-_AVERAGED:]
    unit = np.clip(np.mean([fit.mean for _, fit in last], axis=0), low, high)
    size = len(real.weight)
    again, more = _told_again(simulated, [e for e, _ in last], unit, size, key)
    return _corrected([fit for _, fit in last], again, more, unit, (low, high), lost)


def _told_again(
    simulated: Simulations,
    emulators: Sequence[_Emulator],
    unit: np.ndarray,
    size: int,
    key: jax.Array,
) -> tuple[np.ndarray, float]:
    """What each emulator says of simulations of ``unit (n,)``, ``(R, n)``, and how long
    the log of ``size`` pieces is beside them. What was known is that they are ``unit``,
    so that only what an emulator errs by is told."""
    k_own = jax.random.fold_in(key, ROUNDS)
    read, sound = simulated(np.tile(unit, (simulated.size, 1)), k_own)
    if not sound.any():
        return np.tile(unit, (len(emulators), 1)), 0.0
    log = jax.tree.map(lambda x: x[sound].reshape(-1, *x.shape[2:]), read)
    said = [
        replace(e, known=Known(unit, e.known.information)).fit(log).mean
        for e in emulators
    ]
    return np.array(said), size / max(len(log.weight), 1)


def _corrected(
    fits: Sequence[Matched],
    again: np.ndarray,
    more: float,
    unit: np.ndarray,
    bounds: tuple[np.ndarray, np.ndarray],
    lost: int,
) -> Matched:
    """Rounds together, less what they err by on simulations of ``unit``, which are a
    log, too: ``more`` variance. The scatter of rounds is the emulators' own error."""
    means = np.array([f.mean for f in fits]) - (again - unit)
    cov = (1.0 + more) * np.mean([f.cov for f in fits], axis=0)
    if len(fits) > 1:
        cov = cov + np.diag(means.var(0, ddof=1)) / len(fits)
    excess = float(np.mean([f.excess for f in fits]))
    disagree = sum(f.disagree for f in fits) > len(fits) / 2
    return Matched(np.clip(means.mean(0), *bounds), cov, excess, disagree, lost)


def _regressed(
    before: np.ndarray, change: np.ndarray, weight: np.ndarray
) -> tuple[Callable[..., np.ndarray], Callable[..., np.ndarray]]:
    """How ``before (..., F)`` is shown to a regression, standardized beside a one, and
    what its prediction leaves of ``change (..., C)``, whitened."""
    x, y, w = (a.reshape(-1, *a.shape[2:]) for a in (before, change, weight))
    total = w.sum()
    mid = w @ x / total
    std = np.sqrt(w @ (x - mid) ** 2 / total)
    std = np.where(std > 1e-9, std, 1.0)

    def shown(b: np.ndarray) -> np.ndarray:
        z = np.clip((b - mid) / std, -_OUTLIER, _OUTLIER)
        return np.concatenate([z, np.ones((*z.shape[:-1], 1))], -1)

    z = shown(x)
    weighed = (z * w[:, None]).T
    ridge = _RIDGE * total * np.eye(z.shape[1])
    slope = np.linalg.solve(weighed @ z + ridge, weighed @ y)
    r = y - z @ slope
    cov = (r * w[:, None]).T @ r / total
    # What never changes, such as a foot in the air, is predicted without an error.
    size = np.sqrt(np.maximum(np.diag(cov), 1e-12 * max(cov.max(), 1e-30)))
    whiten = np.linalg.inv(
        np.linalg.cholesky(cov / np.outer(size, size) + 1e-6 * np.eye(len(cov)))
    )

    def left(b: np.ndarray, c: np.ndarray) -> np.ndarray:
        out = ((c - shown(b) @ slope) / size) @ whiten.T
        return np.clip(out, -_OUTLIER, _OUTLIER)

    return shown, left


def _slopes(
    off: np.ndarray, x: np.ndarray, r: np.ndarray, weight: np.ndarray
) -> list[np.ndarray]:
    """How what is left changes with parameters, ``(n, F, C)``, by two halves of the
    individuals, with the ridge with which they predict each other best."""
    halves = [np.arange(len(off)) % 2 == h for h in (0, 1)]
    sums = [_sums(off[h], x[h], r[h], weight[h]) for h in halves]
    best, found = -np.inf, []
    for ridge in _RIDGES:
        slopes = [_solved(*s, ridge) for s in sums]
        told = sum(
            _told(off[h], x[h], r[h], weight[h], v)
            for h, v in zip(halves, slopes[::-1], strict=True)
        )
        if told > best:
            best, found = told, slopes
    return found


def _sums(
    off: np.ndarray, x: np.ndarray, r: np.ndarray, weight: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Normal equations of a regression on ``off (N, n)`` times ``x (N, K, F)``."""
    weighed = x * weight[..., None]
    each = np.einsum("nkf,nkg->nfg", weighed, x, optimize=True)
    with_r = np.einsum("nkf,nkc->nfc", weighed, r, optimize=True)
    size = off.shape[1] * x.shape[-1]
    gram = np.einsum("na,nb,nfg->afbg", off, off, each, optimize=True)
    right = np.einsum("na,nfc->afc", off, with_r, optimize=True)
    return gram.reshape(size, size), right


def _solved(gram: np.ndarray, right: np.ndarray, ridge: float) -> np.ndarray:
    size = len(gram)
    more = ridge * np.trace(gram) / size * np.eye(size)
    return np.linalg.solve(gram + more, right.reshape(size, -1)).reshape(right.shape)


def _told(
    off: np.ndarray, x: np.ndarray, r: np.ndarray, weight: np.ndarray, v: np.ndarray
) -> float:
    """By how much slopes ``v`` lower the squared error of individuals they were not
    fitted to."""
    predicted = np.einsum("na,nkf,afc->nkc", off, x, v, optimize=True)
    return float(((r**2 - (r - predicted) ** 2) * weight[..., None]).sum())


def one_row_errors(
    simulated: Simulations,
    unit: np.ndarray,
    held: Pieces,
    key: jax.Array,
) -> tuple[np.ndarray, np.ndarray]:
    """Errors of predictions of the next reading, RMS of each channel ``(C,)``: of a
    log's pieces ``held``, and of simulations themselves, which is the least; not a
    number where too few simulations stay on their feet.

    The prediction is that of least squares in simulations of one machine, ``unit (n,)``
    in unit coordinates.
    """
    read, sound = simulated(np.tile(unit, (simulated.size, 1)), key)
    weight = read.weight * sound[:, None]
    half = np.arange(simulated.size) % 2 == 0
    if not (weight[half].any() and weight[~half].any()):
        nothing = np.full(read.change.shape[-1], np.nan)
        return nothing, nothing
    given = (x[half] for x in (read.before, read.change, weight))
    flat = (jnp.asarray(x.reshape(-1, *x.shape[2:])) for x in given)
    predicted = linear_prediction(*flat)

    def rms(p: Pieces, w: np.ndarray) -> np.ndarray:
        off = np.asarray(p.change - np.asarray(predicted(jnp.asarray(p.before)))) ** 2
        return np.sqrt((off * w[..., None]).reshape(-1, off.shape[-1]).sum(0) / w.sum())

    own = Pieces(read.before[~half], read.change[~half], read.weight[~half])
    return rms(held, np.asarray(held.weight)), rms(own, weight[~half])
