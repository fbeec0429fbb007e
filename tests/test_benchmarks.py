"""The page of results says what the files say, also of what was not run."""

import json
import shutil
from pathlib import Path

import pytest

from benchmarks import summary
from benchmarks._common import RESULTS
from train._command import main


def page(folder: Path) -> str:
    main(summary.Config, summary.run, args=["--results", str(folder)], name="summary")
    return (folder / "README.md").read_text()


def test_committed_page_is_that_of_the_committed_files(tmp_path: Path) -> None:
    folder = tmp_path / "results"
    shutil.copytree(RESULTS, folder)
    assert page(folder) == (RESULTS / "README.md").read_text()


def test_nothing_run_is_said(tmp_path: Path) -> None:
    text = page(tmp_path)
    for command in ("speed", "recovery --cases free_clean", "transfer --factors 0.25"):
        assert f"Not run: `python -m benchmarks.{command}" in text
    assert "met" not in text.replace("parameters", "")


@pytest.mark.parametrize(("ratio", "said"), [(5.0, "| 4 | met |"), (2.0, "**missed**")])
def test_goals_are_judged(tmp_path: Path, ratio: float, said: str) -> None:
    result = {
        "command": "python -m benchmarks.speed",
        "ratio": ratio,
        "search": {"search_s": [7.0, 6.0], "outside_physics_per_generation_s": 0.01},
        "compile": {"cold": {"trace_s": 1.0, "compile_s": 2.0}},
        "stress": [{"finished": True, "seconds": 1.0}],
    }
    result["compile"]["cached"] = result["compile"]["cold"]
    (tmp_path / "speed.json").write_text(json.dumps(result))
    row = page(tmp_path).split("native MuJoCo")[1].splitlines()[0]
    assert said in row
