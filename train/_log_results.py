"""What an identification from logs leaves in its folder."""

import math
from collections.abc import Callable, Sequence
from typing import Any

from easi_jax.estimation.problem import Problem
from train._results import distribution_json, history_figure, seed_result

_TITLE = "Held-out prediction error"


def write(
    folder: Any,
    problem: Problem,
    search: Any,
    estimates: Sequence[Any],
    seeds: Sequence[int],
    errors_of: Callable[[Any], Any],
) -> tuple[Any, Any, Any]:
    """Writes distribution.json, figures and report.html.

    Args:
        errors_of: of `ready_errors`.

    Returns:
        Columns and rows of the parameter table, and the error table as
        ``(title, columns, rows)``.
    """
    import numpy as np

    from easi_jax.io.report.figures import prediction_errors
    from easi_jax.io.report.html import Diagnostic, Picture, Report, Table, write_report
    from easi_jax.io.runs.metrics import read_metrics
    from easi_jax.io.runs.versions import versions

    space = search.space
    results = []
    for found in estimates:
        root = np.asarray(found.distribution.factor, np.float64)
        results.append(
            seed_result(space, found.distribution.mean, root @ root.T, found.hessian)
        )
    means = [found.distribution.mean for found in estimates]
    errors = _errors(problem, means, space, errors_of)
    best = int(np.argmin([e["fit"] for e in errors["seeds"]]))
    result, after = results[best], errors["seeds"][best]["held_out"]
    before, floor = errors["before"], errors["seeds"][best]["floor"]
    channels, units = errors["channels"], errors["units"]
    held = {
        "what": problem.held_name,
        "horizon": problem.horizon,
        "measure": "RMS over all steps of all windows, open loop from the measured "
        "position and fitted velocity, windows every half horizon",
        "channels": channels,
        "units": units,
        "before": before,
        "after": {
            str(s): e["held_out"] for s, e in zip(seeds, errors["seeds"], strict=True)
        },
        "noise_floor": floor,
    }
    folder.write_json(
        "distribution.json",
        distribution_json(
            space, seeds, results, best_seed=int(seeds[best]), held_out=held
        ),
    )
    lines = read_metrics(folder.path / "metrics.jsonl", "search")
    history = history_figure(folder, space, seeds[best], None, len(lines))
    bars = prediction_errors(
        {"model as given": before, "identified": after}, channels, units, floor=floor
    )
    folder.write("figures/parameters.svg", history)
    folder.write("figures/errors.svg", bars)
    rows = _parameter_rows(space, result)
    lost = int(sum(line["non_finite"] for line in lines))
    doubtful = [r.name for r in rows if r.flag != "determined"]
    error_rows = [
        (name, unit, *(f"{x:.3g}" for x in values))
        for name, unit, *values in zip(
            channels, units, before, after, floor, strict=True
        )
    ]
    table = Table(
        f"{_TITLE} over {problem.horizon:.3g} s",
        ("joint", "unit", "model as given", "identified", "noise floor"),
        error_rows,
        f"On {problem.held_name}, which the fit has not seen. RMS over all steps of "
        "all windows, open loop from the measured state. The noise floor is what a "
        "perfect model would have.",
    )
    better = _better(before, after)
    tables = [table]
    if len(seeds) > 1:
        tables.append(_seed_table(rows, results, seeds))
    write_report(
        folder.path / "report.html",
        Report(
            title=f"{problem.name} identified from logs",
            headline=[
                f"Over {problem.horizon:.3g} s on held-out data ({problem.held_name}) "
                f"the identified model errs {better}."
            ],
            command="python -m train.easi --data ...",
            parameters=rows,
            undetermined=[d["meaning"] for d in result["undetermined"]],
            tables=tables,
            pictures=[
                Picture(
                    _TITLE,
                    bars,
                    "Held-out error of each joint before and after identification",
                ),
                Picture(
                    f"Parameters by generation (seed {seeds[best]})",
                    history,
                    "Mean and spread of each parameter over the generations",
                    "The adversarial search alone, before any least-squares finish.",
                ),
            ],
            diagnostics=_diagnostics(Diagnostic, problem, lost, doubtful, better),
            notes=problem.notes,
            config=folder.config,
            versions=versions(),
        ),
    )
    shown = [
        (r.name, f"{r.mean:.4g}", f"{r.std:.2g}", r.unit or "-", r.flag) for r in rows
    ]
    return (
        ("parameter", "mean", "std", "unit", "what may be believed"),
        shown,
        (table.title, table.columns, table.rows),
    )


