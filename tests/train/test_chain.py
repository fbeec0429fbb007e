"""train.udr, train.easi, train.evaluate and train.pipeline, end to end and small."""

import json
import re
import shutil
from pathlib import Path
from typing import Any, cast

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import onnxruntime
import pytest
import yaml
from PIL import Image, ImageSequence

from easi_jax.io.runs import checkpoints
from easi_jax.pipeline.stages import Pipeline, PipelineConfig, seed_keys
from easi_jax.rl.networks import act
from easi_jax.search.easi import SearchState
from easi_jax.simulation.rollout import policy_rollout
from tests.commands import command, refused
from tests.tiny_robot.env import XML, Tiny
from train import easi, evaluate, export, pipeline, udr
from train._chain import ready
from train._effects import Given
from train._robots import load_policies, search_config, training_config

# The whole chain is compiled here; on a busy machine that takes its time.
pytestmark = pytest.mark.timeout(1500)

SMALL = ("--env-steps", "2400", "--eval-episodes", "4")
SEARCH = ("--generations", "4", "--population", "16", "--trajectories", "8")
SETTINGS = (*("--set", "segments=16", "real_batch=64", "discriminator_updates=2"),)
TARGET = ("--target", "gear*0.5")
ENV = Path(__file__).parents[1] / "tiny_robot" / "env.py"
LAST = 48  # steps of training


