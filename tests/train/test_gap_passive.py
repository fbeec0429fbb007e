"""train.gap on a machine without actuators, recorded once."""

import html
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

import easi_jax
from easi_jax.gap import effect_search
from easi_jax.gap.candidates import places
from easi_jax.gap.held_out import HeldOut
from tests.commands import command, read
from train import gap

XML = """<mujoco model="pendulum"><option timestep="0.002" integrator="implicitfast"/>
<worldbody><body name="arm"><joint name="swing" axis="0 1 0" damping="0.004"/>
<geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.02" mass="0.5"/></body></worldbody>
</mujoco>"""
FRICTION, NOISE, DT = 0.02, 3e-4, 0.01  # N m, rad, s


FEW = ("coulomb_friction", "stribeck_friction", "armature")


def write_log(path: Path, friction: float = FRICTION, start: float = 1.8) -> None:
    """Let go once, and swinging until friction stops it."""
    m = mujoco.MjModel.from_xml_string(XML)
    m.dof_frictionloss[0], m.opt.timestep = friction, DT / 20
    d, rng = mujoco.MjData(m), np.random.default_rng(0)
    d.qpos[0] = start
    rows = []
    for k in range(700):
        rows.append(f"{DT * k:.2f},{d.qpos[0] + NOISE * rng.normal():.6g}")
        mujoco.mj_step(m, d, 20)
    path.write_text("\n".join(["time,qpos.swing", *rows]) + "\n")


@pytest.fixture(autouse=True)
def some_effects(monkeypatch: pytest.MonkeyPatch) -> None:
    """Only `FEW` are looked for."""
    monkeypatch.setattr(
        *(effect_search, "places"),
        lambda *a: [p for p in places(*a) if p.effect in FEW],
    )
    monkeypatch.setattr(effect_search, "ripples", lambda *a: [])


@pytest.mark.fault("a machine without actuators, a single run")
def test_friction_of_a_pendulum_that_nobody_drives(tmp_path: Path) -> None:
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


def test_a_recording_of_another_machine_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Of two logs one is held out; its bearing has four times the friction."""
    (tmp_path / "model.xml").write_text(XML)
    logs = [tmp_path / "one.csv", tmp_path / "two.csv"]
    write_log(logs[0])
    write_log(logs[1], 4 * FRICTION, start=-1.6)
    command(
        *(gap, "--model", tmp_path / "model.xml", "--data", logs[0]),
        *("--held-out", logs[1], "--out", tmp_path / "out"),
    )
    told = read(tmp_path / "out" / "gap.json")
    assert list(told["disagreeing_runs"]) == ["two"]
    said = " ".join(capsys.readouterr().out.split())
    page = html.unescape((tmp_path / "out" / "report.html").read_text())
    for text in (said, page):
        assert 'Run "two" disagrees with the others' in text
    model = easi_jax.read_model(tmp_path / "model.xml")
    first, second = (easi_jax.read_log(log, model) for log in logs)
    found = easi_jax.find_effects(model, first, held_out=second)
    assert list(found.disagreeing) == ["two"]


@pytest.mark.fault("simulations that explode, parameters at absurd corners")
def test_predictions_that_are_not_finite_are_counted_and_spoil_nothing(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    counted = HeldOut._counted

    def blown(self: HeldOut, errors: Any, share: float) -> Any:
        errors = np.array(errors)
        errors[:, :2, -1] = np.nan
        return counted(self, errors, share)

    monkeypatch.setattr(HeldOut, "_counted", blown)
    (tmp_path / "model.xml").write_text(XML)
    write_log(tmp_path / "log.csv")
    out = tmp_path / "out"
    command(
        *(gap, "--model", tmp_path / "model.xml", "--data", tmp_path / "log.csv"),
        *("--out", out),
    )
    told = read(out / "gap.json")
    assert told["not_finite"] == 2
    sizes = [v for v in told["gap"].values() if not isinstance(v, bool)]
    (channel,) = told["gap_si"].values()
    sizes += [channel[k] for k in ("before", "refit", "after", "refit_95", "after_95")]
    assert np.isfinite(np.hstack(sizes)).all()
    (note,) = (n for n in told["notes"] if "not finite" in n)
    assert note.startswith("2 of ")
    assert f"note: {note}" in " ".join(capsys.readouterr().out.split())
    assert note in html.unescape((out / "report.html").read_text())


@pytest.mark.fault("data that say nothing of what is asked")
def test_what_a_refit_cannot_know_is_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A second joint that hangs still has damping that a refit may move."""
    hanging = """<body name="rod" pos="0 1 0"><joint name="idle" axis="0 1 0"
    damping="0.01"/><geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.02"
    mass="0.5"/></body></worldbody>"""
    (tmp_path / "model.xml").write_text(XML.replace("</worldbody>", hanging))
    write_log(tmp_path / "log.csv")
    head, *rows = (tmp_path / "log.csv").read_text().splitlines()
    wide = [f"{head},qpos.idle", *(f"{row},0" for row in rows)]
    (tmp_path / "log.csv").write_text("\n".join(wide) + "\n")
    command(
        *(gap, "--model", tmp_path / "model.xml", "--data", tmp_path / "log.csv"),
        *("--out", tmp_path / "out"),
    )
    told = read(tmp_path / "out" / "gap.json")
    ends = {r["address"]: r["outcome"] for r in told["refitted"]}
    assert ends["joint.idle.damping"] == "not determined"
    assert ends["joint.swing.damping"] == "converged"
    note = "the data do not determine joint.idle.damping"
    assert note in " ".join(capsys.readouterr().out.split())
    page = (tmp_path / "out" / "report.html").read_text()
    assert note in page and "(not determined)" in page
