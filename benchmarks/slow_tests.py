"""``python -m benchmarks.slow_tests``: every test, a file at a time, and line coverage.

Each file's slow tests, and each folder's other tests, are a process of pytest with
programs optimized as users get them. What ended is a line of
``results/slow_tests/parts.jsonl``; a run that was stopped goes on at the part that it
was in. Parts that failed are run again, and all of them at another commit unless
``--since`` names the first whose results still count. At the end the lines that tests
reach are counted by package.
"""

import dataclasses
import functools
import json
import os
import re
import subprocess
import sys
import time
import xml.etree.ElementTree as ElementTree
from collections import Counter, defaultdict
from pathlib import Path, PurePosixPath
from typing import Any

from benchmarks._cells import Share, read_rows, run_cells
from benchmarks._common import RESULTS, ROOT, short, write_result
from benchmarks._page import Section, table
from train._command import main, say

COVERED = ("easi_jax", "envs", "train")  # packages whose lines are counted
TIERS = {"slow": "slow and not gpu", "default": "not slow and not gpu"}
_FOLDER = Path("results") / "slow_tests"
_LIMIT = 3 * 3600.0  # s for one part: the longest slow file takes some 40 minutes
_FAILED = 1  # pytest's exit status where tests failed
SLOWEST = 10


@dataclasses.dataclass(frozen=True)
class Part:
    """Tests that one process runs."""

    path: str
    tier: str
    commit: str
    optimized: bool

    @property
    def key(self) -> str:
        """Its name."""
        return f"{self.tier} tests of {self.path} at {short(self.commit)}"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Config(Share):
    """Runs every test, as users compile, and counts the lines they reach."""

    tier: str = "all"
    """Which tests: slow, default or all."""
    optimized: bool = True
    """Whether programs are compiled as users get them, or as quickly as possible."""
    workers: int = 2
    """Processes of pytest at a time."""
    since: str = ""
    """A commit: parts that passed at it or at a later one are not run again."""
    report: bool = False
    """Add up what was run, without running any."""
    out: Path = _FOLDER / "parts.jsonl"
    """Where a line for each part is added."""
    results: Path = RESULTS
    """Folder of slow_tests.json."""


def run(config: Config) -> None:
    """Runs the parts that have not passed at this commit, then adds up.

    Raises:
        UserError: a test failed, or pytest could not run.
    """
    from easi_jax.errors import UserError
    from easi_jax.io.runs.versions import versions

    if config.tier not in (*TIERS, "all"):
        raise UserError(f"--tier {config.tier}: write slow, default or all")
    commit = versions()["commit"] or "none"
    tiers = [t for t in TIERS if config.tier in (t, "all")]
    folder = config.out.parent.resolve()
    earlier = read_rows(config.out)
    took = {(r["path"], r["tier"]): r["seconds"] for r in earlier}
    passed = _passed_since(config.since, earlier) if config.since else {}
    every = [
        Part(p, t, passed.get((p, t), commit), config.optimized)
        for t in tiers
        for p in _paths(t)
    ]
    # What took longest at an earlier commit goes first.
    every.sort(key=lambda p: -took.get((p.path, p.tier), 0.0))
    solve = functools.partial(_solve, folder=folder)
    if not config.report:
        run_cells(
            *(every, config, solve, _told),
            workers=config.workers,
            passed=lambda row: not row["failed"],
        )
    if config.list:
        return
    # Of each part the last line counts; parts of earlier commits whose files are gone
    # do not.
    wanted = {(p.path, p.tier): p for p in every}
    rows = {(r["path"], r["tier"]): r for r in read_rows(config.out, ("key",))}
    rows = {k: r for k, r in rows.items() if k in wanted}
    path = write_result(
        "slow_tests",
        "python -m benchmarks.slow_tests",
        config,
        config.results,
        parts=[
            {k: v for k, v in row.items() if k not in ("key", "versions")}
            for row in rows.values()
        ],
        not_run=[p.key for k, p in wanted.items() if k not in rows],
        lines=_lines(folder, [_data(folder, k) for k in rows]),
    )
    say("\n\n".join(paragraphs(json.loads(path.read_text()))))
    say(f"written: {path}")
    failed = [name for row in rows.values() for name in row["failures"]]
    if failed:
        raise UserError(f"{len(failed)} tests failed; what they said is in {folder}")


