"""Whether the confidence of ``train.gap`` comes true, and the curve that it follows.

    python -m benchmarks.gap --kind mixed --seeds 80200 80210 --cheap \
        --out benchmarks/results/gap_curve.jsonl
    python -m benchmarks.gap_confidence

The curve of `easi_jax.gap.model_comparison.confidence` is fitted by maximum likelihood
to the lines that the first command adds (kinds ``single``, ``pair``, ``several``: known
effects; ``mixed`` and ``real``: known beside unknown ones; ``outside``: unknown ones
alone). It is tested on machines that it was not fitted to: of these lines with each
mechanism left out in turn, and of the frozen set (`benchmarks.gap_frozen`).
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.gap_frozen import FROZEN, RESULTS
from benchmarks.gap_score import brier
from easi_jax.gap.model_comparison import confidence
from train._command import main, say, show_table

LINES = RESULTS / "gap_curve.jsonl"
FAMILIES = {"outside": "unknown", "mixed": "mixed", "real": "mixed"}  # others: known
_BINS = 5
_SURE = 0.8
_UNKNOWN = 1 / 3  # of the names that the curve is fitted to: beside unknown effects


@dataclasses.dataclass(frozen=True)
class Config:
    """Counts how often what train.gap names is there, by the confidence stated."""

    lines: Path = LINES
    """Lines of benchmarks.gap, that the curve is fitted to."""
    frozen: Path = FROZEN
    """Lines of benchmarks.gap_frozen; without the file that part is left out."""


@dataclasses.dataclass(frozen=True)
class Said:
    """Effects that were named, n of them.

    Attributes:
        confidence: stated, ``(n,)``.
        cost: of taking them out [nats], ``(n,)``.
        odds: of their rivals, ``(n,)``.
        there: whether they, or a twin, are in the machine, ``(n,)`` bool.
        family: known, mixed or unknown, ``(n,)``.
        mechanism: ``(n,)``.
    """

    confidence: np.ndarray
    cost: np.ndarray
    odds: np.ndarray
    there: np.ndarray
    family: np.ndarray
    mechanism: np.ndarray

    def some(self, which: np.ndarray) -> "Said":
        """A part of them."""
        return Said(**{name: x[which] for name, x in vars(self).items()})

    def by(self, even: float, steep: float) -> "Said":
        """With the confidence that a curve would state."""
        each = zip(self.cost, self.odds, strict=True)
        stated = [confidence(c, o, even, steep) for c, o in each]
        return dataclasses.replace(self, confidence=np.array(stated))


def said(rows: Sequence[dict[str, Any]]) -> Said:
    """All that was named in some lines, but faults of readings, which are judged by
    themselves."""
    named = [
        (r, k) for r in rows for k, x in enumerate(r["removal_cost"]) if x is not None
    ]

    def every(key: str) -> np.ndarray:
        return np.array([r[key][k] for r, k in named], float)

    def of_row(value: Any) -> np.ndarray:
        return np.array([value(r) for r, _ in named])

    return Said(
        confidence=every("confidence"),
        cost=every("removal_cost"),
        odds=every("rival_odds"),
        there=every("there").astype(bool),
        family=of_row(lambda r: FAMILIES.get(r["kind"], "known")),
        mechanism=of_row(lambda r: r["mechanism"]),
    )


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


def by_family(part: Said) -> dict[str, dict[str, float]]:
    """`figures` of all, and of each family that has names."""
    each = {"all": np.ones(len(part.there), bool)}
    each |= {f: part.family == f for f in ("known", "mixed", "unknown")}
    return {
        family: figures(part.confidence[mine], part.there[mine])
        for family, mine in each.items()
        if mine.any()
    }


def fitted(part: Said) -> tuple[float, float]:
    """The curve that makes what was the case most likely: even [nats] and steep."""
    from scipy.optimize import minimize

    known = part.family == "known"
    share = np.where(known, 1 - _UNKNOWN, _UNKNOWN)
    weight = share / np.where(known, known.mean(), 1 - known.mean())

    def unlikely(at: np.ndarray) -> float:
        p = np.clip(part.by(*np.exp(at)).confidence, 1e-3, 1 - 1e-3)
        each = np.where(part.there, np.log(p), np.log(1 - p))
        return -float(weight @ each)

    even, steep = np.exp(minimize(unlikely, np.zeros(2), method="Nelder-Mead").x)
    return float(even), float(steep)


def left_out(part: Said) -> Said:
    """With the confidence that a curve would state that was fitted to all mechanisms
    but its own."""
    out = part.confidence.copy()
    for mechanism in np.unique(part.mechanism):
        mine = part.mechanism == mechanism
        out[mine] = part.some(mine).by(*fitted(part.some(~mine))).confidence
    return dataclasses.replace(part, confidence=out)


def run(config: Config) -> None:
    """Fits, tests and writes."""
    from benchmarks._cells import read_rows
    from benchmarks._common import command_of, write_result
    from easi_jax.errors import UserError

    rows = read_rows(config.lines)
    if not rows:
        raise UserError(f"{config.lines}: no lines; python -m benchmarks.gap --help")
    every = said(rows)
    even, steep = fitted(every)
    told = {"mechanism left out": by_family(left_out(every))}
    frozen = read_rows(config.frozen)
    if any(r["named"] for r in frozen):
        told["frozen set, as stated"] = by_family(said(frozen))
    for name, families in told.items():
        show_table(
            f"Confidence of train.gap: {name}",
            ("family", *next(iter(families.values()))),
            [(k, *(f"{x:.3g}" for x in f.values())) for k, f in families.items()],
        )
    path = write_result(
        "gap_confidence",
        command_of("benchmarks.gap_confidence", config),
        {
            "lines": len(rows),
            "frozen": len(frozen),
            "commits": sorted({r["commit"] for r in rows}),
        },
        families=told,
        curve={"even [nats]": even, "steep": steep},
    )
    say(f"fitted: even at {even:.2f} nats, steepness {steep:.2g}")
    say(f"written: {path}")


if __name__ == "__main__":
    main(Config, run, name="benchmarks.gap_confidence")
