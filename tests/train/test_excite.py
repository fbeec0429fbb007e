"""train.excite: its files, what they promise, and its messages."""

import json
from pathlib import Path

import mujoco
import numpy as np
import pytest

from easi_jax.io.logs.reader import read_logs
from train import excite
from train._command import main

ROOT = Path(__file__).parents[2]
XML = """
<mujoco model="rod">
  <compiler angle="radian"/>
  <option timestep="0.005" integrator="implicitfast"/>
  <worldbody>
    <body name="rod">
      <joint name="hinge" axis="0 -1 0" damping="0.05" range="-1.5 1.5"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.5" size="0.02" mass="0.6"/>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="hinge" ctrlrange="-2 2"/></actuator>
</mujoco>
"""
FOUND = """
effects:
- {effect: coulomb_friction, at: hinge, kind: joint, columns: {coulomb: 0.15}}
- {effect: constant_force, at: hinge, kind: joint, columns: {constant: 0.02}}
refitted:
- {address: joint.hinge.damping, value: 0.08}
"""
FEW = (
    *("--horizon", "0.1"),
    *("--only", "armature", "coulomb_friction", "actuator_delay"),
)


def run(*args: object) -> None:
    main(excite.Config, excite.run, name="train.excite", args=[str(a) for a in args])


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("robot") / "rod.xml"
    path.write_text(XML)
    entry = "effects: [{{effect: {}, at: {}, kind: joint, columns: {{{}}}}}]\n"
    other = entry.format("coulomb_friction", "knee", "coulomb: 0.1")
    (path.parent / "other.yaml").write_text(other)
    (path.parent / "found.yaml").write_text(FOUND)
    return path


@pytest.fixture(scope="module")
def results(robot: Path) -> Path:
    out = robot.parent / "excite"
    run("--model", robot, "--out", out, "--duration", 8, *FEW)
    return out


def test_the_commands_are_a_log_that_mujoco_repeats(robot: Path, results: Path) -> None:
    m = mujoco.MjModel.from_xml_path(str(robot))
    log = read_logs([results / "commands.csv"], m)
    (told,) = log.runs
    assert told.dt == pytest.approx(0.01) and len(told) == 801
    np.testing.assert_allclose(told.ctrl[:95], 0.0, atol=1e-9)
    d = mujoco.MjData(m)
    seen = []
    for u in told.ctrl:
        seen.append(d.qpos.copy())
        d.ctrl[:] = u
        mujoco.mj_step(m, d, 2)
    np.testing.assert_allclose(np.array(seen), told.qpos, atol=1e-5)
    assert 0.3 < np.abs(told.qpos).max() <= 1.35 + 1e-6
    assert np.abs(told.ctrl).max() <= 2.0


