"""``python -m benchmarks.fresh_clone``: README's two commands as on a new machine.

The committed state is cloned into a folder of its own; ``make test`` or ``make demo``
installs an environment there and runs. Each run is a line of
``benchmarks/results/test_runs.jsonl``.
"""

import os
import re
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks._cells import add_row, check_out
from benchmarks._common import RESULTS, ROOT
from benchmarks._page import Section, table
from train._command import main, say

TARGETS = ("test", "demo")


@dataclass(frozen=True)
class Config:
    """Runs make in a fresh clone and adds a line on how long it took."""

    target: str = "test"
    """What make is asked for: test or demo."""
    runs: int = 1
    """How often, each in a clone of its own."""
    limit: float = 7200.0
    """Seconds after which a run is stopped."""
    out: Path = RESULTS / "test_runs.jsonl"
    """Where a line for each run is added."""


def run(config: Config) -> None:
    """Clones, installs and runs, as often as asked.

    Raises:
        UserError: an unknown target, a state that is not committed, or a run that took
            too long.
    """
    from easi_jax.errors import UserError
    from easi_jax.io.runs.versions import versions

    if config.target not in TARGETS:
        raise UserError(f"--target {config.target}: write test or demo")
    commit = versions()["commit"]
    if not commit or commit.endswith("+"):
        raise UserError("a clone has what is committed: commit first")
    check_out(config.out)
    for _ in range(config.runs):
        with tempfile.TemporaryDirectory() as folder:
            row = _run(config, Path(folder) / "clone")
        row = {"commit": commit[:7], **row, "versions": versions()}
        add_row(config.out, row)
        say(f"make {config.target}: {_told(row)}")


def _run(config: Config, clone: Path) -> dict[str, Any]:
    from easi_jax.errors import UserError

    subprocess.run(
        ["git", "clone", "--quiet", "--no-hardlinks", str(ROOT), str(clone)],
        timeout=300,
        check=True,
    )
    busy = os.getloadavg()[1]
    # A new user has neither this environment nor its caches.
    env = {k: v for k, v in os.environ.items() if not k.startswith(("JAX_", "VIRTUAL"))}
    python = f"PYTHON={Path(sys.base_prefix) / 'bin' / 'python3'}"
    begin = time.monotonic()
    try:
        done = subprocess.run(
            ["make", python, config.target],
            cwd=clone,
            env=env,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            timeout=config.limit,
            check=False,
        )
    except subprocess.TimeoutExpired:
        raise UserError(
            f"make {config.target} did not end in {config.limit:.0f} s"
        ) from None
    seconds = time.monotonic() - begin
    if done.returncode:
        failed = re.findall(r"^(?:FAILED|ERROR) .*$", done.stdout, re.MULTILINE)
        say("\n".join([*failed, done.stdout[-2000:]]))
    return {
        "command": f"make {config.target}",
        "status": done.returncode,
        **summary(done.stdout),
        "seconds": round(seconds, 1),
        "load": f"load average before: {busy:.1f}",
    }


def summary(said: str) -> dict[str, Any]:
    """Numbers of tests and seconds of pytest's last line; none where it has none."""
    lines = re.findall(r"^=* ?(\d+ \w+.*) in ([\d.]+)s.*$", said, re.MULTILINE)
    if not lines:
        return {"passed": "", "failed": "", "skipped": "", "pytest_s": None}
    counts, seconds = lines[-1]
    found = {word: int(n) for n, word in re.findall(r"(\d+) (\w+)", counts)}
    failed = found.get("failed", 0) + found.get("error", 0) + found.get("errors", 0)
    return {
        "passed": found.get("passed", 0),
        "failed": failed,
        "skipped": found.get("skipped", 0),
        "pytest_s": float(seconds),
    }


def _told(row: dict[str, Any]) -> str:
    tests = f"{row['passed']} passed, {row['failed']} failed, " if row["passed"] else ""
    return f"{tests}exit status {row['status']}, {row['seconds']} s"


# -- the page of results -----------------------------------------------------------


def _runs(rows: list[dict[str, Any]]) -> list[str]:
    columns = {
        "command": "`{command}`",
        "commit": "{commit}",
        "passed": "{passed}",
        "failed": "{failed}",
        "skipped": lambda r: str(r.get("skipped", "")) if "versions" in r else "",
    }
    timed = {
        "pytest": lambda r: f"{r['pytest_s']:.0f} s" if r["pytest_s"] else "",
        "in all": "{seconds:.0f} s",
        "other work on the cores": "{load}",
    }
    said = "In a fresh clone, with nothing cached, on 2 cores (goal 600 s)"
    if any("versions" not in r for r in rows):
        said += "; lines that do not say how many were skipped were copied by hand"
    return [f"{said}:", table(rows, columns | timed)]


SECTIONS = (Section("## Time of the tests", "test_runs.jsonl", "fresh_clone", _runs),)


if __name__ == "__main__":
    main(Config, run, name="benchmarks.fresh_clone")
