"""train.gap on a machine whose drive is not as strong as its owner believes."""

import json
from pathlib import Path

import mujoco
import numpy as np
import pytest
import yaml

from easi_jax.data.recording import Configuration, Run
from easi_jax.data.windows import fitted_velocity
from easi_jax.gap import effect_search
from easi_jax.gap.analysis import Analysis
from easi_jax.gap.candidates import places
from easi_jax.gap.result import Numbers
from easi_jax.gap.screening import expanded
from easi_jax.model.parameters import ParameterSpace
from easi_jax.simulation import engine
from tests.commands import command, read
from train import easi, export, gap

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


def recorded(kp: float, kv: float, seed: int = 0, rows: int = 800) -> np.ndarray:
    """Time, position and command, ``(rows, 3)``."""
    m = mujoco.MjModel.from_xml_string(MODEL.format(kp=kp, kv=kv))
    d, rng = mujoco.MjData(m), np.random.default_rng(seed)
    t = DT * np.arange(rows)
    rate, phase = rng.uniform(2.0, 14.0, 5), rng.uniform(0.0, 6.0, 5)
    ctrl = 0.4 + 0.25 * np.sin(np.outer(t, rate) + phase).sum(1)
    out = []
    for now, u in zip(t, ctrl, strict=True):
        out.append((now, d.qpos[0] + NOISE * rng.normal(), u))
        d.ctrl[:] = u
        mujoco.mj_step(m, d, 5)
    return np.array(out)


def run(name: str, m: mujoco.MjModel, rows: np.ndarray) -> Run:
    t, q, u, c = rows[:, 0], rows[:, 1:2], rows[:, 2:], Configuration.of(m)
    return Run(name, "made", DT, t, q, fitted_velocity(q, DT, c), False, u, c)


def test_a_fit_of_each_candidate_tells_them_apart(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    few = {*TRUTHS, "actuator_gain", "armature", "viscous_damping", "payload_mass"}
    monkeypatch.setattr(
        *(effect_search, "places"),
        lambda *a: [p for p in places(*a) if p.effect in few],
    )
    monkeypatch.setattr(effect_search, "ripples", lambda *a: [])
    m = mujoco.MjModel.from_xml_string(MODEL.format(kp=KP, kv=KV))
    truth = TRUTHS["drive_stiffness"]
    fit, held = (run(str(k), m, recorded(*truth, k, 400)) for k in (0, 1))
    noise = np.array([NOISE])
    with engine.using("mujoco"):
        a = Analysis(m, ParameterSpace(()), [fit], [held], noise, 0.2)
        at = a.search.at
        at.whiten(at.neutral)
        found, _ = expanded(at.selector, at.refit([]), a.places.candidates([]))
    (place,) = found[0].places
    assert place.key == "drive_stiffness@servo"
    value, _, unit = Numbers(at.selector, found[0]).values(place)["factor"]
    # Starts are still those of the model without it.
    assert value == pytest.approx(FACTOR, rel=0.05) and unit == "1"
    assert found[1].loss.mean() > 10 * found[0].loss.mean()


@pytest.mark.slow
@pytest.mark.parametrize("effect", TRUTHS)
def test_what_the_drive_lacks_is_named(effect: str, tmp_path: Path) -> None:
    (tmp_path / "arm.xml").write_text(MODEL.format(kp=KP, kv=KV))
    head, rows = "time,qpos.j,ctrl.servo", recorded(*TRUTHS[effect])
    np.savetxt(tmp_path / "log.csv", rows, "%.9g", ",", header=head, comments="")
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


EFFECTS = """effects:
- {effect: drive_stiffness, at: servo, kind: actuator, columns: {kp: 1.0}}
- {effect: drive_damping, at: servo, kind: actuator, columns: {kv: 1.0}}
- {effect: actuator_strength, at: servo, kind: actuator, columns: {strength: 1.0}}
"""


def test_a_drive_that_is_identified_is_exported(tmp_path: Path) -> None:
    """Stiffness and damping may be both of them less, or the drive weaker: which of the
    two no data say, but what the drive does is known, and written down."""
    kp, kv = 0.7 * KP, 0.85 * KV
    (tmp_path / "arm.xml").write_text(MODEL.format(kp=KP, kv=KV))
    (tmp_path / "effects.yaml").write_text(EFFECTS)
    (tmp_path / "parameters.yaml").write_text(
        "parameters:\n- {name: armature, address: joint.j.armature, "
        "initial: [0.01, 0.04]}\n"
    )
    head, rows = "time,qpos.j,ctrl.servo", recorded(kp, kv)
    np.savetxt(tmp_path / "log.csv", rows, "%.9g", ",", header=head, comments="")
    out = tmp_path / "out"
    command(
        *(easi, "--model", tmp_path / "arm.xml", "--data", tmp_path / "log.csv"),
        *("--parameters", tmp_path / "parameters.yaml"),
        *("--effects", tmp_path / "effects.yaml", "--engine", "mujoco"),
        *("--population", 16, "--generations", 3, "--set", "segments=16"),
        *("--out", out),
    )
    command(export, out, "--to", "mjcf", "randomization")
    m = mujoco.MjModel.from_xml_path(str(out / "export" / "model.xml"))
    np.testing.assert_allclose(m.actuator_gainprm[0, 0], kp, rtol=0.02)
    np.testing.assert_allclose(m.actuator_biasprm[0, 1:3], (-kp, -kv), rtol=0.02)
    told = yaml.safe_load((out / "export" / "randomization.yaml").read_text())
    names = {p["name"] for p in told["parameters"]}
    factors = ("drive_stiffness", "drive_damping", "actuator_strength")
    assert {f"{name}@servo.factor" for name in factors} < names
    flags = read(out / "distribution.json")["seeds"]["0"]["flags"]
    assert "not determined" in flags, "one of three is free"