def test_commands_are_tried_with_effects_that_were_found(
    robot: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    found = ("--effects", robot.parent / "found.yaml")
    given = ("--model", robot, *found, "--duration", 8, "--horizon", "0.1")
    run(*given, "--only", "armature", "--out", tmp_path / "out")
    m = mujoco.MjModel.from_xml_path(str(robot))
    (told,) = read_logs([tmp_path / "out" / "commands.csv"], m).runs
    m.dof_frictionloss[0], m.dof_damping[0] = 0.15, 0.08
    d, seen = mujoco.MjData(m), []
    for u in told.ctrl:
        seen.append(d.qpos.copy())
        d.ctrl[:] = u
        mujoco.mj_step(m, d, 2)
    np.testing.assert_allclose(np.array(seen), told.qpos, atol=1e-5)
    said = "not in the model that commands are tried with: constant_force@hinge"
    assert said in " ".join(capsys.readouterr().out.split())


def test_what_is_told_of_them(results: Path) -> None:
    told = json.loads((results / "excite.json").read_text())
    assert told["schema"] == 1 and told["play"] == "open-loop"
    joint = told["limits"]["joints"]["hinge"]
    assert joint["allowed"] == pytest.approx([-1.35, 1.35])
    low, high = joint["reached"]
    assert -1.35 <= low < joint["model_reaches"][0] + 1e-9
    assert joint["model_reaches"][1] - 1e-9 < high <= 1.35
    assert set(told["effects"]) == {
        "armature@hinge",
        "coulomb_friction@hinge",
        "actuator_delay@motor",
    }
    scores = [t["score"] for t in told["tried"]]
    assert told["score"] == scores[0] == max(scores) and min(scores) < 0.7 * scores[0]
    inertia = told["effects"]["armature@hinge"]
    (number,) = inertia["numbers"]
    assert number["unit"] == "kg m^2" and 0 < number["std_per_size"] < 1
    assert inertia["apart"] <= inertia["visible"] * (1 + 1e-9)
    assert told["worst_pairs"][0]["apart"] == min(
        p["apart"] for p in told["worst_pairs"]
    )


def test_the_same_command_writes_the_same(
    robot: Path, results: Path, tmp_path: Path
) -> None:
    out = tmp_path / "same.csv"
    run("--model", robot, "--out", out, "--duration", 8, *FEW)
    assert out.read_text() == (results / "commands.csv").read_text()
    told = json.loads((tmp_path / "same.json").read_text())
    assert told == json.loads((results / "excite.json").read_text())


def test_pairs_of_a_gap_and_less_motion(
    robot: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    listed = {
        "effect": "armature",
        "at": "hinge",
        "indistinguishable": ["actuator_gain@motor"],
    }
    gap = tmp_path / "gap"
    gap.mkdir()
    (gap / "gap.json").write_text(json.dumps({"effects": [listed]}))
    (gap / "effects.yaml").write_text(
        "effects:\n- {effect: armature, at: hinge, kind: joint, "
        "columns: {armature: 0.02}}\n"
    )
    run(
        *("--model", robot, "--gap", gap, "--out", tmp_path / "a.csv"),
        *("--duration", 8, "--amplitude", "motor=0.5", "--max-speed", 2.0),
    )
    told = json.loads((tmp_path / "a.json").read_text())
    pairs = {(p["effect"], p["as"]) for p in told["told_apart"]}
    assert pairs == {
        ("armature@hinge", "actuator_gain@motor"),
        ("actuator_gain@motor", "armature@hinge"),
    }
    assert all(p["apart"] > 1 and not p["no_test_can"] for p in told["told_apart"])
    assert told["signal"]["amplitude"]["motor"] <= 0.5
    assert told["limits"]["joints"]["hinge"]["speed_reached"] <= 2.0
    assert "to be told apart" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"--model": "no.xml"}, "no such model"),
        ({"--model": None}, "--model"),
        ({"--duration": "1"}, "--duration is 1"),
        ({"--rate": "1"}, "--rate is 1"),
        ({"--margin": "0.5"}, "--margin is 0.5"),
        ({"--noise": "hinge=-1"}, "--noise"),
        ({"--max-speed": "hing=1"}, 'did you mean "hinge"'),
        ({"--amplitude": "much"}, "--amplitude"),
        ({"--only": "armatur"}, 'did you mean "armature"'),
        ({"--only": "viscous_damping"}, "already cover it"),
        ({"--effects": "no.yaml"}, "no.yaml"),
        ({"--effects": "{robot}/other.yaml"}, 'knee" names no joint'),
        ({"--gap": "nowhere"}, "nowhere"),
        ({"--data": "no.csv"}, "no.csv"),
        ({"--out": "{tmp}/a.txt"}, "NAME.csv"),
        ({"--out": "{old}"}, "--overwrite"),
        ({"--max-speed": "1e-7"}, "no test stays inside the limits"),
    ],
)
def test_mistakes_end_with_one_line(
    change: dict[str, str | None],
    text: str,
    robot: Path,
    results: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    options: dict[str, str | None] = {
        "--model": str(robot),
        "--out": "{tmp}/out",
        "--duration": "5",
        **change,
    }
    args = [
        part.format(tmp=tmp_path, old=results, robot=robot.parent)
        for name, value in options.items()
        if value is not None
        for part in (name, value)
    ]
    before = sorted(p.name for p in results.iterdir())
    with pytest.raises(SystemExit) as stop:
        run(*args)
    assert stop.value.code == 2
    error = capsys.readouterr().err
    assert text in error and error.count("\n") == 1 and "Traceback" not in error
    assert not list(tmp_path.iterdir())
    assert sorted(p.name for p in results.iterdir()) == before


@pytest.mark.slow
@pytest.mark.parametrize("name", ["cartpole", "examples/my_robot/model.xml"])
def test_other_robots(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model = name if name == "cartpole" else ROOT / name
    run("--model", model, "--out", tmp_path / "out", "--duration", 10)
    told = json.loads((tmp_path / "out" / "excite.json").read_text())
    head = (tmp_path / "out" / "commands.csv").read_text().split("\n", 1)[0]
    if name == "cartpole":
        assert told["signal"]["rate"] == pytest.approx(50)
        assert head == "time,ctrl.cart,qpos.cart,qpos.pole"
        twins = [{t["effect"], t["as"]} for t in told["twins"]]
        assert {"armature@cart", "payload_mass@cart"} in twins
    else:
        # Two links that stand upright: constant torques do not hold them.
        assert told["play"] == "feed-forward" and told["controller"]["kp"]
        assert head.startswith("time,feedforward.shoulder,feedforward.elbow,")
        assert "add the columns feedforward" in capsys.readouterr().out