@pytest.fixture(scope="module")
def chain(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("chain")
    command(udr, "--env", ENV, "--out", root / "udr", *SMALL, "--chunk", 24, *TARGET)
    command(
        easi,
        *("--env", ENV, "--udr", root / "udr", "--out", root / "easi", "--chunk", 24),
        *("--search-chunk", 2, *SEARCH, *SETTINGS, *TARGET, "--eval-episodes", 4),
    )
    return root


def _pipeline(warm_start: bool = False) -> Pipeline:
    env = Tiny()
    training = training_config(env, 2400)
    return Pipeline(env, PipelineConfig(training=training, warm_start=warm_start))


def _restored(run: Path, stage: str):
    pipe = _pipeline()
    wide = pipe.spread(pipe.udr(), 1)
    target = jax.eval_shape(lambda k: pipe.train_init(k, wide), seed_keys([0]))
    found = checkpoints.restore(run / "checkpoints" / stage, target)
    assert found is not None
    return found


def test_folder_of_udr(chain: Path) -> None:
    result = json.loads((chain / "udr" / "results.json").read_text())
    assert result["methods"] == ["UDR"] and np.isfinite(result["returns"]["UDR"]["0"])
    assert result["target"]["gear"] == 1.0
    assert _restored(chain / "udr", "train").step == LAST


@pytest.mark.parametrize("kept", [24, pytest.param(LAST, marks=pytest.mark.slow)])
@pytest.mark.fault("killed (signal 9), then resumed")
def test_killed_training_goes_on_bit_equal(
    chain: Path, tmp_path: Path, kept: int
) -> None:
    copy = tmp_path / "udr"
    shutil.copytree(chain / "udr", copy)
    whole = _restored(copy, "train")
    # As a kill in the second chunk would have left it, or one at its end.
    if kept < LAST:
        shutil.rmtree(copy / "checkpoints" / "train" / f"step_{LAST:012d}")
    (copy / "results.json").unlink()
    more = ("--chunk", 24, *TARGET, "--resume")
    command(udr, "--env", ENV, "--out", copy, *SMALL, *more)
    again = _restored(copy, "train")
    assert again.step == whole.step == LAST
    for a, b in zip(
        jax.tree.leaves(whole.state), jax.tree.leaves(again.state), strict=True
    ):
        np.testing.assert_array_equal(np.asarray(a), np.asarray(b))
    told = [json.loads((r / "results.json").read_text()) for r in (copy, chain / "udr")]
    assert told[0]["returns"] == told[1]["returns"]


KILLED_IN = {
    "search": ("search/step_000000000004", "estimate", "final"),
    "last training": (f"final/step_{LAST:012d}",),
}


@pytest.mark.slow
@pytest.mark.parametrize("stage", KILLED_IN)
@pytest.mark.fault("killed (signal 9), then resumed")
def test_killed_search_goes_on_bit_equal(
    chain: Path, tmp_path: Path, stage: str
) -> None:
    copy = tmp_path / "easi"
    shutil.copytree(chain / "easi", copy)
    # As a kill in the second chunk of the stage would have left it.
    for lost in (*KILLED_IN[stage], "policy_EASI", "policy_UDR"):
        shutil.rmtree(copy / "checkpoints" / lost)
    for name in ("results.json", "distribution.json", "report.html"):
        (copy / name).unlink()
    command(
        easi,
        *("--env", ENV, "--udr", chain / "udr", "--out", copy, "--chunk", 24),
        "--resume",
        *("--search-chunk", 2, *SEARCH, *SETTINGS, *TARGET, "--eval-episodes", 4),
    )
    for name in ("distribution.json", "results.json"):
        again, whole = (
            json.loads((r / name).read_text()) for r in (copy, chain / "easi")
        )
        assert again == whole, name
    rows = [json.loads(x) for x in (copy / "metrics.jsonl").read_text().splitlines()]
    steps = [r["step"] for r in rows if r["stage"] == "search"]
    assert steps == sorted(set(steps)), "a generation was logged twice"


def test_folder_of_easi(chain: Path) -> None:
    run = chain / "easi"
    found = json.loads((run / "distribution.json").read_text())
    assert [p["name"] for p in found["parameters"]] == ["gear", "damping"]
    seed = found["seeds"]["0"]
    cov = np.array(seed["unit_covariance"])
    assert np.isfinite(cov).all() and np.trace(cov) > 0
    assert np.linalg.eigvalsh(cov).min() > -1e-9
    assert set(seed["flags"]) <= {"determined", "not determined", "at bound"}
    assert found["truth"]["gear"] == 1.0
    result = json.loads((run / "results.json").read_text())
    assert result["methods"] == ["UDR", "EASI"]
    stages = {
        json.loads(line)["stage"]
        for line in (run / "metrics.jsonl").read_text().splitlines()
    }
    assert "search" in stages
    assert (run / "figures" / "parameters.svg").read_text().startswith("<")


def test_report_needs_no_network(chain: Path) -> None:
    text = (chain / "easi" / "report.html").read_text()
    assert "<svg" in text and "gear" in text
    assert "An episode" in text
    assert not re.search(r'(src|href)="https?:', text)


def test_refined_mean_predicts_better_than_nominal(chain: Path) -> None:
    errors = json.loads((chain / "easi" / "results.json").read_text())["held_out"]
    one = errors["one_step"]
    for channel in one["EASI"]:
        assert one["EASI"][channel] < 0.01 * one["nominal"][channel]


def test_evaluate_tests_any_policy_in_any_target(chain: Path, tmp_path, capsys) -> None:
    out = tmp_path / "returns.json"
    run = ("--env", ENV, "--run", chain / "easi")
    args = (*run, "--target", "gear*2", "--episodes", 3)
    command(evaluate, *args, "--out", out)
    saved = json.loads(out.read_text())
    assert saved["method"] == "EASI" and len(saved["returns"]["0"]) == 3
    capsys.readouterr()
    line = refused(capsys, evaluate, *run, "--policy", "Oracl")
    assert "Oracl" in line
    line = refused(capsys, evaluate, *args, "--render", tmp_path / "run.avi")
    assert ".gif" in line


def test_evaluate_draws_an_episode(chain: Path, tmp_path: Path) -> None:
    out = tmp_path / "run.gif"
    run = ("--env", ENV, "--run", chain / "easi")
    command(evaluate, *run, "--episodes", 2, "--render", out)
    with Image.open(out) as image:
        assert len([*ImageSequence.Iterator(image)]) > 10
        width = image.size[0]
    both, told = tmp_path / "both.gif", tmp_path / "both.json"
    first = (*run, "--policy", "UDR", "--beside", chain / "easi", "--episodes", 2)
    command(evaluate, *first, "--render", both, "--out", told)
    with Image.open(both) as image:
        assert image.size[0] == 2 * width
    result = json.loads(told.read_text())
    assert (result["method"], result["beside"]["method"]) == ("UDR", "EASI")
    assert result["target"] == result["beside"]["target"]
    command(evaluate, *first, "--render", tmp_path / "both.svg")
    assert "data:image/jpeg" in (tmp_path / "both.svg").read_text()


@pytest.mark.slow
def test_pipeline_equals_the_two_commands(chain: Path, tmp_path: Path) -> None:
    out = tmp_path / "pipeline"
    command(pipeline, "--env", ENV, "--out", out, *SMALL, *SEARCH, *SETTINGS, *TARGET)
    one = json.loads((out / "distribution.json").read_text())["seeds"]["0"]
    two = json.loads((chain / "easi" / "distribution.json").read_text())["seeds"]["0"]
    # Closely where the data say something, within half a standard deviation elsewhere.
    variance, along = np.linalg.eigh(np.array(two["unit_covariance"]))
    apart = along.T @ (np.array(one["unit_mean"]) - two["unit_mean"])
    std = np.sqrt(np.maximum(variance, 0.0))
    assert (np.abs(apart) < 1e-3 + 0.5 * std).all(), (apart, std)
    result = json.loads((out / "results.json").read_text())["returns"]
    other = json.loads((chain / "easi" / "results.json").read_text())["returns"]
    np.testing.assert_allclose(result["UDR"]["0"], other["UDR"]["0"], rtol=0.05)
    assert _moved(out) < 0.3 * _moved(chain / "easi", fresh=True)


def _moved(run: Path, fresh: bool = False) -> float:
    """How far the final networks are from the first ones, or other new ones are."""
    first, final = (
        load_policies(run, m, ENV)["policies"].network for m in ("UDR", "EASI")
    )
    if fresh:
        pipe = _pipeline()
        wide = pipe.spread(pipe.udr(), 1)
        final = pipe.policies(pipe.train_init(seed_keys([5]), wide)).network
    apart = jax.tree.map(lambda a, b: float(((a - b) ** 2).sum()), first, final)
    return sum(jax.tree.leaves(apart)) ** 0.5


def test_demonstrations_of_the_preset_paper() -> None:
    """They cross resets, hold what is seen, and begin with a stale observation."""
    search = search_config("paper", ("rollout_steps=40",), "ant")
    assert search.discriminator_updates == 20 and search.stale_first_observation
    assert search.rollout_steps == 40
    assert search_config("paper", (), "ant").rollout_steps == 200  # none is remembered
    assert not search_config("paper", (), "cartpole").stale_first_observation
    env = Tiny()
    training = training_config(env, 2400)
    pipe = Pipeline(env, PipelineConfig(search, training, trajectories=6))
    wide = pipe.spread(pipe.udr(), 1)
    policies = pipe.policies(pipe.train_init(seed_keys([0]), wide))
    target = jnp.asarray(env.space.nominal)
    demos = jax.jit(pipe.demonstrate)(policies, target, seed_keys([1]))
    seen, last = np.asarray(demos.seen), env.episode_length - 1
    assert seen.shape == (1, 6, last + 1, 2 * env.obs_size + env.action_size)
    size = env.obs_size
    np.testing.assert_array_equal(seen[..., 1:, :size], seen[..., :-1, -size:])
    # The time limit ends an episode, and the last transition crosses to the next.
    assert (np.asarray(demos.weight)[..., last] == 0).all()
    states = np.concatenate([demos.qpos, demos.qvel], -1)
    np.testing.assert_allclose(states[..., 1:, :], seen[..., 1:, :size], atol=1e-5)
    assert not np.isclose(states[..., 0, :], seen[..., 0, :size]).all(-1).any()


@pytest.mark.parametrize(
    ("more", "refine", "warm"),
    [
        ({}, True, True),
        ({"refine": False, "warm_start": False}, False, False),
        ({"preset": "paper"}, False, False),
        ({"preset": "paper", "set": ("finish=true", "goes_on=true")}, True, True),
    ],
)
def test_the_preset_paper_has_no_finish_unless_asked_for(
    more: dict[str, Any], refine: bool, warm: bool
) -> None:
    config = easi.Config(**more, target=("gear*0.5",))
    setup = ready(config, Tiny(), Given(), training_config(Tiny(), 2400), (0,))
    assert (setup.pipe.config.finishes, setup.pipe.config.goes_on) == (refine, warm)


@pytest.mark.slow
def test_the_preset_paper_goes_through(chain: Path, tmp_path: Path) -> None:
    given = ("--env", ENV, "--udr", chain / "udr", *TARGET, "--chunk", 24)
    small = ("--set", "rollout_steps=20", "real_batch=64", "discriminator_updates=2")
    out = tmp_path / "run"
    command(
        easi, *given, *SEARCH, *small, "--eval-episodes", 4, "--preset", "paper",
        "--out", out,
    )  # fmt: skip
    assert _moved(out) > 0.5 * _moved(chain / "easi", fresh=True)  # new networks
    found = json.loads((out / "distribution.json").read_text())["seeds"]["0"]
    assert np.isfinite(found["mean"]).all()


@pytest.mark.slow
def test_warm_start_goes_on_from_the_first_networks_alone(chain: Path) -> None:
    assert _moved(chain / "easi") < 0.3 * _moved(chain / "easi", fresh=True)
    old, search = _restored(chain / "udr", "train").state, cast(SearchState, None)
    begun = []
    for warm in (True, False):
        pipe = _pipeline(warm)
        wide = pipe.spread(pipe.udr(), 1)
        new = pipe.final_init(seed_keys([5]), wide, search, old)
        assert (new.iteration, old.iteration) == (0, LAST)
        same = jax.tree.map(np.array_equal, new.learner.policy, old.learner.policy)
        begun.append(all(jax.tree.leaves(same)))
    assert begun == [True, False]


@pytest.mark.parametrize(
    ("module", "args", "said"),
    [
        (udr, ("--robot", "cartpol"), 'did you mean "cartpole"?'),
        (udr, ("--target", "cart_kpp*2"), 'did you mean "cart_kp"?'),
        (udr, ("--target", "cart_kp*x"), "NAME*FACTOR"),
        (udr, ("--seeds", "1", "1"), "seeds"),
        (udr, ("--chunk", "0"), "--chunk"),
        (easi, ("--udr", "nowhere"), "holds no run"),
        (easi, ("--model", "robot.xml"), "--data"),
        (evaluate, ("--run", "nowhere"), "holds no run"),
        (pipeline, ("--preset", "papper"), 'did you mean "paper"?'),
        (pipeline, ("--strategy", "CMA_E"), "CMA_ES"),
        (pipeline, ("--set", "segmnts=3"), 'did you mean "segments"?'),
        (pipeline, ("--set", "loss=hinge"), "loss"),
        (pipeline, ("--noise", "0.1"), "noise"),
        (
            pipeline,
            ("--preset", "paper", "--noise", *("0.01",) * 4),
            "observation_inputs=false",
        ),
        (pipeline, ("--set", "observation_inputs=true"), "source=policy"),
    ],
)
@pytest.mark.fault("wrong options and files")
def test_mistakes_end_with_one_line(module, args, said, tmp_path, capsys) -> None:
    out = () if module is evaluate else ("--out", tmp_path / "run")
    assert said in refused(capsys, module, *args, *out)
    assert not (tmp_path / "run").exists()


def test_bad_settings_leave_the_earlier_run(chain: Path, capsys) -> None:
    before = (chain / "udr" / "results.json").read_bytes()
    line = refused(capsys, udr, "--out", chain / "udr", "--robot", "cartpole")
    assert "--resume" in line and "--overwrite" in line
    assert (chain / "udr" / "results.json").read_bytes() == before


def test_export_writes_all_that_a_run_has(chain: Path, tmp_path: Path) -> None:
    out = tmp_path / "export"
    model = tmp_path / "tiny.xml"
    model.write_text(XML)
    command(export, chain / "easi", "--env", ENV, "--model", model, "--out", out)
    assert {p.name for p in out.iterdir()} == {
        *("policy.onnx", "policy.json", "policy.stablehlo", "policy.mlir"),
        *("model.xml", "randomization.yaml"),
    }
    found = json.loads((chain / "easi" / "distribution.json").read_text())
    names = [p["name"] for p in found["parameters"]]
    mean = dict(zip(names, found["seeds"]["0"]["mean"], strict=True))
    m = mujoco.MjModel.from_xml_path(str(out / "model.xml"))
    assert m.actuator("motor").gear[0] == pytest.approx(mean["gear"], rel=1e-4)
    drawn = yaml.safe_load((out / "randomization.yaml").read_text())
    entry = next(p for p in drawn["parameters"] if p["name"] == "gear")
    assert entry["mean"] == pytest.approx(mean["gear"], rel=1e-4)

    policy = load_policies(chain / "easi", env_file=ENV)["policies"]
    obs = np.random.default_rng(0).normal(0, 0.2, (100, 2)).astype(np.float32)
    want = act(
        jax.tree.map(lambda x: x[0], policy), jnp.asarray(obs), deterministic=True
    )
    session = onnxruntime.InferenceSession(out / "policy.onnx")
    got = session.run(["action"], {"observation": obs})[0]
    np.testing.assert_allclose(np.asarray(got), want, atol=1e-5)


def test_export_of_a_policy_alone(chain: Path, tmp_path: Path) -> None:
    command(export, chain / "udr", "--env", ENV, "--to", "onnx", "--out", tmp_path)
    assert {p.name for p in tmp_path.iterdir()} == {"policy.onnx", "policy.json"}
    told = json.loads((tmp_path / "policy.json").read_text())
    assert told["observation"] == ["hinge", "hinge.speed"]
    assert told["method"] == "UDR" and told["ctrl"] == ["motor"] and told["dt"] == 0.02


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["udr", "--to", "mjcf"], "no identified parameters"),
        (["udr", "--to", "onxx"], "did you mean"),
        (["easi", "--seed", "7"], "--seed 7"),
        (["easi", "--method", "Oracle"], "has no policy"),
        (["nothing"], "holds no run"),
    ],
)
@pytest.mark.fault("wrong options and files")
def test_export_says_what_is_wrong(
    chain: Path, words: list[str], said: str, tmp_path: Path, capsys
) -> None:
    out = ("--env", ENV, "--out", tmp_path / "out")
    assert said in refused(capsys, export, chain / words[0], *words[1:], *out)
    assert not (tmp_path / "out").exists()


