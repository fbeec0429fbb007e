"""Identification at equal data and budget: EASI, its rivals and today's tools.

    python -m benchmarks.rivals
    python -m benchmarks.rivals --robots cartpole --settings paired --seeds 0 1 2
    python -m benchmarks.rivals --shard 1/4
    python -m benchmarks.rivals --list

A cell is one robot, setting, method and seed. Each seed draws its own machine, every
parameter within 1.5 times its nominal value either way; searches start within 3 times.
All methods get the same recording and the same budget of simulated control steps, a
derivative counting as one: about what EASI takes at most, its least-squares finish
included. All others get the whole recording. Where the budget does not pay for enough
rounds on all of it, CMA-ES and DROPO replay a part drawn anew in each generation,
random search judges its best on all of it, and mujoco.sysid and NPE get a part at even
distances. What train.gap simulates comes on top, and is in the seconds. Settings:

    clean       logged commands, deterministic ones, no noise
    paired      the same with sensor noise, as in all that follow
    unpaired    single transitions in any order, of an unknown controller
    stochastic  a controller with exploration noise
    effect      the same, and commands reach the target's drives 30 ms late, which no
                model has; there, EASI is tried after train.gap as well

Lines go to ``results/rivals.jsonl``; a cell that has one is not run again. mujoco.sysid
and NPE need ``pip install -e '.[peers]'``.
"""

import dataclasses
from pathlib import Path
from typing import Any

from benchmarks._cells import Share, run_cells
from benchmarks._common import at_least_one
from benchmarks.rival_cells import BUDGETS, METHODS, ROBOTS, SETTINGS, Cell, solve
from train._command import main

RESULTS = Path(__file__).parent / "results" / "rivals.jsonl"


@dataclasses.dataclass(frozen=True)
class Config(Share):
    """Compares methods of identification at equal data."""

    robots: tuple[str, ...] = ROBOTS
    """cartpole, arm6, go2 (hung by its base)."""
    settings: tuple[str, ...] = SETTINGS
    """clean, paired, unpaired, stochastic, effect."""
    methods: tuple[str, ...] = METHODS
    """Methods; SimOpt runs where it has an environment and the controller, and
    train.gap before EASI where the target has an effect."""
    seeds: tuple[int, ...] = (0, 1, 2, 3, 4)
    """Seeds, paired over methods."""
    trajectories: int = 40
    """Recorded trajectories of 200 control steps."""
    budget: int | None = None
    """Control steps that each method may simulate; not given: 40 million, on go2 6."""
    out: Path = dataclasses.field(default=RESULTS, kw_only=True)
    """Where a line for each cell is added."""


def run(config: Config) -> None:
    """Runs the cells that are not there yet."""

    def told(row: dict[str, Any]) -> str:
        if row["error"] is None:
            return f"these data determine nothing, {row['seconds']:.0f} s"
        return (
            f"error {row['error']:.3f} (start {row['start_error']:.3f}) along "
            f"{row['rank']} directions, truth "
            f"{'inside' if row['covered'] else 'outside'}, {row['seconds']:.0f} s"
        )

    run_cells(cells(config), config, solve, told)


def cells(config: Config) -> list[Cell]:
    """The cells, in the order in which they are run.

    Raises:
        UserError: no such robot, setting or method, or a number that makes no sense.
    """
    from easi_jax.errors import UserError, nearest
    from train._robots import check_seeds

    check_seeds(config.seeds)
    at_least_one(config, "trajectories", "budget")
    for flag, given, known in (
        ("robots", config.robots, ROBOTS),
        ("settings", config.settings, SETTINGS),
        ("methods", config.methods, METHODS),
    ):
        for name in given:
            if name not in known:
                raise UserError(
                    f'--{flag} "{name}": {", ".join(known)}{nearest(name, known)}'
                )
    every = (
        Cell(robot, setting, method, seed, config.trajectories, budget)
        for seed in config.seeds
        for robot in config.robots
        for budget in (BUDGETS[robot] if config.budget is None else config.budget,)
        for setting in config.settings
        for method in config.methods
    )
    return [c for c in every if c.possible]


if __name__ == "__main__":
    main(Config, run, name="benchmarks.rivals")
