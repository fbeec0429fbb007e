"""The twins that stand for the paper's hardware: what they share, what they add."""

import re
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from benchmarks import (
    demonstrated,
    paper,
    paper_experiments,
    paper_twin,
    twin_measures,
    twin_video,
)
from benchmarks.paper_cells import Cell
from benchmarks.rival_cells import AFTER_GAP
from benchmarks.twin import CARTPOLE, GAPS, GO2, Gap, Motor, Twin
from benchmarks.twin_runs import commanded, play
from easi_jax.data.recording import Run
from easi_jax.errors import UserError
from easi_jax.io.logs.reader import read_logs, write_log
from easi_jax.io.models.effects_file import write_effects
from easi_jax.model.found_effects import EffectEntry
from easi_jax.model.joint_space import Configuration
from easi_jax.rl.config import EssInfoGailConfig
from easi_jax.rl.evaluate import evaluate
from easi_jax.rl.networks import PolicyParams, act
from envs import make
from tests.commands import refused
from train._command import main

ENVS = {"cartpole": make("cartpole"), "go2": make("go2")}
HALF_SECOND = 25  # control steps


def reset(env: Any, key: jax.Array) -> Any:
    return jax.jit(lambda k: env.reset(env.model(), k))(key)


@cache
def first(name: str) -> Any:
    """Where the robot's episodes begin here."""
    return reset(ENVS[name], jax.random.key(0)).physics


GENTLE = {"cartpole": 0.15, "go2": 0.15}
STRONG = {"cartpole": 0.2, "go2": 0.6}  # of 40 N m/rad: to the motors' limits


