"""``train.easi --data`` on logs with a wild row and a channel that never moves."""

import json
from pathlib import Path

import mujoco
import numpy as np
import pytest

from train import _command, easi

MODEL = """<mujoco model="two">
  <option timestep="0.01" integrator="implicitfast"/>
  <default><geom contype="0" conaffinity="0"/></default>
  <worldbody>
    <body name="rod"><joint name="hinge" axis="0 1 0" damping="0.05"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.4" size="0.02" mass="0.5"/></body>
    <body name="pan" pos="1 0 0"><joint name="still" axis="0 0 1" damping="0.05"/>
      <geom size="0.05" mass="0.2"/></body>
  </worldbody>
  <actuator><motor name="drive" joint="hinge"/><motor name="idle" joint="still"/>
  </actuator>
</mujoco>"""
PARAMETERS = """parameters:
  - {name: damping, address: joint.hinge.damping, initial: [0.01, 0.3]}
  - {name: gain, address: actuator.drive.gain, initial: [0.5, 2.0]}
  - {name: still_damping, address: joint.still.damping, initial: [0.01, 0.3]}
"""
TRUTH = {"damping": 0.12, "gain": 1.3}


def record(path: Path, wild: tuple[int, ...]) -> None:
    """600 rows of the true machine; in rows ``wild`` both readings are absurd."""
    model = mujoco.MjModel.from_xml_string(MODEL)
    model.dof_damping[0] = TRUTH["damping"]
    model.actuator_gainprm[0, 0] = TRUTH["gain"]
    data = mujoco.MjData(model)
    rng = np.random.default_rng(0)
    lines = ["time,qpos.hinge,qvel.hinge,qpos.still,qvel.still,ctrl.drive,ctrl.idle"]
    for row in range(600):
        at = 0.01 * row
        command = 0.9 * np.sin(3.1 * at) + 0.5 * np.sin(7.7 * at + 1.0)
        seen = [data.qpos[0], data.qvel[0]] + rng.normal(size=2) * (1e-4, 1e-3)
        if row in wild:
            seen = [-3e3, 1e6]
        cells = (at, *seen, 0.0, 0.0, command, 0.0)
        lines.append(",".join(f"{x:.8g}" for x in cells))
        data.ctrl[0] = command
        mujoco.mj_step(model, data)
    path.write_text("\n".join(lines) + "\n")


@pytest.mark.parametrize("wild", [(), (123, 300, 301)], ids=len)
@pytest.mark.fault("wild readings, joints that stand still")
def test_the_same_is_found(
    wild: tuple[int, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "model.xml").write_text(MODEL)
    (tmp_path / "parameters.yaml").write_text(PARAMETERS)
    record(tmp_path / "log.csv", wild)
    args = ["--model", "model.xml", "--parameters", "parameters.yaml"]
    args += ["--data", "log.csv", "--out", "out", "--population", "64"]
    args += ["--generations", "6", "--set", "segments=32"]
    given = [str(tmp_path / a) if "." in a or a == "out" else a for a in args]
    _command.main(easi.Config, easi.run, name="train.easi", args=given)
    found = json.loads((tmp_path / "out" / "distribution.json").read_text())
    result = found["seeds"]["0"]
    flags = dict(
        zip([p["name"] for p in found["parameters"]], result["flags"], strict=True)
    )
    assert flags["damping"] == flags["gain"] == "determined"
    assert flags["still_damping"] != "determined"
    for parameter, mean in zip(found["parameters"], result["mean"], strict=True):
        if parameter["name"] in TRUTH:
            wanted = TRUTH[parameter["name"]]
            assert mean == pytest.approx(wanted, rel=0.05), parameter["name"]
    assert ("readings leap" in capsys.readouterr().out) == bool(wild)
