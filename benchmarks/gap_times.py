"""How long the gap workflow takes from a first start, by the size of the machine.

    python -m benchmarks.gap_times

A generated case each (``tests/gap_cases``), nothing cached; about half an hour on an
otherwise idle machine. Each is a line of ``benchmarks/results/gap_times.jsonl`` and is
not run again there.
"""

import dataclasses
import json
import os
import tempfile
from pathlib import Path
from typing import Any

from benchmarks._cells import Share, run_cells
from benchmarks._common import RESULTS, first_start
from benchmarks.gap_score import keys_of
from train._command import main

GOALS = {"pendulum": 15, "cartpole": 20, "leg": 60, "arm6": 150}  # s, on two cores
EFFECTS = ("coulomb_friction", "actuator_lag")
_LIMIT = 3600  # s


@dataclasses.dataclass(frozen=True)
class Cell:
    """A machine and what it hides."""

    mechanism: str
    effect: str
    seed: int

    @property
    def key(self) -> str:
        """All of it, for files."""
        return f"{self.mechanism}, {self.effect}, seed {self.seed}"


@dataclasses.dataclass(frozen=True)
class Config(Share):
    """Times train.gap on machines of one joint to six."""

    seed: int = 30_000
    """Of the cases."""
    out: Path = dataclasses.field(default=RESULTS / "gap_times.jsonl", kw_only=True)
    """Where a line for each case is added."""


def run(config: Config) -> None:
    """Runs the command in processes and compilation caches of their own."""
    cells = [Cell(m, e, config.seed) for m in GOALS for e in EFFECTS]
    run_cells(cells, config, solve, lambda row: f"{row['seconds']:.0f} s")


def solve(cell: Cell) -> dict[str, Any]:
    """Draws a case, and times what is said of it."""
    from easi_jax.errors import UserError
    from tests.gap_cases import CaseError, draw_case

    with tempfile.TemporaryDirectory() as folder:
        case = Path(folder) / "case"
        try:
            draw_case(
                *(cell.seed, "single", case),
                effect=cell.effect,
                mechanism=cell.mechanism,
            )
        except CaseError as error:
            raise UserError(f"{cell.key}: {error}; give another --seed") from error
        seconds, told = timed(case, Path(folder))
        answer = json.loads((case / "answer.json").read_text())
    return {
        "truth": keys_of(answer["effects"]),
        "named": keys_of(told["effects"]),
        "seconds": seconds,
        "goal_s": GOALS[cell.mechanism],
        "cores": len(os.sched_getaffinity(0)),
    }


def timed(case: Path, folder: Path) -> tuple[float, dict]:
    """Seconds of ``train.gap`` on a case, and its ``gap.json``."""
    words = [
        *("-m", "train.gap", "--model", str(case / "model.xml")),
        *("--data", *map(str, sorted(case.glob("run*.csv")))),
        *("--out", str(folder / "gap")),
    ]
    seconds, _ = first_start(words, folder / "cache", _LIMIT)
    return seconds, json.loads((folder / "gap" / "gap.json").read_text())


if __name__ == "__main__":
    main(Config, run, name="benchmarks.gap_times")
