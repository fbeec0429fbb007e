"""Demonstrations, their imitation and EASI with it, end to end and small."""

from pathlib import Path

import numpy as np
import pytest

from easi_jax.io.logs.reader import read_logs
from tests.commands import command, read, refused
from tests.tiny_robot.env import Tiny
from train import demonstrate, easi, evaluate, export, pipeline, udr

pytestmark = pytest.mark.timeout(1500)

ENV = Path(__file__).parents[1] / "tiny_robot" / "env.py"
SEARCH = (
    *("--generations", 3, "--population", 16, "--trajectories", 8),
    *("--set", "segments=16", "real_batch=64", "discriminator_updates=2"),
)
STEPS = ("--env-steps", 10_240, "--eval-episodes", 4)


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """``udr``, whose policy demonstrates; ``shown``; ``like``, which imitates it."""
    root = tmp_path_factory.mktemp("imitation")
    command(udr, "--env", ENV, "--out", root / "udr", "--env-steps", 2400)
    command(
        *(demonstrate, "--policy", root / "udr", "--env", ENV, "--episodes", 12),
        *("--out", root / "shown"),
    )
    imitate = "--algorithm", "ess_infogail", "--demonstrations"
    command(
        *(udr, "--env", ENV, "--out", root / "like", *STEPS, *imitate),
        root / "shown" / "demonstrations.npz",
    )
    return root


def test_a_policy_is_recorded_with_noise(runs: Path) -> None:
    env = Tiny()
    log = read_logs(runs / "shown" / "demonstrations.npz", env.mj_model)
    assert len(log.runs) == read(runs / "shown" / "results.json")["runs"] == 12
    assert {len(run) for run in log.runs} == {env.episode_length}
    assert all(np.abs(np.diff(run.ctrl[:, 0])).max() > 0.01 for run in log.runs)
    assert (runs / "shown" / "report.html").is_file()


def test_an_imitator_is_a_run_like_any(runs: Path, tmp_path: Path) -> None:
    result = read(runs / "like" / "results.json")
    assert result["algorithm"] == "ess_infogail"
    assert np.isfinite(result["returns"]["UDR"]["0"])
    out = tmp_path / "returns.json"
    again = "--run", runs / "like", "--env", ENV, "--episodes", 2
    command(evaluate, *again, "--out", out)
    assert read(out)["method"] == "UDR"
    command(export, runs / "like", "--env", ENV, "--out", tmp_path / "made")
    assert (tmp_path / "made" / "policy.onnx").is_file()


def test_easi_retrains_by_imitation(runs: Path, tmp_path: Path) -> None:
    out = tmp_path / "easi"
    given = "--env", ENV, "--udr", runs / "like", "--out", out, *SEARCH
    command(easi, *given, "--target", "gear*0.5", "--eval-episodes", 4)
    assert read(out / "results.json")["algorithm"] == "ess_infogail"
    assert np.isfinite(read(out / "results.json")["returns"]["EASI"]["0"])


@pytest.mark.slow
def test_one_program_imitates(runs: Path, tmp_path: Path) -> None:
    shown = runs / "shown" / "demonstrations.npz"
    command(
        *(pipeline, "--env", ENV, "--out", tmp_path / "whole", *STEPS, *SEARCH),
        *("--algorithm", "ess_infogail", "--demonstrations", shown),
        *("--target", "gear*0.5"),
    )
    assert np.isfinite(
        read(tmp_path / "whole" / "results.json")["returns"]["EASI"]["0"]
    )


def test_other_demonstrations_are_noticed(
    runs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shown = runs / "shown" / "demonstrations.npz"
    kept = shown.read_bytes()
    try:
        command(
            *(demonstrate, "--policy", runs / "udr", "--env", ENV, "--episodes", 11),
            *("--out", tmp_path / "other"),
        )
        shown.write_bytes((tmp_path / "other" / "demonstrations.npz").read_bytes())
        given = easi, "--env", ENV, "--udr", runs / "like", "--out", tmp_path / "easi"
        assert "is not what" in refused(capsys, *given)
        shown.unlink()
        assert "demonstrations.npz" in refused(capsys, *given)
        # To act, nobody needs them.
        command(evaluate, "--run", runs / "like", "--env", ENV, "--episodes", 2)
    finally:
        shown.write_bytes(kept)
    assert not (tmp_path / "easi").exists()


def test_options_of_imitation_that_do_not_go_together(
    runs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shown = runs / "shown" / "demonstrations.npz"
    out = "--env", ENV, "--out", tmp_path / "run"
    imitate = "--algorithm", "ess_infogail"
    for options, said in (
        (imitate, "give --demonstrations"),
        (("--demonstrations", shown), "--algorithm ess_infogail"),
        ((*imitate, "--demonstrations", tmp_path / "no.npz"), "no.npz"),
        ((*imitate, "--demonstrations", shown, "--skill", "trot"), "labelled"),
        ((*imitate, "--demonstrations", shown, "--skill", "1"), "1 skill,"),
        (("--skill", "trot"), "--skill goes with --algorithm ess_infogail"),
        ((*imitate, "--skills", 2), "give --demonstrations"),
        ((*imitate, "--demonstrations", shown, "--skills", 0), "skills"),
        (
            (*imitate, "--demonstrations", shown, "--skills", 2, "--labelled", 2),
            "labelled is 2",
        ),
    ):
        assert said in refused(capsys, udr, *out, *options)
    robot = "--robot", "cartpole", "--out", tmp_path / "run"
    line = refused(capsys, udr, *robot, *imitate, "--demonstrations", shown)
    assert "qpos" in line
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--gaits", "gallop"), "--gaits gallop: known are trot, pace, bound"),
        (("--gaits", "trot", "trot"), "each once"),
        (("--speeds", 0.0), "above 0"),
        (("--speeds", 0.8, 0.8), "each once"),
        (("--policy", "nowhere", "--gaits", "pace"), "--gaits is of experts"),
        (("--shares", 0.5, 0.5), "one of each gait"),
        (("--episodes", 1), "at least 2"),
        (("--noise", -1), "from 0 to 1"),
        (("--env-steps", 0), "at least 1"),
        (("--policy", "nowhere", "--env-steps", 9), "--env-steps is of experts"),
        (("--method", "UDR"), "--method goes with --policy"),
        (("--policy", "nowhere"), "nowhere"),
    ],
)
def test_demonstrations_that_cannot_be_made(
    options: tuple[object, ...],
    said: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert said in refused(capsys, demonstrate, "--out", tmp_path / "no", *options)
    assert not (tmp_path / "no").exists()


def test_an_expert_walks_by_its_clock(tmp_path: Path) -> None:
    """A training of two unrolls: what falls is left out, what stands is labelled."""
    command(
        *(demonstrate, "--out", tmp_path / "go2", "--env-steps", 10_240),
        *("--speeds", 0.4, 0.8, "--episodes", 3),
    )
    from envs import make

    log = read_logs(tmp_path / "go2" / "demonstrations.npz", make("go2").mj_model)
    names = {run.name.rsplit("/", 1)[-1].rsplit("-", 1)[0] for run in log.runs}
    assert names <= {"trot:0.4", "trot:0.8"} and names
    report = (tmp_path / "go2" / "report.html").read_text()
    assert "Demonstrated gaits" in report
