"""What a finished search leaves in its folder: numbers, figures, the report."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

if TYPE_CHECKING:
    from easi_jax.estimation.posterior import Estimate
    from easi_jax.io.report.html import ParameterRow, Report
    from easi_jax.io.runs.folder import RunFolder
    from easi_jax.model.parameters import ParameterSpace
    from easi_jax.model.results import SeedResult, Transfer
    from easi_jax.pipeline.stages import Pipeline


def per_seed_json(seeds: Sequence[int], values: ArrayLike) -> dict[str, float]:
    """``{"0": value, ...}`` of one number a seed."""
    return {str(s): float(v) for s, v in zip(seeds, np.asarray(values), strict=True)}


def distribution_json(
    space: "ParameterSpace",
    seeds: Sequence[int],
    results: Sequence["SeedResult"],
    **more: Any,
) -> dict[str, Any]:
    """``distribution.json``: the parameters and what each seed found."""
    low, high = space.bounds
    first, last = space.initial
    head = [
        {
            "name": p.name,
            "addresses": list(p.addresses),
            "unit": p.unit,
            "nominal": float(p.nominal),
            "initial": [float(first[i]), float(last[i])],
            "bounds": [float(low[i]), float(high[i])],
            "scale": "log" if bool(space.log[i]) else "linear",
        }
        for i, p in enumerate(space.parameters)
    ]
    return {
        "schema": 1,
        "parameters": head,
        "coordinates": "unit: 0 and 1 are the ends of `initial`, on the scale named; "
        "samples are Gaussian in unit coordinates, clipped to `bounds`",
        "seeds": {str(s): r for s, r in zip(seeds, results, strict=True)},
        **more,
    }


def history_figure(
    folder: "RunFolder",
    space: "ParameterSpace",
    seed: int,
    truth: ArrayLike | None,
    generations: int,
) -> str:
    """Parameters by generation of one seed, from the run's metrics (as Fig. 4)."""
    from easi_jax.io.report.figures import parameters_by_generation
    from easi_jax.io.runs.metrics import read_metrics

    lines = read_metrics(folder.path / "metrics.jsonl", "search")[:generations]
    low, high = space.initial
    start = np.asarray(space.to_si(np.full(space.size, 0.5)), float)
    above = np.asarray(space.to_si(np.full(space.size, 0.5 + 12**-0.5)), float)

    def column(what: str) -> np.ndarray:
        return np.array(
            [[line[f"seed{seed}/{n}/{what}"] for n in space.names] for line in lines]
        ).reshape(-1, space.size)

    return parameters_by_generation(
        np.vstack([start, column("mean")]),
        np.vstack([above - start, column("std")]),
        space.names,
        [p.unit for p in space.parameters],
        truth=truth,
        initial=np.stack([low, high], 1),
        log=[bool(x) for x in space.log],
    )


def lost_simulations(folder: "RunFolder") -> int:
    """Simulations of the search that were not finite, from the run's metrics."""
    from easi_jax.io.runs.metrics import read_metrics

    lines = read_metrics(folder.path / "metrics.jsonl", "search")
    return int(sum(line["non_finite"] for line in lines))


def write_pages(folder: "RunFolder", report: "Report") -> None:
    """Writes a report, then its figures as files of their own, then both together; a
    figure that cannot be drawn becomes a note."""
    from dataclasses import replace

    from easi_jax.io.report.html import write_report
    from train._extras import Extras

    path = folder.path / "report.html"
    write_report(path, replace(report, pictures=()))
    report = Extras(folder).drawn(report)
    for picture in report.pictures:
        if picture.file:
            folder.write(f"figures/{picture.file}.svg", picture.text)
    write_report(path, report)


def truth_of(pipe: "Pipeline", theta: ArrayLike) -> np.ndarray:
    """True values ``(n,)`` of the search's parameters, from those of the real robot;
    what that lacks has no strength there."""
    from easi_jax.model.addresses import nominal

    real = pipe.real.space
    known = dict(zip(real.names, np.asarray(theta, float), strict=True))
    fixed = pipe.real.simulator.fixed
    out = []
    for p in pipe.space.parameters:
        value = known.get(p.name)
        if value is None and p.addresses[0].startswith("effect."):
            value = fixed.get(p.addresses[0])
            value = nominal(pipe.env.mj_model, p.addresses) if value is None else value
        out.append(np.nan if value is None else value)
    return np.array(out)


def write_transfer(
    folder: "RunFolder",
    command: str,
    pipe: "Pipeline",
    estimate: "Estimate",
    theta: ArrayLike,
    seeds: Sequence[int],
    transfer: "Transfer",
    motion: np.ndarray,
    notes: Sequence[str],
    made_with: Mapping[str, Any],
) -> tuple[list["ParameterRow"], list[str]]:
    """Writes results, figures and report.

    Args:
        estimate: of each seed, ``(S, ...)``.
        theta: of the robot that stands for the real one, SI.
        motion: an episode of the EASI policy, ``(T + 1, nq)``.
        made_with: options of the robot and its effects, so that its policies can be
            loaded again.

    Returns:
        The first seed's parameters, and what its data do not determine.
    """
    import jax

    from easi_jax.estimation.relative import seed_results
    from easi_jax.io.report.easi_report import easi_report, medians_of, motion_strip
    from easi_jax.io.runs.versions import versions
    from easi_jax.rl.presets import algorithm_of

    space, config, notes = pipe.space, pipe.config, list(notes)
    truth = truth_of(pipe, theta)
    noisy = any(x > 0 for x in config.noise)
    results = seed_results(
        pipe.simulator,
        space,
        [jax.tree.map(lambda x, i=i: x[i], estimate) for i in range(len(seeds))],
        free_starts=noisy,
        adjusted=True,
    )
    shares = medians_of(transfer.held_out)
    folder.write_json(
        "distribution.json",
        distribution_json(
            space,
            seeds,
            results,
            truth=dict(zip(space.names, truth.tolist(), strict=True)),
            held_out=shares,
        ),
    )
    returns = transfer.returns
    folder.write_json(
        "results.json",
        {
            "robot": transfer.robot,
            "env": folder.config.get("env"),
            **made_with,
            "seeds": list(seeds),
            "env_steps": config.training.env_steps,
            "algorithm": algorithm_of(config.training),
            "methods": list(returns),
            "returns": {k: per_seed_json(seeds, v) for k, v in returns.items()},
            "held_out": shares,
        },
    )
    by_generation = history_figure(
        folder, space, seeds[0], truth, config.search.generations
    )
    report = easi_report(
        *(space, seeds, results[0], truth, transfer, by_generation),
        command=f"python -m {command}",
        pictures=motion_strip(pipe.env.mj_model, pipe.env.dt, motion, "EASI", notes),
        notes=notes,
        config=folder.config,
        versions=versions(),
    )
    write_pages(folder, report)
    return list(report.parameters), list(report.undetermined)
