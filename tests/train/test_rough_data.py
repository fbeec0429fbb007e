"""``train.easi --data`` on logs with a wild row and a channel that never moves."""

import json
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

import easi_jax
from train import _command, easi, info

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


def identified(
    folder: Path, parameters: str, population: str, generations: str
) -> dict[str, Any]:
    """What ``train.easi --data`` finds in ``log.csv``."""
    (folder / "model.xml").write_text(MODEL)
    (folder / "parameters.yaml").write_text(parameters)
    args = ["--model", "model.xml", "--parameters", "parameters.yaml"]
    args += ["--data", "log.csv", "--out", "out", "--population", population]
    args += ["--generations", generations, "--set", "segments=32"]
    given = [str(folder / a) if "." in a or a == "out" else a for a in args]
    _command.main(easi.Config, easi.run, name="train.easi", args=given)
    return json.loads((folder / "out" / "distribution.json").read_text())


@pytest.mark.parametrize("wild", [(), (123, 300, 301)], ids=len)
@pytest.mark.fault("wild readings, joints that stand still")
def test_the_same_is_found(
    wild: tuple[int, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    record(tmp_path / "log.csv", wild)
    found = identified(tmp_path, PARAMETERS, "64", "6")
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


@pytest.mark.fault("data that say nothing of what is asked")
def test_data_that_determine_nothing_say_of_what(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """In result, terminal, report, ``train.info`` and Python."""
    record(tmp_path / "log.csv", ())
    lines = PARAMETERS.splitlines()
    found = identified(tmp_path, "\n".join([lines[0], lines[-1]]) + "\n", "8", "2")
    result, why = found["seeds"]["0"], "the data determine none of still_damping"
    assert result["outcome"] == "not determined" and result["reason"] == why
    said = " ".join(capsys.readouterr().out.split())
    assert f"the fit: not determined ({why})" in said
    assert why in (tmp_path / "out" / "report.html").read_text()
    info.run(info.Config(run=tmp_path / "out"))
    assert why in " ".join(capsys.readouterr().out.split())
    model = easi_jax.read_model(tmp_path / "model.xml")
    space = easi_jax.read_parameters(tmp_path / "parameters.yaml", model)
    log = easi_jax.read_log(tmp_path / "log.csv", model)
    small: Any = {"population": 8, "generations": 2}
    answer = easi_jax.estimate_parameters(model, space, log, **small)
    assert (answer.outcome, answer.reason) == ("not determined", why)
    assert why in str(answer)
