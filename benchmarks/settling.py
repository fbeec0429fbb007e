"""Do policies get better with more training, and with which settings?

    python -m benchmarks.settling
    python -m benchmarks.settling --robots ballbalance --seeds 0 1 2

A training has settled where another half of its steps adds less than 3 % to the return:
methods whose policies are trained for so long are compared by what they found, and not
by how far their trainings got. Each robot trains in its model as it is, by its preset
and by one changed setting at a time: policy and value clipped apart (PPO), rewards
times 0.1, 0.3 and 3 in the losses. The budget is the preset's, its half, and one and a
half and three times of it; the learning rate falls to its end in each. A cell is a line
of ``settling.jsonl``; a run that was stopped goes on.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import mean
from typing import Any

from benchmarks._cells import Share, run_cells
from benchmarks._common import RESULTS, commits_of
from benchmarks._page import Section, each_of, table
from train._command import main

_FILE = "settling.jsonl"
ROBOTS = ("cartpole", "ballbalance", "ant", "go2")
SETTINGS: Mapping[str, Mapping[str, Any]] = {
    "preset": {},
    "clipped apart": {"clip_apart": True},
    "rewards x 0.1": {"reward_scaling": 0.1},
    "rewards x 0.3": {"reward_scaling": 0.3},
    "rewards x 3": {"reward_scaling": 3.0},
}
BUDGETS = (1.0, 1.5, 0.5, 3.0)  # times the preset's steps, in the order of interest
SETTLED = 0.03  # of the return, that half of the steps more may add


@dataclasses.dataclass(frozen=True)
class Cell:
    """A training.

    Attributes:
        robot: built-in, by its default algorithm.
        setting: a name in `SETTINGS`.
        budget: times the preset's control steps.
        seed: of everything random.
    """

    robot: str
    setting: str
    budget: float
    seed: int

    @property
    def key(self) -> str:
        """One line that says it all, for files."""
        return f"{self.robot}, {self.setting}, {self.budget:g}, seed {self.seed}"


@dataclasses.dataclass(frozen=True)
class Config(Share):
    """Trains robots for longer than their presets do, and by other settings."""

    robots: tuple[str, ...] = ROBOTS
    """Built-in robots."""
    settings: tuple[str, ...] = tuple(SETTINGS)
    """preset, clipped apart, rewards x 0.1, rewards x 0.3, rewards x 3."""
    budgets: tuple[float, ...] = BUDGETS
    """Times the control steps of the preset."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Seeds."""
    out: Path = dataclasses.field(default=RESULTS / _FILE, kw_only=True)
    """Where a line for each is added."""


def run(config: Config) -> None:
    """Runs the cells that are not there yet."""
    run_cells(cells(config), config, solve, lambda r: f"return {r['return']:.1f}")


def cells(config: Config) -> list[Cell]:
    """The trainings, those that say most first.

    Raises:
        UserError: no such robot or setting, or a budget that makes no sense.
    """
    from easi_jax.errors import UserError, nearest
    from train._robots import check_seeds

    check_seeds(config.seeds)
    for given, known in ((config.robots, ROBOTS), (config.settings, tuple(SETTINGS))):
        for name in given:
            if name not in known:
                raise UserError(f'"{name}": {", ".join(known)}{nearest(name, known)}')
    if not all(0 < x < float("inf") for x in config.budgets):
        raise UserError(f"--budgets {config.budgets}: give numbers above 0")
    return [
        Cell(robot, setting, budget, seed)
        for setting in config.settings
        for budget in config.budgets
        for seed in config.seeds
        for robot in config.robots
        if _has(robot, setting)
    ]


def solve(cell: Cell) -> dict[str, Any]:
    """Trains and tests; returns what `benchmarks.brax_beside.solve` does."""
    from benchmarks.brax_beside import ours, tried
    from envs import make

    return tried(ours, make(cell.robot), settings_of(cell), cell.seed)


def settings_of(cell: Cell) -> Any:
    """The preset of the robot, changed as the cell says."""
    from easi_jax.baselines.policies import quiet

    preset = quiet(_preset(cell.robot))
    steps = round(cell.budget * preset.env_steps)
    return dataclasses.replace(preset, env_steps=steps, **SETTINGS[cell.setting])


def _preset(robot: str) -> Any:
    from easi_jax.rl.presets import training_preset
    from envs import make

    return training_preset(make(robot))


def _has(robot: str, setting: str) -> bool:
    """Whether the robot's algorithm has the setting."""
    return all(hasattr(_preset(robot), name) for name in SETTINGS[setting])


def _paragraphs(rows: list[dict[str, Any]]) -> list[str]:
    groups: dict[tuple[str, str], dict[float, list[dict[str, Any]]]] = {}
    for r in sorted(rows, key=lambda r: (r["budget"], r["seed"])):
        groups.setdefault((r["robot"], r["setting"]), {}).setdefault(
            r["budget"], []
        ).append(r)
    lines = []
    for (robot, setting), by in groups.items():
        for budget, some in by.items():
            lines.append(
                {
                    **{"robot": robot, "setting": setting},
                    "steps": f"{some[0]['steps']:,}",
                    "returns": [r["return"] for r in some],
                    "adds": _told(some, by.get(1.5 * budget, []), budget),
                }
            )
    columns = {
        "robot": "{robot}",
        "setting": "{setting}",
        "control steps": "{steps}",
        "return (every seed)": lambda r: (
            f"{mean(r['returns']):.1f} ({each_of(r['returns'], 1)})"
        ),
        "half as many more add": "{adds}",
    }
    return [
        "`python -m benchmarks.settling`: trainings in the robot as it is, by its "
        f"preset and by one changed setting, commits {commits_of(rows)}. Settled is "
        f"what another half of the steps makes less than {SETTLED:.0%} better, in the "
        "mean over seeds that have both.",
        table(lines, columns),
    ]


def added(
    rows: Sequence[Mapping[str, Any]], longer: Sequence[Mapping[str, Any]]
) -> float | None:
    """Share of the mean return that ``longer`` trainings of the same seeds add; None
    where no seed has both."""
    later = {r["seed"]: r["return"] for r in longer}
    both = [(r["return"], later[r["seed"]]) for r in rows if r["seed"] in later]
    if not both:
        return None
    before, after = (mean(x) for x in zip(*both, strict=True))
    return (after - before) / max(abs(before), 1e-9)


def _told(
    rows: Sequence[Mapping[str, Any]],
    longer: Sequence[Mapping[str, Any]],
    budget: float,
) -> str:
    adds = added(rows, longer)
    if adds is None:
        return "not run" if 1.5 * budget in BUDGETS else "-"
    if adds < -SETTLED:
        return f"{adds:+.1%}: a training's chance is larger"
    return f"{adds:+.1%}" + (", settled" if adds < SETTLED else "")


SECTIONS = (Section("## Trainings that settle", _FILE, "settling", _paragraphs),)


if __name__ == "__main__":
    main(Config, run, name="benchmarks.settling")
