"""Which parameters, and which combinations of them, data determine."""

import re
from collections.abc import Sequence
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from easi_jax.estimation.least_squares import (
    AT_BOUND,
    CONVERGED,
    NOT_DETERMINED,
    OUTCOMES,
    flag_codes,
    raised_to_range,
    result_code,
)
from easi_jax.model.parameters import Parameter, ParameterSpace
from easi_jax.model.results import (
    LEAK,
    Flag,
    Outcome,
    SeedResult,
    Undetermined,
)

WEAK = 0.5  # std of a log ratio beyond which a direction is called undetermined
_ROUNDING = 1e-6  # eigenvalue of a correlation matrix that single precision makes
_ALONE = 0.998  # of a parameter's own direction unseen: it leaves no trace
_PART = 0.3  # of a mass in what is unseen: enough to settle a direction
_AT = 1e-3  # unit coordinates from a bound that count as at it


@dataclass(frozen=True)
class Identifiability:
    """What data of this kind can determine, near one parameter vector.

    Attributes:
        names: parameters.
        std: Cramer-Rao standard deviation of the log ratio (or, for a linear
            parameter, as a share of its initial range; for a logarithm below its
            initial range, as a share of the low end); inf where undetermined.
        rank: number of determined directions.
        undetermined: each a dict name -> coefficient: the parameters that can move
            together, in these proportions of their logarithms, unseen.
        determined: per parameter, whether the data fix it by itself.
        covariance: Cramer-Rao bound within the determined directions, unit
            coordinates, ``(n, n)``.
        null: orthonormal basis of the undetermined directions, scaled coordinates,
            ``(n, n - rank)``.
        scale: unit coordinate -> scaled coordinate factors, ``(n,)``.
    """

    names: tuple[str, ...]
    std: np.ndarray
    rank: int
    undetermined: tuple[dict[str, float], ...]
    determined: np.ndarray
    covariance: np.ndarray
    null: np.ndarray
    scale: np.ndarray

    def error(self, off: np.ndarray) -> float:
        """RMS of the part of ``off (n,)``, scaled coordinates (log ratios), that lies
        along the determined directions; NaN where there are none."""
        seen = off - self.null @ (self.null.T @ off)
        return float(np.sqrt((seen**2).sum() / self.rank)) if self.rank else np.nan


def identifiability(
    space: ParameterSpace, hessian: np.ndarray, weak: float = WEAK
) -> Identifiability:
    """Reads the Fisher information ``hessian (n, n)`` (unit coordinates).

    Directions are judged in log ratios, where one unit is a factor e.
    """
    scale = space.log_width  # d log(xi) / d unit, or 1 for linear parameters
    info = _resolved(np.asarray(hessian, np.float64)) / np.outer(scale, scale)
    values, vectors = np.linalg.eigh(info)
    seen = values > 1.0 / weak**2
    null = vectors[:, ~seen]
    safe = np.where(seen, values, np.inf)
    cov = (vectors / safe) @ vectors.T
    leak = np.sqrt((null**2).sum(1)) if null.size else np.zeros(len(scale))
    std = np.sqrt(np.diag(cov))
    determined = (leak < LEAK) & (std < weak)
    std = np.where(leak < LEAK, std, np.inf)
    return Identifiability(
        names=space.names,
        std=std,
        rank=int(seen.sum()),
        undetermined=tuple(
            {
                space.names[i]: float(v[i])
                for i in np.argsort(-np.abs(v))
                if abs(v[i]) > 0.05
            }
            for v in _readable_basis(null, forces(space))
        ),
        determined=determined,
        covariance=cov / np.outer(scale, scale),
        null=null,
        scale=scale,
    )


def _resolved(hessian: np.ndarray) -> np.ndarray:
    """Information ``(n, n)`` without what sums in single precision leave of nothing."""
    size = np.sqrt(np.maximum(np.diag(hessian), 1e-300))
    alike = 0.5 * (hessian + hessian.T) / np.outer(size, size)
    values, vectors = np.linalg.eigh(alike)
    kept = np.where(values > _ROUNDING, values, 0.0)
    return (vectors * kept) @ vectors.T * np.outer(size, size)


