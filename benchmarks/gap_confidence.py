"""Whether the confidence of ``train.gap`` comes true, and the curve that it follows.

    python -m benchmarks.gap --kind mixed --seeds 61000 61010 --cheap --engine mujoco \
        --out benchmarks/results/gap_confidence.jsonl
    python -m benchmarks.gap_confidence

Reads the lines that the first command adds (kinds ``single``, ``pair``, ``several``:
known effects; ``mixed``: one beside one that no table has; ``outside``: that alone) and
counts how often what was stated is there. The curve of
`easi_jax.gap.model_comparison.confidence` is fitted to them anew by maximum likelihood,
for comparison with the one in the code, which was fitted to older seeds.
"""

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.gap_score import brier, judged
from easi_jax.gap.decisions import DECIDE
from easi_jax.gap.model_comparison import confidence
from train._command import main, say, show_table

RESULTS = Path(__file__).parent / "results"
LINES = RESULTS / "gap_confidence.jsonl"
FAMILIES = {"outside": "unknown", "mixed": "mixed"}  # all other kinds: known
_BINS = 5
_SURE = 0.8
_GAPS = 2.5, 5.0, 15.0  # floors, that bins of older lines end at
_SIZES = *map(str, _GAPS), "more"
_OLDER = "gap_cases.jsonl", "gap_cases_fitted.jsonl", "gap_confidence.jsonl"


@dataclasses.dataclass(frozen=True)
class Config:
    """Counts how often what train.gap names is there, by the confidence stated."""

    lines: Path = LINES
    """Lines of benchmarks.gap."""


@dataclasses.dataclass(frozen=True)
class Said:
    """Effects that were named, n of them.

    Attributes:
        confidence: stated, ``(n,)``.
        cost: of taking them out [nats], ``(n,)``.
        there: whether they, or a twin, are in the machine, ``(n,)`` bool.
        family: known, mixed or unknown, ``(n,)``.
    """

    confidence: np.ndarray
    cost: np.ndarray
    there: np.ndarray
    family: np.ndarray


def said(rows: Sequence[dict[str, Any]]) -> Said:
    """All that was named in some lines."""
    of = [FAMILIES.get(r["kind"], "known") for r in rows for _ in r["named"]]

    def every(key: str) -> np.ndarray:
        return np.array([x for r in rows for x in r[key]])

    there = every("there").astype(bool)
    return Said(every("confidence"), every("removal_cost"), there, np.array(of))


def figures(stated: np.ndarray, there: np.ndarray) -> dict[str, float]:
    """How true statements ``(n,)`` came: Brier score, mean distance of bins from what
    was the case less what chance makes of it, and how many were sure and wrong."""
    bins = np.minimum((stated * _BINS).astype(int), _BINS - 1)
    off = 0.0
    for k in np.unique(bins):
        mine, right = stated[bins == k], there[bins == k]
        # The variance of a share is taken off its squared distance.
        by_chance = float(np.mean(mine * (1 - mine))) / len(mine)
        square = max((mine.mean() - right.mean()) ** 2 - by_chance, 0.0)
        off += len(mine) / len(stated) * float(np.sqrt(square))
    return {
        "names": len(stated),
        "there": int(there.sum()),
        "mean confidence": float(stated.mean()),
        "Brier score": brier(list(zip(there, stated, strict=True))),
        "calibration error": off,
        "wrong above 0.8": int(((stated > _SURE) & ~there).sum()),
    }


def by_family(part: Said, families: Sequence[str]) -> dict[str, dict[str, float]]:
    """`figures` of each family that has names."""
    each = {family: part.family == family for family in families}
    return {
        family: figures(part.confidence[mine], part.there[mine])
        for family, mine in each.items()
        if mine.any()
    }


def fitted(part: Said) -> np.ndarray:
    """Logarithms of the curve's two numbers that make what was the case most likely,
    ``(2,)``."""
    from scipy.optimize import minimize

    alone = np.array([confidence(c, 0.0) for c in part.cost])
    odds = np.maximum(alone / np.maximum(part.confidence, 1e-9) - 1.0, 0.0)

    def unlikely(at: np.ndarray) -> float:
        each = zip(part.cost, odds, strict=True)
        p = np.array([confidence(c, o, *np.exp(at)) for c, o in each])
        p = np.clip(p, 1e-3, 1 - 1e-3)
        return -float(np.sum(np.where(part.there, np.log(p), np.log(1 - p))))

    return minimize(unlikely, np.zeros(2), method="Nelder-Mead").x


def by_gaps(rows: Sequence[dict[str, Any]], anyway: float) -> Said:
    """All that was named in some lines, the cost from the gap before and after each
    effect joined: for lines that do not hold it. The confidence is the curve's, without
    rivals; families are sizes of the gap.

    Args:
        rows: of ``benchmarks.gap``.
        anyway: times the floor, within which all counts as open with an effect, too.
    """
    cost, there, gap = [], [], []
    for r in rows:
        floor, least = r["gap"]["floor"], anyway**2 - 1.0
        path = [r["gap"]["refit"], *r["gap_after"]]
        left = [max((x / floor) ** 2 - 1.0, 0.0) + least for x in path]
        for k, (ok, _) in enumerate(judged([r])):
            without = max(left[k] - left[k + 1], 0.0) + left[-1]
            cost.append(0.5 * np.log(without / left[-1]))
            there.append(bool(ok))
            gap.append(path[0] / floor)
    sizes = np.array(_SIZES)[np.searchsorted(_GAPS, gap)]
    stated = [confidence(c, 0.0) for c in cost]
    return Said(*(np.array(x) for x in (stated, cost, there, sizes)))


def _of_gaps() -> dict[str, Any]:
    """How true the curve comes by the size of the gap, for two ways to reckon with what
    is nearly closed."""
    every = [
        json.loads(line)
        for name in _OLDER
        for line in (RESULTS / name).read_text().splitlines()
    ]
    found = {}
    for name in ("open_from", "closed"):
        part = by_gaps(every, getattr(DECIDE, name))
        even, steep = np.exp(fitted(part))
        found[name] = {
            "all": figures(part.confidence, part.there),
            "by gap, in floors at most": by_family(part, _SIZES),
            "curve": {"even [nats]": float(even), "steep": float(steep)},
        }
    return found


def run(config: Config) -> None:
    """Counts, and fits the curve again."""
    from benchmarks._common import command_of, write_result
    from easi_jax.errors import UserError

    if not config.lines.is_file():
        raise UserError(f"{config.lines} is not there; python -m benchmarks.gap --help")
    rows = [json.loads(line) for line in config.lines.read_text().splitlines()]
    every = said(rows)
    told = {"all": figures(every.confidence, every.there)}
    told |= by_family(every, ("known", "mixed", "unknown"))
    even, steep = np.exp(fitted(every))
    show_table(
        "Confidence of train.gap",
        ("family", *next(iter(told.values()))),
        [(k, *(f"{x:.3g}" for x in f.values())) for k, f in told.items()],
    )
    path = write_result(
        "gap_confidence",
        command_of("benchmarks.gap_confidence", config),
        {"lines": len(rows), "commits": sorted({r["commit"] for r in rows})},
        families=told,
        curve={"even [nats]": float(even), "steep": float(steep)},
        by_gaps=_of_gaps(),
    )
    say(f"fitted anew: even at {even:.2f} nats, steepness {steep:.2g}")
    say(f"written: {path}")


if __name__ == "__main__":
    main(Config, run, name="benchmarks.gap_confidence")
