"""Where the default tests spend their time: compiling, in child processes, the rest.

    python -m benchmarks.where_tests_spend --out results/test_times.json [pytest's options]

Runs pytest with itself as a plugin. For each test: seconds in all, seconds jax spent
tracing, lowering and compiling, seconds its child processes ran, and their number.
"""

import argparse
import json
import os
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

import pytest

FOLDER = "EASI_TEST_TIMES"
_spent: dict[str, float] = defaultdict(float)


def _on_duration(event: str, seconds: float, **_: object) -> None:
    for name in ("jaxpr_trace", "jaxpr_to_mlir_module", "backend_compile"):
        if event.endswith(f"{name}_duration"):
            _spent[name] += seconds


def pytest_configure(config: pytest.Config) -> None:
    """Listens to jax and to child processes."""
    import jax

    jax.monitoring.register_event_duration_secs_listener(_on_duration)
    wait = subprocess.Popen.wait
    communicate = subprocess.Popen.communicate

    def timed(call):  # type: ignore[no-untyped-def]
        def inner(self, *args, **kwargs):  # type: ignore[no-untyped-def]
            begin = time.perf_counter()
            nested = _spent["nested"]
            _spent["nested"] = 1.0
            try:
                return call(self, *args, **kwargs)
            finally:
                _spent["nested"] = nested
                if not nested:
                    _spent["processes"] += time.perf_counter() - begin
                    _spent["process_waits"] += 1

        return inner

    subprocess.Popen.wait = timed(wait)
    subprocess.Popen.communicate = timed(communicate)


@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Iterator[None]:
    """Writes one line a test."""
    _spent.clear()
    begin, cpu = time.perf_counter(), time.process_time()
    yield
    row = {
        "test": item.nodeid,
        "seconds": time.perf_counter() - begin,
        "cpu": time.process_time() - cpu,
        **{k: v for k, v in _spent.items() if k != "nested"},
    }
    with (Path(os.environ[FOLDER]) / f"{os.getpid()}.jsonl").open("a") as file:
        file.write(json.dumps(row) + "\n")


def main() -> int:
    """Runs the tests, adds up, writes the file."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True)
    args, rest = parser.parse_known_args()
    parts = args.out.with_suffix(".parts")
    parts.mkdir(parents=True, exist_ok=True)
    for old in parts.glob("*.jsonl"):
        old.unlink()
    begin = time.perf_counter()
    status = subprocess.run(
        [sys.executable, "-m", "pytest", "-p", "benchmarks.where_tests_spend", *rest],
        env={**os.environ, FOLDER: str(parts.absolute())},
        timeout=4 * 3600,
        check=False,
    ).returncode
    rows = [
        json.loads(line)
        for path in sorted(parts.glob("*.jsonl"))
        for line in path.read_text().splitlines()
    ]
    rows.sort(key=lambda r: -r["seconds"])
    total: dict[str, float] = defaultdict(float)
    for row in rows:
        for key, value in row.items():
            if key != "test":
                total[key] += value
    args.out.write_text(
        json.dumps(
            {
                "wall": time.perf_counter() - begin,
                "status": status,
                "tests": len(rows),
                "total": {k: round(v, 1) for k, v in total.items()},
                "rows": [
                    {k: v if k == "test" else round(v, 3) for k, v in r.items()}
                    for r in rows
                ],
            },
            indent=1,
        )
    )
    return status


if __name__ == "__main__":
    raise SystemExit(main())