def measured(run: Path, to: Path, mode: bool = False) -> Path:
    """What the robot of a run's policy measured where its gear is 1.2, not 2; actions
    are drawn, or the policy's ``mode``."""
    known = load_policies(run, env_file=ENV)
    env = known["env"]
    policy = jax.tree.map(lambda x: x[0], known["policies"])

    def chosen(obs: jax.Array, key: jax.Array) -> jax.Array:
        return act(policy, obs, key, mode)

    rollout = jax.jit(
        lambda theta, key: policy_rollout(env, env.model(theta), chosen, key, 600)
    )
    seg = rollout(jnp.array([1.2, 0.1]), jax.random.key(3))
    rng = np.random.default_rng(0)
    columns = {
        "time": env.dt * np.arange(600),
        "qpos.hinge": np.asarray(seg.qpos[:, 0]) + 1e-4 * rng.standard_normal(600),
        "qvel.hinge": np.asarray(seg.qvel[:, 0]) + 1e-3 * rng.standard_normal(600),
        "ctrl.motor": np.asarray(seg.ctrl[:, 0, 0]),
    }
    np.savez(to, **columns)
    return to


@pytest.fixture(scope="module")
def log(chain: Path) -> Path:
    return measured(chain / "udr", chain / "log.npz")


FROM_POLICY = (
    *("--population", 16, "--generations", 2, "--set", "rollout_steps=120"),
    *("real_batch=64", "discriminator_updates=2", "--sampled", "--env", ENV),
)


