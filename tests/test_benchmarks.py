"""The page of results says what the files say, also of what was not run."""

import dataclasses
import json
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks import gap_score, lines, summary, transfer
from benchmarks._common import RESULTS
from benchmarks._page import Section
from easi_jax.errors import UserError
from envs import make
from train._command import main


def page(folder: Path) -> str:
    main(summary.Config, summary.run, args=["--results", str(folder)], name="summary")
    return (folder / "README.md").read_text()


def test_committed_page_is_that_of_the_committed_files(tmp_path: Path) -> None:
    folder = tmp_path / "results"
    shutil.copytree(RESULTS, folder)
    assert page(folder) == (RESULTS / "README.md").read_text()
    for picture in RESULTS.glob("gap_c*"):
        assert (folder / picture.name).read_text() == picture.read_text()


def test_nothing_run_is_said(tmp_path: Path) -> None:
    text = page(tmp_path)
    for command in ("own_robot", "recovery --cases free_clean", "export"):
        assert f"Not run: `python -m benchmarks.{command}" in text
    assert re.search(r"\bmet\b|missed", text) is None


def test_of_several_sources_what_is_missing_is_named(tmp_path: Path) -> None:
    some = {"a": "rate_a.json", "b": "rate_b.json", "rest": "more_*.json"}
    section = Section("## Rates", some, "rate --robot {name}", lambda f: [str(f)])
    (tmp_path / "rate_b.json").write_text('{"rate": 0}')
    missing = [f"Not run: `python -m benchmarks.rate --robot {x}`." for x in "ab"]
    rest = "Not run: `python -m benchmarks.rate --robot rest`."
    assert section(tmp_path) == ["## Rates", missing[0], rest, "{'b': {'rate': 0}}"]
    (tmp_path / "rate_b.json").unlink()
    assert section(tmp_path) == ["## Rates", *missing, rest]
    assert dataclasses.replace(section, source="c.jsonl", optional=True)(tmp_path) == []


@pytest.mark.parametrize(("share", "said"), [(5.5, "5, met"), (2.0, "**missed**")])
def test_goals_are_judged(tmp_path: Path, share: float, said: str) -> None:
    same = {"device": "cpu", "devices": 2, "robot": "cartpole", "kind": "replay"}
    same |= {"population": 300, "auto": "mjx", "first_call_s": 1.0}
    same |= {"trace_s": 2.0, "compile_s": 3.0, "versions": {"runtime": {"cores": 2}}}
    rows = [
        {**same, "program": "rollout", "steps_per_s": [90.0, 100.0, 110.0]},
        {**same, "program": "mjx", "steps_per_s": [100 * share]},
    ]
    text = "".join(json.dumps(row) + "\n" for row in rows)
    (tmp_path / "engines.jsonl").write_text(text)
    (row,) = [x for x in page(tmp_path).splitlines() if x.startswith("| cartpole")]
    assert f"| **mjx** (auto) | {100 * share:,.0f} | {share:.2f} |" in row
    assert said in row
    assert "| 6.0 s |" in row


def case(
    kind: str, truth: list[str], named: list[str], sure: float, listed: str = ""
) -> dict[str, Any]:
    right = named[: len(truth)] == truth if truth else not named
    return {
        "kind": kind,
        "truth": truth,
        "named": named,
        "there": [name in truth for name in named],
        "readings": [],
        "confidence": [sure] * len(named),
        "verdict": "explained",
        "verdicts": ["explained"] if truth else ["no_gap"],
        "found": {k: k in named[: len(truth)] for k in truth},
        "listed": {k: k == listed for k in truth},
        "right": right,
    }