def _passed_since(since: str, rows: list[dict[str, Any]]) -> dict[tuple[str, str], str]:
    """Of parts that passed last, at the commit ``since`` or a later one, that commit.

    Raises:
        UserError: no such commit.
    """
    from easi_jax.errors import UserError

    words = ["git", "rev-list", f"{since}^..HEAD", "--"]
    done = subprocess.run(
        words, cwd=ROOT, capture_output=True, text=True, timeout=60, check=False
    )
    if done.returncode:
        raise UserError(f"--since {since}: no commit of this checkout with one before")
    good = set(done.stdout.split())
    last = {(r["path"], r["tier"]): r for r in rows}
    return {
        part: row["commit"]
        for part, row in last.items()
        if row["commit"].removesuffix("+") in good and not row["failed"]
    }


def _paths(tier: str) -> list[str]:
    """Files with slow tests; folders with others, as many tests as possible first."""
    from easi_jax.errors import UserError

    words = [*_pytest(tier), "--collect-only", "-q"]
    done = subprocess.run(
        words, cwd=ROOT, capture_output=True, text=True, timeout=300, check=False
    )
    if done.returncode:
        raise UserError(f"pytest cannot read the tests: {done.stdout.strip()[-500:]}")
    files = Counter(re.findall(r"^(tests/\S+?\.py)::", done.stdout, re.MULTILINE))
    if tier == "slow":
        return [name for name, _ in files.most_common()]
    folders = Counter[str]()
    for name, number in files.items():
        folders[str(PurePosixPath(name).parent)] += number
    return [name for name, _ in folders.most_common()]


def _pytest(tier: str) -> list[str]:
    return [sys.executable, "-m", "pytest", "-m", TIERS[tier]]


def _data(folder: Path, part: tuple[str, str]) -> Path:
    """Where the lines that a part reaches are written."""
    path, tier = part
    return folder / f"{tier}-{path.replace('/', '-').removesuffix('.py')}.coverage"


def _solve(part: Part, folder: Path) -> dict[str, Any]:
    """Runs a part's tests.

    Raises:
        UserError: pytest could not run, or did not end in time.
    """
    from easi_jax.errors import UserError

    folder.mkdir(parents=True, exist_ok=True)
    data = _data(folder, (part.path, part.tier))
    log, report = data.with_suffix(".log"), data.with_suffix(".xml")
    paths = [part.path]
    if part.tier == "default":  # the folder's own files, not those of folders in it
        paths = sorted(
            str(p.relative_to(ROOT)) for p in (ROOT / part.path).glob("*.py")
        )
        paths = [p for p in paths if PurePosixPath(p).name.startswith("test_")]
    words = [
        *(*_pytest(part.tier), "-v", f"--junitxml={report}", "--cov-report="),
        *(f"--cov={name}" for name in COVERED),
        *paths,
    ]
    told = {
        "EASI_JAX_TESTS": "optimized" if part.optimized else "",
        "COVERAGE_FILE": str(data),
        "JAX_COMPILATION_CACHE_DIR": str(folder / "cache"),
    }
    begin = time.monotonic()
    with log.open("w") as out:
        try:
            status = subprocess.run(
                words,
                cwd=ROOT,
                env={**os.environ, **told},
                stdout=out,
                stderr=subprocess.STDOUT,
                timeout=_LIMIT,
                check=False,
            ).returncode
        except subprocess.TimeoutExpired:
            raise UserError(f"{part.key}: not done in {_LIMIT:.0f} s: {log}") from None
    if status not in (0, _FAILED):
        raise UserError(f"{part.key}: pytest ended with {status}: {log}")
    return {"seconds": round(time.monotonic() - begin, 1), **_outcomes(report)}


