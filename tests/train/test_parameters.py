"""``train.parameters``: a first parameter file, read back and used."""

from importlib import resources
from pathlib import Path

import mujoco
import numpy as np
import pytest

from easi_jax.io.models.parameter_file import read_parameter_file
from easi_jax.model.parameter_proposal import propose
from train import parameters
from train._command import main
from train._log_problem import load_model

EXAMPLE = Path(__file__).parents[2] / "examples" / "lift_arm"
BARE = """<mujoco><worldbody><body name="rod">
  <joint name="swing" axis="0 1 0"/>
  <geom type="capsule" fromto="0 0 0 0 0 -.4" size=".001" mass=".5"/>
</body></worldbody></mujoco>"""


def call(*args: object) -> None:
    main(
        parameters.Config,
        parameters.run,
        name="train.parameters",
        args=[str(a) for a in args],
    )


@pytest.mark.parametrize(
    ("robot", "some"),
    [
        ("cartpole", {"cart_kp": 20.0, "pole_mass": 0.1, "cart_force_limit": 5.0}),
        ("ant", {"hip_damping": 0.3, "ankle_frictionloss": 0.1, "leg_mass": 0.1}),
        ("ballbalance", {"knee_kp": 100.0, "ball_mass": 3.0}),
        ("go2", {"hip_kp": 40.0, "calf_kv": 1.0, "base_mass": 6.923}),
    ],
)
def test_built_in_robots(robot: str, some: dict[str, float], tmp_path: Path) -> None:
    asset = resources.files("envs") / "assets" / f"{robot}.xml"
    path = tmp_path / "robot.xml"
    path.write_text(asset.read_text())
    out = tmp_path / "new" / "p.yaml"
    call("--model", path, "--out", out)
    space = read_parameter_file(out, load_model(path))
    values = dict(zip(space.names, space.nominal, strict=True))
    for name, value in some.items():
        assert values[name] == pytest.approx(value), (name, values)


def test_what_the_model_lacks_gets_a_range_from_the_machine() -> None:
    m = mujoco.MjModel.from_xml_string(BARE)
    found = {p.parameter.name: p for p in propose(m)}
    friction = found["swing_frictionloss"]
    assert friction.note == "the model has none"
    low, high = friction.parameter.initial
    weight = 0.5 * 9.81 * 0.2  # N m, of the rod at its middle
    assert 0 < low < 0.01 * weight < high < weight
    low, high = found["swing_armature"].parameter.initial
    assert 0 < low < 0.1 * 0.5 * 0.4**2 / 3 < high


