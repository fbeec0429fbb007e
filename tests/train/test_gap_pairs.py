"""train.gap on a machine that touches the ground at two places."""

import html
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from easi_jax.gap import effect_search
from easi_jax.gap.candidates import places
from easi_jax.io.models.effects_file import read_effects
from tests.commands import command, read
from train import gap

FOOT = """<body name="{0}" pos="0 {1} 0.05"><joint name="{0}_x" type="slide"
axis="1 0 0"/><joint name="{0}_z" type="slide" axis="0 0 1" range="-1 1"/>
<geom name="{0}_foot" size="0.05" mass="1" solref="0.1 1" {2}/></body>"""
MOTORS = """<motor name="{0}_x" joint="{0}_x"/><motor name="{0}_z" joint="{0}_z"/>"""
XML = """<mujoco><option timestep="{step}" integrator="implicitfast"/><worldbody>
<geom name="floor" type="plane" size="5 5 0.1" friction="0.5" solref="0.1 1"/>
{feet}</worldbody><actuator>{motors}</actuator></mujoco>"""
NAMES = ("left", "right")
DT, NOISE = 0.01, np.array([5e-5, 1e-5])


def xml(frictions: tuple[float, ...], step: float) -> str:
    """A foot for each; the floor's friction is the smaller of a contact's two."""
    feet = [
        FOOT.format(name, y, f'friction="{f}"')
        for y, (name, f) in enumerate(zip(NAMES, frictions, strict=False))
    ]
    motors = [MOTORS.format(name) for name in NAMES[: len(feet)]]
    return XML.format(step=step, feet="".join(feet), motors="".join(motors))


def write_log(path: Path, m: mujoco.MjModel, rows: int, seed: int) -> None:
    """Feet are pushed along while they are pressed down, more and less."""
    rng, feet = np.random.default_rng(seed), m.nq // 2
    rate = rng.uniform(3, 14, (m.nu, 4))
    phase = rng.uniform(0, 6, (m.nu, 4))
    d, written = mujoco.MjData(m), []
    for k in range(rows):
        wave = np.sin(rate * k * DT + phase).mean(1)
        d.ctrl[:] = wave * np.tile([30, 16], feet) - np.tile([0, 8], feet)
        q = d.qpos + np.tile(NOISE, feet) * rng.normal(size=m.nq)
        written.append([k * DT, *q, *d.ctrl])
        for _ in range(round(DT / m.opt.timestep)):
            mujoco.mj_step(m, d)
    joints = [f"qpos.{m.joint(j).name}" for j in range(m.njnt)]
    head = ["time", *joints, *(f"ctrl.{m.actuator(a).name}" for a in range(m.nu))]
    text = [",".join(f"{x:.9g}" for x in row) for row in written]
    path.write_text("\n".join([",".join(head), *text]) + "\n")


def only(monkeypatch: pytest.MonkeyPatch, *effects: str) -> None:
    """Few rivals: no others are tried."""
    monkeypatch.setattr(
        *(effect_search, "places"),
        lambda *a: [p for p in places(*a) if p.effect in effects],
    )
    monkeypatch.setattr(effect_search, "ripples", lambda *a: [])


@pytest.mark.slow
def test_friction_under_one_foot(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Small and short, so that it takes seconds: on MuJoCo, which compiles little."""
    only(monkeypatch, "contact_friction", "coulomb_friction")
    told, _ = named(
        *((0.9,), tmp_path, 80, 0.01),
        *("--engine", "mujoco", "--horizon", "0.15"),
    )
    (effect,) = told["effects"]
    assert effect["effect"] == "contact_friction" and told["verdict"] == "explained"
    assert effect["parameters"]["friction"]["value"] == pytest.approx(0.9, rel=0.1)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("left", "right", "at"),
    [(0.9, 0.6, "floor/left_foot"), (0.9, 0.9, "")],
    ids=["one foot", "both"],
)
def test_friction_is_named_where_it_is(
    left: float, right: float, at: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Among a few rivals; the test below has all."""
    only(monkeypatch, "contact_friction", "contact_softness", "coulomb_friction")
    told, out = named((left, right), tmp_path)
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
    effect = named((0.9, 0.6), tmp_path)[0]["effects"][0]
    assert (effect["effect"], effect["at"]) == ("contact_friction", "floor/left_foot")


def named(
    frictions: tuple[float, ...],
    tmp_path: Path,
    rows: int = 250,
    step: float = 0.002,
    *more: str,
) -> tuple[Any, Path]:
    model = tmp_path / "robot.xml"
    model.write_text(xml((0.6,) * len(frictions), step))
    simulator = mujoco.MjModel.from_xml_string(xml(frictions, step))
    logs = [tmp_path / f"run{i}.csv" for i in range(2)]
    for i, path in enumerate(logs):
        write_log(path, simulator, rows, i)
    out = tmp_path / "out"
    command(gap, "--model", model, "--data", *logs, "--out", out, *more)
    return read(out / "gap.json"), out
