"""Files of cells: what a kill, a full disk or a wrong hand leaves in them."""

import json
import os
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

import pytest

from benchmarks import coverage, paper, rivals, summary
from benchmarks._cells import Share, add_row, read_rows, run_cells
from benchmarks.paper_cells import Cell, udr_run
from easi_jax.errors import UserError
from tests.commands import refused

GOOD = '{"key": "a", "seed": 0, "value": 1}\n'


@dataclass(frozen=True)
class One:
    key: str


def run(out: Path, keys: str) -> list[str]:
    """Which cells were run."""
    ran: list[str] = []

    def solve(cell: One) -> dict[str, int]:
        ran.append(cell.key)
        return {"value": 2}

    share = Share(out=out)
    run_cells([One(k) for k in keys], share, solve, lambda row: "done")
    return ran


@pytest.mark.fault("killed (signal 9), then resumed")
@pytest.mark.parametrize("torn", ['{"key": "b", "val', '{"key": "b", "value": 2}'])
def test_a_torn_line_is_run_again(tmp_path: Path, torn: str) -> None:
    out = tmp_path / "rows.jsonl"
    out.write_text(GOOD + torn)
    assert [r["key"] for r in read_rows(out)] == ["a"]
    assert run(out, "abc") == ["b", "c"]
    rows = [json.loads(x) for x in out.read_text().splitlines()]
    assert [r["key"] for r in rows] == ["a", "b", "c"]
    assert run(out, "abc") == []


def test_a_torn_first_line_is_no_row(tmp_path: Path) -> None:
    out = tmp_path / "rows.jsonl"
    out.write_text(GOOD.rstrip())
    assert read_rows(out) == []
    add_row(out, {"key": "b"})
    assert read_rows(out) == [{"key": "b"}]


@pytest.mark.fault("wrong options and files")
@pytest.mark.parametrize("line", ["", "{", "[1]", "null", "nan", '{"seed', "\\udcff"])
@pytest.mark.parametrize("module", [paper, rivals, coverage])
def test_a_broken_line_is_told_with_its_number(
    module: ModuleType, line: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "rows.jsonl"
    out.write_text(GOOD + line + "\n" + GOOD)
    words = ["table1"] if module is paper else []
    said = refused(capsys, module, *words, "--out", out)
    assert f"{out}, line 2" in said
    assert out.read_text() == GOOD + line + "\n" + GOOD


@pytest.mark.fault("wrong options and files")
@pytest.mark.parametrize("name", ["paper", "rivals", "coverage", "scaling"])
def test_the_page_tells_of_a_broken_line(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / f"{name}.jsonl").write_text("{\n")
    said = refused(capsys, summary, "--results", tmp_path)
    assert f"{name}.jsonl, line 1" in said
    assert not (tmp_path / "README.md").exists()


@pytest.mark.fault("wrong options and files")
def test_a_line_without_a_key_is_none_of_ours(tmp_path: Path) -> None:
    out = tmp_path / "rows.jsonl"
    out.write_text('{"value": 1}\n')
    with pytest.raises(UserError, match="line 1: not a line of this benchmark"):
        run(out, "a")


@pytest.mark.fault("wrong options and files")
def test_a_place_that_takes_nothing_is_told_before_the_work(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    places = [tmp_path, tmp_path / "file" / "rows.jsonl"]
    if os.geteuid():  # root may write anywhere
        (tmp_path / "locked").mkdir(0o500)
        places.append(tmp_path / "locked" / "rows.jsonl")
    for out in places:
        with pytest.raises(UserError, match=r"cannot (read|write)"):
            run(out, "a")
    with pytest.raises(UserError, match="another --folder"):
        udr_run(Cell("UDR", "cartpole", "", 0), tmp_path / "file")


@pytest.mark.fault("wrong options and files")
@pytest.mark.parametrize(
    ("module", "words", "said"),
    [
        (paper, ("table1", "--seeds", 0, 0), "once"),
        (paper, ("table1", "--seeds", 2**32), "0 to 4294967295"),
        (paper, ("table1", "--seeds", -1), "0 to 4294967295"),
        (paper, ("table1", "--env-steps", -5, "--list"), "--env-steps -5"),
        (rivals, ("--seeds", 3, 3, "--list"), "once"),
        (rivals, ("--budget", 0, "--list"), "--budget 0"),
        (rivals, ("--trajectories", 0, "--list"), "--trajectories 0"),
        (rivals, ("--methods", "SimOpt", "--robots", "go2"), "no cells"),
        (coverage, ("--targets", 0), "--targets 0"),
        (coverage, ("--late", -1), "--late -1"),
        (coverage, ("--late", "nan"), "--late nan"),
    ],
)
def test_mistakes_end_with_one_line(
    module: ModuleType,
    words: tuple,
    said: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert said in refused(capsys, module, *words, "--out", tmp_path / "rows.jsonl")
    assert not (tmp_path / "rows.jsonl").exists()
