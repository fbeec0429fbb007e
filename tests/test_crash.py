"""The comparison of a command that was killed with one that was left alone."""

import json
import time
from pathlib import Path
from unittest.mock import MagicMock

import pytest

from benchmarks import crash_summary, faults, soak
from benchmarks._page import shown
from benchmarks.crash import Cell, Jobs, differences, started
from tests.commands import command

RESULT = {"returns": {"UDR": 1.25}, "seconds": 3.0}
LINES = [{"step": k, "time": 0.1 * k, "score": 2.0**k} for k in range(3)]


def job(folder: Path, result: dict = RESULT, lines: list[dict] = LINES) -> Path:
    folder.mkdir()
    (folder / "results.json").write_text(json.dumps(result))
    text = "".join(json.dumps(x) + "\n" for x in lines)
    (folder / "metrics.jsonl").write_text(text)
    (folder / "effects.yaml").write_text("effects: []\n")
    (folder / "versions.json").write_text(json.dumps({"started": str(folder)}))
    return folder


def test_times_may_differ_and_nothing_else(tmp_path: Path) -> None:
    one = job(tmp_path / "one")
    later = [{**x, "time": 9.0} for x in LINES]
    same = job(tmp_path / "same", {**RESULT, "seconds": 4.0}, later)
    assert differences(one, same) == []
    value = job(tmp_path / "value", {**RESULT, "returns": {"UDR": 1.25 + 1e-15}})
    assert differences(one, value) == ["results.json"]
    twice = job(tmp_path / "twice", lines=[*LINES, LINES[-1]])
    assert differences(one, twice) == ["metrics.jsonl"]
    (same / "metrics.jsonl").write_text("")
    assert differences(one, same) == ["metrics.jsonl"]
    for folder in (one, same):
        (folder / "metrics.jsonl").unlink()
    (same / "metrics.jsonl").write_text("")
    assert differences(one, same) == []
    (same / "effects.yaml").unlink()
    assert differences(one, same) == ["effects.yaml"]


def test_a_process_is_killed_at_its_moment(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "sleeper.py").write_text("import time; time.sleep(60)")
    (tmp_path / "quick.py").write_text("")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    begin = time.monotonic()
    assert started(["sleeper"], 0.5)
    assert not started(["quick"], 20.0)
    assert time.monotonic() - begin < 20


def test_what_was_not_run_and_what_went_wrong_is_said(tmp_path: Path) -> None:
    assert "Not run" in "".join(shown(crash_summary.SECTIONS, tmp_path))
    row = {"command": "gap", "checkpoints": 2, "different": []}
    lost = {**row, "key": "gap, kill 1", "different": ["gap.json"]}
    rows = [{**r, "versions": {"commit": "0123456789"}} for r in (row, lost)]
    text = "".join(json.dumps(r) + "\n" for r in rows)
    (tmp_path / "crash.jsonl").write_text(text)
    page = "\n".join(shown(crash_summary.SECTIONS, tmp_path))
    assert "| train.gap | 2 | 2 | 1 | gap, kill 1: gap.json |" in page
    assert "| train.udr | not run |" in page


def test_tests_of_faults_are_counted(tmp_path: Path) -> None:
    counted = faults.Faults()
    marked, plain = MagicMock(nodeid="a"), MagicMock(nodeid="b")
    marked.get_closest_marker.return_value = pytest.mark.fault("a disk").mark
    plain.get_closest_marker.return_value = None
    counted.pytest_collection_modifyitems([marked, plain])
    for test, when, outcome in (
        *(("a", "setup", "passed"), ("a", "call", "passed"), ("a", "call", "failed")),
        *(("a", "setup", "skipped"), ("b", "call", "failed")),
    ):
        report = MagicMock(nodeid=test, when=when, outcome=outcome)
        report.passed = outcome == "passed"
        counted.pytest_runtest_logreport(report)
    assert counted.outcomes == {"a disk": {"passed": 1, "failed": 1, "skipped": 1}}
    counts = {"a disk": {"tried": 2, "survived": 1, "left_out": 1}}
    told = {"command": "x", "versions": {"commit": "0123456789"}, "counts": counts}
    (tmp_path / "faults.json").write_text(json.dumps(told))
    (tmp_path / "fuzz.json").write_text('{"total": {"cases": 9, "failed": 1}}')
    page = "\n".join(shown(crash_summary.SECTIONS, tmp_path))
    assert "| a disk | tests | 2 | 1 |" in page
    assert "| `benchmarks.fuzz` | 9 | 8 |" in page
    assert "Not run: `python -m benchmarks.crash`." in page


@pytest.mark.slow
def test_many_searches_hold_their_memory(tmp_path: Path) -> None:
    words = ("--searches", 300, "--warm-up", 100, "--folder", tmp_path)
    command(soak, *words)
    told = json.loads((tmp_path / "soak.json").read_text())
    assert told["finite"] == 300
    assert told["growth_megabytes"] < 10


@pytest.mark.slow
@pytest.mark.timeout(1200)
@pytest.mark.parametrize("which", ["udr", "easi", "gap"])
def test_killed_and_gone_on(which: str, tmp_path: Path) -> None:
    jobs = Jobs(tmp_path, seed=1)
    for kill in range(2):
        row = jobs.solve(Cell(which, kill))
        assert row["different"] == []
