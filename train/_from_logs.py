"""Identifies a machine from measured logs; what ``train.easi --data`` does."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

from train._command import say, show_table
from train._effects import read_given
from train._log_problem import FINISH, Problem, read_problem

_STEPS = 500_000  # physics steps in a generation that are worth their time
_PASSES = 3  # of the finish: the model's own error is learned from the one before
_ENDINGS = 2  # of a larger robot's, on all pieces
_ROBUST = 12  # rounds of the first pass; later ones know which pieces fit badly
_LACKING = 1.5  # times wider spreads, that are worth a note
_OUTLIER = 2.5  # times the median error: windows beyond it weigh less


def run(config: Any) -> None:
    """Reads, searches, finishes and reports; ``config`` is that of ``train.easi``."""
    problem = read_problem(config)
    seeds = config.seeds or (0,)
    import jax

    from easi_jax.io.runs.folder import RunFolder
    from easi_jax.search.easi import Search

    search = Search(problem.simulator, _settings(config, problem))

    with RunFolder.open(
        config.out,
        read_given(config).recorded(config),
        command="train.easi",
        resume=config.resume,
        overwrite=config.overwrite,
    ) as folder:
        from easi_jax.devices.distributed import started
        from train._log_results import ready_errors, write
        from train._stages import found_check

        finish = started(
            lambda: _ready_finish(problem, search, config.refine, config.restarts or 0)
        )
        states = _search(folder, config, search, problem, seeds)
        errors = started(lambda: ready_errors(problem, search.space))
        estimates, outliers = finish()(states)
        for seed, found in zip(seeds, estimates, strict=True):
            one = jax.tree.map(lambda x: x[None], found.distribution)
            found_check([seed], search.space.names, one)
        problem.notes.extend(outliers)
        columns, rows, errors = write(
            folder, problem, search, estimates, seeds, errors()
        )
    show_table(f"Parameters of {problem.name}", columns, rows)
    show_table(*errors)
    for note in problem.notes:
        say(f"note: {note}")
    say(f"report: {config.out / 'report.html'}")


def _settings(config: Any, problem: Problem) -> Any:
    """Search settings; as many pieces a generation as their length lets pay."""
    from easi_jax.errors import UserError
    from train._robots import search_config

    chosen = search_config(
        config.preset,
        config.set,
        strategy=config.strategy,
        generations=config.generations,
        population=config.population,
        source="replay",
        horizon=problem.piece,
    )
    if chosen.source != "replay" or chosen.policy_updates_per_generation:
        raise UserError(
            "logs come without their controller: leave source and "
            "policy_updates_per_generation alone with --data"
        )
    if any(s.startswith("segments=") for s in config.set):
        return chosen
    cost = chosen.population * problem.piece * problem.simulator.substeps
    segments = max(16, min(chosen.segments, _STEPS // cost))
    return replace(chosen, segments=segments)


def _search(
    folder: Any, config: Any, search: Any, problem: Problem, seeds: Sequence[int]
) -> Any:
    import jax
    import jax.numpy as jnp

    from easi_jax.data.segments import to_device
    from easi_jax.devices.runtime import fast_loops, quick_compile
    from easi_jax.estimation.pieces import segments_from_runs
    from easi_jax.pipeline.stages import seed_keys
    from easi_jax.search.easi import SearchData
    from train._stages import jit_chunks, run_stage, search_check, search_rows

    pieces = segments_from_runs(
        problem.simulator, problem.fit, problem.piece, max(1, problem.piece // 2)
    )
    noise = jnp.asarray(problem.noise, jnp.result_type(float))
    data = SearchData(segments=to_device(pieces), noise=noise)
    keys = seed_keys(list(seeds))
    advance = jit_chunks(
        lambda states, data, n: jax.lax.map(lambda s: search.run(s, data, n), states),
        fast_loops() | quick_compile(),
    )
    states = run_stage(
        folder,
        "search",
        search.config.generations,
        config.search_chunk,
        lambda: jax.lax.map(lambda k: search.init(k, data), keys),
        lambda states, n: advance(states, data, n),
        search_rows(seeds, search.space.names, search.space.to_si),
        problem.notes,
        search_check(seeds, search.space.names, search.config.population),
    )
    return states


def _ready_finish(
    problem: Problem, search: Any, refined: bool, restarts: int
) -> Callable[[Any], tuple[list[Any], list[str]]]:
    """Compiles the finish.

    Returns:
        Takes the search's states and returns an `Estimate` a seed, and notes on pieces
        that fit badly.
    """
    import jax
    import jax.numpy as jnp
    import numpy as np

    from easi_jax.data.segments import to_device
    from easi_jax.devices import distributed
    from easi_jax.devices.runtime import quick_compile
    from easi_jax.estimation.normal_equations import shift_start
    from easi_jax.estimation.pieces import effective_noise, few, segments_from_runs
    from easi_jax.estimation.posterior import estimate, polished, widened
    from easi_jax.estimation.prediction_error import misfit_of, outlier_weights
    from easi_jax.simulation import open_loop
    from train._stages import placed

    simulator, space = problem.simulator, search.space
    steps = max(problem.steps, round(FINISH / simulator.dt))
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
        )
        return found, errors(found, pieces)

    def ending(center: Any, cov: Any, whole: Any, misfit: Any) -> Any:
        how = search.config.informed_spread, search.mesh, misfit
        found = polished(simulator, space, center, cov, whole, noise, *how)
        return found, errors(found, whole)

    def errors(found: Any, pieces: Any) -> Any:
        model = simulator.model(space.to_si(found.fit))
        starts = shift_start(simulator, pieces, found.delta)
        return open_loop.errors_from(simulator, model, starts, pieces)

    n = space.size
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
            say(f"least-squares finish: pass {k + 1} of {_PASSES}")
        assumed = effective_noise(simulator, whole, noise)
        weighed = whole
        for k in range(_ENDINGS if more else 0):
            given = center, cov, weighed, misfit
            found, error = distributed.local(ended(*placed(given)))
            misfit, weight = judged(error, weighed.weight, assumed)
            weighed = replace(whole, weight=whole.weight * weight)
            center = found.fit
            say(f"on all of the logs: pass {k + 1} of {_ENDINGS}")
        return found.replace(search_mean=mean, search_cov=cov), weight

    def estimates(states: Any) -> tuple[list[Any], list[str]]:
        both = zip(states.result_mean, states.result_cov, strict=True)
        results = [passes(mean, cov) for mean, cov in both]
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
