"""Killed at random moments, does each command go on, and to the same end?

    python -m benchmarks.crash
    python -m benchmarks.crash --only "gap, kill 3"

Each cell starts a small job, kills it (signal 9, all its processes) at a moment drawn
from the time that it takes, goes on with ``--resume`` and compares every number that it
leaves with those of a job that was left alone. About half a minute each on two cores;
each is a line of ``benchmarks/results/crash.jsonl`` and is not run again.
"""

import dataclasses
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

from benchmarks._cells import Share, read_rows, run_cells
from benchmarks._common import RESULTS, ROOT
from train._command import main

_SMALL = ("--env-steps", "12000", "--eval-episodes", "4", "--target", "cart_kp*0.5")
_SEARCH = (
    *("--generations", "6", "--population", "16", "--trajectories", "8"),
    *("--set", "segments=16", "real_batch=64", "discriminator_updates=2"),
)
# Words of each command; names of files and folders are filled in.
COMMANDS: dict[str, tuple[str, ...]] = {
    "udr": ("train.udr", "--seeds", "0", "1", "--chunk", "20", *_SMALL),
    "easi": (
        *("train.easi", "--udr", "{folder}/udr", "--chunk", "20"),
        *("--search-chunk", "2", *_SEARCH, *_SMALL[2:]),
    ),
    "pipeline": ("train.pipeline", *_SEARCH, *_SMALL),
    "gap": ("train.gap", "--model", "{folder}/case/model.xml", "--data", "{logs}"),
}
_TIMES = {"time", "seconds", "compile_s", "run_s"}  # keys of what may differ
_LIMIT = 900  # s


@dataclasses.dataclass(frozen=True)
class Cell:
    """A command and one of its kills."""

    command: str
    kill: int

    @property
    def key(self) -> str:
        """Both."""
        return f"{self.command}, kill {self.kill}"


@dataclasses.dataclass(frozen=True)
class Config(Share):
    """Kills commands at random moments, and lets them go on."""

    kills: int = 20
    """Of each command."""
    seed: int = 0
    """Of the moments."""
    out: Path = dataclasses.field(default=RESULTS / "crash.jsonl", kw_only=True)
    """Where a line for each cell is added."""


def run(config: Config) -> None:
    """Runs the cells, with one job of each command that is left alone."""
    cells = [Cell(c, k) for c in COMMANDS for k in range(config.kills)]
    with tempfile.TemporaryDirectory() as folder:
        jobs = Jobs(Path(folder), config.seed)
        run_cells(cells, config, jobs.solve, told)


def told(row: dict[str, Any]) -> str:
    """What is said of a line."""
    end = "same end" if not row["different"] else f"DIFFERENT: {row['different'][0]}"
    return f"killed after {row['killed_s']:.1f} of {row['alone_s']:.1f} s, {end}"


class Jobs:
    """Small jobs in a folder."""

    def __init__(self, folder: Path, seed: int) -> None:
        self.folder, self.seed = folder, seed
        self.alone = cache(self._alone)

    def solve(self, cell: Cell) -> dict[str, Any]:
        """Kills a job, goes on with it and compares."""
        import numpy as np

        whole, seconds = self.alone(cell.command)
        draw = np.random.default_rng([self.seed, cell.kill, *cell.command.encode()])
        moment = float(draw.uniform(0.0, seconds))
        out = self.folder / f"{cell.command}_killed"
        words = [*self.words(cell.command), "--out", str(out)]
        while True:
            shutil.rmtree(out, ignore_errors=True)
            if started(words, moment):
                break
            moment *= 0.7  # it was quicker than the one left alone
        kept = sum(1 for _ in out.glob("checkpoints/**/step_*"))
        began = time.monotonic()
        again = subprocess.run(
            [sys.executable, "-m", *words, "--resume"],
            cwd=ROOT,
            capture_output=True,
            text=True,
            timeout=_LIMIT,
            check=False,
        )
        different = [f"exit status {again.returncode}: {again.stderr[-300:]}"]
        if again.returncode == 0:
            different = differences(whole, out)
        return {
            "killed_s": moment,
            "alone_s": seconds,
            "checkpoints": kept,
            "resumed_s": time.monotonic() - began,
            "different": different,
        }

    def words(self, command: str) -> list[str]:
        """Of a command, with what it needs in the folder."""
        from tests.gap_cases import Effect, make_case

        case = self.folder / "case"
        if command == "gap" and not case.exists():
            make_case(22, "pendulum", [Effect("coulomb_friction", "hinge")], case)
        if command == "easi":
            self.alone("udr")
            if not (self.folder / "udr").exists():
                shutil.copytree(self.alone("udr")[0], self.folder / "udr")
        out = []
        for word in COMMANDS[command]:
            logs = sorted(map(str, case.glob("run*.csv")))
            out += logs if word == "{logs}" else [word.format(folder=self.folder)]
        return out

    def _alone(self, command: str) -> tuple[Path, float]:
        """Folder of a job that was left alone, and its time with nothing to compile."""
        words = self.words(command)
        out = self.folder / f"{command}_alone"
        seconds = 0.0
        for more in ((), ("--overwrite",)):
            began = time.monotonic()
            subprocess.run(
                [sys.executable, "-m", *words, "--out", str(out), *more],
                cwd=ROOT,
                stdout=subprocess.DEVNULL,
                timeout=_LIMIT,
                check=True,
            )
            seconds = time.monotonic() - began
        return out, seconds


def started(words: Sequence[str], moment: float) -> bool:
    """Starts a command and kills it after ``moment`` [s]; whether it was running."""
    process = subprocess.Popen(
        [sys.executable, "-m", *words],
        cwd=ROOT,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    try:
        process.wait(moment)
        return False
    except subprocess.TimeoutExpired:
        return True
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def differences(one: Path, other: Path) -> list[str]:
    """Names of files, and of policies, in which two finished jobs differ."""
    import jax
    import numpy as np

    from easi_jax.io.files import read_json
    from train._robots import load_policies

    kinds = {".json", ".jsonl", ".yaml", ".xml"}
    files = (p for folder in (one, other) for p in folder.iterdir())
    names = {p.name for p in files if p.suffix in kinds} - {"versions.json"}
    out = [n for n in sorted(names) if not _equal(one / n, other / n)]
    results = one / "results.json"
    if results.exists() and "methods" in read_json(results):
        policies = (load_policies(f, None, None)["policies"] for f in (one, other))
        a, b = (jax.tree.leaves(p) for p in policies)
        same = [np.array_equal(x, y) for x, y in zip(a, b, strict=True)]
        out += [] if all(same) else ["policies"]
    return out


def _equal(one: Path, other: Path) -> bool:
    if one.suffix == ".jsonl":  # may not be there where nothing was told
        return _timeless(read_rows(one)) == _timeless(read_rows(other))
    if not (one.exists() and other.exists()):
        return False
    a, b = one.read_text(), other.read_text()
    if one.suffix == ".json":
        return _timeless(json.loads(a)) == _timeless(json.loads(b))
    return a == b


def _timeless(x: Any) -> Any:
    if isinstance(x, dict):
        return {k: _timeless(v) for k, v in x.items() if k not in _TIMES}
    return [_timeless(v) for v in x] if isinstance(x, list) else x


if __name__ == "__main__":
    main(Config, run, name="benchmarks.crash")
