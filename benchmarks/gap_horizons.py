"""Whether ``train.gap`` names the same at every horizon of its report.

    python -m benchmarks.gap_horizons --data ../shared/data

On recordings of real machines: names and values at horizons of 0.05 to 1 s, beside
those at the first.
"""

import dataclasses
import tempfile
from pathlib import Path
from typing import Any

from benchmarks.gap_real import MACHINES, analysed, check
from benchmarks.gap_score import keys_of
from train._command import main, say, show_table
from train._options import EngineOptions

NAMES = "double_pendulum", "emps", "cartpole", "pendulum"
HORIZONS = 0.2, 0.05, 0.5, 1.0  # of the report [s]
MADE = {name: MACHINES[name] for name in NAMES}


@dataclasses.dataclass(frozen=True)
class Config(EngineOptions):
    """Asks train.gap about the same recordings at several horizons."""

    data: Path = Path("../shared/data")
    """Folder of the recordings."""
    machines: tuple[str, ...] = tuple(MADE)
    """Which of them."""
    horizons: tuple[float, ...] = HORIZONS
    """Of the report [s]."""


def run(config: Config) -> None:
    """Asks, compares and writes, machine by machine."""
    from benchmarks._common import command_of, write_result

    check(config.machines, MADE, config.data)
    for name in config.machines:
        found = []
        for horizon in config.horizons:
            machine = dataclasses.replace(MADE[name], horizon=horizon)
            with tempfile.TemporaryDirectory() as folder:
                told = analysed(machine, config.data, Path(folder) / "gap")
            found.append({"horizon": horizon, **told})
            named = ", ".join(keys_of(told["effects"])) or "nothing"
            say(f"{name}, {horizon:g} s: {named}")
        chosen = dataclasses.replace(config, machines=(name,))
        path = write_result(
            f"gap_horizons_{name}",
            command_of("benchmarks.gap_horizons", chosen),
            {"machine": name, "folder": MADE[name].folder},
            same_names=is_same(found),
            farthest_value=farthest(found),
            horizons=found,
        )
        show_table(name, ("horizon [s]", "verdict", "gap", "names"), table(found))
        say(f"written: {path}")


def is_same(found: list[dict[str, Any]]) -> bool:
    """Whether the same effects are named, in any order."""
    return len({tuple(sorted(keys_of(f["effects"]))) for f in found}) == 1


def farthest(found: list[dict[str, Any]]) -> float:
    """The largest relative difference of a value from that at the first horizon, of
    effects that both name."""
    first, *others = map(_values, found)
    off = [
        abs(value / first[key] - 1.0)
        for values in others
        for key, value in values.items()
        if first.get(key)
    ]
    return max(off, default=0.0)


def _values(told: dict[str, Any]) -> dict[tuple[str, str], float]:
    """Of each parameter of each effect."""
    keys = keys_of(told["effects"])
    return {
        (key, k): p["value"]
        for key, e in zip(keys, told["effects"], strict=True)
        for k, p in e["parameters"].items()
    }


def table(found: list[dict[str, Any]]) -> list[tuple[str, ...]]:
    """A row for each horizon."""
    rows = []
    for told in found:
        gap = told["gap"]
        figures = f"{gap['before']:.3g} to {gap['after']:.3g}, floor {gap['floor']:.2g}"
        rows.append(
            (
                f"{told['horizon']:g}",
                told["verdict"],
                figures,
                ", ".join(keys_of(told["effects"])),
            )
        )
    return rows


if __name__ == "__main__":
    main(Config, run, name="benchmarks.gap_horizons")
