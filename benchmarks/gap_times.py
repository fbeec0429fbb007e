"""How long the gap workflow takes from a first start, by the size of the machine.

    python -m benchmarks.gap_times

A generated case each (``tests/gap_cases``), nothing cached; about half an hour on an
otherwise idle machine. Results go to ``benchmarks/results/gap_times.json``.
"""

import dataclasses
import json
import os
import tempfile
from pathlib import Path

from benchmarks._common import first_start
from train._command import main, say, show_table

GOALS = {"pendulum": 90, "cartpole": 180, "leg": 300, "arm6": 600}  # s, on two cores
EFFECTS = ("coulomb_friction", "actuator_lag")
_LIMIT = 3600  # s


@dataclasses.dataclass(frozen=True)
class Config:
    """Times train.gap on machines of one joint to six."""

    seed: int = 30_000
    """Of the cases."""


def run(config: Config) -> None:
    """Runs the command in processes and compilation caches of their own."""
    from benchmarks._common import command_of, write_result
    from tests.gap_cases import CaseError, draw_case

    rows = []
    for mechanism, goal in GOALS.items():
        for effect in EFFECTS:
            with tempfile.TemporaryDirectory() as folder:
                case = Path(folder) / "case"
                try:
                    draw_case(
                        config.seed, "single", case, effect=effect, mechanism=mechanism
                    )
                except CaseError as error:
                    say(f"{mechanism}, {effect}: no case ({error})")
                    continue
                seconds, told = timed(case, Path(folder))
                answer = json.loads((case / "answer.json").read_text())
            rows.append(
                {
                    "mechanism": mechanism,
                    "truth": [f"{e['effect']}@{e['at']}" for e in answer["effects"]],
                    "named": [f"{e['effect']}@{e['at']}" for e in told["effects"]],
                    "seconds": seconds,
                    "goal_s": goal,
                }
            )
            say(f"{mechanism}, {effect}: {seconds:.0f} s")
    path = write_result(
        "gap_times",
        command_of("benchmarks.gap_times", config),
        config,
        cores=len(os.sched_getaffinity(0)),
        cases=rows,
    )
    show_table(
        "train.gap from a first start",
        ("machine", "hidden", "seconds", "goal"),
        [(r["mechanism"], r["truth"][0], r["seconds"], r["goal_s"]) for r in rows],
    )
    say(f"written: {path}")


def timed(case: Path, folder: Path) -> tuple[float, dict]:
    """Seconds of ``train.gap`` on a case, and its ``gap.json``."""
    words = [
        *("-m", "train.gap", "--model", str(case / "model.xml")),
        *("--data", *map(str, sorted(case.glob("run*.csv")))),
        *("--out", str(folder / "gap")),
    ]
    seconds = first_start(words, folder, _LIMIT)
    return seconds, json.loads((folder / "gap" / "gap.json").read_text())


if __name__ == "__main__":
    main(Config, run, name="benchmarks.gap_times")