def _errors(
    problem: Problem, means: Sequence[Any], space: Any, errors_of: Callable[[Any], Any]
) -> dict[str, Any]:
    """Open-loop errors, the model as given and each seed's."""
    import jax.numpy as jnp
    import numpy as np

    from easi_jax.model.joint_space import tangent_units

    before, scale, _ = errors_of(jnp.asarray(space.nominal, jnp.result_type(float)))
    scale = np.maximum(scale, 1e-12)
    seeds = []
    for unit in means:
        after, own, floor = errors_of(space.to_si(unit))
        seeds.append(
            {
                "held_out": after.tolist(),
                "fit": float(np.mean((own / scale) ** 2)),
                "floor": floor.tolist(),
            }
        )
    simulator = problem.simulator
    coordinates = simulator.state_names[: simulator.mj_model.nv]
    names = [n.removeprefix("qpos.") for n in coordinates]
    return {
        "channels": names,
        "units": list(tangent_units(simulator.mj_model)),
        "before": before.tolist(),
        "seeds": seeds,
    }


def _better(before: Sequence[float], after: Sequence[float]) -> str:
    # A joint that stands still, measured and predicted, tells nothing.
    ratios = [a / b for a, b in zip(after, before, strict=True) if b > 0]
    ratio = math.sqrt(sum(r**2 for r in ratios) / len(ratios)) if ratios else 1.0
    if ratio < 0.95:
        return f"{1 / ratio:.2g} times less than the model as given"
    if ratio <= 1.05:
        return "as much as the model as given"
    return f"{ratio:.2g} times more than the model as given"


def _parameter_rows(space: Any, result: Any) -> list[Any]:
    from easi_jax.io.report.html import ParameterRow

    return [
        ParameterRow(
            name=p.name,
            addresses=p.addresses,
            unit=p.unit,
            initial=p.initial,
            mean=result["mean"][i],
            std=result["std"][i],
            flag=result["flags"][i],
            bounds=p.bounds,
        )
        for i, p in enumerate(space.parameters)
    ]


def _seed_table(rows: Sequence[Any], results: Sequence[Any], seeds: Any) -> Any:
    from easi_jax.io.report.html import Table

    return Table(
        "Agreement of the seeds",
        ("parameter", *(f"seed {s}" for s in seeds)),
        [
            (row.name, *(f"{r['mean'][i]:.4g}" for r in results))
            for i, row in enumerate(rows)
        ],
        "The table of parameters shows the seed that fits its own data best.",
    )


def _diagnostics(
    make: Any, problem: Problem, lost: int, doubtful: Sequence[str], better: str
) -> list[Any]:
    return [
        make(
            "held-out error",
            better,
            ok="less" in better,
            note=""
            if "less" in better
            else "no listed parameter can express what the model lacks",
        ),
        make(
            "non-finite simulations",
            lost,
            ok=lost == 0,
            note="ranked last, never recombined",
        ),
        make(
            "not determined or at a bound",
            ", ".join(doubtful) or "none",
            ok=not doubtful,
            note="not to be believed by themselves" if doubtful else "",
        ),
        make(
            "measurement noise",
            ", ".join(f"{x:.2g}" for x in problem.noise),
            note=f"of {', '.join(problem.simulator.state_names)} (SI)",
        ),
    ]
