"""Names for a vendor's joints and actuators that have none."""

from pathlib import Path

import mujoco
import numpy as np
import pytest

import easi_jax
from easi_jax.data.scales import scales_of
from easi_jax.errors import UserError
from easi_jax.gap.candidates import places
from easi_jax.io.logs.columns import log_columns
from easi_jax.io.logs.reader import first_pose, read_logs
from easi_jax.io.models.completed import held_joint, names_note, new_names
from easi_jax.io.models.mjcf import read_mjcf
from easi_jax.io.models.repaired_mjcf import deviations, repaired_model
from easi_jax.model.effect_numbers import EffectEntry
from tests.easi_jax.gap.test_lengths import recorded_of
from train._gap_config import Config as GapConfig
from train._gap_problem import read_model
from train._log_problem import held_of
from train.parameters import Config, run

VENDOR = """<mujoco model="vendor"><compiler autolimits="true"/>
<default><default class="leg"><joint axis="0 1 0" damping=".1"/>
  <position kp="20" ctrlrange="-1 1"/></default></default>
<worldbody><body name="base" pos="0 0 1"><freejoint/><geom size=".1"/>
  <body name="leg" childclass="leg"><joint/><joint axis="1 0 0"/>
    <geom size=".05" pos="0 0 -.2"/>
    <body pos="0 0 -.4"><joint name="leg_joint_2"/><geom size=".05"/></body>
    <body pos="0 0 .4"><joint/><geom size=".05"/><site name="tip"/></body>
  </body></body></worldbody>
<tendon><fixed><joint joint="leg_joint_2" coef="1"/></fixed></tendon>
<actuator><position class="leg" joint="leg_joint_2"/><motor joint="leg_joint_2"/>
  <motor site="tip"/><motor tendon="{tendon}"/></actuator>
<keyframe><key qpos="0 0 1 1 0 0 0 .1 .2 .3 .4"/></keyframe></mujoco>"""
OPTION = '<option timestep=".01"/><default>'
JOINTS = ["base", "leg_joint", "leg_joint_3", "leg_joint_2", "body4_joint"]
ACTUATORS = [
    *("leg_joint_2_actuator", "leg_joint_2_actuator_2", "tip_actuator"),
    "cord_actuator",
]


@pytest.fixture
def vendor(tmp_path: Path) -> Path:
    path = tmp_path / "vendor.xml"
    text = VENDOR.replace("<fixed>", '<fixed name="cord">')
    path.write_text(text.format(tendon="cord"))
    return path


def joints(m: mujoco.MjModel) -> list[str]:
    return [m.joint(j).name for j in range(m.njnt)]


def actuators(m: mujoco.MjModel) -> list[str]:
    return [m.actuator(a).name for a in range(m.nu)]


def test_what_has_no_name_gets_one_and_is_told_in_one_line(vendor: Path) -> None:
    told: list[str] = []
    m = read_mjcf(vendor, tell=told.append)
    assert joints(m) == JOINTS
    assert actuators(m) == ACTUATORS
    (line,) = told
    assert line.startswith(f"{vendor}: 4 joints without a name, called base, leg_joint")
    assert "4 actuators without a name, called leg_joint_2_actuator, " in line
    assert line.endswith("logs and addresses use these names")
    assert deviations(m, mujoco.MjModel.from_xml_path(str(vendor))) == []
    assert "qpos.body4_joint" in log_columns(m).qpos
    assert names_note(m) == ""


def test_bodies_alone_get_names_too(tmp_path: Path) -> None:
    """Two bodies without one: an effect at either is an effect at a place."""
    path = tmp_path / "arm.xml"
    link = (
        '<body pos="0 0 -.3"><joint name="{j}" axis="0 1 0"/><geom size=".05"/>{more}'
    )
    inner = link.format(j="b", more="</body>")
    path.write_text(
        f"<mujoco><worldbody>{link.format(j='a', more=inner)}</body></worldbody>"
        '<actuator><motor name="m" joint="a"/></actuator></mujoco>'
    )
    told: list[str] = []
    m = read_mjcf(path, tell=told.append)
    assert [m.body(b).name for b in range(3)] == ["world", "body1", "body2"]
    assert not told, "their names say what they are"
    loads = [
        p for p in places(m, scales_of(m, [recorded_of(m, 0)])) if p.kind == "body"
    ]
    assert {p.at for p in loads if p.effect == "payload_mass"} >= {"body1", "body2"}


def test_python_users_are_warned(vendor: Path) -> None:
    with pytest.warns(UserWarning, match="4 joints without a name") as caught:
        m = easi_jax.read_model(vendor)
    assert joints(m) == JOINTS
    assert caught[0].filename == __file__


def test_many_are_told_in_short(tmp_path: Path) -> None:
    body = '<body><joint/><geom size=".1"/></body>'
    path = tmp_path / "many.xml"
    path.write_text(f"<mujoco><worldbody>{body * 9}</worldbody></mujoco>")
    told: list[str] = []
    read_mjcf(path, tell=told.append)
    assert "body6_joint and 3 more: logs" in told[0]


def test_a_written_model_has_the_names(vendor: Path) -> None:
    friction = EffectEntry(
        "coulomb_friction", "leg_joint_3", "joint", {"coulomb": 0.2}, {}
    )
    written = repaired_model(vendor, [friction])
    assert written.left == []
    m = mujoco.MjModel.from_xml_string(written.xml)
    assert joints(m) == JOINTS
    assert actuators(m) == ACTUATORS
    assert m.joint("leg_joint_3").frictionloss == 0.2