def test_cases_of_the_gap_are_counted() -> None:
    rows = [
        case("single", ["a@x"], ["a@x"], 0.9),
        case("single", ["a@x"], ["b@x"], 0.9),
        case("single", ["a@x"], ["b@x"], 0.3, listed="a@x"),
        case("none", [], [], 0.0),
        case("wrong_own", [], ["b@x"], 0.6),
        case("pair", ["a@x", "b@x"], ["a@x", "b@x"], 1.0),
    ]
    assert not gap_score.told(case("pair", ["a@x", "b@x"], ["a@x"], 1.0))
    assert gap_score.told(case("pair", ["a@x", "b@x"], ["a@x"], 1.0, listed="b@x"))
    got = gap_score.shares(rows)
    assert got["right name and place first"] == (1, 3)
    assert got["the same, or listed as alike"] == (2, 3)
    assert got["verdict right"] == (4, 6)
    assert got["false alarms without effect"] == (1, 2)
    assert got["wrong with confidence above 0.8"] == (1, 6)
    assert got["pairs both found"] == (1, 1)
    late = {**rows[3], "readings": ["sensor_delay@qvel.x"]}
    assert gap_score.has_right_verdict(late), "late velocities are an effect"
    assert not gap_score.has_right_verdict(rows[3])
    assert gap_score.confusion(rows) == {"a": {"a": 1, "b": 2}}
    pairs = gap_score.judged(rows)
    assert [ok for ok, _ in pairs] == [True, False, False, False, True, True]
    assert gap_score.brier(pairs) == pytest.approx(
        (0.01 + 0.81 + 0.09 + 0.36 + 0 + 0) / 6
    )
    assert gap_score.calibration(pairs)[-1] == (pytest.approx(0.95), 0.75, 4)


def test_parameters_are_compared_as_what_they_are() -> None:
    row = case("single", ["a@x"], ["a@x"], 0.9)
    row["true_parameters"] = [
        {"x": 3.0, "y": 4.0, "mass": 2.0, "phase": 1.0, "shape": "a"}
    ]
    row["parameters"] = [{"x": 3.0, "y": 4.5, "mass": 1.0, "phase": 7.0}]
    wrong = {**row, "named": ["b@x"]}
    assert gap_score.parameter_errors([row, wrong]) == pytest.approx([0.1, 0.5])
    assert gap_score.standardised([row]) == [], "no deviations were kept then"
    row["deviations"] = [{"x": 0.1, "y": 0.25, "mass": 2.0, "phase": 0.1}]
    assert gap_score.standardised(
        [row, {**wrong, "deviations": row["deviations"]}]
    ) == (pytest.approx([0.0, 2.0, -0.5]))
    row["gap"] = {"after": 0.3, "floor": 0.2}
    assert gap_score.ratios([row, {**row, "kind": "pair"}]) == pytest.approx([1.5])


def test_wilson_interval() -> None:
    # R. G. Newcombe, Stat. Med. 17 (1998), table I
    assert gap_score.wilson(81, 263) == pytest.approx((0.2553, 0.3662), abs=1e-4)
    assert gap_score.wilson(0, 20) == pytest.approx((0.0, 0.1611), abs=1e-4)


def test_lines_are_counted_by_package() -> None:
    packages = {"easi_jax/io": [5, 3], "train": [2, 4], "tests": [1000, 2000]}
    result = {"command": "lines", "summed": lines.SUMMED, "packages": packages}
    *_, told = lines.paragraphs(result)
    assert "| easi_jax/io | 5 | 3 | -2 |" in told
    assert "| **easi_jax, train, benchmarks** | 7 | 7 | +0 |" in told
    assert told.endswith("| **in all** | 1,007 | 2,007 | +1,000 |")
    with pytest.raises(UserError, match="no such commit"):
        lines.files("no such commit")


@pytest.mark.slow
@pytest.mark.timeout(3000)
@pytest.mark.parametrize("robot", ["ant", "ballbalance", "go2"])
def test_transfer_of_every_robot(robot: str, tmp_path: Path) -> None:
    """Fig. 6 at its smallest: one target, two seeds, hardly any training."""
    main(
        transfer.Config,
        transfer.run,
        args=[
            *("--robot", robot, "--seeds", "0", "1", "--factors", "0.5"),
            *("--env-steps", "10240", "--generations", "2", "--population", "16"),
            *("--trajectories", "4", "--episodes", "4", "--folder", str(tmp_path)),
        ],
        name="transfer",
    )
    (path,) = tmp_path.glob("transfer_*.json")
    got = json.loads(path.read_text())
    assert got["robot"] == robot and set(got["returns"]) == {"UDR", "EASI", "Oracle"}
    for returns in got["returns"].values():
        assert np.isfinite([*returns.values()]).all() and len(returns) == 2
    nominal = make(robot).space.nominal
    names = make(robot).space.names
    half = 0.5 * nominal[names.index(got["changed"])]
    assert got["target"][got["changed"]] == pytest.approx(half)
    assert np.isfinite(got["changed_found"]).all()
