"""From measured runs to an estimate: the search's data, and its finish."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from easi_jax.data import unmeasured
from easi_jax.data.activations import activation_spread
from easi_jax.data.noise import finest, resolution_of, resolutions
from easi_jax.data.recording import Run
from easi_jax.data.scales import scales_of
from easi_jax.data.segments import Segments, to_device
from easi_jax.data.sensor_channels import NO_SENSORS, Sensors
from easi_jax.data.velocity_lag import noise_in_starts
from easi_jax.devices import distributed
from easi_jax.devices.mesh import placed
from easi_jax.devices.runtime import quick_compile
from easi_jax.estimation import limits, step_error
from easi_jax.estimation.blocks import too_few
from easi_jax.estimation.contradictions import (
    Recording,
    compared,
    contradictions,
    held_apart,
)
from easi_jax.estimation.doubts import Doubts, all_doubts, doubts_of, shown, told
from easi_jax.estimation.least_squares import raised_to_range
from easi_jax.estimation.normal_equations import PairedFit
from easi_jax.estimation.pieces import effective_noise, few, segments_from_runs
from easi_jax.estimation.posterior import (
    Estimate,
    begun,
    diverged,
    no_region,
    polished,
    widened,
)
from easi_jax.estimation.prediction_error import (
    believed,
    misfit_of,
    outlier_weights,
    white_noise,
)
from easi_jax.estimation.problem import Problem
from easi_jax.estimation.step_error import error_of_steps, is_visible, widened_by
from easi_jax.estimation.weights import readings, step_weights
from easi_jax.progress import Tell
from easi_jax.search.config import SearchConfig
from easi_jax.search.easi import Search, SearchData
from easi_jax.simulation.slopes import shift_readings

Notes = Callable[[int], list[str]]

# Pieces of a generation at least, and physics steps that are worth their time; a piece
# of a larger robot tells more, and each of its steps takes longer.
_SEARCH, _WIDE_SEARCH = (16, 500_000), (4, 100_000)
# At most, of the finish: the model's own error is learned from the one before. And on
# all pieces, with all doubts.
_PASSES, _ENDINGS = 3, 2
_ALIKE = 0.1  # of what readings count: to less than that it is learned already
_ROBUST = 12  # rounds of the first pass; later ones know which pieces fit badly
_LACKING = 1.5  # times wider spreads, that are worth a note
_LEFT = 0.1  # of the rows, that may be in runs shorter than a piece
_FINISH = 0.5  # s, of pieces in the least-squares finish
# Quarters of a second that it begins with for larger robots, which are slow: enough to
# find the valley, for the last steps take all.
_FEW = 24
_READABLE = 8  # steps at least of pieces whose errors tell the noise
_OUTLIER = 2.5  # times the median error: windows beyond it weigh less


def replayed(problem: Problem, config: SearchConfig) -> SearchConfig:
    """Settings that replay the problem's pieces, as many a generation as pay."""
    cost = config.population * problem.piece * problem.simulator.substeps
    wide = problem.simulator.wide
    least, steps = _WIDE_SEARCH if wide else _SEARCH
    segments = max(least, min(config.segments, steps // cost))
    return replace(config, source="replay", horizon=problem.piece, segments=segments)


def search_data(problem: Problem) -> SearchData:
    """Pieces of the runs to fit, twice over, and their noise."""
    pieces = segments_from_runs(
        problem.simulator, problem.fit, problem.piece, max(1, problem.piece // 2)
    )
    hidden = np.isinf(problem.noise)
    # Where a start is hidden, how far it may be off.
    spread = unmeasured.start_spread(problem.simulator.mj_model, problem.fit)
    noise = np.where(hidden, spread, problem.noise)
    return SearchData(
        segments=to_device(pieces),
        noise=jnp.asarray(noise, jnp.result_type(float)),
        hidden=jnp.asarray(hidden) if hidden.any() else (),
    )


def start_spread(problem: Problem, noise: jax.Array) -> jax.Array:
    """What the problem's logs know of starts, ``(2 nv + na,)``: `spread_of_starts`, of
    measured velocities what they are off by beside the positions as well
    (`easi_jax.data.velocity_lag.noise_in_starts`): an error of their gain is no
    noise."""
    m, runs = problem.simulator.mj_model, problem.fit
    spread = spread_of_starts(m, runs, noise, problem.measured)
    if not problem.measured.any():
        return spread
    speeds = slice(m.nv, 2 * m.nv)
    off = noise_in_starts(m, runs, np.asarray(spread[: 2 * m.nv], float))
    # Of runs too short to tell, anything that occurs.
    off = np.where(np.isfinite(off), off, _rms_speed(runs))
    read = np.maximum(np.asarray(spread[speeds]), off)
    return spread.at[speeds].set(jnp.where(problem.measured, read, spread[speeds]))


def spread_of_starts(
    m: mujoco.MjModel, runs: Sequence[Run], noise: jax.Array, measured: np.ndarray
) -> jax.Array:
    """What logs know of where a piece starts, standard deviations ``(2 nv + na,)``.

    A reading is as good as its ``noise (2 nv,)``. Velocities that come from positions
    say nothing that the rows of a piece do not say again, so they may be anything that
    occurs; so may what is hidden, whose noise is infinite
    (`easi_jax.data.unmeasured.start_spread`), and activations
    (`easi_jax.data.activations.activation_spread`). ``measured (nv,)`` says which
    velocities were.
    """
    moving = _rms_speed(runs)
    hidden = np.isinf(np.asarray(noise))
    wide = unmeasured.start_spread(m, runs, hidden[: m.nv])
    position, velocity = np.split(np.where(hidden, wide, np.asarray(noise)), 2)
    derived = ~measured & ~hidden[m.nv :]
    return jnp.concatenate(
        [
            position,
            np.where(derived, np.hypot(velocity, moving), velocity),
            activation_spread(m, runs),
        ],
        dtype=jnp.result_type(float),
    )


def _rms_speed(runs: Sequence[Run]) -> np.ndarray:
    return np.sqrt(np.mean(np.concatenate([r.qvel for r in runs]) ** 2, 0))


def ready_finish(
    problem: Problem,
    search: Search,
    refined: bool = True,
    restarts: int = 0,
    tell: Tell = lambda _: None,
) -> Callable[[jax.Array, jax.Array], tuple[list[Estimate], Notes]]:
    """Compiles the finish.

    Args:
        problem: the measured runs.
        search: whose end it starts from.
        refined: whether to fit by least squares; else the search's mean is kept.
        restarts: more starts of the fit; the best counts.
        tell: takes a line on how far it is.

    Returns:
        Takes means ``(S, n)`` and covariances ``(S, n, n)`` of searches, unit
        coordinates, and returns an `Estimate` each, and what gives the notes of one,
        by its number, that did not diverge: on pieces and runs that fit badly, and on
        what the model lacks.
    """
    finish = _Finish(problem, search, refined, restarts, tell)
    finish.compile()

    def estimates(means: Any, covs: Any) -> tuple[list[Estimate], Notes]:
        every = [finish.passes(*both) for both in zip(means, covs, strict=True)]
        return [found for found, _ in every], lambda k: finish.notes(*every[k])

    return estimates


@dataclass(frozen=True)
class _Last:
    """Where the last steps are.

    Attributes:
        found: so far.
        weight: of each piece by how well it fits, ``(M,)``; ``weighed`` the pieces.
        misfit: what the model errs by, and ``noise`` of the readings.
        begun: the fit before any last steps, ``(n,)``.
    """

    found: Estimate
    weight: jax.Array
    weighed: Segments
    misfit: jax.Array
    noise: jax.Array
    begun: jax.Array


class _Finish:
    """The programs of a finish and what they are given.

    Attributes:
        whole: all pieces, M of them; `pieces` those that many trials are made with.
        owner: recording of each of ``whole``, ``(M,)``; ``apart`` are recordings of
            which all is held out.
        simulator: reads ``sensors``, N numbers, that are fitted as well.
        told: noise as the rows tell it: where motion is rough, too much; ``least``
            what the resolution makes.
        hidden: misfit that leaves out velocities that were derived from positions,
            ``(H, 2 nv + N)``.
        doubts: what the model may lack; None where nothing is refined.
        lacking: what it may lack as well where it errs by more than the noise, or
            what is in doubt shows.
    """

    def __init__(
        self,
        problem: Problem,
        search: Search,
        refined: bool,
        restarts: int,
        tell: Tell,
    ) -> None:
        self.problem, self.search, self.tell = problem, search, tell
        self.refined, self.restarts = refined, restarts
        self.sensors = problem.fitted_sensors if refined else NO_SENSORS
        simulator = problem.sensing if refined else problem.simulator
        self.simulator = simulator
        self.doubts = doubts_of(simulator, search.space) if refined else None
        widest = self.lacking or self.doubts if refined else None
        self.endings: dict[tuple[Doubts | None, int], Any] = {}
        # With commands before each piece, where one that comes late needs them.
        cutting = widest.simulator if widest else simulator
        steps = max(problem.steps, round(_FINISH / simulator.dt))
        steps = min(steps, _most_steps([len(r) for r in problem.fit], problem.steps))
        # Twice over, each counted half: where pieces begin matters less. A piece has a
        # row more than steps, its start's, which counts in the prior of that: with an
        # even number of rows each one is in two pieces.
        self.steps = max(1, steps - (steps + 1) % 2)
        every = (self.steps + 1) // 2
        given = cutting, problem.fit, self.steps, every
        whole = to_device(segments_from_runs(*given, sensors=self.sensors))
        self.whole = replace(whole, weight=0.5 * whole.weight)
        runs = problem.fit, problem.held
        cut = cutting, runs, self.steps, every, self.sensors
        self.apart = held_apart(self.whole, *cut) if refined else []
        starts = [len(range(0, len(r) - self.steps, every)) for r in problem.fit]
        self.owner = np.repeat([r.recording for r in problem.fit], starts)
        self.pieces = few(simulator, self.whole, _FEW) if refined else self.whole
        noise = np.concatenate([problem.noise, self.sensors.noise(problem.fit)[0]])
        self.told = jnp.asarray(noise, jnp.result_type(float))
        self.least = jnp.asarray(_resolution_noise(problem, self.sensors))
        limited = limits.of(search.space)
        self.limited = np.isin(np.arange(search.space.size), limited)
        # Velocities derived from the positions say nothing that those do not.
        nv, count = simulator.mj_model.nv, len(self.sensors)
        seen = np.concatenate([np.ones(nv), problem.measured, np.ones(count)])
        hidden = np.broadcast_to(
            np.where(seen > 0, 0.0, np.inf), (self.steps, len(seen))
        )
        self.hidden = jnp.asarray(hidden, self.told.dtype)

    def compile(self) -> None:
        """Compiles both programs beside each other; the second where it is needed."""
        ending = None
        if self.refined:
            ending = distributed.started(lambda: self.ending(self.doubts))
        n, known = self.search.space.size, self.known(self.told)
        like = jnp.zeros(n), jnp.eye(n), self.pieces, self.hidden, known, _ROBUST, False
        self._fit = jax.jit(self.fit).lower(*placed(like)).compile(quick_compile())
        if ending is not None:
            ending()

    @cached_property
    def lacking(self) -> Doubts | None:
        """Of the logs, in which something is missing."""
        m = self.simulator.mj_model
        scales = scales_of(m, self.problem.fit)
        return all_doubts(self.simulator, self.search.space, scales)

    @cached_property
    def error_of_steps(self) -> Callable[[Any, Segments, Any], jax.Array]:
        """What the model's own physics steps do to predictions of pieces."""
        return error_of_steps(self.problem.simulator)

    def ending(self, doubts: Doubts | None, count: int | None = None) -> Any:
        """The compiled last steps with ``doubts``, on all pieces or ``count`` of
        them."""
        count = self.whole.count if count is None else count
        if (doubts, count) not in self.endings:
            n, known = self.search.space.size, self.known(self.told)
            pieces = self.whole.take(slice(count))
            like = placed((jnp.zeros(n), jnp.eye(n), pieces, self.hidden, known))
            program = jax.jit(partial(self.end, doubts)).lower(*like)
            self.endings[doubts, count] = program.compile(quick_compile())
        return self.endings[doubts, count]

    def known(self, noise: jax.Array) -> tuple[jax.Array, jax.Array]:
        """The noise, and what is known of starts."""
        assumed = effective_noise(self.simulator, self.whole, noise)
        motion = assumed[: len(self.problem.noise)]
        return noise, start_spread(self.problem, motion)

    def paired(self, pieces: Any, misfit: Any, known: Any) -> PairedFit:
        """What is fitted."""
        search, (noise, start) = self.search, known
        return PairedFit(
            *(self.simulator, search.space, pieces, noise, search.mesh),
            start=start,
            misfit=misfit,
        )

    def fit(
        self,
        mean: Any,
        cov: Any,
        pieces: Any,
        misfit: Any,
        known: Any,
        robust: Any,
        near: Any,
    ) -> Estimate:
        """A fit from ``mean``."""
        paired = self.paired(pieces, misfit, known)
        found = begun(
            *(paired, mean, cov, self.refined),
            *(self.search.config.informed_spread, robust, near, self.restarts),
        )
        if self.refined:
            return found
        # Its starts are corrected once, which nothing has looked at.
        return replace(found, residuals=paired.residuals(found.fit, found.delta))

    def end(
        self,
        doubts: Doubts | None,
        center: Any,
        cov: Any,
        whole: Any,
        misfit: Any,
        known: Any,
    ) -> Estimate:
        """The last steps, on all pieces and with ``doubts``."""
        informed = self.search.config.informed_spread
        given = self.paired(whole, misfit, known), center, cov, informed
        return polished(*given, doubts=doubts)

    def passes(self, mean: Any, cov: Any) -> tuple[Estimate, jax.Array]:
        """The finish of one search, and the weights that its pieces end with."""
        center, pieces = mean, self.pieces
        # What sensors read is taken for what the fit to the motion leaves of it.
        motion = jnp.arange(len(self.told)) < len(self.problem.noise)
        misfit = jnp.where(motion, self.hidden, jnp.inf)
        weighed, noise = pieces, self.told
        # The last steps on all pieces learn it, too.
        fewer = self.refined and pieces.count < self.whole.count
        passes = _PASSES - 1 if fewer else _PASSES
        counts = self.counted(weighed, noise, misfit)
        for k in range(passes):
            robust, near = 0 if k else _ROBUST, k > 0
            given = center, cov, weighed, misfit, self.known(noise), robust, near
            found = distributed.local(self._fit(*placed(given)))
            noise = self.learned(found)
            misfit, weight = self.judged(found, weighed, pieces, noise)
            weighed = replace(pieces, weight=pieces.weight * weight)
            center = jax.block_until_ready(found.fit)
            self.tell(f"least-squares finish: pass {k + 1} of at most {passes}")
            before, counts = counts, self.counted(weighed, noise, misfit)
            if self.alike(before, counts):
                break
        if not self.refined or self.lost(found):
            return replace(found, search_cov=cov), weight
        if fewer:
            weighed = self.whole
        undoubted = _Last(found, weight, weighed, misfit, noise, found.fit)
        last = self.ended(undoubted, cov, self.doubts, "", self.lacks)
        if self.lacks(last.found):
            more = ", with more in doubt"
            last = self.ended(last, cov, self.lacking, more, self.beyond)
        if self.beyond(last.found) and last.found.doubted:
            # Nobody knows what it lacks: then what predicts best by itself, which is
            # near where the fit was before anything else could take up errors.
            last = self.ended(undoubted, cov, None, ", as the model is", self.lost)
        found = last.found
        if not self.lost(found) and not self.beyond(found):
            found = self.of_steps(found, cov)
        return replace(found, search_cov=cov), last.weight

    def ended(
        self,
        last: _Last,
        cov: Any,
        doubts: Doubts | None,
        what: str,
        over: Callable[[Estimate], bool],
    ) -> _Last:
        """The last steps on all pieces with ``doubts``; fewer where they are ``over``,
        since others follow."""
        counts = self.counted(last.weighed, last.noise, last.misfit)
        for k in range(_ENDINGS):
            known, at, begun = self.known(last.noise), last.found.fit, last.begun
            # From a plateau nothing leads back.
            lost = self.limited & np.asarray(limits.unmet(last.found.hessian))
            at = jnp.where(lost, begun, at)
            if k == 0:  # nor from where a value is as good as zero
                at = raised_to_range(self.search.space, at)
            given = at, cov, last.weighed, last.misfit, known
            found = distributed.local(self.ending(doubts)(*placed(given)))
            noise = self.learned(found)
            misfit, weight = self.judged(found, last.weighed, self.whole, noise)
            weighed = replace(self.whole, weight=self.whole.weight * weight)
            found = jax.block_until_ready(found)
            last = _Last(found, weight, weighed, misfit, noise, begun)
            self.tell(f"on all of the logs{what}: pass {k + 1} of at most {_ENDINGS}")
            before, counts = counts, self.counted(weighed, noise, misfit)
            if self.lost(found) or over(found) or self.alike(before, counts):
                break
        return last

    def of_steps(self, found: Estimate, cov: Any) -> Estimate:
        """What is stated with the model's own physics steps in doubt."""
        error = self.error_of_steps(found.fit, found.pieces, found.delta)
        if not is_visible(found, error):
            return found
        pieces = shift_readings(self.simulator, found.pieces, error)
        given = found.fit, cov, pieces, found.misfit, (found.noise, found.start)
        other = self.ending(self.doubts_in(found))(*placed(given))
        self.tell("on all of the logs, as the model's timestep would have made them")
        other = distributed.local(other)
        return (
            found if self.lost(other) else widened_by(self.search.space, found, other)
        )

    def doubts_in(self, found: Estimate) -> Doubts | None:
        """The doubts that an estimate was made with."""
        made = {d.parameters if d else (): d for d, _ in self.endings}
        return made[found.doubted]

    def beyond(self, found: Estimate) -> bool:
        """Whether no region can be stated."""
        return bool(no_region(found))

    def lacks(self, found: Estimate) -> bool:
        """Whether the model surely errs by more than the noise, or what is in doubt is
        there, and may be of another kind; and more can be in doubt than was."""
        lacks = float(widened(found.excess)) > _LACKING
        doubts = np.asarray(found.doubts, float)
        lacks |= bool(shown(found.doubted, doubts, self.step))
        if not lacks or self.lost(found) or self.lacking is None:
            return False
        return self.lacking.count > len(found.doubted)

    @property
    def step(self) -> float:
        """Of the physics [s]."""
        return self.simulator.dt / self.simulator.substeps

    def lost(self, found: Estimate) -> bool:
        """Whether a fit is none."""
        return bool(diverged(found, self.search.space.names))

    def learned(self, found: Estimate) -> jax.Array:
        """Noise ``(2 nv + N,)`` as what a fit leaves shows it, where that is no more
        than rows alone tell; as it was given, if it was."""
        runs, error = self.problem.fit, found.residuals
        smooth = any(r.smoothed or r.stamps is not None for r in runs)
        if self.problem.noise_given or smooth or error.shape[1] < _READABLE:
            return self.told
        there = readings(found.pieces, error.shape[2])
        return believed(white_noise(error, there), self.told, self.least)

    def judged(
        self,
        found: Estimate,
        weighed: Segments,
        pieces: Segments,
        noise: jax.Array,
    ) -> tuple[jax.Array, jax.Array]:
        """What the model errs by, and new weights, from what a fit leaves."""
        assumed = effective_noise(self.simulator, pieces, noise)
        error = found.residuals
        there = readings(pieces, error.shape[2])
        counts = weighed.weight[:, None, None] * there
        misfit = jnp.maximum(misfit_of(error, assumed, counts), self.hidden)
        return misfit, outlier_weights(error, assumed, misfit, _OUTLIER, there)

    def counted(
        self, pieces: Segments, noise: jax.Array, misfit: jax.Array
    ) -> np.ndarray:
        """What each reading counts in a fit, ``(M, H, 2 nv + N)``."""
        assumed = effective_noise(self.simulator, pieces, noise)
        return np.asarray(step_weights(pieces, assumed, misfit) / assumed**2)

    def alike(self, before: np.ndarray, now: np.ndarray) -> bool:
        """Whether readings count what they did, so that a fit would be the same."""
        moved, size = np.abs(now - before).sum((0, 1)), before.sum((0, 1))
        return bool((moved <= _ALIKE * size).all())

    def notes(self, found: Estimate, weight: jax.Array) -> list[str]:
        """What fits badly, and what the model lacks."""
        notes = []
        odd = np.flatnonzero(np.asarray(weight) < 0.5)
        if odd.size:
            notes.append(
                f"{odd.size} of {len(weight)} pieces of "
                f"{self.steps * self.problem.simulator.dt:g} s "
                "fit much worse than the rest and weigh less than half "
                "(a bump, a wrong reading, or motion that the model lacks)"
            )
        fit = self.problem.fit
        short = [run for run in fit if len(run) <= self.steps]
        if short:
            rows = sum(map(len, short)), sum(map(len, fit))
            notes.append(
                f"{len(short)} of {len(fit)} runs ({rows[0]} of {rows[1]} rows) are "
                f"shorter than a piece of {self.steps * self.problem.simulator.dt:.3g} "
                "s, and are not fitted"
            )
        times, why = float(widened(found.excess)), no_region(found)
        if why:
            notes.append(why)
        elif times > _LACKING:
            notes.append(
                "the model errs by more than the noise explains, so it lacks "
                "something, and parameters take up part of that: their spreads are "
                f"{times:.2g} times as wide for it. train.gap with these logs names "
                "what is missing; then give --effects"
            )
        early = dict.fromkeys(n.sensor for n in self.sensors if n.at_end)
        if early:
            notes.append(
                "sensors read before the command of their row was sent: "
                f"{', '.join(early)}; compared as such"
            )
        notes += too_few(self.whole.count, "pieces") if self.refined else []
        notes += told(found.doubted, np.asarray(found.doubts, float), self.step)
        notes += step_error.notes(self.search.space, found, self.step)
        return notes + self.contradictions(found, weight)

    def contradictions(self, found: Estimate, weight: jax.Array) -> list[str]:
        """Notes on recordings that lead elsewhere than all of them together do; of many
        those that fit worst are looked at, and held-out ones."""
        if not self.refined:
            return []
        # A larger robot's program for fewer pieces is compiled in less time than the
        # others take; one of a smaller robot is there.
        few = self.simulator.wide
        given = self.whole, self.owner, np.asarray(weight), self.apart, few
        doubts = self.doubts_in(found)

        def by_itself(recording: Recording) -> Estimate:
            pieces = recording.pieces
            end = self.ending(doubts, pieces.count if few else None)

            def ended(weighed: Segments) -> Estimate:
                start, known = (found.fit, found.search_cov), (found.noise, found.start)
                return distributed.local(
                    end(*placed((*start, weighed, found.misfit, known)))
                )

            self.tell(f"{recording.name} by itself, beside the others")
            alone = ended(pieces)
            if not recording.held or self.lost(alone):
                return alone
            # Its pieces have not been weighed by how well they fit.
            weight = self.judged(alone, pieces, pieces, found.noise)[1]
            return ended(replace(pieces, weight=pieces.weight * weight))

        return contradictions(self.search.space, compared(*given), found, by_itself)


def _most_steps(rows: Sequence[int], least: int) -> int:
    """Steps of a piece at most, of runs with so many ``rows``: nine rows in ten are in
    runs that are as long; ``least`` steps where any run has them."""
    size = np.sort(rows)
    some = size[np.cumsum(size) > _LEFT * size.sum()][0]
    return max(int(some) - 1, min(least, int(size[-1]) - 1))


def _resolution_noise(problem: Problem, sensors: Sensors) -> np.ndarray:
    """What the resolution of readings makes of noise, ``(2 nv + N,)``."""
    runs, measured = problem.fit, problem.measured
    position = resolutions(runs)
    velocity = finest([resolution_of(run.qvel) for run in runs])
    sensed = sensors.finest(runs)
    step = [position, np.where(measured, velocity, 0.0), sensed]
    return np.concatenate(step) / math.sqrt(12.0)
