"""train.gap where every drive has the same effect: named at each, found as one."""

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

LINK = """<body name="{0}" pos="{1} 0 0"><joint name="{0}" axis="0 1 0" damping="0.05"/>
<geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.02" mass="0.4"/></body>"""
NAMES = ("a", "b", "c")
DT, PHYSICS, NOISE = 0.01, 5, 2e-4


def xml(count: int) -> str:
    """A machine of so many drives."""
    names = NAMES[:count]
    return (
        '<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody>'
        + "".join(LINK.format(n, k) for k, n in enumerate(names))
        + "</worldbody><actuator>"
        + "".join(f'<position name="{n}" joint="{n}" kp="8" kv="0.4"/>' for n in names)
        + "</actuator></mujoco>"
    )


def write_log(path: Path, late: tuple[int, ...]) -> None:
    """Commands that reach each drive some physics steps late."""
    count, names = len(late), NAMES[: len(late)]
    m = mujoco.MjModel.from_xml_string(xml(count))
    d, rng = mujoco.MjData(m), np.random.default_rng(3)
    rate, phase = rng.uniform(3, 14, (4, count)), rng.uniform(0, 6, (4, count))
    t = DT * np.arange(500)
    ctrl = 0.6 * np.sin(rate[:, None] * t[:, None] + phase[:, None]).mean(0)
    sent = np.repeat(ctrl, PHYSICS, axis=0)
    rows = []
    for k in range(len(t)):
        q = d.qpos + NOISE * rng.normal(size=count)
        rows.append([t[k], *q, *ctrl[k]])
        for i in range(PHYSICS):
            at = np.maximum(PHYSICS * k + i - np.array(late), 0)
            d.ctrl[:] = sent[at, np.arange(count)]
            mujoco.mj_step(m, d)
    head = ["time", *(f"qpos.{n}" for n in names), *(f"ctrl.{n}" for n in names)]
    text = [",".join(f"{x:.9g}" for x in row) for row in rows]
    path.write_text("\n".join([",".join(head), *text]) + "\n")


@pytest.mark.parametrize(
    "late",
    [
        pytest.param((15, 15), id="two alike"),
        pytest.param((15, 15, 15), id="alike", marks=pytest.mark.slow),
        pytest.param((15, 15, 30), id="one more", marks=pytest.mark.slow),
        pytest.param((0, 15, 0), id="one", marks=pytest.mark.slow),
    ],
)
def test_late_drives_are_named_one_by_one(
    late: tuple[int, ...], tmp_path: Path, monkeypatch: Any
) -> None:
    few = ("actuator_delay",)
    if len(late) == len(NAMES):  # the slow ones have rivals
        few = (*few, "actuator_gain", "armature")
    monkeypatch.setattr(
        *(effect_search, "places"),
        lambda *a: [p for p in places(*a) if p.effect in few],
    )
    monkeypatch.setattr(effect_search, "ripples", lambda *a: [])
    (tmp_path / "arm.xml").write_text(xml(len(late)))
    write_log(tmp_path / "log.csv", late)
    out = tmp_path / "out"
    command(
        *(gap, "--model", tmp_path / "arm.xml", "--data", tmp_path / "log.csv"),
        *("--out", out),
    )
    told = read(out / "gap.json")
    seconds = {n: k * DT / PHYSICS for n, k in zip(NAMES, late, strict=False) if k}
    found = {e["at"]: e["parameters"]["delay"]["value"] for e in told["effects"]}
    assert found == pytest.approx(seconds, abs=2e-3)
    assert {(e["effect"], e["kind"]) for e in told["effects"]} == {
        ("actuator_delay", "actuator")
    }
    assert not any(e["indistinguishable"] for e in told["effects"])
    gaps = [told["gap"]["refit"], *(e["gap_after"] for e in told["effects"])]
    assert gaps == sorted(gaps, reverse=True)
    assert gaps[-1] == told["gap"]["after"] < 0.2 * gaps[0]  # steps of 2 ms are left
    entries, _ = read_effects(out / "effects.yaml")
    assert {e.at: e.columns["delay"] for e in entries} == pytest.approx(
        seconds, abs=2e-3
    )
    told_people = (out / "report.html").read_text()
    alike = f"arrive at {len(late)} actuators alike (" in told_people
    assert alike == (len({*late}) == 1)
