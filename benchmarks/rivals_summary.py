"""Section of the results page on identification beside rivals and today's tools."""

from collections import defaultdict
from collections.abc import Sequence
from itertools import product
from statistics import median
from typing import Any

from benchmarks._common import commits_of, markdown_table
from benchmarks._page import Section, named, table, those
from benchmarks.rival_cells import AFTER_GAP, METHODS, ROBOTS, SETTINGS, Cell

OURS = METHODS[0]
_EXACT = 1e-3  # errors below it are the same: a tenth of a percent

Row = dict[str, Any]


def _measured(rows: Sequence[Row]) -> list[str]:
    """What is compared, and how to read it."""
    return [
        f"`python -m benchmarks.rivals`, commits {commits_of(rows)}: equal data and "
        "budget (simulated control steps, a derivative as one), each seed a machine of "
        "its own. RMS of the log ratio to the truth "
        "along the directions that the data determine, median over seeds (every seed); "
        "in how many the truth lies in the stated 90 % region of these directions. "
        "`clean`: no noise; the others have sensor noise. `unpaired`: single "
        "transitions of an unknown controller. `stochastic`: a controller with "
        "exploration noise. `effect`: the same, but commands arrive 30 ms late, which "
        "no model has; there EASI also goes with what `train.gap` names. SimOpt asks "
        "for more trajectories of the real machine, which explore in every setting, "
        "and knows their starts exactly; the controller stays the same, for none of "
        "these machines has a task.",
        "To read with it: CMA-ES, random search, `mujoco.sysid` and NPE replay pieces "
        "of 25 control steps from the states that were recorded, noise included, as "
        "their authors do; EASI's finish fits the starts as well. Where the budget "
        "does not pay for sixty generations on all pieces, CMA-ES and DROPO draw some "
        "of all anew in each. Parameters of which "
        "the data say little, such as small frictions, can be off by many times, and "
        "logarithms count that in full. The bound is that of estimates without any "
        "prior knowledge: along a direction that is hardly seen, a method that keeps "
        "to the middle of its start may be nearer by chance, so that a verdict of one "
        "seed says little where errors are beyond a tenth of a percent.",
    ]


def _robot(rows: Sequence[Row]) -> list[str]:
    """Errors, regions and costs of every method on one robot."""
    return [_errors(rows), *_verdicts(rows), *_costs(rows)]


def best_rival(rows: Sequence[Row], setting: str) -> tuple[str, float, float] | None:
    """The rival with the least median error, that error and `OURS`, over the seeds
    that both have; None where nothing can be compared."""
    found = []
    own = _by_seed(rows, setting, OURS)
    for method in METHODS:
        seeds = own.keys() & _by_seed(rows, setting, method).keys()
        if method in (OURS, AFTER_GAP) or not seeds:
            continue
        its = _by_seed(rows, setting, method)
        found.append((median(its[s] for s in seeds), method, seeds))
    if not found:
        return None
    error, method, seeds = min(found, key=lambda f: (-len(f[2]), f[0]))
    return method, error, median(own[s] for s in seeds)


def _by_seed(rows: Sequence[Row], setting: str, method: str) -> dict[int, float]:
    return {
        r["seed"]: r["error"]
        for r in rows
        if (r["setting"], r["method"]) == (setting, method) and r["error"] is not None
    }


def _errors(rows: Sequence[Row]) -> str:
    lines = []
    for name, key in (("start", "start_error"), ("Cramer-Rao bound", "bound")):
        cells = []
        for setting in SETTINGS:
            some = [r for r in rows if r["setting"] == setting]
            by_seed: dict[int, list[float]] = defaultdict(list)
            for r in some:
                if r[key] is not None:
                    by_seed[r["seed"]].append(r[key])
            # Without noise nothing bounds the error.
            known = by_seed and (key != "bound" or setting != "clean")
            cells.append(_told(median(map(median, by_seed.values()))) if known else "")
        lines.append((name, *cells))
    for method in METHODS:
        cells = [_cell(rows, setting, method) for setting in SETTINGS]
        lines.append((named(method, rows), *cells))
    return markdown_table(("method", *SETTINGS), lines)


