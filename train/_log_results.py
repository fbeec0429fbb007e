"""What an identification from logs leaves in its folder."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

from train._results import (
    distribution_json,
    history_figure,
    lost_simulations,
    write_pages,
)

if TYPE_CHECKING:
    from easi_jax.estimation.held_out import WindowErrors
    from easi_jax.estimation.posterior import Estimate
    from easi_jax.estimation.problem import Problem
    from easi_jax.io.report.html import Report
    from easi_jax.io.runs.folder import RunFolder
    from easi_jax.model.parameters import ParameterSpace
    from easi_jax.model.results import HeldOutErrors, SeedResult


def write(
    folder: "RunFolder",
    problem: "Problem",
    space: "ParameterSpace",
    generations: int,
    estimates: Sequence["Estimate"],
    seeds: Sequence[int],
    ready: tuple["WindowErrors", "WindowErrors | None"],
    diverged: Mapping[int, str],
    notes_of: Callable[[int], list[str]],
) -> "Report":
    """Writes distribution.json, figures and report.html; returns the report.

    ``ready`` is of `easi_jax.estimation.held_out.ready_errors`; ``diverged`` are seeds
    without a result, and why; ``notes_of`` says what is to be said of one of
    ``estimates``, and is asked of the best.
    """
    import numpy as np

    from easi_jax.estimation.held_out import held_out_errors
    from easi_jax.estimation.relative import seed_results

    results = seed_results(problem.sensing, space, estimates)
    means = [found.distribution.mean for found in estimates]
    errors = held_out_errors(problem, space, means, ready)
    problem.notes.extend(notes_of(errors.best))
    learned = np.asarray(estimates[errors.best].noise, float)[: len(problem.noise)]
    scatter = np.minimum(problem.noise, learned)
    seen = np.flatnonzero(np.isfinite(scatter))
    noise = {problem.simulator.state_names[i]: scatter[i].item() for i in seen}
    given = folder, problem.name, space, generations
    more = problem.notes, noise, "--data ..."
    return write_found(*given, results, seeds, errors, diverged, *more)


def write_found(
    folder: "RunFolder",
    name: str,
    space: "ParameterSpace",
    generations: int,
    results: Sequence["SeedResult"],
    seeds: Sequence[int],
    errors: "HeldOutErrors",
    diverged: Mapping[int, str],
    notes: Sequence[str],
    noise: Mapping[str, float],
    options: str,
    **more: Any,
) -> "Report":
    """Writes what each of ``seeds`` found, as `write`.

    Args:
        name: of the model.
        noise: standard deviation of each number that was measured.
        options: of the command, for the report.
        more: further entries of distribution.json.
    """
    from easi_jax.io.report.logs_report import logs_report
    from easi_jax.io.runs.versions import versions

    best = errors.best
    folder.write_json(
        "distribution.json",
        distribution_json(
            space,
            seeds,
            results,
            best_seed=int(seeds[best]),
            held_out={
                "what": errors.what,
                "horizon": errors.horizon,
                "measure": errors.measure,
                "channels": errors.channels,
                "units": errors.units,
                "before": errors.before,
                "after": {str(s): e for s, e in zip(seeds, errors.after, strict=True)},
                "noise_floor": errors.floor[best],
                "windows": errors.windows,
                "not_finite": errors.not_finite,
            },
            diverged={str(seed): why for seed, why in diverged.items()},
            **more,
        ),
    )
    report = logs_report(
        name,
        space,
        seeds,
        results,
        errors,
        partial(history_figure, folder, space, seeds[best], None, generations),
        lost_simulations(folder),
        list(noise.values()),
        list(noise),
        command=f"python -m train.easi {options}",
        notes=[
            *(f"seed {s} has no result: {why}" for s, why in diverged.items()),
            *errors.notes(seeds),
            *notes,
        ],
        config=folder.config,
        versions=versions(),
    )
    write_pages(folder, report)
    return report
