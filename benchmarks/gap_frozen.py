"""Four hundred generated machines, all solved by one commit: what is said of train.gap.

    python -m benchmarks.gap_frozen --list
    python -m benchmarks.gap_frozen --shard 1/2

Cases come from ``tests/gap_cases``, by seeds that nothing was fitted to; 150 of them
lack nothing. Any first part of the list has the same mixture as the whole. A run goes
on where it was stopped, on the commit that it began on: a code that changed meanwhile
would make two sets of one.
"""

import dataclasses
import tempfile
from pathlib import Path
from typing import Any

from benchmarks._cells import Share, read_rows, run_cells
from benchmarks._common import short
from benchmarks.gap import solved, told
from train._command import main
from train._options import EngineOptions

RESULTS = Path(__file__).parent / "results"
FROZEN = RESULTS / "gap_frozen.jsonl"
MIXTURE = (
    *("none", "single", "pair", "none", "single", "mixed", "wrong_own", "outside"),
    *("none", "single", "real", "none", "pair", "wrong_own", "single", "several"),
)
"""Kinds of cases, in turns."""
COUNT = 400
_FIRST_SEED = 300_000
_OTHER = 1_000_000  # between seeds of a case that could not be drawn
_DRAWS = 5


@dataclasses.dataclass(frozen=True)
class Cell:
    """A machine: one or two joints at usual rates, or ``wide``: see benchmarks.gap."""

    kind: str
    seed: int
    wide: bool

    @property
    def key(self) -> str:
        """Names its line."""
        return f"{self.kind} {self.seed}" + " wide" * self.wide


@dataclasses.dataclass(frozen=True)
class Config(Share, EngineOptions):
    """Runs train.gap on a frozen set of generated cases and grades its names."""

    out: Path = FROZEN
    """Where a line for each case is added."""


def cells() -> list[Cell]:
    """All of them; of each kind every other one is wide."""
    turns = (divmod(i, len(MIXTURE)) for i in range(COUNT))
    return [
        Cell(MIXTURE[k], _FIRST_SEED + i, bool((turn + k) % 2))
        for i, (turn, k) in enumerate(turns)
    ]


def run(config: Config) -> None:
    """Makes, runs and grades each case."""
    # Of the code that is imported now: files may change while this runs.
    commit = "" if config.list else commit_for(config.out)

    def solve(cell: Cell) -> dict[str, Any]:
        return {"commit": commit, **_solve(cell)}

    run_cells(cells(), config, solve, told)


def commit_for(out: Path) -> str:
    """The commit of this code.

    Raises:
        UserError: there are lines of another one, or files have changed since.
    """
    from easi_jax.errors import UserError
    from easi_jax.io.runs.versions import versions

    commit = versions()["commit"] or ""
    others = {r["commit"] for r in read_rows(out, ("commit",))} - {commit}
    if others:
        first = sorted(others)[0]
        raise UserError(
            f"{out} has cases of commit {short(first)}, and this is {short(commit)}: "
            f"run it there (git worktree add ../frozen {short(first)}), or give "
            "another --out"
        )
    if commit.endswith("+"):
        raise UserError("files were changed since the last commit: commit them first")
    return commit


def _solve(cell: Cell) -> dict[str, Any]:
    with tempfile.TemporaryDirectory() as folder:
        data = Path(folder) / "case"
        seed = drawn(cell, data)
        return {"drawn": seed, **solved(data, Path(folder) / "gap")}


def drawn(cell: Cell, data: Path) -> int:
    """Writes a case to ``data``, by another seed where the cell's makes none; the seed
    that did."""
    from tests.gap_cases import CaseError, draw_case

    for seed in range(cell.seed, cell.seed + _DRAWS * _OTHER, _OTHER):
        try:
            draw_case(seed, cell.kind, data, cheap=not cell.wide, wide=cell.wide)
        except CaseError:
            continue
        return seed
    raise CaseError(f"{cell.key}: no case in {_DRAWS} draws")


if __name__ == "__main__":
    main(Config, run, name="benchmarks.gap_frozen")