def _cell(rows: Sequence[Row], setting: str, method: str) -> str:
    mine = sorted(
        (r for r in rows if (r["setting"], r["method"]) == (setting, method)),
        key=lambda r: r["seed"],
    )
    good = [r for r in mine if r["error"] is not None]
    if not good:
        possible = Cell(rows[0]["robot"], setting, method, 0, 0, 0).possible
        return "nothing determined" if mine else "not run" if possible else ""
    errors = [r["error"] for r in good]
    inside = sum(r["covered"] for r in good)
    each = ", ".join(_told(e) for e in errors)
    return f"{_told(median(errors))} ({each}); in {inside} of {len(good)}"


def _told(error: float) -> str:
    return f"{error:.2g}" if error >= _EXACT else f"{error:.0e}"


def _verdicts(rows: Sequence[Row]) -> list[str]:
    said = []
    for setting in SETTINGS:
        found = best_rival(rows, setting)
        if found is None:
            continue
        method, error, own = found
        line = f"- {setting}: {verdict(method, error, own)}"
        if len(_by_seed(rows, setting, OURS)) == 1:
            line += "; one seed"
        start = median(
            r["start_error"] for r in rows if r["setting"] == setting and r["rank"]
        )
        if start < min(error, own):
            line += f"; where searches start is nearer ({_told(start)})"
        mended = _by_seed(rows, setting, AFTER_GAP)
        if mended:
            line += f"; {AFTER_GAP} {_told(median(mended.values()))}"
        said.append(line)
    return ["\n".join(said)] if said else []


def verdict(method: str, error: float, own: float) -> str:
    """Who is ahead, in a few words."""
    if max(error, own) < _EXACT:
        return f"{OURS} and {method} both exact to a tenth of a percent"
    pair = f"{_told(own)} against {_told(error)} of {method}, the best rival"
    if own <= error:
        return f"{OURS} ahead, {pair} ({error / own:.1f} times)"
    return f"**{method} ahead**: {OURS} {pair} ({own / error:.1f} times)"


def _costs(rows: Sequence[Row]) -> list[str]:
    def seconds(mine: Sequence[Row]) -> str:
        # Rows made before methods were waited for have none.
        known = [r["seconds"] for r in mine if r["seconds"] is not None]
        return f"{median(known):.0f}" if known else "not measured"

    columns = {
        "method": lambda mine: mine[0]["method"],
        "seconds, one core": seconds,
        "million steps simulated": lambda mine: (
            f"{median(r['simulated'] for r in mine) / 1e6:.2f}"
        ),
        "further steps of the real machine": lambda mine: (
            f"{max(r['measured'] for r in mine):,}"
            if any(r["measured"] for r in mine)
            else "none"
        ),
    }
    by_method = ([r for r in rows if r["method"] == m] for m in METHODS)
    return [table(filter(None, by_method), columns), *_beyond(rows)]


def _beyond(rows: Sequence[Row]) -> list[str]:
    """Who simulated more than the budget, if anybody."""
    said = []
    for budget, method in product(sorted({r["budget"] for r in rows}), METHODS):
        mine = [r for r in rows if (r["budget"], r["method"]) == (budget, method)]
        most = max((r["simulated"] for r in mine), default=0)
        if most > budget:
            over = sum(r["simulated"] > budget for r in mine)
            said.append(
                f"Beyond the budget of {budget / 1e6:.3g} million: {method} in {over} "
                f"of {len(mine)} cells, up to {most / 1e6:.3g}."
            )
    return said


_FILE = "rivals.jsonl"
_TITLE = "## Identification beside rivals and today's tools"
SECTIONS = (
    Section(_TITLE, _FILE, "rivals", _measured),
    *(
        Section(
            *(f"### {robot}", _FILE, f"rivals --robots {robot}", _robot),
            those(lambda row, robot=robot: row["robot"] == robot),
        )
        for robot in ROBOTS
    ),
)