def forces(space: ParameterSpace) -> np.ndarray:
    """1 where a unit holds a mass or a force: what one common factor would scale."""
    bases = (re.findall(r"[A-Za-z]+", u.split("/")[0]) for u in space.units)
    return np.array([float(bool({"kg", "N", "Nm"} & set(b))) for b in bases])


def _readable_basis(null: np.ndarray, common: np.ndarray) -> list[np.ndarray]:
    """A basis of a subspace in the order in which people think of it.

    Parameters without any trace; the common scale of all masses and forces, if it is
    there; what is left, as sparse as can be.
    """
    n, count = null.shape
    singles = np.flatnonzero((null**2).sum(1) > _ALONE)[:count]
    parts = [np.eye(n)[i] for i in singles]
    scale = common.copy()
    scale[singles] = 0.0
    missed = scale - null @ (null.T @ scale)
    found = scale.sum() >= 2 and len(parts) < count
    found = found and np.linalg.norm(missed) < 0.05 * np.linalg.norm(scale)
    if found:
        parts.append(scale)
    if not parts:
        return _sparse_basis(null)
    if len(parts) == count:
        return parts
    used = np.linalg.qr(np.stack(parts, 1))[0]
    left = np.linalg.svd(null - used @ (used.T @ null))[0][:, : count - len(parts)]
    others = _sparse_basis(left)
    if found:
        others = [_without(v, scale) for v in others]
    return [*parts, *others]


