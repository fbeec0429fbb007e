"""The README's robot of the user's own: the command as it stands, nothing cached.

    python -m benchmarks.own_robot

Minutes; results go to ``benchmarks/results/own_robot.json``.
"""

import dataclasses
import json
import runpy
import tempfile
from pathlib import Path

from train._command import main, say

EXAMPLE = Path("examples/lift_arm")
GOAL = 60  # s
_LIMIT = 1200  # s


@dataclasses.dataclass(frozen=True)
class Config:
    """Times the identification of the example arm from a first start."""


def run(config: Config) -> None:
    """Runs the command in a process and a compilation cache of its own."""
    from benchmarks._common import ROOT, command_of, first_start, write_result

    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "run"
        words = [
            *("-m", "train.easi"),
            *("--model", str(EXAMPLE / "model.xml")),
            *("--parameters", str(EXAMPLE / "parameters.yaml")),
            *("--data", str(EXAMPLE / "sweep.csv")),
            *("--held-out", str(EXAMPLE / "moves.csv")),
            *("--out", str(out)),
        ]
        seconds, _ = first_start(words, Path(folder) / "cache", _LIMIT)
        found = json.loads((out / "distribution.json").read_text())
    truth = runpy.run_path(str(ROOT / EXAMPLE / "make_log.py"))["TRUTH"]
    first = found["seeds"]["0"]
    names = [p["name"] for p in found["parameters"]]
    values = dict(zip(names, first["mean"], strict=True))
    path = write_result(
        "own_robot",
        command_of("benchmarks.own_robot", config),
        config,
        seconds=seconds,
        found=values,
        truth=truth,
        flags=dict(zip(names, first["flags"], strict=True)),
        held_out=found["held_out"],
    )
    say(f"{seconds:.0f} s; written: {path}")


if __name__ == "__main__":
    main(Config, run, name="benchmarks.own_robot")
