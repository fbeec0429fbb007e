"""Section of the results page on the spread that a search returns."""

from typing import Any

import numpy as np

from benchmarks._common import commits_of, markdown_table
from benchmarks._page import Section, computing, met
from benchmarks.coverage import WAYS
from benchmarks.gap_score import wilson

# Share of truths inside a region; missed where the interval of what came out excludes
# all of it.
GOALS = {0.5: (0.45, 0.55), 0.9: (0.87, 0.93)}
MEANT = WAYS[1:]  # spreads that commands state
BOUND = 1.07  # times the Cramer-Rao bound
LATE = 0.8  # of truths, at least, inside regions of 90 % where commands come late
SILENT = 0.1  # of targets with a right model, at most, of which no region is stated
OFF = 0.2  # standard deviations, that the mean error of a parameter is at most
TARGETS = 100
_REGIONS = (
    "Truths inside the regions of the data's information alone, and inside those that "
    "are stated; targets of which no region is stated, since the model errs by more "
    "than twice the noise."
)
NOT_TOLD = "not told from it"
_NINETY, _TWO_SIDED, _FAR = 1.645, 1.96, 3.0  # standard deviations


def _late(rows: list[dict[str, Any]]) -> list[str]:
    """Coverage where the finish has late commands in doubt, and where they are late."""
    return [
        "`python -m benchmarks.coverage --late 0.005` (`--doubts` where they come in "
        "time): the same Cartpoles with commands that come late, of which the model "
        "knows nothing; the finish is that of measured logs, with late commands "
        f"in doubt; commits {commits_of(rows)}. {_REGIONS} Goal: {100 * LATE:.0f} % of "
        "truths inside what is stated with 90 %.",
        _as_stated(rows, {0.9: (LATE, 1.0)}),
        computing(rows),
    ]


def _logs(rows: list[dict[str, Any]]) -> list[str]:
    """Coverage of ``train.easi --data``."""
    return [
        "`python -m benchmarks.coverage --logs`: the same Cartpoles, their "
        "demonstrations given as logs, search and finish those of `train.easi --data` "
        f"(every step twice in pieces, late commands in doubt); commits "
        f"{commits_of(rows)}. {_REGIONS} Goals: 45 to 55 % and 87 to 93 % inside what "
        f"is stated, no region of {100 * SILENT:.0f} % of the targets at most.",
        _as_stated(rows, GOALS),
        *_centered(rows),
        computing(rows),
    ]


def _as_stated(
    rows: list[dict[str, Any]], goals: dict[float, tuple[float, float]]
) -> str:
    """A line for each lateness; ``goals`` are those of what is stated."""
    from easi_jax.estimation.posterior import UNSTATED

    lines = []
    for late in sorted({r["late"] for r in rows}):
        mine = [r for r in rows if r["late"] == late]
        plain = [{**r, "plain": {"distance": r[WAYS[-1]]["bound"]}} for r in mine]
        inside = [share(covered(plain, "plain", q)) for q in (0.5, 0.9)]
        for q in (0.5, 0.9):
            hit = covered(mine, WAYS[-1], q)
            told = f", {judged(hit, goals[q])}" if q in goals else ""
            inside.append(share(hit) + told)
        error = f"{np.median(beside_bound(mine, WAYS[-1])):.3g}"
        silent = [
            r.get("no_region") or r.get("times_noise", 0) > UNSTATED for r in mine
        ]
        none = np.array(silent, bool)
        told = f"{none.sum()}"
        if late == 0:  # a model that is right says where its parameters are
            told += f", {judged(none, (0.0, SILENT))}"
        lines.append((f"{1000 * late:g} ms", len(mine), *inside, error, told))
    head = (
        *("late by", "targets", "50 %, information", "90 %, information"),
        *("50 %, as stated", "90 %, as stated", "error / bound", "no region"),
    )
    return markdown_table(head, lines)


def share(hit: np.ndarray, digits: int = 0) -> str:
    """How many of all, ``(targets,)`` bool, and its interval."""
    low, high = wilson(int(hit.sum()), len(hit))
    return f"{hit.mean():.0%} [{low:.{digits}%}, {high:.{digits}%}]"


def judged(hit: np.ndarray, goal: tuple[float, float]) -> str:
    """Whether a goal is reached by a share, or cannot be told from it."""
    if goal[0] <= hit.mean() <= goal[1]:
        return met(True)
    low, high = wilson(int(hit.sum()), len(hit))
    touches = low <= goal[1] and high >= goal[0]
    return NOT_TOLD if touches else met(False)


