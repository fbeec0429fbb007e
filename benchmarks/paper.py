"""The paper's tables and figures, cell by cell.

    python -m benchmarks.paper table1
    python -m benchmarks.paper table1 --robot ant --seeds 0 1 2
    python -m benchmarks.paper table3 --shard 1/2
    python -m benchmarks.paper table5 --list
    python -m benchmarks.paper status
    python -m benchmarks.paper all --workers 2

A cell is one method, robot, target and seed. Each that is done is a line of
``results/paper.jsonl``, and is not run again: a run that was stopped goes on, and
several processes or batch jobs share the work by ``--shard`` (the second of four is
2/4) or ``--only``. ``status`` shows for all experiments what stands, what is stale
(made before its method was changed) and what the rest takes; ``all`` runs that rest.
Tables and figures are made from that file alone
(``python -m benchmarks.summary``).
"""

from typing import Any

from benchmarks import paper_status, paper_twin
from benchmarks._cells import run_cells
from benchmarks.paper_cells import Cell
from benchmarks.paper_experiments import WHOLE, Config, cells
from benchmarks.paper_runtime import WAYS
from train._command import main


def run(config: Config) -> None:
    """Runs the cells that are not there yet."""
    from benchmarks.paper_cells import is_stale, recipe, solve
    from benchmarks.paper_runtime import timed

    if config.experiment in WHOLE:
        paper_status.check(config)
        if config.experiment == "status":
            return paper_status.status(config)
        return paper_status.run_all(config)

    def result(c: Cell) -> dict[str, Any]:
        made = {"recipe": recipe(c.method, c.robot)}
        if c.method in WAYS:
            return timed(c) | made
        if c.target == paper_twin.TWIN:
            return paper_twin.solve(c, config.folder) | made
        return solve(c, config.folder) | made

    def told(row: dict[str, Any]) -> str:
        result = f"return {row['return']:.1f}" if "return" in row else "identified"
        return f"{result}, {row.get('seconds', row.get('identify_s', 0)):.0f} s"

    run_cells(cells(config), config, result, told, passed=lambda row: not is_stale(row))


if __name__ == "__main__":
    main(Config, run, name="benchmarks.paper")
