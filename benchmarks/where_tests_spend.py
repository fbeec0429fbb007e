"""``python -m benchmarks.where_tests_spend``: what the default tests' time goes into.

Runs pytest with this module as a plugin. For each test it counts seconds in all,
seconds in which jax traced, lowered and compiled, and seconds spent waiting for child
processes. Seconds of compiling overlap where one program is traced inside another.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from benchmarks._common import write_result
from benchmarks._page import Section, table
from train._command import main, say

FOLDER = "EASI_JAX_TEST_TIMES"  # environment variable: where workers write their rows
STAGES = ("jaxpr_trace", "jaxpr_to_mlir_module", "backend_compile")
SLOWEST = 10
_spent: dict[str, float] = defaultdict(float)
_waiting: list[bool] = []


@dataclass(frozen=True)
class Config:
    """Times the default tests and writes ``NAME.json`` beside the other results."""

    name: str = "test_times"
    """Name of the result."""
    workers: int = 2
    """Processes that share the tests."""
    paths: tuple[str, ...] = ()
    """Test files; not given: all."""
    limit: float = 7200.0
    """Seconds after which the tests are stopped."""


def _on_duration(event: str, duration_secs: float, **_: str | int) -> None:
    for name in STAGES:
        if event.endswith(f"{name}_duration"):
            _spent[name] += duration_secs


def _timed(call: Callable[..., Any]) -> Callable[..., Any]:
    """``call`` with the seconds of its outermost run counted."""

    def inner(*args: Any, **kwargs: Any) -> Any:
        begin = time.perf_counter()
        _waiting.append(True)
        try:
            return call(*args, **kwargs)
        finally:
            _waiting.pop()
            if not _waiting:
                _spent["processes"] += time.perf_counter() - begin

    return inner


def pytest_configure(config: pytest.Config) -> None:
    """Listens to jax and to child processes."""
    del config
    import jax

    jax.monitoring.register_event_duration_secs_listener(_on_duration)
    for name in ("wait", "communicate"):
        setattr(subprocess.Popen, name, _timed(getattr(subprocess.Popen, name)))


@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Iterator[None]:
    """Writes one line a test; a fixture counts where it is first asked for."""
    _spent.clear()
    begin, cpu = time.perf_counter(), time.process_time()
    yield
    row = {
        "test": item.nodeid,
        "seconds": time.perf_counter() - begin,
        "cpu": time.process_time() - cpu,
        **_spent,
    }
    with (Path(os.environ[FOLDER]) / f"{os.getpid()}.jsonl").open("a") as file:
        file.write(json.dumps(row) + "\n")


def summed(rows: list[dict[str, Any]]) -> dict[str, float]:
    """Sums of all numbers of ``rows``, to a tenth of a second."""
    total: dict[str, float] = defaultdict(float)
    for row in rows:
        for key, value in row.items():
            if key != "test":
                total[key] += value
    return {key: round(value, 1) for key, value in total.items()}


def run(config: Config) -> None:
    """Runs the tests, adds up, writes and shows the result."""
    begin = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        status = subprocess.run(
            [
                *(sys.executable, "-m", "pytest", "-q", "-n", str(config.workers)),
                *("--dist", "loadfile", "--no-loadscope-reorder"),
                *("-p", "benchmarks.where_tests_spend", *config.paths),
            ],
            env={**os.environ, FOLDER: folder},
            timeout=config.limit,
            check=False,
        ).returncode
        rows = [
            json.loads(line)
            for path in sorted(Path(folder).glob("*.jsonl"))
            for line in path.read_text().splitlines()
        ]
    wall = time.perf_counter() - begin
    rows.sort(key=lambda row: -row["seconds"])
    files: dict[str, list[dict[str, Any]]] = defaultdict(list)
    for row in rows:
        files[row["test"].partition("::")[0]].append(row)
    by_file = {name: summed(part) for name, part in files.items()}
    slowest = [{"test": row["test"], **summed([row])} for row in rows[:SLOWEST]]
    path = write_result(
        config.name,
        "python -m benchmarks.where_tests_spend",
        config,
        exit_status=status,
        wall=round(wall, 1),
        tests=len(rows),
        total=summed(rows),
        slowest=slowest,
        files=dict(sorted(by_file.items(), key=lambda item: -item[1]["seconds"])),
    )
    say(table(slowest, {"test": "{test}", "s": "{seconds}"}))
    say(f"{len(rows)} tests in {wall:.0f} s, exit status {status}: {path}")


def _spending(found: dict[str, Any]) -> list[str]:
    said = []
    for name, r in found.items():
        t = r["total"]
        said += [
            f"{name}: {r['tests']} default tests in {r['wall']:.0f} s with 2 workers, "
            f"{t['jaxpr_trace'] + t['jaxpr_to_mlir_module']:.0f} s of tracing and "
            f"lowering, {t['backend_compile']:.0f} s of compiling. The slowest, with "
            "what is made for the first test of a file:",
            table(r["slowest"], {"test": "`{test}`", "s": "{seconds}"}),
        ]
    return said


SECTIONS = (
    Section(
        "### What the tests' time goes into",
        {"Before": "test_times_before.json", "Now": "test_times.json"},
        "where_tests_spend",
        _spending,
    ),
)


if __name__ == "__main__":
    main(Config, run, name="benchmarks.where_tests_spend")