def _right(rows: list[dict[str, Any]]) -> list[str]:
    lines = []
    few = f" by {len(rows)} of {TARGETS} targets" if len(rows) < TARGETS else ""
    for way in WAYS:
        inside = {q: covered(rows, way, q) for q in (0.5, 0.9)}
        ratio, most = np.quantile(beside_bound(rows, way), (0.5, 0.95))
        cells = []
        for q, hit in inside.items():
            told = share(hit, 1)
            if way in MEANT:
                told += f", {judged(hit, GOALS[q])}{few}"
            cells.append(told)
        told = f"{ratio:.2f}" + (f", {met(ratio <= BOUND)}" if way == WAYS[-1] else "")
        lines.append((way, *cells, told, f"{most:.3g}"))
    head = ("", "50 % region", "90 % region", "error / bound", "of 95 %")
    return [
        f"`python -m benchmarks.coverage`, {len(rows)} Cartpoles with parameters drawn "
        f"from UDR's range, sensor noise, commits {commits_of(rows)}. Share of "
        "truths inside the stated regions along the directions that the data "
        "determine (95 % interval); goals 45 to 55 % and 87 to 93 %, missed where the "
        "interval excludes all of that, and not told from it where it holds a part. "
        "Error as a multiple of the Cramer-Rao bound, median; goal at most "
        f"{BOUND:g} after refinement; and what 95 % of the targets stay below. "
        "`search, own spread` is what the evolution strategy ends with, `search` has "
        "the spread that is stated without refinement.",
        markdown_table(head, lines),
        *_centered(rows),
        *_unseen(rows),
        computing(rows),
    ]


def _centered(rows: list[dict[str, Any]]) -> list[str]:
    """Whether errors of what the data determine are zero on average."""
    told: dict[int, list[float]] = {}
    for r in rows:
        last = r[WAYS[-1]]
        given = zip(*(last.get(k, ()) for k in ("off", "std")), strict=True)
        for i, (off, std) in enumerate(given):
            if r["determined"][i]:
                told.setdefault(i, []).append(off / std)
    if not told:
        return []
    means = [(abs(float(np.mean(z))), len(z)) for z in told.values()]
    most, count = max(means)
    error = count**-0.5
    least = most - _TWO_SIDED * error
    end = met(most <= OFF) if most <= OFF or least > OFF else NOT_TOLD
    return [
        f"Of {len(told)} parameters, where the data determine them, the mean error "
        f"after refinement is {most:.2f} of its stated standard deviation at most "
        f"(by {count} targets, standard error {error:.2f}); goal {OFF:g}: "
        f"{end}."
    ]


def _unseen(rows: list[dict[str, Any]]) -> list[str]:
    """Whether something is stated of what data do not show; no region counts that."""
    far = [
        abs(off) / std
        for r in rows
        for off, std, seen in zip(
            *(r[WAYS[-1]].get(k, ()) for k in ("off", "std")),
            r.get("determined", ()),
            strict=True,
        )
        if not seen
    ]
    if not far:
        return []
    beyond = [sum(x > times for x in far) for times in (_NINETY, _FAR)]
    return [
        f"Of {len(far)} parameters that the data do not determine by themselves, "
        f"{beyond[0]} are outside what is stated of each after refinement with 90 %, "
        f"{beyond[1]} of them farther than {_FAR:g} standard deviations."
    ]


def covered(rows: list[dict[str, Any]], way: str, share: float) -> np.ndarray:
    """Whether the truth lies inside the region of that probability, ``(targets,)``."""
    from scipy.stats import chi2

    rank = np.array([r["rank"] for r in rows])
    distance = np.array([r[way]["distance"] for r in rows])
    return distance <= chi2.ppf(share, rank)


def beside_bound(rows: list[dict[str, Any]], way: str) -> np.ndarray:
    """RMS errors in units of the Cramer-Rao bound, ``(targets,)``."""
    return np.array([(r[way]["bound"] / max(r["rank"], 1)) ** 0.5 for r in rows])


SECTIONS = (
    Section(
        *("## What the stated spread is worth", "coverage.jsonl", "coverage", _right)
    ),
    Section(
        *("### Spreads where the model falls short", "coverage_late.jsonl"),
        *("coverage --late 0.005", _late),
    ),
    Section(
        *("### Spreads of parameters from logs", "coverage_logs.jsonl"),
        *("coverage --logs", _logs),
    ),
    Section(
        *("### Spreads with late commands in doubt that are in time",),
        *("coverage_doubts.jsonl", "coverage --doubts", _late),
    ),
)
