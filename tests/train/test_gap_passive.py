"""train.gap on a machine without actuators, recorded once."""

from pathlib import Path

import mujoco
import numpy as np
import pytest

from easi_jax.gap import effect_search
from easi_jax.gap.candidates import places
from tests.commands import command, read
from train import gap

XML = """<mujoco model="pendulum"><option timestep="0.002" integrator="implicitfast"/>
<worldbody><body name="arm"><joint name="swing" axis="0 1 0" damping="0.004"/>
<geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.02" mass="0.5"/></body></worldbody>
</mujoco>"""
FRICTION, NOISE, DT = 0.02, 3e-4, 0.01  # N m, rad, s


def write_log(path: Path) -> None:
    """Let go once, and swinging until friction stops it."""
    m = mujoco.MjModel.from_xml_string(XML)
    m.dof_frictionloss[0], m.opt.timestep = FRICTION, DT / 20
    d, rng = mujoco.MjData(m), np.random.default_rng(0)
    d.qpos[0] = 1.8
    rows = []
    for k in range(700):
        rows.append(f"{DT * k:.2f},{d.qpos[0] + NOISE * rng.normal():.6g}")
        mujoco.mj_step(m, d, 20)
    path.write_text("\n".join(["time,qpos.swing", *rows]) + "\n")


@pytest.mark.fault("a machine without actuators, a single run")
def test_friction_of_a_pendulum_that_nobody_drives(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    few = ("coulomb_friction", "stribeck_friction", "armature")
    monkeypatch.setattr(
        *(effect_search, "places"),
        lambda *a: [p for p in places(*a) if p.effect in few],
    )
    monkeypatch.setattr(effect_search, "ripples", lambda *a: [])
    (tmp_path / "model.xml").write_text(XML)
    write_log(tmp_path / "log.csv")
    out = tmp_path / "out"
    command(
        *(gap, "--model", tmp_path / "model.xml", "--data", tmp_path / "log.csv"),
        *("--out", out),
    )
    told = read(out / "gap.json")
    found = {e["effect"]: e for e in told["effects"]}
    assert set(found) <= {"coulomb_friction", "stribeck_friction"} and found
    assert told["held_out"][0] == "log, 0.82 to 1.51 s" and len(told["held_out"]) == 3
    assert told["not_finite"] == 0 and told["where"][0]["at"] == "swing"
    assert not any("left out: " in note for note in told["notes"])
    page = (out / "report.html").read_text()
    assert "Where and when" in page and "Measured and predicted" in page
    m = mujoco.MjModel.from_xml_path(str(out / "model.xml"))
    assert m.nu == 0 and m.dof_frictionloss[0] == pytest.approx(FRICTION, rel=0.1)