def _outcomes(report: Path) -> dict[str, Any]:
    """Numbers of tests, names of those that failed, and seconds of each."""
    found, failures, seconds = Counter[str](), [], {}
    for case in ElementTree.parse(report).iter("testcase"):
        name = f"{case.get('classname', '').rpartition('.')[2]}.py::{case.get('name')}"
        outcomes = {child.tag for child in case}
        seconds[name] = round(float(case.get("time", "0")), 1)
        if outcomes & {"failure", "error"}:
            found["failed"] += 1
            failures.append(name)
        else:
            found["skipped" if "skipped" in outcomes else "passed"] += 1
    slowest = sorted(seconds, key=lambda name: -seconds[name])[:SLOWEST]
    return {
        **{name: found[name] for name in ("passed", "failed", "skipped")},
        "failures": failures,
        "slowest": {name: seconds[name] for name in slowest},
    }


def _lines(folder: Path, data: list[Path]) -> dict[str, list[int]]:
    """Lines that tests reach, and all lines with code, by package."""
    there = [str(p) for p in data if p.is_file()]
    if not there:
        return {}
    whole, told = folder / "coverage", folder / "coverage.json"
    # Of files that were moved since, nothing is known.
    read = ["json", "-q", "-i", "-o", str(told)]
    for words in (["combine", "--keep", *there], read):
        subprocess.run(
            [sys.executable, "-m", "coverage", *words],
            cwd=ROOT,
            env={**os.environ, "COVERAGE_FILE": str(whole)},
            stdout=subprocess.DEVNULL,
            timeout=600,
            check=True,
        )
    packages: dict[str, list[int]] = defaultdict(lambda: [0, 0])
    for name, file in json.loads(told.read_text())["files"].items():
        package = PurePosixPath(name).parent
        deep = (
            package.parts[:2] if package.parts[0] == "easi_jax" else package.parts[:1]
        )
        counted = packages["/".join(deep)]
        counted[0] += file["summary"]["covered_lines"]
        counted[1] += file["summary"]["num_statements"]
    return dict(sorted(packages.items()))


def _told(row: dict[str, Any]) -> str:
    failed = f", failed: {', '.join(row['failures'])}" if row["failures"] else ""
    return (
        f"{row['passed']} passed, {row['skipped']} skipped, {row['seconds']} s{failed}"
    )


# -- the page of results -----------------------------------------------------------


def paragraphs(found: dict[str, Any]) -> list[str]:
    """All tests in a line, the slowest, then the coverage of lines."""
    parts = found["parts"]
    said = []
    for tier in TIERS:
        some = [r for r in parts if r["tier"] == tier]
        if some:
            total = {
                k: sum(r[k] for r in some) for k in ("passed", "failed", "skipped")
            }
            commits = sorted({short(r["commit"]) for r in some})
            how = "" if some[0].get("optimized", True) else ", compiled quickly"
            said.append(
                f"{tier.capitalize()} tests: {total['passed']} passed, "
                f"{total['failed']} failed, {total['skipped']} skipped, "
                f"{sum(r['seconds'] for r in some):.0f} s of "
                f"{found['config']['workers']} processes, at {', '.join(commits)}{how}."
            )
    failed = [f"`{name}`" for r in parts for name in r["failures"]]
    said += [f"Failed: {', '.join(failed)}."] if failed else []
    missing = found["not_run"]
    said += [f"Not run: {len(missing)} of {len(missing) + len(parts)} parts."]
    slowest = [pair for r in parts for pair in r["slowest"].items()]
    slowest = sorted(slowest, key=lambda pair: -pair[1])[:SLOWEST]
    said.append(
        table(slowest, {"test": lambda p: f"`{p[0]}`", "s": lambda p: f"{p[1]:.0f}"})
    )
    lines = {**found["lines"]}
    if lines:
        lines["all"] = [sum(column) for column in zip(*lines.values(), strict=True)]
        columns = {
            "package": lambda p: p[0],
            "lines with code": lambda p: str(p[1][1]),
            "reached by tests": lambda p: f"{100 * p[1][0] / max(p[1][1], 1):.0f} %",
        }
        said.append(table(list(lines.items()), columns))
    return said


SECTIONS = (
    Section(
        "### Slow tests, and coverage of lines",
        "slow_tests.json",
        "slow_tests",
        paragraphs,
    ),
)


if __name__ == "__main__":
    main(Config, run, name="benchmarks.slow_tests")
