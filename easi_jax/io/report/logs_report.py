"""The report of a machine that was identified from its logs."""

import math
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np

from easi_jax.io.report.figures import prediction_errors
from easi_jax.io.report.html import Diagnostic, Picture, Report, Svg, Table
from easi_jax.io.report.numbers import number, shown_unit
from easi_jax.io.report.parameters import doubtful, lost, parameter_rows, unseen_notes
from easi_jax.model.parameters import ParameterSpace
from easi_jax.model.results import HeldOutErrors, SeedResult

TITLE = "Held-out prediction error"


def logs_report(
    name: str,
    space: ParameterSpace,
    seeds: Sequence[int],
    results: Sequence[SeedResult],
    errors: HeldOutErrors,
    by_generation: Svg,
    non_finite: int,
    noise: Sequence[float],
    channels: Sequence[str],
    **more: Any,
) -> Report:
    """What the seed that fits its own data best has found, and how well it predicts.

    Args:
        name: of the model.
        by_generation: figure of that seed's search, SVG.
        non_finite: simulations of the search that were lost.
        noise: of ``channels``, positions and velocities, SI.
        more: further fields of `Report`.
    """
    best = errors.best
    rows = parameter_rows(space, results[best])
    better = _better(errors.before, errors.after[best])
    tables = [error_table(errors)]
    if len(seeds) > 1:
        tables.append(_agreement(space, results, seeds))
    return Report(
        title=f"{name} identified from logs",
        headline=[
            f"Over {number(errors.horizon, 3)} s on held-out data ({errors.what}) the "
            f"identified model errs {better}."
        ],
        parameters=rows,
        undetermined=unseen_notes(space, results[best]),
        tables=tables,
        pictures=[
            Picture(
                TITLE,
                partial(error_bars, errors),
                "Held-out error of each joint before and after identification",
                file="errors",
            ),
            Picture(
                f"Parameters by generation (seed {seeds[best]})",
                by_generation,
                "Mean and spread of each parameter over the generations",
                "The adversarial search alone, before any least-squares finish.",
                file="parameters",
            ),
        ],
        diagnostics=[
            Diagnostic(
                "held-out error",
                better,
                ok="less" in better,
                note=""
                if "less" in better
                else "no listed parameter can express what the model lacks, if it "
                "lacks anything",
            ),
            Diagnostic(
                "the fit",
                results[best].outcome,
                ok=results[best].outcome == "converged",
                note=results[best].reason,
            ),
            lost(non_finite),
            doubtful(rows),
            Diagnostic(
                "measurement noise",
                ", ".join(number(x, 2) for x in noise),
                note=f"of {', '.join(channels)} (SI)",
            ),
        ],
        **more,
    )


def error_table(errors: HeldOutErrors) -> Table:
    """Errors of each joint: as given, identified, and what noise alone gives."""
    columns = (errors.before, errors.after[errors.best], errors.floor[errors.best])
    return Table(
        f"{TITLE} over {number(errors.horizon, 3)} s",
        ("channel", "unit", "model as given", "identified", "noise floor"),
        [
            (name, shown_unit(unit), *(number(x, 3) for x in values))
            for name, unit, *values in zip(
                errors.channels, errors.units, *columns, strict=True
            )
        ],
        f"On {errors.what}, which the fit has not seen. {errors.measure}. The noise "
        "floor is what a perfect model would have.",
    )


def error_bars(errors: HeldOutErrors) -> str:
    """The same as a figure, SVG."""
    return prediction_errors(
        {"model as given": errors.before, "identified": errors.after[errors.best]},
        errors.channels,
        errors.units,
        floor=np.asarray(errors.floor[errors.best]),
    )


def _better(before: Sequence[float], after: Sequence[float]) -> str:
    # A joint that stands still, measured and predicted, tells nothing.
    ratios = [a / b for a, b in zip(after, before, strict=True) if b > 0]
    ratio = math.sqrt(sum(r**2 for r in ratios) / len(ratios)) if ratios else 1.0
    if ratio < 0.95:
        return f"{number(1 / ratio, 2)} times less than the model as given"
    if ratio <= 1.05:
        return "as much as the model as given"
    return f"{number(ratio, 2)} times more than the model as given"


def _agreement(
    space: ParameterSpace, results: Sequence[SeedResult], seeds: Sequence[int]
) -> Table:
    found = [{r.name: r.found for r in parameter_rows(space, x)} for x in results]
    return Table(
        "Agreement of the seeds",
        ("parameter", *(f"seed {s}" for s in seeds)),
        [(name, *(by_name[name] for by_name in found)) for name in space.names],
        "The table of parameters shows the seed that fits its own data best.",
    )
