"""Which cells of the paper are done, stale or missing, and in which order they run."""

import dataclasses
import json
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from benchmarks import paper, paper_experiments, paper_status
from benchmarks._cells import add_row, read_rows
from benchmarks.paper_cells import Cell, is_stale, recipe
from benchmarks.paper_experiments import Config, cells
from tests.commands import refused

HERE = {"commit": "0123456789", "runtime": {"device_kind": "cpu"}}


def row(cell: Cell, seconds: float, **more: Any) -> dict[str, Any]:
    given = {
        "key": cell.key,
        **dataclasses.asdict(cell),
        "recipe": recipe(cell.method, cell.robot),
    }
    return {**given, "seconds": seconds, "versions": HERE, **more}


def some(method: str, seed: int = 0, robot: str = "cartpole") -> Cell:
    (found,) = (
        c
        for c in cells(Config("table1", robot=robot, seeds=(seed,)))
        if c.method == method and c.target.endswith("0.5")
    )
    return found


def test_a_row_from_before_a_change_is_stale_and_is_run_again(
    tmp_path: Path, monkeypatch: Any
) -> None:
    old = row(some("EASI paper"), 5.0, **{"return": 1.0}, recipe=0)
    assert is_stale(old) and not is_stale(row(some("Oracle"), 1.0))
    assert not is_stale({**old, "recipe": recipe("EASI paper", "cartpole")})
    out = tmp_path / "paper.jsonl"
    add_row(out, old)
    add_row(out, row(some("Oracle"), 1.0))
    ran: list[str] = []

    def solve(cell: Any, folder: Path) -> dict[str, Any]:
        ran.append(cell.key)
        return {"return": 2.0, "seconds": 6.0}

    monkeypatch.setattr("benchmarks.paper_cells.solve", solve)
    methods = ("EASI paper", "Oracle")
    paper.run(Config("table3", seeds=(0,), methods=methods, out=out))
    # The stale one is among them, what is done is not; its new line is what counts.
    assert old["key"] in ran and some("Oracle").key not in ran
    rows = {r["key"]: r for r in read_rows(out)}
    assert rows[old["key"]]["return"] == 2.0 and not is_stale(rows[old["key"]])
    assert len(rows) == len(read_rows(out))


def test_parts_say_what_is_done_stale_and_missing() -> None:
    every = cells(Config("table1"))
    rows = [row(c, 1.0) for c in every[:5]]
    rows[0]["recipe"] = -1  # of a method without changes
    searches = [c for c in every if c.method == "EASI default"]
    rows += [row(c, 1.0, recipe=0) for c in searches]
    found = paper_status.parts(Config("status", robot="cartpole"), rows)
    (table1,) = (p for p in found if p.experiment == "table1")
    assert {c.key for c in table1.stale} == {c.key for c in searches} | {every[0].key}
    assert len(table1.done) + len(table1.left) == len(every)
    assert not {p.robot for p in found} - {"cartpole"}
    assert {p.robot for p in paper_status.parts(Config("status"), rows)} == set(
        paper_experiments.CHANGED
    )


def test_costs_are_those_of_like_cells_on_this_device() -> None:
    there = {"versions": {"runtime": {"device_kind": "gpu"}}}
    oracle, search = some("Oracle"), some("EASI default")
    rows = [row(oracle, 10.0), row(oracle, 30.0), row(oracle, 1.0, **there)]
    rows.append(row(search, 7.0, **there))
    costs = paper_status.Costs(rows, "cpu")
    assert costs(some("Oracle", 3)) == 20.0
    assert costs(some("EASI paper")) == 7.0  # nothing nearer was run
    assert costs(some("GARAT")) is None
    assert costs(some("Oracle", robot="ant")) is None
    assert costs.sum([some("GARAT"), some("Oracle")]) == "0.0 h + 1 unknown"


