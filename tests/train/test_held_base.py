"""Logs of a robot in a stand, by every command that has ``--held-base``."""

from pathlib import Path

import mujoco
import numpy as np
import pytest

from easi_jax.gap import effect_search
from easi_jax.gap.candidates import places
from easi_jax.io.logs.reader import read_logs
from tests.commands import command, read, refused
from tests.recordings import pace, torch_zip
from train import easi, evaluate, excite, export, gap, import_logs

LIMBS = """<body name="thigh" pos="0 0 -.1">
    <joint name="hip" axis="0 1 0" damping=".05" range="-2 2"/>
    <geom type="capsule" fromto="0 0 0 0 0 -.2" size=".02" mass=".4"/>
    <body name="calf" pos="0 0 -.2">
      <joint name="knee" axis="0 1 0" damping=".02" range="-2 2"/>
      <geom type="capsule" fromto="0 0 0 0 0 -.2" size=".02" mass=".2"/>
  </body></body>"""
XML = """<mujoco model="leg"><compiler angle="radian"/>
<option timestep=".005" integrator="implicitfast"/>
<default><geom contype="0" conaffinity="0"/></default>
<worldbody><body name="trunk" pos="0 0 1">{joint}<geom size=".1" mass="3"/>
  {limbs}</body></worldbody>
<actuator><motor name="hip_drive" joint="hip"/>
  <motor name="knee_drive" joint="knee"/></actuator></mujoco>"""
PARAMETERS = """parameters:
  - {name: hip_damping, address: joint.hip.damping, initial: [0.02, 0.2],
      bounds: [0.001, 2.0], scale: log}
"""
DT, FRICTION = 0.01, 0.15  # s, N m at the hip, which the model lacks


def hung() -> mujoco.MjModel:
    """The robot in its stand."""
    return mujoco.MjModel.from_xml_string(XML.format(joint="", limbs=LIMBS))


@pytest.fixture
def stand(tmp_path: Path) -> tuple[Path, Path, Path]:
    """A model with a free base, a log of its joints alone, and the base's pose too."""
    model = tmp_path / "leg.xml"
    model.write_text(XML.format(joint="<freejoint/>", limbs=LIMBS))
    m = hung()
    m.dof_frictionloss[0] = FRICTION
    d, rng = mujoco.MjData(m), np.random.default_rng(0)
    rows = []
    for k in range(400):
        t = DT * k
        d.ctrl = [0.9 * np.sin(4 * t + t * t), 0.3 * np.sin(7 * t)]
        angles = d.qpos + 3e-4 * rng.normal(size=2)
        rows.append([t, *angles, *d.ctrl, 0, 0, 1, 1, 0, 0, 0])
        mujoco.mj_step(m, d, 2)
    names = ["time", "qpos.hip", "qpos.knee", "ctrl.hip_drive", "ctrl.knee_drive"]
    names += [f"qpos.trunk.{i}" for i in range(7)]
    paths = []
    for name, width in (("joints.csv", 5), ("all.csv", 12)):
        paths.append(tmp_path / name)
        np.savetxt(
            paths[-1],
            np.array(rows)[:, :width],
            delimiter=",",
            header=",".join(names[:width]),
            comments="",
        )
    return model, paths[0], paths[1]


def test_what_to_do_is_said(
    stand: tuple[Path, Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model, joints, whole = stand
    for path in (joints, whole):
        line = refused(
            *(capsys, gap, "--model", model, "--data", path, "--out", tmp_path / "o")
        )
        assert "does not move in this log" in line
        assert "remove its free joint, or give --held-base" in line


def test_commands_run_in_the_stand(
    stand: tuple[Path, Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model, joints, _ = stand
    (tmp_path / "map.yaml").write_text(
        "joints: [hip, knee]\nactuators: {0: hip_drive, 1: knee_drive}\n"
    )
    held = ("--model", model, "--held-base")
    command(
        *(import_logs, torch_zip(tmp_path / "a.pt", pace()), *held),
        *("--mapping", tmp_path / "map.yaml", "--out", tmp_path / "logs"),
    )
    assert (tmp_path / "logs" / "a.csv").is_file()
    (tmp_path / "p.yaml").write_text(PARAMETERS)
    out = tmp_path / "easi"
    command(
        *(easi, *held, "--data", joints, "--parameters", tmp_path / "p.yaml"),
        *("--population", 8, "--generations", 2, "--set", "segments=16", "--out", out),
        *("--engine", "mujoco", "--no-refine"),
    )
    pose = '"trunk" is held at the pose of the model: 0 0 1 m, quaternion 1 0 0 0'
    assert capsys.readouterr().out.count(pose) == 2
    command(export, out, "--to", "mjcf")
    m = mujoco.MjModel.from_xml_path(str(out / "export" / "model.xml"))
    assert m.nv == 2 and m.body("trunk").pos[2] == 1
    line = refused(capsys, evaluate, "--run", out)
    assert "no policy" in line


@pytest.mark.slow
def test_the_next_commands_for_the_stand(
    stand: tuple[Path, Path, Path], tmp_path: Path
) -> None:
    model, joints, _ = stand
    command(
        *(excite, "--model", model, "--held-base", "--data", joints, "--duration", 4),
        *("--horizon", 0.1, "--effects", "armature", "coulomb_friction"),
        *("--out", tmp_path / "excite"),
    )
    log = read_logs([tmp_path / "excite" / "commands.csv"], hung())
    assert np.abs(log.runs[0].ctrl).max(0).min() > 0.01  # N m, of both drives


@pytest.mark.slow
def test_an_effect_is_found_in_the_stand(
    stand: tuple[Path, Path, Path],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    model, _, whole = stand
    few = ("coulomb_friction",)
    monkeypatch.setattr(
        *(effect_search, "places"),
        lambda *a: [p for p in places(*a) if p.effect in few],
    )
    monkeypatch.setattr(effect_search, "ripples", lambda *a: [])
    out = tmp_path / "gap"
    command(gap, "--model", model, "--held-base", "--data", whole, "--out", out)
    told = read(out / "gap.json")
    assert [(e["effect"], e["at"]) for e in told["effects"]] == [
        ("coulomb_friction", "hip")
    ]
    assert "held at the pose first in the logs" in capsys.readouterr().out
    m = mujoco.MjModel.from_xml_path(str(out / "model.xml"))
    assert m.nv == 2
    assert m.joint("hip").frictionloss == pytest.approx(FRICTION, rel=0.2)
