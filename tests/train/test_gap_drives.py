"""train.gap on a machine whose drive is not as strong as its owner believes."""

import json
from pathlib import Path

import mujoco
import numpy as np
import pytest

from tests.commands import command
from train import gap

MODEL = """<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody>
<body><joint name="j" axis="0 1 0" armature="0.02"/>
<geom type="capsule" fromto="0 0 0 0 0 -0.4" size="0.02" mass="0.8"/></body></worldbody>
<actuator><position name="servo" joint="j" kp="{kp:g}" kv="{kv:g}"/></actuator>
</mujoco>"""
KP, KV, FACTOR = 10.0, 0.6, 0.7
DT, NOISE = 0.01, 1e-4
TRUTHS = {
    "drive_stiffness": (FACTOR * KP, KV),
    "drive_damping": (KP, FACTOR * KV),
    "actuator_strength": (FACTOR * KP, FACTOR * KV),
}


def write_log(path: Path, kp: float, kv: float) -> None:
    m = mujoco.MjModel.from_xml_string(MODEL.format(kp=kp, kv=kv))
    d, rng = mujoco.MjData(m), np.random.default_rng(0)
    t = DT * np.arange(800)
    rate, phase = rng.uniform(2.0, 14.0, 5), rng.uniform(0.0, 6.0, 5)
    ctrl = 0.4 + 0.25 * np.sin(np.outer(t, rate) + phase).sum(1)
    rows = []
    for now, u in zip(t, ctrl, strict=True):
        rows.append((now, d.qpos[0] + NOISE * rng.normal(), u))
        d.ctrl[:] = u
        mujoco.mj_step(m, d, 5)
    head = "time,qpos.j,ctrl.servo"
    np.savetxt(path, rows, "%.9g", ",", header=head, comments="")


@pytest.mark.slow
@pytest.mark.parametrize("effect", TRUTHS)
def test_what_the_drive_lacks_is_named(effect: str, tmp_path: Path) -> None:
    (tmp_path / "arm.xml").write_text(MODEL.format(kp=KP, kv=KV))
    write_log(tmp_path / "log.csv", *TRUTHS[effect])
    out = tmp_path / "out"
    command(
        *(gap, "--model", tmp_path / "arm.xml", "--data", tmp_path / "log.csv"),
        *("--engine", "mujoco", "--out", out),
    )
    told = json.loads((out / "gap.json").read_text())
    (found,) = told["effects"]
    assert (found["effect"], found["at"]) == (effect, "servo")
    factor = found["parameters"]["factor"]
    assert factor["unit"] == "1" and factor["std"] < 0.02
    assert abs(factor["value"] - FACTOR) < 3 * factor["std"]
    assert found["confidence"] > 0.5
    m = mujoco.MjModel.from_xml_path(str(out / "model.xml"))
    kp, kv = TRUTHS[effect]
    np.testing.assert_allclose(m.actuator_gainprm[0, 0], kp, rtol=0.02)
    np.testing.assert_allclose(m.actuator_biasprm[0, 1:3], (-kp, -kv), rtol=0.02)
