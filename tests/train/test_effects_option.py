"""--effects and --target-effects of the commands, end to end and small."""

from pathlib import Path

import jax
import mujoco
import numpy as np
import pytest

from easi_jax.errors import UserError
from envs import make
from tests.commands import command, read, refused
from train import easi, evaluate, pipeline, udr
from train._retrain import check_robot, retrain
from train._robots import load_policies

pytestmark = pytest.mark.timeout(1500)

FOUND = """
effects:
- effect: coulomb_friction
  at: hinge
  kind: joint
  columns: {coulomb: 0.3}
  std: {coulomb: 0.02}
- {effect: actuator_delay, at: motor, kind: actuator, columns: {delay: 0.03}}
refitted:
- {address: joint.hinge.damping, value: 0.15}
"""
HIDDEN = """
effects:
- {effect: coulomb_friction, at: hinge, kind: joint, columns: {coulomb: 0.33}}
"""
MASS = """<mujoco><option timestep="0.002"/><worldbody><body>
<joint name="x" type="slide" axis="1 0 0"/><geom size="0.1" mass="1"/>
</body></worldbody>
<actuator><motor name="x" joint="x"/></actuator></mujoco>"""
SAC_AND_PPO = """
from easi_jax.rl.config import PpoConfig
from tests.tiny_robot.env import Tiny


class Both(Tiny):
    training = {**Tiny.training, "ppo": PpoConfig()}


make = Both
"""
NAMES = ("coulomb_friction@hinge.torque", "actuator_delay@motor.delay")
ENV = Path(__file__).parents[1] / "tiny_robot" / "env.py"
SMALL = ("--env-steps", "2400", "--eval-episodes", "4")
SEARCH = ("--generations", "2", "--population", "16", "--trajectories", "8")
SETTINGS = ("--set", "segments=16", "real_batch=64", "discriminator_updates=2")


@pytest.fixture(scope="module")
def files(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("effects")
    (folder / "found.yaml").write_text(FOUND)
    (folder / "hidden.yaml").write_text(HIDDEN)
    return folder


@pytest.fixture(scope="module")
def trained(files: Path) -> Path:
    out = files / "udr"
    with_effects = ("--env", ENV, "--effects", files / "found.yaml")
    command(udr, *with_effects, "--out", out, *SMALL, "--chunk", 24)
    return out


def test_the_run_says_what_it_was_trained_with(trained: Path) -> None:
    results = read(trained / "results.json")
    assert results["effects"]["effects"][0]["columns"] == {"coulomb": 0.3}
    assert results["target"][NAMES[0]] == 0.3 and results["target"][NAMES[1]] == 0.03
    assert results["target"]["damping"] == 0.15
    assert read(trained / "config.json")["config"]["effects"] == results["effects"]
    assert "coulomb_friction@hinge" in (trained / "report.html").read_text()


def test_evaluate_restores_the_effects_and_takes_others(
    trained: Path, files: Path, capsys
) -> None:
    got = []
    for k, more in enumerate(((), ("--effects", files / "hidden.yaml"))):
        out = files / f"evaluated{k}.json"
        run = ("--env", ENV, "--run", trained)
        command(evaluate, *run, "--episodes", 4, "--out", out, *more)
        got.append(read(out))
    assert set(NAMES) <= set(got[0]["target"])
    assert got[0]["effects"] == read(trained / "results.json")["effects"]
    assert NAMES[0] in got[1]["target"] and NAMES[1] not in got[1]["target"]
    assert got[0]["returns"] != got[1]["returns"]
    assert "coulomb_friction@hinge, actuator_delay@motor" in capsys.readouterr().out


def test_training_goes_on_from_another_run(trained: Path, files: Path, capsys) -> None:
    """One iteration with updates: networks are nearly those of the first run, for a
    seed of its own and for one that the run lacks."""
    out = files / "tuned"
    short = ("--env-steps", 250, "--eval-episodes", 4)
    start = ("--env", ENV, "--start-from", trained, "--effects", files / "found.yaml")
    command(udr, *start, "--out", out, *short, "--seeds", 0, 7)
    first = load_policies(trained, env_file=ENV)["policies"]
    tuned = load_policies(out, env_file=ENV)["policies"]
    for a, b in zip(
        jax.tree.leaves(first.network), jax.tree.leaves(tuned.network), strict=True
    ):
        for seed in (0, 1):
            np.testing.assert_allclose(a[0], b[seed], atol=0.05)
    both = files / "both.py"
    both.write_text(SAC_AND_PPO)
    other = ("--env", both, *start[2:], "--out", files / "no", "--algorithm", "ppo")
    said = refused(capsys, udr, *other)
    assert "its algorithm is sac, this training's ppo" in said
    assert not (files / "no").exists()


def test_resume_needs_the_same_effects(trained: Path, files: Path, capsys) -> None:
    before = read(trained / "results.json")
    again = ("--env", ENV, "--out", trained, *SMALL, "--chunk", 24, "--resume")
    command(udr, "--effects", files / "found.yaml", *again)
    assert read(trained / "results.json") == before
    other = files / "other.yaml"
    other.write_text(FOUND.replace("0.3}", "0.31}"))
    assert "effects" in refused(capsys, udr, "--effects", other, *again)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (HIDDEN.replace("at: hinge", "at: cart"), "names no joint"),
        (HIDDEN.replace("kind: joint", "kind: body"), "of kind joint"),
        ("refitted: 3\neffects: []", "holds a list"),
    ],
)
def test_bad_files_leave_nothing_behind(text: str, said: str, tmp_path, capsys) -> None:
    path = tmp_path / "effects.yaml"
    path.write_text(text)
    own = ("--env", ENV)
    for option in ("--effects", "--target-effects"):
        out = tmp_path / "out"
        assert said in refused(capsys, udr, *own, option, path, "--out", out)
        assert not out.exists()
    line = refused(
        capsys,
        *(udr, *own, "--effects", tmp_path / "none.yaml", "--out", tmp_path / "out"),
    )
    assert "cannot be read" in line


