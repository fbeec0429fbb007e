"""`benchmarks.same_twice`: bits are compared, and what differs is told."""

import json
import subprocess
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from benchmarks import same_twice
from benchmarks._page import shown
from benchmarks.same_twice import Config, compared, told
from tests.commands import refused

ONE = {"returns": {"UDR": 100.0, "EASI": 50.0}, "mean": [1.0, 2.0], "std": [0.5, 0.0]}


def processes(monkeypatch: Any, run: Any) -> None:
    """Runs of this benchmark alone are stood in for."""
    stand_in = SimpleNamespace(run=run, TimeoutExpired=subprocess.TimeoutExpired)
    monkeypatch.setattr(same_twice, "subprocess", stand_in)


def test_what_is_the_same_to_the_last_bit() -> None:
    found = compared(ONE, json.loads(json.dumps(ONE)))
    assert found["same"] and told(found) == "the same to the last bit"


def test_what_differs_is_told_in_its_own_measure() -> None:
    other = {
        "returns": {"UDR": 100.0, "EASI": 51.0},
        "mean": [1.1, 2.0],
        "std": [0.5, 0.0],
    }
    found = compared(ONE, other)
    assert not found["same"]
    assert found["returns"] == pytest.approx(0.02)
    assert found["deviations"] == pytest.approx(0.2)
    assert "2 %" in told(found) and "0.2 deviations" in told(found)
    nothing = {**ONE, "std": [0.0, 0.0]}
    assert compared(nothing, {**nothing, "mean": [1.0, 3.0]})["deviations"] is None


def test_the_whole_is_written_and_shown(tmp_path: Path, monkeypatch: Any) -> None:
    asked: list[str] = []

    def run(words: list[str], env: dict[str, str], **_: Any) -> Any:
        asked.append(env["XLA_FLAGS"])
        out = Path(words[words.index("--out") + 1])
        out.mkdir(parents=True)
        seeds = {"0": {"mean": [1.0], "std": [0.1]}}
        (out / "distribution.json").write_text(json.dumps({"seeds": seeds}))
        returns = {"EASI": {"0": 1.0 + (len(asked) == 2)}}
        (out / "results.json").write_text(json.dumps({"returns": returns}))
        return SimpleNamespace(returncode=0)

    processes(monkeypatch, run)
    same_twice.run(Config(folder=tmp_path))
    assert len(asked) == 4
    flag = "--xla_gpu_exclude_nondeterministic_ops"
    assert [flag in x for x in asked] == [False, False, True, True]
    (path,) = tmp_path.glob("same_twice_cartpole_*.json")
    ways = json.loads(path.read_text())["ways"]
    assert not ways["as it is"]["same"] and ways["in one order"]["same"]
    page = "\n".join(shown(same_twice.SECTIONS, tmp_path))
    assert "the same to the last bit" in page and "returns differ" in page


@pytest.mark.fault("wrong options and files")
def test_a_run_that_fails_is_one_line(monkeypatch: Any, capsys: Any, tmp_path: Path):
    def run(*_: Any, **__: Any) -> Any:
        return SimpleNamespace(returncode=2, stderr="error: no such robot\n")

    processes(monkeypatch, run)
    said = refused(capsys, same_twice, "--folder", tmp_path)
    assert "ended with 2: error: no such robot" in said
    assert "cartpole" in refused(capsys, same_twice, "--robot", "cartpol")
    assert not list(tmp_path.iterdir())