def begin(
    env: Any, size: dict[str, float] = GENTLE
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A start, and commands that change every 0.1 s."""
    physics = first(env.name)
    rng = np.random.default_rng(0)
    center = 0.0 if env.name == "cartpole" else env.mj_model.key_ctrl[0]
    ctrl = center + rng.uniform(-1, 1, (5, env.mj_model.nu)) * size[env.name]
    return np.asarray(physics.qpos), np.asarray(physics.qvel), np.repeat(ctrl, 5, 0)


def moved(env: Any, gap: Gap, size: dict[str, float] = GENTLE) -> np.ndarray:
    """Positions ``(T, nq)`` of a twin."""
    twin, (qpos, qvel, ctrl) = Twin(env, gap), begin(env, size)
    episode, out = twin.start(qpos, qvel), []
    for u in ctrl:
        twin.advance(episode, u)
        out.append(episode.data.qpos.copy())
    return np.array(out)


@pytest.fixture(scope="module", params=ENVS)
def robot(request: pytest.FixtureRequest) -> Any:
    """An environment, its twin without a gap, and MJX from the same start."""
    env = ENVS[request.param]
    qpos, qvel, ctrl = begin(env)
    step = jax.jit(lambda state, u: env.simulator.step(env.model(), state, u))
    state, out = env.simulator.start(jnp.asarray(qpos), jnp.asarray(qvel)), []
    for u in ctrl:
        state = step(state, jnp.asarray(u, jnp.float32))
        out.append(np.asarray(state.qpos))
    return env, moved(env, Gap()), np.array(out)


def test_without_its_gap_a_twin_is_the_environment(robot: Any) -> None:
    """To rounding at the model's own physics step; at 0.5 ms to what that step costs
    MJX over half a second (`benchmarks.accuracy`)."""
    env, fine, mjx = robot
    same = moved(env, Gap(timestep=env.dt / env.simulator.substeps))
    assert len(mjx) * env.dt == 0.5
    np.testing.assert_allclose(same, mjx, atol=1e-5)
    np.testing.assert_allclose(fine, mjx, atol=0.03)
    assert np.abs(fine - mjx).max() > 1e-5  # it is another physics step


PHYSICAL = ("delay", "gain", "static", "kinetic", "viscous", "motor", "change")


@pytest.fixture(scope="module", params=ENVS)
def shaken(request: pytest.FixtureRequest) -> Any:
    """An environment, and its twin without a gap under strong commands."""
    env = ENVS[request.param]
    return env, moved(env, Gap(), STRONG)


@pytest.mark.parametrize("effect", PHYSICAL)
def test_every_effect_changes_the_motion(shaken: Any, effect: str) -> None:
    env, bare = shaken
    gap = GAPS[env.name]
    alone = Gap(**{effect: getattr(gap, effect)}, stribeck=gap.stribeck)
    # Without an effect it is the same to the last bit.
    assert np.abs(moved(env, alone, STRONG) - bare).max() > 5e-5


@pytest.mark.parametrize("delay", [0.01, 0.0125, 0.05])
def test_a_delay_shifts_the_response(delay: float) -> None:
    """The drive holds where it starts, then all is as without delay."""
    env = ENVS["cartpole"]
    late = Twin(env, Gap(delay=delay))
    episode = late.start(np.zeros(2), np.zeros(2))
    prompt = mujoco.MjData(late.model)
    prompt.ctrl[:] = 0.05
    for row in range(1, 5):
        late.advance(episode, np.array([0.05]))
        for _ in range(round((row * env.dt - delay - prompt.time) / 5e-4)):
            mujoco.mj_step(late.model, prompt)
        np.testing.assert_allclose(episode.data.qpos, prompt.qpos, atol=1e-12)
    assert prompt.qpos[0] > 1e-3


def test_friction_falls_from_static_to_kinetic() -> None:
    """What it takes to move a cart that rests, and how a fast one slows down."""
    env = ENVS["cartpole"]
    twin = Twin(env, Gap(static=0.44, kinetic=0.33, stribeck=0.01))
    own = env.mj_model.dof_frictionloss[0]
    for force, moves in ((0.42, False), (0.48, True)):
        episode = twin.start(np.zeros(2), np.zeros(2))
        for _ in range(10):
            # Of 20 N/m, wherever the cart is.
            twin.advance(episode, episode.data.qpos[:1] + force / 20)
        assert (episode.data.qpos[0] > 3e-3) == moves
    fast = twin.start(np.zeros(2), np.array([0.3, 0.0]))
    twin.advance(fast, np.zeros(1))
    np.testing.assert_allclose(twin.model.dof_frictionloss[0], own + 0.33, rtol=1e-6)


def test_a_motor_gives_less_at_speed_and_brakes_at_any() -> None:
    motor = Motor(1.0, 3.0, np.array([10.0, 20.0]), np.array([12.0, 24.0]))
    speeds = ((0.5, 10, 12), (2.0, 5, 12), (4.0, 0, 12), (-4.0, 12, 0))
    for speed, most, least in speeds:
        low, high = motor.limits(np.array([speed, 0.0]))[0]
        assert (low, high) == pytest.approx((-least, most))


@pytest.mark.parametrize("gap", [CARTPOLE, GO2], ids=["cartpole", "go2"])
def test_readings_are_on_the_encoders_grid(gap: Gap) -> None:
    name = "cartpole" if gap is CARTPOLE else "go2"
    twin = Twin(ENVS[name], gap)
    qpos, qvel, _ = begin(ENVS[name])
    episode = twin.start(qpos, qvel)
    drawn = [twin.read(episode, np.random.default_rng(i)) for i in range(200)]
    q, v = (np.array(x) for x in zip(*drawn, strict=True))
    grid = gap.quantum[gap.quantum > 0]
    joints, speeds = q[:, -len(grid) :], v[:, -len(grid) :]
    np.testing.assert_allclose(joints / grid, np.round(joints / grid), atol=1e-6)
    counts = speeds * gap.window / grid
    np.testing.assert_allclose(counts, np.round(counts), atol=1e-6)
    spread = np.sqrt(gap.noise**2 + gap.quantum**2 / 12)[-len(grid) :]
    np.testing.assert_allclose(joints.std(0), spread, rtol=0.6)
    np.testing.assert_allclose(joints.mean(0), qpos[-len(grid) :], atol=0.5 * max(grid))
    np.testing.assert_allclose(
        v.mean(0), qvel, atol=4 * max(gap.noise + gap.quantum) / gap.window
    )
    if name == "go2":  # a reading's quaternion is one, and it is read as it lies
        np.testing.assert_allclose(np.linalg.norm(q[:, 3:7], axis=1), 1, atol=1e-12)
        assert np.all(np.abs(q[:, 3:7] @ qpos[3:7]) > 0.999)


def test_speeds_are_those_between_two_readings() -> None:
    twin = Twin(ENVS["cartpole"], Gap(window=0.02))
    qpos, qvel, ctrl = begin(ENVS["cartpole"])
    episode = twin.start(qpos, qvel)
    rng = np.random.default_rng(0)
    np.testing.assert_allclose(twin.read(episode, rng)[1], qvel, atol=1e-6)
    twin.advance(episode, ctrl[0])
    q, v = twin.read(episode, rng)
    np.testing.assert_allclose(v, (q - qpos) / 0.02, atol=1e-9)
    with pytest.raises(ValueError, match="one control step"):
        Twin(ENVS["cartpole"], Gap(window=0.021))


def linear(env: Any, gains: np.ndarray) -> PolicyParams:
    """The policy ``tanh(gains @ obs)``."""
    kernel = np.concatenate([gains, 0 * gains]).T
    layer = {"kernel": jnp.asarray(kernel), "bias": jnp.zeros(kernel.shape[1])}
    size = env.obs_size
    return PolicyParams(
        jnp.zeros(size), jnp.ones(size), {"params": {"hidden_0": layer}}
    )


POLICIES = {
    "cartpole": linear(ENVS["cartpole"], np.array([[1.0, 0.3, 5.0, 1.0]])),
    "go2": linear(ENVS["go2"], np.zeros((12, 48))),
}


@pytest.mark.parametrize(
    "name", ["cartpole", pytest.param("go2", marks=pytest.mark.slow)]
)
def test_play_is_the_environments_own_episode(name: str) -> None:
    """Rewards, ends and observations, where the twin has no gap."""
    env = make(name)
    env.episode_length = 40
    keys = jax.random.split(jax.random.key(3), 6)
    resets = jax.vmap(jax.random.split, out_axes=1)(keys)[0]
    ours = jax.jit(lambda p, k: evaluate(env, env.model(), p, act, k))(
        POLICIES[name], keys
    )
    got = play(
        Twin(env, Gap(timestep=env.dt / env.simulator.substeps)),
        POLICIES[name],
        *(0, 6, 40),
        start=lambda _: jax.vmap(lambda k: env.reset(env.model(), k))(resets),
    )
    np.testing.assert_allclose(got.returns, ours, rtol=2e-3)
    if name == "cartpole":
        assert got.fallen.any() and not got.fallen.all()


@pytest.fixture(scope="module")
def recorded() -> Any:
    twin = Twin(ENVS["cartpole"], CARTPOLE)
    return twin, play(twin, POLICIES["cartpole"], 5, 4, 40, False)


def test_the_policy_sees_readings(recorded: Any) -> None:
    _, got = recorded
    noise = (got.qpos - got.true_qpos)[..., 1]
    assert 3e-4 < noise.std() < 2e-3
    assert np.all(np.abs(noise) < 5e-3)
    # The pole falls at some 4 /s; speeds over a row come half a row late.
    assert not np.allclose(got.qvel, got.true_qvel, atol=1e-3)


def test_a_recording_becomes_a_log_and_segments(recorded: Any, tmp_path: Path) -> None:
    twin, got = recorded
    path = tmp_path / "log.csv"
    write_log(path, ENVS["cartpole"].mj_model, got.runs(twin))
    log = read_logs(path, ENVS["cartpole"].mj_model)
    assert [len(run) for run in log.runs] == (got.steps + 1).tolist()
    for i, run in enumerate(log.runs):
        n = got.steps[i]
        np.testing.assert_allclose(run.qpos, got.qpos[i, : n + 1], atol=1e-9)
        np.testing.assert_allclose(run.qvel, got.qvel[i, : n + 1], atol=1e-9)
        np.testing.assert_allclose(run.ctrl[:-1], got.ctrl[i, :n], atol=1e-9)
        assert run.qvel_measured
    s = got.segments()
    assert s.ctrl.shape == (4, 40, 1, 1)
    np.testing.assert_allclose(s.next_qpos[:, :-1, 0], s.qpos[:, 1:])
    assert s.weight.sum() == got.steps.sum()


def test_the_same_seed_gives_the_same_starts(recorded: Any) -> None:
    twin, got = recorded
    other = linear(ENVS["cartpole"], np.array([[0.0, 0.0, 1.0, 0.0]]))
    again = play(twin, other, 5, 4, 2)
    np.testing.assert_array_equal(again.true_qpos[:, 0], got.true_qpos[:, 0])
    assert not np.array_equal(play(twin, other, 6, 4, 2).qpos[:, 0], again.qpos[:, 0])


def test_commands_reach_the_observation() -> None:
    env = ENVS["go2"]
    keys = jax.random.split(jax.random.key(0), 2)
    state = jax.jit(commanded(env, [0.4, 1.4]))(keys)
    np.testing.assert_allclose(state.obs[:, -3:], [[0.4, 0, 0], [1.4, 0, 0]], rtol=1e-6)
    walker = paper_twin.walker()
    assert walker.space.size == 7 and "ground_friction" not in walker.space.names
    only = reset(walker, keys[0]).memory.command
    np.testing.assert_allclose(only, [1.4, 0, 0], rtol=1e-6)


def test_a_spectrum_shows_where_each_kind_of_joint_moves() -> None:
    t = 0.02 * np.arange(1000)
    waves = [0.1 * np.sin(2 * np.pi * f * t) for f in (1.0, 2.5, 4.0)]
    frequency, got = twin_measures.spectrum(
        [np.tile(waves, (4, 1)).T, np.zeros((9, 12))]
    )
    assert frequency[got.argmax(1)].tolist() == [1.0, 2.5, 4.0]
    # Power of a sine: half its squared amplitude.
    np.testing.assert_allclose((got**2).sum(1) * 0.25, 0.005, rtol=1e-3)
    assert twin_measures.spectrum([np.zeros((299, 12))])[1] is None


def test_what_was_not_searched_stays_as_under_udr() -> None:
    space = ENVS["go2"].space
    names = paper_twin.walker().space.names
    found = {
        "names": names,
        "unit_mean": np.linspace(0.1, 0.7, 7),
        "unit_cov": 0.01 * np.eye(7),
    }
    mean, cov = paper_twin.whole(space, found)
    at = space.names.index("ground_friction")
    assert mean[at] == 0.5 and cov[at, at] == pytest.approx(1 / 12)
    assert mean[space.names.index(names[6])] == pytest.approx(0.7)
    assert cov[0, 0] == pytest.approx(0.01)


def test_what_the_gap_workflow_named_is_in_search_and_training(tmp_path: Path) -> None:
    env = ENVS["go2"]
    assert paper_twin.with_effects(env, tmp_path) is env
    entries = [
        EffectEntry("actuator_delay", a, "actuator", {"delay": 0.015}, {"delay": 1e-3})
        for a in (env.mj_model.actuator(i).name for i in range(env.mj_model.nu))
    ]
    (tmp_path / "gap").mkdir()
    shown = [dict(e.columns) for e in entries]
    write_effects(tmp_path / "gap" / "effects.yaml", "go2", entries, shown, [])
    late = paper_twin.with_effects(env, tmp_path)
    assert late.space.names == (*env.space.names, "actuator_delay@all.delay")
    searched = paper_twin.with_effects(paper_twin.walker(), tmp_path).space
    n = len(searched.names)
    found = {"names": searched.names, "unit_mean": np.arange(n), "unit_cov": np.eye(n)}
    mean, _ = paper_twin.whole(late.space, found)
    assert mean[-1] == n - 1 and mean[late.space.names.index("ground_friction")] == 0.5


def test_cells_are_of_the_twins_and_named_so() -> None:
    for experiment, robot, given in (
        ("table2", "cartpole", "ant"),
        ("fig7", "go2", ""),
        ("fig7", "go2-imitating", "go2-imitating"),
    ):
        config = paper.Config(experiment, robot=given, seeds=(0, 1))
        cells = paper.cells(config)
        assert [c.method for c in cells[:4]] == list(paper_experiments.ON_HARDWARE)
        assert all("twin" in c.key and c.robot == robot for c in cells)
    with pytest.raises(UserError, match="of table2 and fig7"):
        paper.cells(paper.Config("table1", methods=(AFTER_GAP,)))
    with pytest.raises(UserError, match="no GARAT in a twin"):
        paper_twin.solve(Cell("GARAT", "cartpole", "twin", 0), Path("none"))


def test_walks_in_a_twin_are_drawn_side_by_side(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    env, cells = ENVS["go2"], []

    def transferred(cell: Cell, folder: Path) -> Any:
        cells.append(cell)
        return SimpleNamespace(twin=Twin(env, GO2), policy=POLICIES["go2"])

    monkeypatch.setattr(paper_twin, "transferred", transferred)
    out = tmp_path / "both.svg"
    words = ["--seconds", "0.1", "--out", str(out)]
    main(twin_video.Config, twin_video.run, name="benchmarks.twin_video", args=words)
    assert [c.method for c in cells] == ["UDR", "EASI default"]
    assert {(c.robot, c.target, c.trajectories) for c in cells} == {("go2", "twin", 1)}
    said = capsys.readouterr().out
    assert "no hardware: UDR" in said and str(out) in said
    wide, high = map(int, re.findall(r'viewBox="0 0 (\d+) (\d+)"', out.read_text())[0])
    assert wide / high == pytest.approx(3 * 2 * 480 / (2 * 320))


@pytest.mark.fault("wrong options and files")
@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--robot", "ant"], "go2, go2-imitating"),
        (["--out", "walk.avi"], ".gif or .mp4"),
        (["--seconds", "0"], "above 0"),
        (["--methods", "GARAT"], "UDR, EASI paper"),
    ],
)
def test_videos_that_cannot_be_made(words: list[str], said: str, capsys: Any) -> None:
    assert said in refused(capsys, twin_video, *words)


def test_the_papers_go2_imitates_and_is_paid_for_its_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every training of a cell imitates one log, which is made once."""
    env, made = ENVS["go2"], []

    def command(words: list[str], **more: Any) -> Any:
        assert words[1:3] == ["-m", "train.demonstrate"]
        made.append(words)
        physics, rows = first("go2"), np.arange(300)
        log = Path(words[words.index("--out") + 1]) / "demonstrations.npz"
        log.parent.mkdir()
        qpos = np.tile(np.asarray(physics.qpos), (300, 1))
        qpos[:, 0] += 0.02 * rows
        qpos[:, 7:] += 0.1 * np.sin(0.7 * rows[:, None] + np.arange(12))
        run = Run(
            *("trot", "made", env.dt, env.dt * rows, qpos),
            *(np.zeros((300, 18)), True, qpos[:, 7:]),
            configuration=Configuration.of(env.mj_model),
        )
        write_log(log, env.mj_model, [run])
        return SimpleNamespace(returncode=0)

    monkeypatch.setattr(demonstrated.subprocess, "run", command)
    cell = Cell("EASI default", "go2-imitating", "twin", 0)
    assert cell.env().rewarded == "command"
    for _ in range(2):
        training = cell.training(cell.env(), tmp_path)
        assert isinstance(training, EssInfoGailConfig)
        assert training.demonstrations is not None
    assert len(made) == 1 and made[0].count("trot") == 1
    assert Cell("UDR", "go2", "twin", 0).shown(tmp_path) is None


@pytest.mark.slow
@pytest.mark.timeout(3000)
@pytest.mark.parametrize("robot", ["cartpole", "go2", "go2-imitating"])
def test_cells_at_their_smallest(
    robot: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every method, hardly any training; what is done is not done again."""
    monkeypatch.setattr(twin_measures, "EPISODES", 4)
    monkeypatch.setattr(twin_measures, "TRACKED", (1, 20, 5))
    monkeypatch.setattr(paper_twin, "LOGGED", 120)
    small = ("population=16", "generations=2", "rollout_steps=20")
    cell = Cell("UDR", robot, "twin", 0, 4, 10_240, settings=small)
    for method in paper_experiments.ON_HARDWARE[: 4 if robot == "cartpole" else 3]:
        row = paper_twin.solve(replace(cell, method=method), tmp_path)
        assert "not" in row["stands_for"] and np.isfinite(row["return"])
        if method != "UDR":
            assert len(row["mean"]) == len(row["names"]) and np.all(
                np.isfinite(row["mean"])
            )
            folder = re.sub(r"\W", "_", method)
            assert next(tmp_path.glob(f"{folder}*/training"))
    again = paper_twin.solve(replace(cell, method=method), tmp_path)
    same = [k for k in row if k != "seconds"]
    assert [again[k] for k in same] == [row[k] for k in same]