def _without(v: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """``v`` less the multiple of ``scale`` that leaves the smallest sum of powers."""
    tries = [v - v[i] * scale for i in np.flatnonzero(scale)]
    best = min(tries, key=lambda x: float(np.abs(x).sum()))
    return best / np.max(np.abs(best))


def _sparse_basis(null: np.ndarray) -> list[np.ndarray]:
    """A readable basis of a subspace: each vector rid of the others' pivots."""
    rows = null.T.copy()
    done: list[int] = []
    for i in range(len(rows)):
        free = np.abs(rows[i]).copy()
        free[done] = 0
        pivot = int(np.argmax(free))
        rows[i] /= rows[i, pivot]
        for k in range(len(rows)):
            if k != i:
                rows[k] -= rows[k, pivot] * rows[i]
        done.append(pivot)
    return [r / np.max(np.abs(r)) for r in rows]


def describe(direction: dict[str, float]) -> str:
    """A sentence about one undetermined direction."""
    if len(direction) == 1:
        return f"{next(iter(direction))} leaves no trace in these data"
    rounded = {k: round(v, 2) for k, v in direction.items()}
    if all(abs(v - 1) < 0.05 for v in direction.values()):
        return f"{', '.join(rounded)} times one common factor change nothing"
    terms = ", ".join(f"{k}^{v:g}" for k, v in rounded.items())
    return f"moving together as {terms} changes nothing that these data show"


def flag_words(codes: np.ndarray) -> list[Flag]:
    """What may be believed of each parameter by itself, by `flag_codes`."""
    words: dict[int, Flag] = {CONVERGED: "determined", AT_BOUND: "at bound"}
    return [words.get(c, "not determined") for c in codes.tolist()]


def ended(names: Sequence[str], codes: np.ndarray) -> tuple[Outcome, str]:
    """How a fit ended that did not diverge, by `flag_codes`, and what it is about."""
    code = int(result_code(codes))
    at = ", ".join(n for n, c in zip(names, codes, strict=True) if c == AT_BOUND)
    reasons = {
        CONVERGED: "",
        AT_BOUND: f"{at}: wider bounds may fit better, where physics allows them",
        NOT_DETERMINED: f"the data determine none of {', '.join(names)}",
    }
    return OUTCOMES[code], reasons[code]


def seed_result(
    space: ParameterSpace,
    unit_mean: ArrayLike,
    unit_cov: ArrayLike,
    hessian: ArrayLike,
    unit_fit: ArrayLike | None = None,
) -> SeedResult:
    """One seed's result in SI units, and what may be believed of it.

    Args:
        unit_mean: ``(n,)``.
        unit_cov: ``(n, n)``.
        hessian: Fisher information, ``(n, n)``; all in unit coordinates.
        unit_fit: best fit, from which the initial range draws the mean, ``(n,)``: a fit
            may end at a bound where the mean does not.
    """
    ident = identifiability(space, np.asarray(hessian))
    mean, cov = np.asarray(unit_mean), np.asarray(unit_cov, float)
    below, above = _ends(space, mean, cov)
    low, high = (np.asarray(b) for b in space.unit_bounds)
    codes = flag_codes(mean, low, high, ident.determined, _AT)
    if unit_fit is not None:
        # Friction that is not there is no bound, nor is what no data hold back.
        fit = np.asarray(raised_to_range(space, jnp.asarray(unit_fit)))
        ends = flag_codes(fit, low, high, ident.determined, _AT)
        codes = np.where(ident.determined, ends, codes)
    outcome, reason = ended(space.names, codes)
    return SeedResult(
        mean=_si(space, mean).tolist(),
        std=(0.5 * (above - below)).tolist(),
        interval_68=np.stack([_within(space, x) for x in (below, above)], 1).tolist(),
        unit_mean=np.asarray(mean, float).tolist(),
        unit_covariance=cov.tolist(),
        flags=flag_words(codes),
        cramer_rao_std=ident.std.tolist(),
        determined_directions=ident.rank,
        undetermined=[Undetermined(d, describe(d)) for d in ident.undetermined],
        outcome=outcome,
        reason=reason,
    )


def settled(
    space: ParameterSpace, ident: Identifiability
) -> tuple[np.ndarray, list[int]]:
    """Masses and lengths that, once known, settle undetermined directions: an owner can
    weigh and measure those. Directions without them stay open.

    Returns:
        ``(n, k)``: how far each parameter moves with the ``k`` that are chosen, in
        scaled coordinates; their places.
    """
    alone = (ident.null**2).sum(1) > _ALONE
    free = np.where(alone[:, None], 0.0, ident.null)
    left, size, _ = np.linalg.svd(free, full_matrices=False)
    basis = left = left[:, size > _PART]
    nominal = np.asarray(space.to_unit(space.nominal), float)
    simple = np.array([_weighed(p) for p in space.parameters]) & np.isfinite(nominal)
    chosen: list[int] = []
    while basis.shape[1]:
        part = np.where(simple & ~alone, np.linalg.norm(basis, axis=1), 0.0)
        i = int(np.argmax(part))
        if part[i] < _PART:
            break
        chosen.append(i)
        # What is left of the directions with that parameter held.
        basis = basis @ np.linalg.svd(basis[i : i + 1])[2][1:].T
    gain = left @ np.linalg.pinv(left[chosen]) if chosen else np.zeros((len(left), 0))
    return gain, chosen


def _weighed(parameter: Parameter) -> bool:
    """Whether an owner can weigh or measure it: mass or size of a part of the model."""
    parts = all(a.startswith(("body.", "geom.")) for a in parameter.addresses)
    return parts and parameter.unit in ("kg", "m")


def _si(space: ParameterSpace, unit: np.ndarray) -> np.ndarray:
    return np.asarray(space.to_si(unit), float)


def _within(space: ParameterSpace, si: np.ndarray) -> np.ndarray:
    """SI values ``(n,)`` inside their bounds."""
    low, high = (_si(space, np.asarray(b, float)) for b in space.unit_bounds)
    return np.clip(si, low, high)


def _ends(
    space: ParameterSpace, unit_mean: np.ndarray, cov: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """One standard deviation below and above, SI, ``(n,)`` each."""
    std = np.sqrt(np.maximum(np.diag(cov), 0.0))
    return _si(space, unit_mean - std), _si(space, unit_mean + std)
