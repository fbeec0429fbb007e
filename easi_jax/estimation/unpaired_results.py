"""What a search on unpaired logs, and the fit after it, say."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import jax
import numpy as np

from easi_jax.estimation.emulator import (
    BEYOND,
    NOTHING,
    PRIOR,
    Known,
    Matched,
    matched,
    one_row_errors,
)
from easi_jax.estimation.identifiability import seed_result
from easi_jax.estimation.unpaired_runs import UnpairedProblem
from easi_jax.model.parameters import ParameterSpace
from easi_jax.model.results import HeldOutErrors, SeedResult
from easi_jax.progress import Tell
from easi_jax.search.unpaired import Pieces, Simulations, UnpairedSearch

_LACKING = 1.5  # times the squared error of simulations, that is worth a note
_EDGE = 1e-3  # unit coordinates
_SURE = 2.0  # standard deviations, that a delay is told from none
_MEASURE = (
    "RMS error of the next reading, predicted from the readings and commands of three "
    "rows by least squares in simulations of the model under the controller"
)


@dataclass(frozen=True)
class Found:
    """What one seed found, unit coordinates of the search's space.

    Attributes:
        mean, cov: ``(n,)``, ``(n, n)``.
        fit: what it is from; None of the search alone.
    """

    mean: np.ndarray
    cov: np.ndarray
    fit: Matched | None

    @cached_property
    def information(self) -> np.ndarray:
        """Of the log, without the initial range, ``(n, n)``; none of a search alone,
        whose spread shrinks whatever the log says."""
        if self.fit is None:
            return np.zeros_like(self.cov)
        values, vectors = np.linalg.eigh(np.linalg.inv(self.cov))
        return (vectors * np.maximum(values - PRIOR, 0.0)) @ vectors.T

    def space(self, search: UnpairedSearch) -> ParameterSpace:
        """The robot's parameters."""
        return search.simulator.space.with_scale(search.config.log_scale)

    def result(self, search: UnpairedSearch) -> SeedResult:
        """Of the robot's parameters, whatever the delays of readings are."""
        space = self.space(search)
        n = slice(space.size)
        mine = Found(self.mean[n], self.cov[n, n], self.fit)
        return seed_result(space, mine.mean, mine.cov, mine.information)

    def readings(self, search: UnpairedSearch) -> list[dict[str, Any]]:
        """How late readings come [s], and the standard deviation of that."""
        n, every = search.simulator.space.size, search.space
        value = np.asarray(every.to_si(self.mean), float)
        width = np.asarray(every.to_si(np.ones(every.size)), float) - np.asarray(
            every.to_si(np.zeros(every.size)), float
        )
        std = np.sqrt(np.diag(self.cov)) * width
        return [
            {"name": p.name, "value": value[i], "std": std[i], "unit": p.unit}
            for i, p in enumerate(every.parameters)
            if i >= n
        ]

    def notes(self, search: UnpairedSearch) -> list[str]:
        """What the user should know."""
        notes = []
        for r in self.readings(search):
            if r["value"] > _SURE * r["std"]:
                notes.append(
                    f"{r['name']}: {1e3 * r['value']:.2g} ms (standard deviation "
                    f"{1e3 * r['std']:.2g} ms)"
                )
        if self.fit is None:
            notes.append(
                "without a fit nothing says what the log determines: spreads are the "
                "search's own"
            )
            return notes
        beyond = np.abs(self.mean - 0.5) > 0.5 + BEYOND - _EDGE
        notes += [
            f"{name} ended at the edge of what the fit may reach: widen its initial "
            "range"
            for name, at in zip(search.space.names, beyond, strict=True)
            if at
        ]
        if self.fit.disagree:
            notes.append(
                "some readings ask for other values than others do, by more than their "
                "noise: the model lacks something, and spreads are widened by it"
            )
        if self.fit.excess > _LACKING:
            notes.append(
                f"the log errs from its prediction by {self.fit.excess**0.5:.2g} times "
                "as much as simulations do, so the model lacks something, and "
                "parameters take up part of that"
            )
        if self.fit.lost:
            notes.append(
                f"{self.fit.lost} simulations of the fit fell or were not finite"
            )
        return notes


def found_of(
    simulated: Simulations,
    pieces: Pieces,
    mean: jax.Array,
    cov: jax.Array,
    key: jax.Array,
    refined: bool,
    tell: Tell,
    known: Known = NOTHING,
) -> Found:
    """What a search at ``mean (n,)``, ``cov (n, n)`` found, with the fit after it where
    ``refined``; the other arguments as for `easi_jax.estimation.emulator.matched`."""
    if not refined:
        return Found(np.asarray(mean, float), np.asarray(cov, float), None)
    fit = matched(simulated, pieces, np.asarray(mean, float), key, tell, known)
    return Found(fit.mean, fit.cov, fit)


def held_out_errors(
    problem: UnpairedProblem, simulated: Simulations, found: Sequence[Found], key: Any
) -> HeldOutErrors:
    """Errors of predictions of the next reading on held-out runs."""
    space = simulated.search.space
    nominal = np.asarray(space.to_unit(space.nominal), float)
    held = problem.pieces(problem.held)
    before, _ = one_row_errors(simulated, nominal, held, key)
    pairs = [one_row_errors(simulated, f.mean, held, key) for f in found]
    fits = []
    if len(found) > 1:
        mine = problem.pieces(problem.fit)
        each = [one_row_errors(simulated, f.mean, mine, key) for f in found]
        fits = [_beside(*pair) for pair in each]
    return HeldOutErrors(
        what=problem.held_name,
        horizon=problem.env.dt,
        channels=list(problem.of.names),
        units=list(problem.of.units),
        before=before.tolist(),
        after=[error.tolist() for error, _ in pairs],
        floor=[floor.tolist() for _, floor in pairs],
        fit=fits,
        measure=_MEASURE,
    )


def _beside(error: np.ndarray, floor: np.ndarray) -> float:
    """Mean squared error beside its least, of channels that have one."""
    seen = floor > 0
    if not (seen.any() and np.isfinite(error).all()):
        return np.inf
    return float(np.mean((error[seen] / floor[seen]) ** 2))
