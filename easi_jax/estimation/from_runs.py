"""From measured runs to an estimate: the search's data, and its finish."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from easi_jax.data import unmeasured
from easi_jax.data.activations import activation_guess, activation_spread
from easi_jax.data.recording import Run
from easi_jax.data.segments import to_device
from easi_jax.devices import distributed
from easi_jax.devices.mesh import make_mesh, placed, replicated
from easi_jax.devices.runtime import quick_compile
from easi_jax.estimation.pieces import effective_noise, few, segments_from_runs
from easi_jax.estimation.posterior import Estimate, estimate, polished, widened
from easi_jax.estimation.prediction_error import (
    errors_and_floor,
    misfit_of,
    outlier_weights,
)
from easi_jax.estimation.problem import Problem
from easi_jax.model.joint_space import tangent_units
from easi_jax.model.parameters import ParameterSpace
from easi_jax.model.results import HeldOutErrors
from easi_jax.search.config import SearchConfig
from easi_jax.search.easi import Search, SearchData
from easi_jax.simulation import open_loop
from easi_jax.simulation.slopes import shift_start

Tell = Callable[[str], None]

_STEPS = 500_000  # physics steps in a generation that are worth their time
_PASSES = 3  # of the finish: the model's own error is learned from the one before
_ENDINGS = 2  # of a larger robot's, on all pieces
_ROBUST = 12  # rounds of the first pass; later ones know which pieces fit badly
_LACKING = 1.5  # times wider spreads, that are worth a note
_FINISH = 0.5  # s, of pieces in the least-squares finish
_OUTLIER = 2.5  # times the median error: windows beyond it weigh less


def replayed(problem: Problem, config: SearchConfig) -> SearchConfig:
    """Settings that replay the problem's pieces, as many a generation as pay."""
    cost = config.population * problem.piece * problem.simulator.substeps
    segments = max(16, min(config.segments, _STEPS // cost))
    return replace(config, source="replay", horizon=problem.piece, segments=segments)


def search_data(problem: Problem) -> SearchData:
    """Pieces of the runs to fit, twice over, and their noise."""
    pieces = segments_from_runs(
        problem.simulator, problem.fit, problem.piece, max(1, problem.piece // 2)
    )
    hidden = np.isinf(problem.noise)
    noise = _with_start_spread(problem)
    return SearchData(
        segments=to_device(pieces),
        noise=noise,
        hidden=jnp.asarray(hidden) if hidden.any() else (),
    )


def _with_start_spread(problem: Problem) -> jax.Array:
    """Noise ``(2 nv,)``, and where a start is hidden how far it may be off."""
    spread = unmeasured.start_spread(problem.simulator.mj_model, problem.fit)
    noise = np.where(np.isfinite(problem.noise), problem.noise, spread)
    return jnp.asarray(noise, jnp.result_type(float))


def start_spread(problem: Problem, noise: jax.Array) -> jax.Array:
    """What the problem's logs know of starts, ``(2 nv + na,)``: `spread_of_starts`."""
    m = problem.simulator.mj_model
    return spread_of_starts(m, problem.fit, noise, problem.measured)


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
    moving = np.sqrt(np.mean(np.concatenate([r.qvel for r in runs]) ** 2, 0))
    hidden = np.isinf(np.asarray(noise))
    wide = unmeasured.start_spread(m, runs, hidden[: m.nv])
    position, velocity = np.split(np.where(hidden, wide, np.asarray(noise)), 2)
    derived = ~measured & ~hidden[m.nv :]
    guesses = [activation_guess(m, run) for run in runs]
    return jnp.concatenate(
        [
            position,
            np.where(derived, np.hypot(velocity, moving), velocity),
            activation_spread(m, runs, guesses),
        ],
        dtype=jnp.result_type(float),
    )


def ready_finish(
    problem: Problem,
    search: Search,
    refined: bool = True,
    restarts: int = 0,
    tell: Tell = lambda _: None,
) -> Callable[[jax.Array, jax.Array], tuple[list[Estimate], list[str]]]:
    """Compiles the finish.

    Args:
        problem: the measured runs.
        search: whose end it starts from.
        refined: whether to fit by least squares; else the search's mean is kept.
        restarts: more starts of the fit; the best counts.
        tell: takes a line on how far it is.

    Returns:
        Takes means ``(S, n)`` and covariances ``(S, n, n)`` of searches, unit
        coordinates, and returns an `Estimate` each, and notes on pieces that fit badly.
    """
    simulator, space = problem.simulator, search.space
    steps = max(problem.steps, round(_FINISH / simulator.dt))
    steps = min(steps, max(len(r) for r in problem.fit) - 1)
    # Twice over, each counted half: where pieces begin matters less.
    every = max(1, steps // 2)
    whole = to_device(segments_from_runs(simulator, problem.fit, steps, every))
    whole = replace(whole, weight=whole.weight * every / steps)
    pieces = few(simulator, whole) if refined else whole
    more = pieces.count < whole.count
    noise = jnp.asarray(problem.noise, jnp.result_type(float))
    # Velocities derived from the positions say nothing that those do not.
    seen = jnp.asarray(
        np.concatenate([np.ones(simulator.mj_model.nv), problem.measured])
    )
    hidden = jnp.where(seen > 0, 0.0, jnp.inf)
    start = start_spread(problem, effective_noise(simulator, whole, noise))

    def finish(
        mean: Any, cov: Any, pieces: Any, misfit: Any, robust: Any, near: Any
    ) -> Any:
        found = estimate(
            simulator,
            space,
            mean,
            cov,
            pieces,
            noise,
            refined,
            search.config.informed_spread,
            search.mesh,
            misfit,
            robust,
            near=near,
            restarts=restarts,
            start=start,
        )
        return found, errors(found, pieces)

    def ending(center: Any, cov: Any, whole: Any, misfit: Any) -> Any:
        how = search.config.informed_spread, search.mesh, misfit
        given = simulator, space, center, cov, whole, noise
        found = polished(*given, *how, start=start)
        return found, errors(found, whole)

    def errors(found: Any, pieces: Any) -> Any:
        model = simulator.model(space.to_si(found.fit))
        # Whole on every device: one of them calls native MuJoCo, out here.
        starts = replicated(shift_start(simulator, pieces, found.delta), mesh)
        return open_loop.errors_from(simulator, model, starts, pieces)

    n, mesh = space.size, search.mesh or make_mesh()
    like = placed((jnp.zeros(n), jnp.eye(n), pieces, hidden, _ROBUST, False))
    fitted = jax.jit(finish).lower(*like).compile(quick_compile())
    if more:
        like = placed((jnp.zeros(n), jnp.eye(n), whole, hidden))
        ended = jax.jit(ending).lower(*like).compile(quick_compile())

    def passes(mean: Any, cov: Any) -> tuple[Any, Any]:
        misfit, weighed, center = hidden, pieces, mean
        assumed = effective_noise(simulator, pieces, noise)

        def judged(error: Any, weight: Any, assumed: Any) -> tuple[Any, Any]:
            misfit = jnp.maximum(misfit_of(error, assumed, weight), hidden)
            return misfit, outlier_weights(error, assumed, misfit, _OUTLIER)

        for k in range(_PASSES):
            given = (center, cov, weighed, misfit, 0 if k else _ROBUST, k > 0)
            found, error = distributed.local(fitted(*placed(given)))
            misfit, weight = judged(error, weighed.weight, assumed)
            weighed = replace(pieces, weight=pieces.weight * weight)
            center = found.fit
            tell(f"least-squares finish: pass {k + 1} of {_PASSES}")
        assumed = effective_noise(simulator, whole, noise)
        weighed = whole
        for k in range(_ENDINGS if more else 0):
            given = center, cov, weighed, misfit
            found, error = distributed.local(ended(*placed(given)))
            misfit, weight = judged(error, weighed.weight, assumed)
            weighed = replace(whole, weight=whole.weight * weight)
            center = found.fit
            tell(f"on all of the logs: pass {k + 1} of {_ENDINGS}")
        return found.replace(search_mean=mean, search_cov=cov), weight

    def estimates(means: Any, covs: Any) -> tuple[list[Any], list[str]]:
        results = [passes(*both) for both in zip(means, covs, strict=True)]
        odd = np.flatnonzero(np.asarray(results[0][1]) < 0.5)
        notes = []
        if odd.size:
            notes.append(
                f"{odd.size} of {whole.count} pieces of {steps * simulator.dt:g} s "
                "fit much worse than the rest and weigh less than half "
                "(a bump, a wrong reading, or motion that the model lacks)"
            )
        times = float(widened(results[0][0].excess))
        if times > _LACKING:
            notes.append(
                "the model errs by more than the noise explains, so it lacks "
                "something, and parameters take up part of that: their spreads are "
                f"{times:.2g} times as wide for it. train.gap with these logs names "
                "what is missing; then give --effects"
            )
        return [found for found, _ in results], notes

    return estimates


def ready_errors(
    problem: Problem, space: ParameterSpace
) -> Callable[[jax.Array], tuple[Any, Any, Any]]:
    """Compiles what takes SI parameters ``(n,)`` to
    `easi_jax.estimation.prediction_error.errors_and_floor`."""
    simulator, every = problem.simulator, max(1, problem.steps // 2)
    held, fit = (
        to_device(
            segments_from_runs(simulator, runs, problem.steps, every, fitted=True)
        )
        for runs in (problem.held, problem.fit)
    )
    noise = _with_start_spread(problem)

    def errors(theta: Any) -> Any:
        model = simulator.model(theta)
        return errors_and_floor(simulator, model, held, fit, noise, jax.random.key(0))

    like = placed(jnp.zeros(space.size))
    compiled = jax.jit(errors).lower(like).compile(quick_compile())
    return lambda theta: jax.device_get(compiled(placed(theta)))


def held_out_errors(
    problem: Problem,
    space: ParameterSpace,
    means: Sequence[jax.Array],
    errors_of: Callable[[jax.Array], tuple[Any, Any, Any]],
) -> HeldOutErrors:
    """Open-loop errors of the model as given and at each of ``means (n,)``, unit
    coordinates, of the joints that were measured; ``errors_of`` is of `ready_errors`.
    """
    before, scale, _ = errors_of(jnp.asarray(space.nominal, jnp.result_type(float)))
    scale = np.maximum(scale, 1e-12)
    each = [errors_of(space.to_si(unit)) for unit in means]
    simulator = problem.simulator
    nv = simulator.mj_model.nv
    seen = np.flatnonzero(np.isfinite(problem.noise[:nv]))
    names, units = simulator.state_names[:nv], tangent_units(simulator.mj_model)
    return HeldOutErrors(
        what=problem.held_name,
        horizon=problem.horizon,
        channels=[names[i].removeprefix("qpos.") for i in seen],
        units=[units[i] for i in seen],
        before=before[seen].tolist(),
        after=[after[seen].tolist() for after, _, _ in each],
        floor=[floor[seen].tolist() for _, _, floor in each],
        fit=[float(np.mean((own / scale)[seen] ** 2)) for _, own, _ in each],
    )
