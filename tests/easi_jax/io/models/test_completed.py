"""Names for a vendor's joints and actuators that have none."""

from pathlib import Path

import mujoco
import pytest

import easi_jax
from easi_jax.io.logs.columns import log_columns
from easi_jax.io.models.completed import names_note
from easi_jax.io.models.mjcf import read_mjcf
from easi_jax.io.models.repaired_mjcf import deviations, repaired_model
from easi_jax.model.effect_numbers import EffectEntry

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
