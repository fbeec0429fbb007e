"""train.gap where a joint has no reading, as the owner says."""

from pathlib import Path

import mujoco
import numpy as np
import pytest

from easi_jax.gap import effect_search
from easi_jax.gap.candidates import places
from tests.commands import command, read
from train import gap

XML = """<mujoco model="soft arm"><option timestep="0.002" integrator="implicitfast"/>
<worldbody><body name="arm"><joint name="a" axis="0 1 0" damping="0.02"/>
<geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.02" mass="0.5"/>
<body name="tip" pos="0 0 -0.3"><joint name="b" axis="0 1 0" damping="0.002"
stiffness="1.5"/><geom type="capsule" fromto="0 0 0 0 0 -0.2" size="0.02" mass="0.3"/>
</body></body></worldbody><actuator><motor name="m" joint="a"/></actuator></mujoco>"""
NOISE, DT = 2e-4, 0.01  # rad, s


def write_log(path: Path, friction: float, seed: int) -> None:
    """Positions of the driven joint alone, its tip swinging after it from the start;
    the truth steps by a tenth of the model's step."""
    m = mujoco.MjModel.from_xml_string(XML)
    m.dof_frictionloss[0], m.opt.timestep = friction, 0.0002
    d, rng = mujoco.MjData(m), np.random.default_rng(seed)
    d.qpos[:], d.qvel[:] = [0.3, -0.2], [0.0, 1.0]
    rows = []
    for k in range(800):
        t = DT * k
        d.ctrl[0] = 0.8 * np.sin(5 * t + seed) + 0.5 * np.sin(11 * t)
        noisy = d.qpos[0] + NOISE * rng.normal()
        rows.append(f"{t:.2f},{noisy:.6g},{d.ctrl[0]:.6g}")
        mujoco.mj_step(m, d, 50)
    path.write_text("\n".join(["time,qpos.a,ctrl.m", *rows]) + "\n")


@pytest.mark.parametrize("friction", [0.0, 0.06])
def test_a_joint_that_nobody_reads(
    tmp_path: Path, friction: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A right model is at the floor; what the read joint lacks is named there."""
    few = ("coulomb_friction", "armature", "constant_force")
    monkeypatch.setattr(
        *(effect_search, "places"),
        lambda *a: [p for p in places(*a) if p.effect in few],
    )
    monkeypatch.setattr(effect_search, "ripples", lambda *a: [])
    (tmp_path / "model.xml").write_text(XML)
    logs = [tmp_path / "one.csv", tmp_path / "two.csv"]
    for seed, log in enumerate(logs):
        write_log(log, friction, seed)
    command(
        *(gap, "--model", tmp_path / "model.xml", "--data", *logs),
        *("--unmeasured", "b", "--engine", "mujoco", "--out", tmp_path / "out"),
    )
    told = read(tmp_path / "out" / "gap.json")
    assert told["verdict"] == ("explained" if friction else "no_gap")
    last = told["gap"]["after" if friction else "refit"]
    assert 0.85 < last / told["gap"]["floor"] < 1.2
    assert list(told["gap_si"]) == ["a"]
    named = [(e["effect"], e["at"]) for e in told["effects"]]
    assert named == ([("coulomb_friction", "a")] if friction else [])
