"""How well data would show each effect, and how far apart two effects would be.

Every effect changes the predictions of windows in its own way. The changes are divided
by what sensor noise does to the same windows, start states included, exactly as the gap
workflow weighs its errors; then the model's own refittable parameters are projected
out. What is left of one effect after the best fit of another is their distance in units
of noise: of two names so far apart the wrong one fits worse by half its square in
log-likelihood (S. Kay, *Fundamentals of Statistical Signal Processing II*, 1998, ch.
4 and 6).
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from easi_jax.gap.batched_least_squares import Bounds
from easi_jax.gap.predictor import Predictor
from easi_jax.gap.table import Place
from easi_jax.model.effect_catalog import CATALOG

_PARALLEL = 0.04  # sine of an angle that counts as none; slopes are differences
_SEEN = 1.0  # times the noise, below which an effect leaves no trace
_FAINT = 1e-6  # squared size of a change that counts as none
_RANK = 1e-9  # relative curvature that counts as none


@dataclass
class Design:
    """Which vectors to simulate, and what their differences say.

    A signature is a difference of the predictions of two vectors. Of an effect with a
    slope at zero it is the change by one size of each number; of one without (delay,
    deadband, saturation) also that by the effect at the strength it starts from.

    Attributes:
        predictor: whose vectors they are.
        bounds: limits and sizes of entries.
        base: the vector that everything is counted from, ``(n,)``.
        nuisance: entries that any fit moves as well.
        vectors: what to simulate.
        pairs: signatures, each the difference of two vectors.
        spans: for each start of an effect, the signatures that a fit from there mixes.
        truths: signatures of an effect at its strength.
        numbers: name, unit and size of each number that a fit moves.
        typical: which start belongs to the strength.
    """

    predictor: Predictor
    bounds: Bounds
    base: np.ndarray
    nuisance: Sequence[int]
    vectors: list[np.ndarray] = field(default_factory=list)
    pairs: list[tuple[int, int]] = field(default_factory=list)
    spans: dict[str, list[list[int]]] = field(default_factory=dict)
    truths: dict[str, list[int]] = field(default_factory=dict)
    numbers: dict[str, list[tuple[str, str, float]]] = field(default_factory=dict)
    typical: dict[str, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._known: dict[bytes, int] = {}
        self._vector(self.base)
        self.ignored = [self._slope(self.base, i) for i in self.nuisance]

    def _vector(self, x: np.ndarray) -> int:
        key = np.asarray(x, np.float64).tobytes()
        if key not in self._known:
            self._known[key] = len(self.vectors)
            self.vectors.append(np.asarray(x, np.float64))
        return self._known[key]

    def _pair(self, a: np.ndarray, b: np.ndarray) -> int:
        pair = (self._vector(a), self._vector(b))
        if pair not in self.pairs:
            self.pairs.append(pair)
        return self.pairs.index(pair)

    def _slope(self, x: np.ndarray, i: int) -> int:
        moved, size = x.copy(), self.bounds.size[i]
        up = x[i] + size <= self.bounds.high[i]
        moved[i] += size if up else -size
        # Either way round it is the change by plus one size.
        return self._pair(moved, x) if up else self._pair(x, moved)

    def add(self, place: Place, truth: np.ndarray | None = None) -> None:
        """Takes in an effect; two shapes of one name are one effect.

        Args:
            truth: the vector with the effect at its strength; by default one size of
                each of its numbers, or where it has no slope at zero the strength
                that a fit starts from.
        """
        layout = self.predictor.layout
        index = layout.where(place) + self.predictor.own
        moves = np.array(place.fitted)
        fitted = index[moves]
        none = layout.neutral[index - self.predictor.own]
        spans = self.spans.setdefault(place.key, [])
        first: list[list[int]] = []
        for start in place.starts:
            x = self.base.copy()
            x[index] = start
            slopes = [self._slope(x, int(i)) for i in fitted]
            if not np.array_equal(np.asarray(start)[moves], none[moves]):
                first.append([self._pair(x, self.base)])
                slopes = [*first[-1], *slopes]
            else:
                first.append(slopes)
            spans.append(slopes)
        if place.key in self.truths:
            return
        endless = any(c.neutral > c.high for c in place.columns)
        chosen = len(first) // 2 if endless else 0
        self.typical[place.key] = chosen
        self.truths[place.key] = first[chosen]
        if truth is not None:
            self.truths[place.key] = [self._pair(truth, self.base)]
        columns = [c for c, f in zip(place.columns, place.fitted, strict=True) if f]
        self.numbers[place.key] = [
            (c.parameter, c.unit, c.of * c.size) for c in columns
        ]


@dataclass(frozen=True)
class Separation:
    """What one set of data says, in units of noise.

    Attributes:
        keys: effects, ``effect@at``, K of them.
        visible: expected size of each effect in the data, own parameters refitted,
            ``(K,)``.
        apart: expected distance of effect i from the best fit of effect j,
            ``(K, K)``; on the diagonal that from nothing.
        std: expected standard deviation of each number of an effect, in its unit;
            infinite where undetermined.
    """

    keys: tuple[str, ...]
    visible: np.ndarray
    apart: np.ndarray
    std: dict[str, list[float]]


def _inverse(g: np.ndarray) -> np.ndarray:
    """Pseudo-inverse of a matrix of products, each row in its own unit."""
    size = np.sqrt(np.maximum(np.diag(g), 1e-300))
    return np.linalg.pinv(g / np.outer(size, size), rcond=_RANK, hermitian=True) / (
        np.outer(size, size)
    )


def _without(g: np.ndarray, gone: Sequence[int]) -> np.ndarray:
    """Products ``(K, K)`` of what is left when some signatures are projected out."""
    if not len(gone):
        return g
    index = np.asarray(gone)
    cross = g[:, index]
    return g - cross @ _inverse(g[np.ix_(index, index)]) @ cross.T


def separation(design: Design, products: np.ndarray) -> Separation:
    """Reads the products ``(P, P)`` of a design's signatures, in units of noise."""
    g = _without(products, design.ignored)
    keys = tuple(design.truths)
    owner = np.concatenate([[i] * len(design.truths[k]) for i, k in enumerate(keys)])
    truth = np.concatenate([design.truths[k] for k in keys])
    size = np.maximum(np.diag(g)[truth], 0.0)

    def mean(square: np.ndarray) -> np.ndarray:
        """Over the numbers of each effect."""
        return np.bincount(owner, square) / np.bincount(owner)

    visible = np.sqrt(mean(size))
    apart = np.zeros((len(keys), len(keys)))
    for j, b in enumerate(keys):
        left = []
        for span in map(np.array, design.spans[b]):
            cross = g[np.ix_(truth, span)]
            inverse = _inverse(g[np.ix_(span, span)])
            took = np.einsum("ts,su,tu->t", cross, inverse, cross)
            left.append(mean(np.clip(size - took, 0.0, None)))
        apart[:, j] = np.sqrt(np.min(left, 0))
    np.fill_diagonal(apart, visible)
    return Separation(keys, visible, apart, _deviations(design, g))