HUNG = (
    VENDOR.replace("<fixed>", '<fixed name="cord">')
    .format(tendon="cord")
    .replace(
        '<body name="base" pos="0 0 1">',
        '<frame pos="1 0 0" euler="0 0 90"><body name="base" euler="0 20 0">',
    )
    .replace("</body></worldbody>", "</body></frame></worldbody>")
)


def test_a_held_base_stays_where_it_is_said(vendor: Path) -> None:
    vendor.write_text(HUNG)
    pose = np.array([0.3, 0.2, 0.9, 0.8, 0.6, 0.0, 0.0])
    m = read_mjcf(vendor, tell=[].append, held=lambda _: pose)
    assert joints(m) == JOINTS[1:]
    np.testing.assert_allclose(m.key_qpos, [[0.1, 0.2, 0.3, 0.4]])
    b = m.body("base").id
    np.testing.assert_allclose(m.body_pos[b], pose[:3], atol=1e-12)
    np.testing.assert_allclose(m.body_quat[b], pose[3:], atol=1e-12)
    assert held_joint(m) == "base"
    # What is written has it too, and needs no holding when it is read.
    again = mujoco.MjModel.from_xml_string(repaired_model(vendor, [], m).xml)
    assert deviations(again, m) == []
    assert held_joint(again) == "base"


def test_what_cannot_be_held(vendor: Path, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no free joint that carries other joints"):
        still = '<body><joint name="j"/><geom size=".1"/></body>'
        vendor.write_text(f"<mujoco><worldbody>{still}</worldbody></mujoco>")
        easi_jax.read_model(vendor, held_base=True)


def log(path: Path, base: np.ndarray | None) -> Path:
    """Joints that move, and the base's pose where it is given."""
    time = 0.01 * np.arange(50)
    columns = {"time": time}
    if base is not None:
        columns |= {f"qpos.base.{i}": base[:, i] for i in range(7)}
    columns |= {f"qpos.{n}": 0.3 * np.sin(9 * time) for n in JOINTS[1:]}
    columns |= {f"ctrl.{n}": 0 * time for n in ACTUATORS}
    rows = np.stack([*columns.values()], 1)
    np.savetxt(path, rows, delimiter=",", header=",".join(columns), comments="")
    return path


def test_logs_of_a_held_base(vendor: Path, tmp_path: Path) -> None:
    vendor.write_text(vendor.read_text().replace("<default>", OPTION, 1))
    free = read_mjcf(vendor, tell=[].append)
    hung = np.tile([0.3, 0.2, 0.9, 0.8, 0.6, 0.0, 0.0], (50, 1))
    joints_only = log(tmp_path / "joints.csv", None)
    fixed = log(tmp_path / "fixed.csv", hung)
    noisy = log(tmp_path / "noisy.csv", hung + 1e-4 * np.eye(7)[np.arange(50) % 3])
    down = np.outer(np.arange(50) / 100, np.eye(7)[2])
    fell = log(tmp_path / "fell.csv", hung - down)
    for path in (joints_only, fixed):
        with pytest.raises(UserError, match=r"not move in this log.*give --held-base"):
            read_logs(path, free)
    said = [n for n in read_logs(noisy, free).notes if "give --held-base" in n]
    assert len(said) == 1
    assert not any("--held" in n for n in read_logs(fell, free).notes)
    pose = first_pose([joints_only, fixed], free)
    assert pose is not None
    np.testing.assert_allclose(pose, hung[0])
    held = read_mjcf(vendor, tell=[].append, held=lambda _: pose)
    for path in (joints_only, fixed, noisy):
        assert read_logs(path, held).runs[0].qpos.shape == (50, 4)
    with pytest.raises(UserError, match=r"up to 0.49 m and .* leave that out"):
        read_logs(fell, held)


def test_held_base_in_a_command(
    vendor: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, path = tmp_path / "p.yaml", log(tmp_path / "joints.csv", None)
    config = Config(model=vendor, out=out, held_base=True)
    run(config)
    assert "base_mass" not in out.read_text()
    problem = GapConfig(model=str(vendor), data=(path,), held_base=True)
    given = read_model(problem.model, (), held_of(problem))
    assert joints(given.mj_model) == JOINTS[1:]
    assert given.mj_model.body("base").pos[2] == 1  # of the key frame
    capsys.readouterr()


def test_an_actuator_of_several_commands_gets_one_name() -> None:
    m = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><body name='arm'><joint name='hinge'/><geom size='.1'/>"
        "</body></worldbody><actuator><pid joint='hinge' kp='5' ki='1' kv='.1'/>"
        "</actuator></mujoco>"
    )
    assert m.nu > 1 == len(m.actuator_trntype)
    assert new_names(m) == {"body": {}, "joint": {}, "actuator": {0: "hinge_actuator"}}


def test_bodies_without_a_name_get_one(tmp_path: Path) -> None:
    path, told = tmp_path / "m.xml", []
    path.write_text(
        "<mujoco><worldbody><body><freejoint/><geom size='.1'/></body>"
        "<body name='body1'><joint/><geom size='.1'/><body><joint name='tip'/>"
        "<geom size='.1'/></body></body></worldbody></mujoco>"
    )
    m = read_mjcf(path, tell=told.append)
    assert [m.body(b).name for b in range(4)] == ["world", "body1_2", "body1", "body3"]
    assert joints(m) == ["body1_2", "body1_joint", "tip"]
    (note,) = told
    assert "2 joints without a name, called body1_2, body1_joint: logs" in note
