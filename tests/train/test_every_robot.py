"""The whole pipeline for the larger robots, small; Cartpole's is in `test_chain`."""

import json
from pathlib import Path

import numpy as np
import pytest

from tests.commands import command
from train import easi, evaluate, pipeline, udr

pytestmark = [pytest.mark.slow, pytest.mark.timeout(3000)]

SEARCH = (
    *("--generations", "3", "--population", "24", "--trajectories", "4"),
    *("--set", "segments=16", "real_batch=64", "discriminator_updates=2"),
)
TARGETS = {
    "ant": "torso_mass*0.5",
    "ballbalance": "ball_mass*0.5",
    "go2": "thigh_kp*0.5",
}


def _check(run: Path, robot: str) -> None:
    result = json.loads((run / "results.json").read_text())
    assert result["robot"] == robot and result["methods"] == ["UDR", "EASI"]
    assert np.isfinite([*result["returns"]["EASI"].values()]).all()
    found = json.loads((run / "distribution.json").read_text())
    seed = found["seeds"]["0"]
    assert np.isfinite(seed["mean"]).all()
    assert "determined" in seed["flags"]
    # Of what the data determine, the finish nears most, however short search and
    # recording; a stiff local minimum may keep one parameter.
    errors = [
        abs(np.log(x / found["truth"][p["name"]]))
        for p, x, flag in zip(
            found["parameters"], seed["mean"], seed["flags"], strict=True
        )
        if flag == "determined"
    ]
    assert np.median(errors) < 0.5, errors
    report = (run / "report.html").read_text()
    assert "Return by method" in report and "An episode" in report


@pytest.mark.parametrize("robot", list(TARGETS))
def test_from_udr_to_evaluation(robot: str, tmp_path: Path) -> None:
    target = ("--target", TARGETS[robot])
    steps = ("--env-steps", 10_240, "--algorithm", "ppo", "--eval-episodes", 4)
    command(udr, "--robot", robot, "--out", tmp_path / "udr", *steps, *target)
    command(
        easi,
        *("--udr", tmp_path / "udr", "--out", tmp_path / "easi", *SEARCH, *target),
        *("--eval-episodes", 4),
    )
    _check(tmp_path / "easi", robot)
    out = tmp_path / "returns.json"
    command(evaluate, "--run", tmp_path / "easi", "--episodes", 2, "--out", out)
    assert json.loads(out.read_text())["method"] == "EASI"


@pytest.mark.parametrize("robot", list(TARGETS))
def test_as_one_program(robot: str, tmp_path: Path) -> None:
    command(
        pipeline,
        *("--robot", robot, "--out", tmp_path / "run", "--algorithm", "ppo"),
        *("--env-steps", 10_240, "--eval-episodes", 4, *SEARCH),
        *("--target", TARGETS[robot]),
    )
    _check(tmp_path / "run", robot)