def test_a_run_folders_policy_identifies_its_robot(chain: Path, log: Path) -> None:
    out = chain / "from_policy"
    given = ("--data", log, "--policy", chain / "udr", "--out", out)
    command(easi, *given, *FROM_POLICY)
    told = json.loads((out / "distribution.json").read_text())
    gear = told["parameters"][0]["name"], told["seeds"]["0"]["mean"][0]
    std = told["seeds"]["0"]["std"][0]
    assert gear[0] == "gear" and abs(gear[1] - 1.2) < max(3 * std, 0.1)
    assert std < 0.2
    model = out.parent / "tiny.xml"
    model.write_text(XML)
    command(export, out, "--model", model, "--env", ENV, "--out", out / "export")
    written = mujoco.MjModel.from_xml_path(str(out / "export" / "model.xml"))
    assert written.actuator_gear[0, 0] == pytest.approx(gear[1], rel=1e-4)
    assert "gear" in (out / "export" / "randomization.yaml").read_text()


def test_an_onnx_is_a_policy_too(
    chain: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its mode, as it is played on a machine: it stands still, and nothing can be told
    of it. One of another robot is refused."""
    command(export, chain / "udr", "--env", ENV, "--to", "onnx", "--out", tmp_path)
    log = measured(chain / "udr", tmp_path / "log.npz", mode=True)
    given = ("--data", log, "--policy", tmp_path / "policy.onnx")
    settings = [x for x in FROM_POLICY if x != "--sampled"]
    command(easi, *given, "--out", tmp_path / "run", *settings)
    told = json.loads((tmp_path / "run" / "distribution.json").read_text())
    assert told["seeds"]["0"]["flags"] == ["not determined"] * 2
    assert "gear leaves no trace" in capsys.readouterr().out
    said = refused(
        capsys, easi, *given, "--robot", "cartpole", "--out", tmp_path / "other"
    )
    assert "policy.onnx" in said


def test_a_policy_that_did_not_send_the_logs_commands_is_told(
    chain: Path, log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    content = dict(np.load(log))
    content["ctrl.motor"] = content["ctrl.motor"] + 7.0
    np.savez(tmp_path / "log.npz", **content)
    given = ("--policy", chain / "udr", "--out", tmp_path / "out", *FROM_POLICY)
    said = refused(capsys, easi, "--data", tmp_path / "log.npz", *given)
    assert "the policy does not fit the log's commands: motor was sent" in said
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--policy-seed", 4), "has no policy of seed 4: it holds seeds [0]"),
        (("--observed", "hing=1"), 'did you mean "hinge"'),
        (("--observed", "hinge"), "write NAME=NUMBER"),
        (("--robot", "go2"), "a run knows its robot"),
    ],
)
def test_what_does_not_go_with_a_policy_is_one_line(
    chain: Path,
    log: Path,
    tmp_path: Path,
    options: tuple[object, ...],
    said: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    out = tmp_path / "out"
    given = ("--data", log, "--policy", chain / "udr", "--out", out, *FROM_POLICY)
    assert said in refused(capsys, easi, *given, *options)
    assert not out.exists()


def test_rows_that_no_controller_made_are_told(
    chain: Path, log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    content = dict(np.load(log))
    content["time"] = 0.7 * content["time"]
    np.savez(tmp_path / "log.npz", **content)
    given = ("--policy", chain / "udr", "--out", tmp_path / "out", *FROM_POLICY)
    said = refused(capsys, easi, "--data", tmp_path / "log.npz", *given)
    assert "a row every 0.014 s, and the controller acts every 0.02 s" in said
