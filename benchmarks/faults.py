"""What breaks in the tests, how often it was tried, and how often it was survived.

    python -m benchmarks.faults
    python -m benchmarks.faults --slow

Runs the tests that are marked with what breaks in them (``@pytest.mark.fault``), and
counts. About ten minutes on two cores. `benchmarks.summary` makes one table of them and
of the files of `benchmarks.fuzz` and the kills of `benchmarks.crash`.
"""

import dataclasses
from collections import Counter
from pathlib import Path
from typing import Any

from benchmarks._common import RESULTS, ROOT, command_of, write_result
from train._command import main, say, show_table


@dataclasses.dataclass(frozen=True)
class Config:
    """Runs the tests in which something breaks."""

    slow: bool = False
    """The slow ones too."""
    only: str = ""
    """Tests whose names hold this (as pytest's -k)."""
    folder: Path = RESULTS
    """Where the counts go."""


class Faults:
    """A pytest plugin that counts outcomes by the mark of their test."""

    def __init__(self) -> None:
        self.of: dict[str, str] = {}
        self.outcomes: dict[str, Counter[str]] = {}

    def pytest_collection_modifyitems(self, items: Any) -> None:
        """Notes the marks."""
        for item in items:
            mark = item.get_closest_marker("fault")
            if mark is not None:
                self.of[item.nodeid] = mark.args[0]

    def pytest_runtest_logreport(self, report: Any) -> None:
        """Counts a test once: when it was called, or fails or is left out before."""
        if report.nodeid in self.of and (report.when == "call" or not report.passed):
            fault = self.of[report.nodeid]
            self.outcomes.setdefault(fault, Counter())[report.outcome] += 1


def run(config: Config) -> None:
    """Runs the tests and writes the counts."""
    import os

    import pytest

    from easi_jax.errors import UserError

    os.chdir(ROOT)
    faults = Faults()
    chosen = "fault" if config.slow else "fault and not slow"
    words = ["-q", "-p", "no:cacheprovider", "-m", f"({chosen}) and not gpu", "tests"]
    pytest.main(words + (["-k", config.only] if config.only else []), [faults])
    if not faults.outcomes:
        raise UserError(f"no test of a fault has a name with {config.only!r}")
    counts = {
        fault: {
            "tried": count["passed"] + count["failed"],
            "survived": count["passed"],
            "left_out": count["skipped"],
        }
        for fault, count in sorted(faults.outcomes.items())
    }
    plain = dataclasses.replace(config, folder=RESULTS)
    path = write_result(
        *("faults", command_of("benchmarks.faults", plain), plain, config.folder),
        counts=counts,
    )
    lines = [
        (fault, str(c["tried"]), str(c["survived"])) for fault, c in counts.items()
    ]
    show_table("Faults", ("what breaks", "tried", "survived"), lines)
    say(f"written: {path}")


if __name__ == "__main__":
    main(Config, run, name="benchmarks.faults")