@pytest.mark.slow
def test_the_chain_with_known_and_hidden_effects(trained: Path, files: Path) -> None:
    out = files / "easi"
    command(
        easi,
        *("--env", ENV, "--udr", trained, "--out", out, *SEARCH, *SETTINGS),
        "--oracle",
        *("--target-effects", files / "hidden.yaml", "--eval-episodes", 4),
    )
    told = read(out / "distribution.json")
    assert [p["name"] for p in told["parameters"]][-2:] == list(NAMES)
    assert told["truth"][NAMES[0]] == 0.33 and told["truth"][NAMES[1]] == 0.0
    results = read(out / "results.json")
    assert set(results["methods"]) == {"UDR", "EASI", "Oracle"}
    assert results["effects"] and results["target_effects"]
    command(evaluate, "--env", ENV, "--run", out, "--policy", "Oracle", "--episodes", 4)


@pytest.mark.slow
def test_the_whole_chain_in_one_program(files: Path) -> None:
    out = files / "pipeline"
    command(
        pipeline,
        *("--env", ENV, "--effects", files / "found.yaml", "--out", out),
        *(*SMALL, *SEARCH),
        *("--target-effects", files / "hidden.yaml", *SETTINGS),
    )
    results = read(out / "results.json")
    assert results["effects"] and results["target_effects"]
    assert read(out / "distribution.json")["truth"][NAMES[0]] == 0.33


@pytest.mark.slow
def test_retraining_tests_both_policies_with_the_effects(files: Path) -> None:
    out, found = files / "retrained", files / "cartpole.yaml"
    found.write_text(FOUND.replace("hinge", "cart").replace("motor", "cart"))
    told = retrain("cartpole", out, found, (0, 3), 2400)
    assert told.env_steps == 2400 and told.robot == "cartpole"
    for which, returns in (("with", told.with_effects), ("without", told.without)):
        assert set(returns) == {"0", "3"}
        results = read(out / f"retrain_{which}" / "results.json")
        assert results["target"]["coulomb_friction@cart.torque"] == 0.3
        assert ("effects" in results) == (which == "with")
    assert told.with_effects != told.without


def test_retraining_needs_a_robot_with_the_places() -> None:
    ant = make("ant").mj_model
    check_robot("ant", ant)
    with pytest.raises(UserError, match="--retrain cartpole: that robot has no joint"):
        check_robot("cartpole", ant)
    with pytest.raises(UserError, match="unknown robot"):
        check_robot("cartpol", ant)


@pytest.mark.slow
def test_logs_are_fitted_with_effects_and_no_parameter_file(files: Path) -> None:
    """A delay and a friction that the model lacks, from a log of a plain mass."""
    rng, dt, rows = np.random.default_rng(0), 0.01, 600
    model = files / "mass.xml"
    model.write_text(MASS)
    real = MASS.replace("<joint", '<joint frictionloss="0.5"')
    m = mujoco.MjModel.from_xml_string(real)
    d = mujoco.MjData(m)
    ctrl = 3 * np.repeat(rng.uniform(-1, 1, rows // 10), 10)
    lines = ["time,qpos.x,ctrl.x"]
    for i in range(rows):
        lines.append(f"{dt * i:.4f},{d.qpos[0]:.17g},{ctrl[i]:.17g}")
        d.ctrl[0] = ctrl[max(i - 2, 0)]
        for _ in range(5):
            mujoco.mj_step(m, d)
    (files / "log.csv").write_text("\n".join(lines))
    (files / "mass.yaml").write_text(
        "effects:\n"
        "- {effect: coulomb_friction, at: x, kind: joint, columns: {coulomb: 0.4}}\n"
        "- {effect: actuator_delay, at: x, kind: actuator, columns: {delay: 0.018}}\n"
    )
    out = files / "logs"
    command(
        easi,
        *("--model", model, "--data", files / "log.csv", "--out", out),
        *("--effects", files / "mass.yaml", "--generations", 20, "--population", 40),
    )
    told = read(out / "distribution.json")
    mean = dict(
        zip(
            [p["name"] for p in told["parameters"]],
            told["seeds"]["0"]["mean"],
            strict=True,
        )
    )
    assert mean["coulomb_friction@x.torque"] == pytest.approx(0.5, rel=0.05)
    assert mean["actuator_delay@x.delay"] == pytest.approx(0.02, rel=0.05)


def test_logs_bring_their_own_effects(files: Path, capsys) -> None:
    line = refused(
        capsys,
        easi,
        *("--data", "log.csv", "--robot", "cartpole"),
        *("--target-effects", files / "hidden.yaml"),
    )
    assert "--target-effects goes without --data" in line
