"""Blocks of a recording that are dealt out in turns."""

from pathlib import Path

from benchmarks._common import RESULTS
from benchmarks.go2_in_air import BLOCK, blocks, figures


def test_blocks_are_dealt_out_in_turns(tmp_path: Path) -> None:
    """Every row is in one block; a last one that is too short is in none."""
    log = tmp_path / "log.csv"
    rows = [f"{1 + 0.01 * k:.2f},{k}" for k in range(625)]  # 6.25 s
    log.write_text("\n".join(["time,qpos.a", *rows]) + "\n")
    halves = blocks(log, tmp_path)
    assert [len(half) for half in halves] == [2, 1]
    read = {p.name: p.read_text().splitlines() for half in halves for p in half}
    assert {lines[0] for lines in read.values()} == {"time,qpos.a"}
    found = [line for lines in read.values() for line in lines[1:]]
    assert sorted(found) == sorted(rows[:600])
    assert all(len(lines) == BLOCK / 0.01 + 1 for lines in read.values())


def test_pictures_come_from_the_committed_figures(tmp_path: Path) -> None:
    drawn = figures(RESULTS)
    assert set(drawn) == {"go2_in_air_errors.svg", "go2_in_air_values.svg"}
    for text in drawn.values():
        assert text.lstrip().startswith("<") and "</svg>" in text
    assert "FL thigh" in drawn["go2_in_air_errors.svg"]
    assert "calf kv" in drawn["go2_in_air_values.svg"]
    assert figures(tmp_path) == {}
