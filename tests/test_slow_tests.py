"""The slow tests' own runner: what ended is kept, what failed is run again."""

import dataclasses
import subprocess
from pathlib import Path
from typing import Any

import pytest

from benchmarks import slow_tests
from benchmarks._cells import Share, run_cells
from benchmarks.slow_tests import ROOT
from easi_jax.errors import UserError

REPORT = """<testsuites><testsuite>
<testcase classname="tests.train.test_gap" name="test_a" time="2.04"/>
<testcase classname="tests.train.test_gap" name="test_b[x]" time="7.0">
<failure message="no">trace</failure></testcase>
<testcase classname="tests.train.test_gap" name="test_c" time="0">
<skipped message="why"/></testcase></testsuite></testsuites>"""


def test_what_pytest_reports(tmp_path: Path) -> None:
    (tmp_path / "report.xml").write_text(REPORT)
    assert slow_tests._outcomes(tmp_path / "report.xml") == {
        **{"passed": 1, "failed": 1, "skipped": 1},
        "failures": ["test_gap.py::test_b[x]"],
        "slowest": {
            "test_gap.py::test_b[x]": 7.0,
            "test_gap.py::test_a": 2.0,
            "test_gap.py::test_c": 0.0,
        },
    }


@dataclasses.dataclass(frozen=True)
class Cell:
    key: str


def test_what_failed_is_run_again_by_several_at_once(tmp_path: Path) -> None:
    share, ran = Share(out=tmp_path / "rows.jsonl"), []

    def solve(cell: Cell) -> dict[str, Any]:
        ran.append(cell.key)
        return {"failed": int(cell.key == "b" and ran.count("b") == 1)}

    cells = [Cell("a"), Cell("b"), Cell("c")]
    for _ in range(3):
        run_cells(
            *(cells, share, solve, lambda row: "ended"),
            workers=2,
            passed=lambda row: not row["failed"],
        )
    assert sorted(ran) == ["a", "b", "b", "c"]


def test_an_error_in_one_of_several_is_told(tmp_path: Path) -> None:
    def solve(cell: Cell) -> dict[str, Any]:
        raise ValueError(cell.key)

    with pytest.raises(ValueError, match="a"):
        share = Share(out=tmp_path / "rows.jsonl")
        run_cells([Cell("a")], share, solve, str, workers=2)


def test_the_page_adds_up(tmp_path: Path) -> None:
    part = {"tier": "slow", "commit": "0123456789", "optimized": True, "seconds": 9.0}
    part |= {"passed": 2, "failed": 1, "skipped": 0, "failures": ["f.py::test"]}
    part |= {"slowest": {"f.py::test": 8.0}}
    found = {
        **{"parts": [part, {**part, "failed": 0, "failures": []}], "not_run": ["x"]},
        "lines": {"easi_jax/a": [1, 2], "train": [5, 6]},
        "config": {"workers": 2},
    }
    text = "\n".join(slow_tests.paragraphs(found))
    assert "4 passed, 1 failed" in text and "18 s of 2 processes" in text
    assert "Failed: `f.py::test`" in text and "1 of 3 parts" in text
    assert "| all | 8 | 75 % |" in text


def test_what_passed_since_a_commit_counts(tmp_path: Path) -> None:
    words = ["git", "rev-list", "--max-count=2", "HEAD"]
    done = subprocess.run(
        words, cwd=ROOT, capture_output=True, text=True, timeout=60, check=False
    )
    if done.returncode or len(done.stdout.split()) < 2:
        pytest.skip("needs a checkout with a history of two commits")
    head, before = done.stdout.split()

    def row(path: str, commit: str, failed: int = 0) -> dict[str, Any]:
        return {"path": path, "tier": "slow", "commit": commit, "failed": failed}

    rows = [
        *(row("old.py", before), row("new.py", head), row("edited.py", head + "+")),
        *(row("failed.py", head, 1), row("elsewhere.py", "0" * 40)),
        *(row("failed_later.py", head), row("failed_later.py", head, 1)),
    ]
    assert slow_tests._passed_since(head, rows) == {
        ("new.py", "slow"): head,
        ("edited.py", "slow"): head + "+",
    }
    with pytest.raises(UserError, match="--since nowhere: no commit"):
        slow_tests._passed_since("nowhere", rows)