def ran(monkeypatch: Any, config: Config, status: int = 0) -> list[str]:
    """Cells in the order in which processes are started for them."""
    keys: list[str] = []

    def run(words: list[str], core: int, limit: float) -> int:
        assert words[1:3] == ["-m", "benchmarks.paper"] and limit > 0
        assert words[3] in paper_experiments.EXPERIMENTS
        keys.append(words[words.index("--only") + 1])
        return status

    monkeypatch.setattr(paper_status, "ran", run)
    paper.run(config)
    return keys


def test_all_runs_each_cell_once_the_cheapest_part_first(
    tmp_path: Path, monkeypatch: Any
) -> None:
    out = tmp_path / "paper.jsonl"
    done = cells(Config("table1", seeds=(0,)))
    takes = {"EASI paper": 3.0, "EASI default": 9.0, "Oracle": 2.0}
    for c in done:
        add_row(out, row(c, takes.get(c.method, 1.0)))
    config = Config("all", robot="cartpole", seeds=(0, 1), out=out)
    keys = ran(monkeypatch, config)
    assert len(set(keys)) == len(keys)
    assert not {c.key for c in done} & set(keys)
    table = [c.key for c in cells(Config("table1", seeds=(1,)))]
    order = [k for k in keys if k in table]
    assert sorted(order) == sorted(table)
    assert "UDR" in order[0] and "EASI default" in order[-1]
    # One missing seed of Table 1 takes less than all of Table 4, of unknown cost.
    sweep = [i for i, k in enumerate(keys) if "elite_ratio" in k]
    assert max(map(keys.index, table)) < min(sweep)


def test_minutes_leave_out_what_would_not_end(
    tmp_path: Path, monkeypatch: Any, capsys: Any
) -> None:
    out = tmp_path / "paper.jsonl"
    takes = {"Oracle": 50.0, "GARAT": 5000.0}
    for c in cells(Config("table1", seeds=(0,))):
        add_row(out, row(c, takes.get(c.method, 1.0)))
    config = Config("all", robot="cartpole", seeds=(0, 1), out=out, minutes=1.5)
    keys = ran(monkeypatch, config)
    assert "take longer" in capsys.readouterr().out
    assert any("Oracle" in k for k in keys)
    assert not any("GARAT" in k or "elite_ratio" in k for k in keys)


@pytest.mark.fault("wrong options and files")
@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["stauts"], 'did you mean "status"'),
        (["all", "--workers", 0], "workers"),
        (["all", "--minutes", -1], "--minutes"),
        (["status", "--robot", "cartpol"], "cartpole"),
        (["all", "--list"], "goes without them"),
        (["all", "--shard", "1/2"], "goes without them"),
        (["status", "--methods", "GARATT"], "GARAT"),
    ],
)
def test_mistakes_are_one_line(words: list[Any], said: str, capsys: Any) -> None:
    assert said in refused(capsys, paper, *words)


def test_a_process_that_hangs_is_killed_with_what_it_started(tmp_path: Path) -> None:
    mark = tmp_path / "alive"
    child = f"import time, pathlib; time.sleep(3); pathlib.Path({str(mark)!r}).touch()"
    parent = (
        f"import subprocess, sys; subprocess.run([sys.executable, '-c', {child!r}])"
    )
    assert paper_status.ran([sys.executable, "-c", parent], -1, 0.5) is None
    time.sleep(3.5)
    assert not mark.exists()
    assert paper_status.ran([sys.executable, "-c", "raise SystemExit(3)"], 0, 60) == 3


def test_a_cell_that_fails_is_named(
    tmp_path: Path, monkeypatch: Any, capsys: Any
) -> None:
    monkeypatch.setattr(paper_status, "ran", lambda *_: 1)
    out = tmp_path / "paper.jsonl"
    words = ["all", "--robot", "cartpole", "--seeds", 0, "--methods", "Oracle"]
    assert "status 1" in refused(capsys, paper, *words, "--out", out)


def test_status_is_a_table(tmp_path: Path, capsys: Any) -> None:
    out = tmp_path / "paper.jsonl"
    out.write_text(json.dumps(row(some("EASI paper"), 5.0, recipe=0)) + "\n")
    paper.run(Config("status", out=out))
    told = capsys.readouterr().out
    assert "table1" in told and "stale, EASI paper" in told and "unknown" in told
