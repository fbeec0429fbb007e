"""Whether ``train.gap`` names the same at every horizon, on generated machines.

    python -m benchmarks.gap_horizons_cases --shard 1/2

The first forty machines of one or two joints of `benchmarks.gap_frozen` that lack
something, each at four horizons of the report.
"""

import dataclasses
import tempfile
import time
from pathlib import Path
from typing import Any

from benchmarks._cells import Share, run_cells
from benchmarks.gap import asked
from benchmarks.gap_frozen import RESULTS, Cell, cells, drawn
from benchmarks.gap_horizons import HORIZONS, farthest, is_same
from benchmarks.gap_score import keys_of
from train._command import main
from train._options import EngineOptions

LINES = RESULTS / "gap_horizons_cases.jsonl"
COUNT = 40
_LACKING_NONE = "none", "wrong_own"


@dataclasses.dataclass(frozen=True)
class Config(Share, EngineOptions):
    """Asks train.gap about the same generated machines at several horizons."""

    out: Path = LINES
    """Where a line for each machine is added."""


def run(config: Config) -> None:
    """Asks and compares, machine by machine."""
    small = [c for c in cells() if not c.wide and c.kind not in _LACKING_NONE]
    run_cells(small[:COUNT], config, _solve, _told)


def _solve(cell: Cell) -> dict[str, Any]:
    began = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        data = Path(folder) / "case"
        drawn(cell, data)
        found = [
            {"horizon": h, **asked(data, Path(folder) / f"{h:g}", horizon=h)}
            for h in HORIZONS
        ]
    return {
        "same_names": is_same(found),
        "farthest_value": farthest(found),
        "named": {f"{f['horizon']:g}": keys_of(f["effects"]) for f in found},
        "verdicts": {f"{f['horizon']:g}": f["verdict"] for f in found},
        "seconds": time.perf_counter() - began,
    }


def _told(row: dict[str, Any]) -> str:
    each = "; ".join(f"{h} s: {', '.join(n) or '-'}" for h, n in row["named"].items())
    return f"{'the same' if row['same_names'] else 'OTHERS'} ({each})"


if __name__ == "__main__":
    main(Config, run, name="benchmarks.gap_horizons_cases")
