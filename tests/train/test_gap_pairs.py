"""train.gap on a machine that touches the ground at two places."""

import html
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from easi_jax.gap import analysis
from easi_jax.gap.candidates import places
from easi_jax.io.models.effects_file import read_effects
from tests.commands import command, read
from train import gap

FOOT = """<body name="{0}" pos="0 {1} 0.05"><joint name="{0}_x" type="slide"
axis="1 0 0"/><joint name="{0}_z" type="slide" axis="0 0 1" range="-1 1"/>
<geom name="{0}_foot" size="0.05" mass="1" solref="0.1 1" {2}/></body>"""
XML = """<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody>
<geom name="floor" type="plane" size="5 5 0.1" friction="0.5" solref="0.1 1"/>
{feet}</worldbody>
<actuator><motor name="left_x" joint="left_x"/><motor name="left_z" joint="left_z"/>
<motor name="right_x" joint="right_x"/><motor name="right_z" joint="right_z"/>
</actuator></mujoco>"""
DT, NOISE = 0.01, np.array([5e-5, 1e-5, 5e-5, 1e-5])


def xml(left: float, right: float) -> str:
    """Two feet; the floor's friction is the smaller of a contact's two."""
    feet = [
        FOOT.format(name, y, f'friction="{f}"')
        for name, y, f in (("left", 0, left), ("right", 1, right))
    ]
    return XML.format(feet="".join(feet))


def write_log(path: Path, m: mujoco.MjModel, seed: int) -> None:
    """Both feet are pushed along while they are pressed down, more and less."""
    rng = np.random.default_rng(seed)
    rate = rng.uniform(3, 14, (4, 4))
    phase = rng.uniform(0, 6, (4, 4))
    d, rows = mujoco.MjData(m), []
    for k in range(250):
        wave = np.sin(rate * k * DT + phase).mean(1)
        d.ctrl[:] = wave * [30, 16, 30, 16] - [0, 8, 0, 8]
        q = d.qpos + NOISE * rng.normal(size=4)
        rows.append([k * DT, *q, *d.ctrl])
        for _ in range(round(DT / m.opt.timestep)):
            mujoco.mj_step(m, d)
    joints = [f"qpos.{m.joint(j).name}" for j in range(4)]
    head = ["time", *joints, *(f"ctrl.{m.actuator(a).name}" for a in range(4))]
    text = [",".join(f"{x:.9g}" for x in row) for row in rows]
    path.write_text("\n".join([",".join(head), *text]) + "\n")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("left", "right", "at"),
    [(0.9, 0.6, "floor/left_foot"), (0.9, 0.9, "")],
    ids=["one foot", "both"],
)
def test_friction_is_named_where_it_is(
    left: float, right: float, at: str, tmp_path: Path, monkeypatch: Any
) -> None:
    """Among a few rivals; the slow test has all."""
    few = ("contact_friction", "contact_softness", "coulomb_friction")
    monkeypatch.setattr(
        *(analysis, "places"), lambda *a: [p for p in places(*a) if p.effect in few]
    )
    monkeypatch.setattr(analysis, "ripples", lambda *a: [])
    told, out = named(left, right, tmp_path)
    effect = told["effects"][0]
    assert (effect["effect"], effect["at"]) == ("contact_friction", at)
    assert effect["kind"] == ("geom" if at else "model")
    assert effect["parameters"]["friction"]["value"] == pytest.approx(0.9, rel=0.1)
    assert told["not_in_model_xml"] == []
    entries, _ = read_effects(out / "effects.yaml")
    assert list(entries[0].columns.values()) == [pytest.approx(1.5, rel=0.1)]
    repaired = mujoco.MjModel.from_xml_path(str(out / "model.xml"))
    assert repaired.npair == len({e["at"] for e in told["effects"] if e["at"]})
    said = '"floor" and "left_foot"' if at else "contacts have"
    assert said in html.unescape((out / "report.html").read_text()).lower()


@pytest.mark.slow
@pytest.mark.timeout(1500)
def test_friction_of_one_foot_among_all_effects(tmp_path: Path) -> None:
    effect = named(0.9, 0.6, tmp_path)[0]["effects"][0]
    assert (effect["effect"], effect["at"]) == ("contact_friction", "floor/left_foot")


def named(left: float, right: float, tmp_path: Path) -> tuple[Any, Path]:
    model = tmp_path / "robot.xml"
    model.write_text(xml(0.6, 0.6))
    simulator = mujoco.MjModel.from_xml_string(xml(left, right))
    logs = [tmp_path / f"run{i}.csv" for i in range(2)]
    for i, path in enumerate(logs):
        write_log(path, simulator, i)
    out = tmp_path / "out"
    command(gap, "--model", model, "--data", *logs, "--out", out)
    return read(out / "gap.json"), out
