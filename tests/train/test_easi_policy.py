"""``train.easi --data LOG --policy``: robots whose base nobody measured."""

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from easi_jax.io.logs.reader import write_log
from tests.commands import command, read, refused
from tests.walker import PARAMETERS, XML, in_a_stand, walk
from train import easi

TRUTH = {"kp": 26.0, "kv": 0.8}
SMALL = ("--population", "16", "--generations", "2", "--search-chunk", "1")
SHORT = ("--set", "rollout_steps=90", "real_batch=64", "discriminator_updates=2")


def without_base(log: Path) -> None:
    """Takes the base's columns out of a log."""
    rows = [line.split(",") for line in log.read_text().splitlines()]
    kept = [i for i, name in enumerate(rows[0]) if ".root." not in name]
    log.write_text("\n".join(",".join(row[i] for i in kept) for row in rows) + "\n")


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A model, its parameters, and a log of its joints and sensors."""
    folder = tmp_path_factory.mktemp("walker")
    (folder / "walker.xml").write_text(XML)
    (folder / "parameters.yaml").write_text(PARAMETERS)
    model, run = walk(20.0, kp=TRUTH["kp"], kv=TRUTH["kv"], kept=True)
    write_log(folder / "log.csv", model, run)
    without_base(folder / "log.csv")
    return folder


def arguments(files: Path, *more: object) -> list[object]:
    model = ["--model", files / "walker.xml", "--policy", "commands"]
    given = ["--parameters", files / "parameters.yaml", "--data", files / "log.csv"]
    return [*model, *given, *SMALL, *SHORT, *more]


@pytest.fixture(scope="module")
def found(files: Path) -> Path:
    command(easi, *arguments(files, "--out", files / "run"))
    return files / "run"


def test_finds_gains_without_a_base(found: Path) -> None:
    told = read(found / "distribution.json")
    result = told["seeds"]["0"]
    for i, p in enumerate(told["parameters"]):
        mean, std = result["mean"][i], result["std"][i]
        assert abs(mean - TRUTH[p["name"]]) < max(3 * std, 0.1 * TRUTH[p["name"]])
        assert result["flags"][i] == "determined"
    assert [r["name"] for r in told["readings"]] == [
        f"reading.{kind}.delay" for kind in ("qvel", "gyro", "orientation")
    ]


def test_predicts_the_next_reading_better(found: Path) -> None:
    held = read(found / "distribution.json")["held_out"]
    before, after = np.array(held["before"]), np.array(held["after"]["0"])
    joints = [i for i, c in enumerate(held["channels"]) if c.startswith("q")]
    assert np.mean(after[joints] / before[joints]) < 0.9
    assert "next reading" in held["measure"] and held["horizon"] == 0.02


def test_says_so_in_its_report(found: Path) -> None:
    text = (found / "report.html").read_text()
    assert "place is left out: it depends on the heading" in text
    assert "RMS error of the next reading" in text
    assert "gravity.orientation.x" in text


def test_a_log_in_a_stand_is_known_when_the_walk_is_fitted(
    found: Path, files: Path, tmp_path: Path
) -> None:
    """Values are surer with it, and true."""
    stand = tmp_path / "stand.csv"
    stand.write_text(in_a_stand(**TRUTH))
    out = tmp_path / "run"
    command(easi, *arguments(files, "--out", out, "--stand", stand))
    alone, both = (read(f / "distribution.json")["seeds"]["0"] for f in (found, out))
    for i, truth in enumerate(TRUTH.values()):
        assert both["std"][i] < 0.7 * alone["std"][i]
        assert abs(both["mean"][i] - truth) < max(3 * both["std"][i], 0.05 * truth)
    assert "in the stand: " in (out / "report.html").read_text()


def test_a_killed_search_goes_on_to_the_same_result(
    found: Path, files: Path, tmp_path: Path
) -> None:
    """A run whose second chunk was never made, resumed."""
    import shutil

    run = tmp_path / "run"
    shutil.copytree(found, run)
    for name in ("distribution.json", "report.html"):
        (run / name).unlink()
    chunks = sorted((run / "checkpoints" / "search").iterdir())
    shutil.rmtree(chunks[-1])
    config = json.loads((run / "config.json").read_text())
    config["config"]["out"] = str(run)
    command(easi, *arguments(files, "--out", run, "--resume"))
    mine, theirs = (
        read(folder / "distribution.json")["seeds"]["0"] for folder in (run, found)
    )
    assert mine == theirs


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (["--horizon", "0.2"], "--horizon goes without --policy"),
        (["--noise", "0.1"], "--noise is [0.1]: with --policy it needs 15 numbers"),
        (["--held-base"], "--held-base goes without --policy"),
        (["--observed", "speed=1"], "--observed goes with a policy"),
        (["--sampled"], "--sampled goes with a policy"),
        (["--stand", "nowhere.csv"], "nowhere.csv"),
        (["--stand", "stand.csv", "--no-refine"], "--stand goes without --no-refine"),
        (["--set", "policy_updates_per_generation=2"], "no policy is trained from"),
        (["--set", "rollout_steps=40"], "rollout_steps is 40"),
        (["--set", "rollout_steps=5000"], "too few to send 5000 commands"),
        (["--policy", "nowhere"], "--model goes with --policy commands"),
    ],
)
@pytest.mark.fault("wrong options and files")
def test_wrong_options_are_one_line(
    more: list[str],
    said: str,
    files: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    out = tmp_path / "out"
    assert said in refused(capsys, easi, *arguments(files, "--out", out, *more))
    assert not out.exists()


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--policy", "nowhere"], "nowhere"),
        (["--policy", "nowhere.onnx"], "cannot read nowhere.onnx"),
        (["--policy", "commands"], "--data needs --model"),
        (["--robot", "go2", "--observed", "a=1"], "--observed goes with --policy"),
        (["--policy-seed", "1", "--robot", "go2"], "--policy-seed goes with --policy"),
        (["--stand", "s.csv", "--robot", "go2"], "--stand goes with --policy"),
    ],
)
@pytest.mark.fault("wrong options and files")
def test_a_policy_that_is_not_there_is_one_line(
    options: list[str],
    said: str,
    files: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    given = ["--data", files / "log.csv", "--out", tmp_path / "out", *options]
    assert said in refused(capsys, easi, *given)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--policy", "x"), "--policy goes with --data"),
        (("--held-base",), "--held-base goes with --data"),
        (("--unmeasured", "all"), "--unmeasured goes with --data"),
        (("--oracle", "--data", "x.csv"), "--oracle goes without --data"),
        (("--no-warm-start", "--data", "x.csv"), "--no-warm-start goes without"),
        (("--sampled", "--data", "x.csv"), "--sampled goes with --policy"),
    ],
)
def test_options_that_would_do_nothing_are_refused(
    options: Sequence[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert said in refused(capsys, easi, *options)