def _deviations(design: Design, g: np.ndarray) -> dict[str, list[float]]:
    out = {}
    for key in design.truths:
        sizes = [s for _, _, s in design.numbers[key]]
        slopes = np.array(design.spans[key][design.typical[key]][-len(sizes) :])
        inner = g[np.ix_(slopes, slopes)]
        inverse = _inverse(inner)
        # A number that others of the same effect take over is not determined.
        known = np.diag(inverse @ inner) > 0.99
        var = np.where((np.diag(inner) > _FAINT) & known, np.diag(inverse), np.inf)
        out[key] = [float(np.sqrt(v) * s) for v, s in zip(var, sizes, strict=True)]
    return out


@dataclass(frozen=True)
class Alike:
    """What no data that were tried can tell.

    Attributes:
        unseen: effects that leave no trace, ``(K,)`` bool.
        same: effect i looks like a case of effect j, ``(K, K)`` bool.
    """

    unseen: np.ndarray
    same: np.ndarray


def alike(found: Sequence[Separation]) -> Alike:
    """What holds in all of several data sets."""
    visible = np.stack([s.visible for s in found])
    apart = np.stack([s.apart for s in found])
    seen = np.asarray(visible > _SEEN)
    sine = apart / np.maximum(visible, 1e-12)[:, :, None]
    sine = np.where(seen[:, :, None], sine, 0.0).max(0)
    ever = np.any(seen, axis=0)
    same = (sine < _PARALLEL) & ever[:, None]
    np.fill_diagonal(same, False)
    # What an effect contains it can do too; of two such names the simpler is taken.
    for j, key in enumerate(found[0].keys):
        effect, at = key.split("@", 1)
        less = f"{CATALOG[effect].contains}@{at}"
        if less in found[0].keys:
            same[found[0].keys.index(less), j] = True
    return Alike(~ever, same)


def nearest_rival(s: Separation, known: Alike) -> tuple[np.ndarray, np.ndarray]:
    """Distance of each effect from its nearest rival, and which that is; ``(K,)``.

    The rival -1 is nothing at all. Rivals that no data tell apart are left out.
    """
    apart = np.where(known.same, np.inf, s.apart)
    rival = apart.argmin(1)
    rival = np.where(rival == np.arange(len(rival)), -1, rival)
    return apart.min(1), rival


def soft_minimum(distances: np.ndarray) -> float:
    """One number for several distances in units of noise, near the smallest ones.

    ``1 / mean(1 / (1 + d)) - 1``: a distance of nothing counts, but does not decide
    alone.
    """
    if not len(distances):
        return 0.0
    return float(1.0 / np.mean(1.0 / (1.0 + distances)) - 1.0)