def test_logs_say_what_they_determine(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "p.yaml"
    args = ("--model", EXAMPLE / "model.xml", "--data", EXAMPLE / "sweep.csv")
    call(*args, "--out", out)
    told = capsys.readouterr().out
    assert "these logs" in told and "known to" in told
    # All masses and forces at once: no log of motions alone can show it.
    assert "one common factor change nothing" in told
    assert "known to" in out.read_text()


def test_a_file_is_not_replaced_unasked(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "p.yaml"
    out.write_text("mine")
    with pytest.raises(SystemExit) as stop:
        call("--model", EXAMPLE / "model.xml", "--out", out)
    assert stop.value.code == 2 and "--overwrite" in capsys.readouterr().err
    assert out.read_text() == "mine"


REFUSED = {
    "dcmotor": (
        '<dcmotor joint="swing" motorconst="0.1" resistance="1"/>',
        "mjBIAS_DCMOTOR: 3>] not supported: use --engine mujoco or --engine auto",
    ),
    "delay": (
        '<position joint="swing" kp="3" delay="0.01" nsample="6"/>',
        "delay, nsample",
    ),
    "pid": ('<pid joint="swing" kp="2"/>', "several commands"),
    "no xml": ("<motor joint='swing' <", "MuJoCo cannot read this model"),
    "no such joint": ('<motor joint="swin"/>', "MuJoCo cannot read this model"),
    "no mesh": (
        '</actuator><asset><mesh name="m" file="gone.stl"/></asset><actuator>',
        "gone.stl",
    ),
}


@pytest.mark.parametrize("kind", REFUSED)
def test_a_model_that_no_command_can_use(
    kind: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """One line with what to do, and no file."""
    drive, message = REFUSED[kind]
    path, out = tmp_path / "robot.xml", tmp_path / "p.yaml"
    tail = f"<actuator>{drive}</actuator></mujoco>"
    path.write_text(BARE.replace("</mujoco>", tail))
    with pytest.raises(SystemExit) as stop:
        call("--model", path, "--out", out, "--engine", "mjx")
    told = capsys.readouterr().err
    assert stop.value.code == 2 and message in told
    assert told.count("\n") == 1 and "Traceback" not in told
    assert not out.exists()


def test_native_mujoco_takes_what_mjx_lacks(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    drive, _ = REFUSED["dcmotor"]
    path, out = tmp_path / "robot.xml", tmp_path / "p.yaml"
    tail = f"<actuator>{drive}</actuator></mujoco>"
    path.write_text(BARE.replace("</mujoco>", tail))
    call("--model", path, "--out", out)
    assert "engine: mujoco" in capsys.readouterr().out
    assert "damping" in out.read_text()


def test_what_is_tied_is_shown_and_can_be_parted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "robot.xml"
    asset = resources.files("envs") / "assets" / "go2.xml"
    path.write_text(asset.read_text())
    call("--model", path, "--out", tmp_path / "p.yaml")
    assert "*_calf" in capsys.readouterr().out
    text = (tmp_path / "p.yaml").read_text()
    assert "# one value for FL_calf, FR_calf" in text and "--no-tie" in text
    call("--model", path, "--out", tmp_path / "q.yaml", "--no-tie")
    text = (tmp_path / "q.yaml").read_text()
    assert "*" not in text and "body.FR_calf.mass" in text


def test_joints_without_a_name(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, out = tmp_path / "rod.xml", tmp_path / "p.yaml"
    path.write_text(BARE.replace('name="swing" ', ""))
    call("--model", path, "--out", out)
    told = capsys.readouterr().out
    assert told.count("without a name") == 1
    assert "1 joint without a name, called rod_joint: logs and addresses" in told
    assert "joint.rod_joint.frictionloss" in out.read_text()


def test_warnings_of_mujoco_are_notes_and_no_file(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "play.xml"
    joints = '<joint name="swing" axis="0 1 0"/><joint name="play" axis="0 1 0"/>'
    path.write_text(BARE.replace('<joint name="swing" axis="0 1 0"/>', joints))
    monkeypatch.chdir(tmp_path)
    call("--model", path, "--out", tmp_path / "p.yaml")
    told = capfd.readouterr()
    assert told.out.count("MuJoCo warned") == 1 and "close to singular" in told.out
    assert "WARNING" not in told.err
    assert sorted(p.name for p in tmp_path.iterdir()) == ["p.yaml", "play.xml"]


ROD = """<mujoco><option timestep="0.005" integrator="implicitfast"/><worldbody>
  <body name="rod"><joint name="swing" axis="0 1 0" damping="0.06"/>
  <geom type="capsule" fromto="0 0 0 0 0 -.3" size=".02" mass=".5"/></body></worldbody>
  <actuator><motor name="drive" joint="swing" gear="2"/></actuator>
  <sensor><jointactuatorfrc name="torque" joint="swing"/></sensor></mujoco>"""


def test_a_measured_torque_spares_the_scales(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """On native MuJoCo; without the column one mass has to be weighed."""
    model, rng = tmp_path / "rod.xml", np.random.default_rng(0)
    model.write_text(ROD)
    m = mujoco.MjModel.from_xml_path(str(model))
    d, rows = mujoco.MjData(m), []
    for k in range(300):
        d.ctrl[:] = np.sin(0.07 * k) + np.sin(0.19 * k)
        mujoco.mj_forward(m, d)
        q = d.qpos + 1e-4 * rng.normal(size=1)
        torque = d.sensordata + 0.01 * rng.normal(size=1)
        rows.append([0.01 * k, *q, *d.ctrl, *torque])
        mujoco.mj_step(m, d, 2)
    header = ["time", "qpos.swing", "ctrl.drive", "sensor.torque"]
    for name, columns in (("with", 4), ("without", 3)):
        lines = [",".join(f"{x:.9g}" for x in row[:columns]) for row in rows]
        text = "\n".join([",".join(header[:columns]), *lines]) + "\n"
        (tmp_path / f"{name}.csv").write_text(text)
        log, out = tmp_path / f"{name}.csv", tmp_path / f"{name}.yaml"
        given = "--model", model, "--data", log, "--out", out
        call(*given, "--engine", "mujoco")
        said = capsys.readouterr()
        assert ("weigh it" in said.out + said.err) == (name == "without")
        assert ("fitted as well: torque" in said.out + said.err) == (name == "with")
