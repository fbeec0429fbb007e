"""Identified parameters as people read them: what is known first, and given what."""

import math
from collections.abc import Sequence

import numpy as np

from easi_jax.io.report.html import Diagnostic, Known, ParameterRow
from easi_jax.io.report.numbers import measured, number, shown_unit
from easi_jax.model.parameters import ParameterSpace
from easi_jax.model.results import SeedResult

_RANKS: dict[Known, int] = {
    "determined": 0,
    "relative": 0,
    "taken": 1,
    "at bound": 2,
    "not determined": 3,
}
_SAME = 1e-6  # relative, of a value in single precision that nobody has changed
COLUMNS = ("parameter", "unit", "model", "found", "change", "known from the data")


def parameter_rows(
    space: ParameterSpace, result: SeedResult, truth: np.ndarray | None = None
) -> list[ParameterRow]:
    """A row a parameter: those first that the data determine, and have moved.

    Where data leave a direction open, such as one factor of all masses and forces,
    values are those of `SeedResult.relative`. They have no ``truth (n,)`` to compare
    with where what they rest on is another in truth than in the model.
    """
    known = result.relative
    rows = []
    for i, p in enumerate(space.parameters):
        flag: Known = result.flags[i]
        mean, std, depends = result.mean[i], result.std[i], ()
        if known is not None and flag == "not determined":
            depends = tuple(known.depends(i))
            if p.name in known.taken:
                flag, depends = "taken", ()
            elif depends and known.determined[i]:
                flag = "relative"
            mean, std = known.mean[i], known.std[i]
        rests_on = [space.index(name) for name in depends] if flag == "relative" else []
        real = None if truth is None else float(truth[i])
        if truth is not None and not np.allclose(
            truth[rests_on], space.nominal[rests_on], rtol=_SAME, atol=0.0
        ):
            real = None
        rows.append(
            ParameterRow(
                name=p.name,
                addresses=p.addresses,
                unit=p.unit,
                initial=p.initial,
                mean=mean,
                std=std,
                flag=flag,
                truth=real,
                bounds=p.bounds,
                nominal=p.nominal,
                depends=depends if flag == "relative" else (),
                region=not result.no_region,
            )
        )
    return sorted(rows, key=_rank)


def _rank(row: ParameterRow) -> tuple[int, float]:
    known = row.flag in ("determined", "relative") and row.nominal
    ratio = row.mean / row.nominal if known and row.nominal else 1.0
    # Less than a tenth or so is no order that a reader would look for.
    moved = round(abs(math.log(ratio)), 1) if ratio > 0 else math.inf
    return _RANKS[row.flag], -moved


def unseen_notes(space: ParameterSpace, result: SeedResult) -> list[str]:
    """What the data do not determine, and what `parameter_rows` does about it."""
    notes = [d.meaning for d in result.undetermined]
    if result.relative is None:
        return notes
    units = dict(zip(space.names, space.units, strict=True))
    taken = [
        f"{name} = {measured(value, units[name])}"
        for name, value in result.relative.taken.items()
    ]
    return [
        *notes,
        f"hence the table takes {' and '.join(taken)} from the model: what is known "
        "given them is right where they are, and moves with them where they are not",
    ]


def parameter_table(
    rows: Sequence[ParameterRow],
) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Columns and rows for a terminal."""
    known = any(row.truth is not None for row in rows)
    columns = (*COLUMNS[:-1], *(("truth",) if known else ()), COLUMNS[-1])
    cells = [
        (
            row.name,
            shown_unit(row.unit) or "-",
            number(row.nominal) if row.nominal is not None else "-",
            row.found,
            row.change,
            *(("-" if row.truth is None else number(row.truth),) if known else ()),
            row.verdict,
        )
        for row in rows
    ]
    return columns, cells


def doubtful(rows: Sequence[ParameterRow]) -> Diagnostic:
    """The parameters whose values say little."""
    bad = [r.name for r in rows if r.flag in ("not determined", "at bound")]
    return Diagnostic(
        "not determined or at a bound",
        ", ".join(bad) or "none",
        ok=not bad,
        note="not to be believed by themselves" if bad else "",
    )


def lost(count: int) -> Diagnostic:
    """Simulations that were not finite."""
    return Diagnostic(
        "non-finite simulations",
        count,
        ok=count == 0,
        note="ranked last, never recombined",
    )
