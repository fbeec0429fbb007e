"""train.gap on a machine without a hidden effect: own parameters, late velocities."""

import csv
import os
import re
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
import yaml

from easi_jax.data.cleaning import true_readings
from easi_jax.data.scales import scales_of
from easi_jax.gap.candidates import places
from easi_jax.gap.table import covered
from easi_jax.io.logs.reader import read_logs
from easi_jax.io.models.effects_file import read_effects
from easi_jax.model.parameters import Parameter, ParameterSpace
from tests.commands import command, read, refused
from tests.gap_cases import Stated, make_case
from train import gap, udr
from train._effects import found_in

PARAMETERS = """parameters:
- {{name: mass, address: body.{body}.mass, initial: [{low}, {high}], bounds: [0.01, 9]}}
- {{name: damping, address: joint.*.damping, initial: [0.001, 1], bounds: [1e-5, 9]}}
"""


@pytest.fixture(scope="module")
def bare(tmp_path_factory: pytest.TempPathFactory) -> Any:
    folder = tmp_path_factory.mktemp("bare") / "data"
    return make_case(24, "pendulum", [], folder, stated=Stated(damping=True))


def test_what_may_be_refitted_is_no_effect_and_reaches_the_model(
    bare: Any, tmp_path: Path
) -> None:
    text = (bare.directory / "model.xml").read_text()
    true = mujoco.MjModel.from_xml_string(text)
    body, mass = true.body(1).name, float(true.body_mass[1])
    model = tmp_path / "model.xml"
    spec = mujoco.MjSpec.from_string(text)
    spec.compile()
    spec.body(body).explicitinertial = True
    spec.body(body).mass = 1.2 * mass
    spec.body(body).ipos, spec.body(body).iquat = true.body_ipos[1], true.body_iquat[1]
    spec.body(body).inertia = 1.2 * true.body_inertia[1]
    spec.compile()
    model.write_text(spec.to_xml())
    parameters = tmp_path / "parameters.yaml"
    low, high = 0.6 * mass, 2 * mass
    parameters.write_text(PARAMETERS.format(body=body, low=low, high=high))
    *fit, held = sorted(bare.directory.glob("run*.csv"))
    command(
        gap,
        *("--model", model, "--parameters", parameters, "--out", tmp_path / "out"),
        *("--data", *fit, held, "--held-out", os.path.relpath(held)),
    )
    told = read(tmp_path / "out" / "gap.json")
    assert told["held_out"] == [held.stem] and told["verdict"] == "no_gap"
    assert told["effects"] == [] and told["not_in_model_xml"] == []
    found = {r["address"]: r["to"] for r in told["refitted"]}
    assert found[f"body.{body}.mass"] == pytest.approx(mass, rel=0.03)
    new = mujoco.MjModel.from_xml_path(str(tmp_path / "out" / "model.xml"))
    assert new.body_mass[1] == pytest.approx(found[f"body.{body}.mass"], rel=1e-5)
    assert new.dof_damping[0] == pytest.approx(found["joint.*.damping"], rel=1e-5)
    # Every command takes the file, which holds refitted values alone.
    again = read_plain(tmp_path / "out" / "effects.yaml")
    assert found_in(again).own == pytest.approx(found)


def read_plain(path: Path) -> Any:
    return yaml.safe_load(path.read_text())


def test_wildcards_cover_every_place(bare: Any) -> None:
    m = mujoco.MjModel.from_xml_path(str(bare.directory / "model.xml"))
    runs = read_logs(sorted(bare.directory.glob("run*.csv")), m).runs
    own = ParameterSpace(
        (
            Parameter("d", ("joint.*.damping",), 0.1, (0.05, 0.2), (0.01, 1.0)),
            Parameter("m", (f"body.{m.body(1).name}.mass",), 1.0, (0.5, 2.0), (0.1, 9)),
        )
    )
    out = {p.effect for p in places(m, scales_of(m, runs)) if covered(p, own, m)}
    assert out == {"viscous_damping", "payload_mass"}


def test_late_velocities_are_named_also_where_positions_show_no_gap(
    bare: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    m = mujoco.MjModel.from_xml_path(str(bare.directory / "model.xml"))
    joint = m.joint(0).name
    logs = []
    for path in sorted(bare.directory.glob("run*.csv")):
        with path.open() as file:
            rows = list(csv.DictReader(file))
        time, q = (
            np.array([float(r[k]) for r in rows]) for k in ("time", f"qpos.{joint}")
        )
        speed, late = np.gradient(q, time), np.zeros(len(q))
        for i in range(1, len(q)):  # a filter with a time constant of 30 ms
            share = 1 - np.exp(-(time[i] - time[i - 1]) / 0.03)
            late[i] = late[i - 1] + share * (speed[i] - late[i - 1])
        logs.append(tmp_path / path.name)
        with logs[-1].open("w") as file:
            writer = csv.DictWriter(file, [*rows[0], f"qvel.{joint}"])
            writer.writeheader()
            for r, v in zip(rows, late, strict=True):
                writer.writerow({**r, f"qvel.{joint}": v})
    out = tmp_path / "out"
    model = bare.directory / "model.xml"
    command(gap, "--model", model, "--data", *logs, "--out", out)
    told = read(out / "gap.json")
    (effect,) = told["effects"]
    assert (effect["effect"], effect["at"]) == ("sensor_delay", f"qvel.{joint}")
    assert effect["parameters"]["delay"]["value"] == pytest.approx(0.03, abs=0.01)
    assert told["verdict"] == "explained"
    assert told["gap"]["after"] <= 1.25 * told["gap"]["floor"]
    assert f"sensor_delay | qvel.{joint}" in table_text(capsys.readouterr().out)
    assert f"<td>qvel.{joint}</td>" in (out / "report.html").read_text()
    (entry,) = read_plain(out / "effects.yaml")["effects"]
    assert entry["at"] == f"qvel.{joint}" and entry["columns"]["late"] > 0


def test_a_named_sensor_that_is_off_is_named(
    bare: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = (bare.directory / "model.xml").read_text()
    joint = mujoco.MjModel.from_xml_string(text).joint(0).name
    model = tmp_path / "model.xml"
    sensor = f'<sensor><jointpos name="encoder" joint="{joint}"/></sensor></mujoco>'
    model.write_text(text.replace("</mujoco>", sensor))
    logs = []
    for path in sorted(bare.directory.glob("run*.csv")):
        with path.open() as file:
            rows = list(csv.DictReader(file))
        logs.append(tmp_path / path.name)
        with logs[-1].open("w") as file:
            writer = csv.DictWriter(file, [*rows[0], "sensor.encoder"])
            writer.writeheader()
            for r in rows:
                reading = float(r[f"qpos.{joint}"]) + 0.07
                writer.writerow({**r, "sensor.encoder": reading})
    out = tmp_path / "out"
    command(gap, "--model", model, "--data", *logs, "--out", out)
    (effect,) = read(out / "gap.json")["effects"]
    assert (effect["effect"], effect["at"]) == ("sensor_bias", "encoder")
    assert effect["kind"] == "sensor"
    assert effect["parameters"]["bias"]["value"] == pytest.approx(0.07, abs=1e-3)
    assert read(out / "gap.json")["not_in_model_xml"] == ["sensor_bias@encoder"]
    assert 'Sensor "encoder" is off' in (out / "report.html").read_text().replace(
        "&#34;", '"'
    )
    found = read_effects(out / "effects.yaml")[0]
    log = read_logs([logs[0]], mujoco.MjModel.from_xml_path(str(model)))
    (run,) = log.runs
    (same,) = true_readings(mujoco.MjModel.from_xml_path(str(model)), [run], found)
    assert same is run, "a sensor's own readings move no joint's"


def table_text(shown: str) -> str:
    """A printed table with one blank beside each line."""
    return re.sub(r"\s*│\s*", " | ", shown)


COARSE = """<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody>
<body><joint name="hinge" axis="0 1 0"/>
<geom type="capsule" fromto="0 0 0 0 0 -0.44" size="0.02" mass="0.83"/></body>
</worldbody><actuator><motor name="motor" joint="hinge"/></actuator></mujoco>"""


@pytest.mark.parametrize(
    "steps",
    [100, pytest.param(5, marks=pytest.mark.slow)],
    ids=["machine", "simulation"],
)
def test_what_the_models_own_steps_do_is_no_effect(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], steps: int
) -> None:
    """A model of 2 ms, beside what takes smaller steps, or the same."""
    (tmp_path / "model.xml").write_text(COARSE)
    simulator = mujoco.MjModel.from_xml_string(COARSE)
    simulator.opt.timestep = 0.01 / steps
    for run in range(3):
        rng = np.random.default_rng(run)
        rates, phases = rng.uniform(1.0, 12.0, 6), rng.uniform(0, 6.3, 6)
        data = mujoco.MjData(simulator)
        lines = ["time,qpos.hinge,ctrl.motor"]
        for row in range(600):
            at = 0.01 * row
            data.ctrl[0] = 0.5 * np.sin(rates * at + phases).sum()
            seen = data.qpos[0] + rng.normal(0, 1e-4)
            lines.append(f"{at:.4f},{seen:.9g},{data.ctrl[0]:.9g}")
            mujoco.mj_step(simulator, data, steps)
        (tmp_path / f"run{run}.csv").write_text("\n".join([*lines, ""]))
    logs = sorted(tmp_path.glob("run*.csv"))
    out = tmp_path / "out"
    command(gap, "--model", tmp_path / "model.xml", "--data", *logs, "--out", out)
    told = read(out / "gap.json")
    assert told["effects"] == []
    assert read_plain(out / "effects.yaml")["effects"] == []
    assert "physics step of 2 ms makes an error of" in capsys.readouterr().out
    noted = [n for n in told["notes"] if "physics step of 2 ms" in n]
    assert len(noted) == (steps > 5)


def test_retraining_too_short_to_train_is_told_at_once(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = tmp_path / "log.csv"
    rows = "".join(f"{0.02 * i},{np.sin(i)},0,0.1\n" for i in range(200))
    log.write_text("time,qpos.cart,qpos.pole,ctrl.cart\n" + rows)
    said = refused(
        capsys,
        gap,
        *("--model", "cartpole", "--data", log, "--out", tmp_path / "out"),
        *("--retrain", "cartpole", "--retrain-steps", 2000),
    )
    assert "env_steps=2000" in said and not (tmp_path / "out").exists()


@pytest.mark.slow
def test_a_robot_gets_what_the_physics_of_a_file_says(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "effects.yaml"
    path.write_text(
        "effects:\n"
        "- {effect: sensor_bias, at: pole, kind: joint, columns: {bias: 0.02}}\n"
    )
    out = tmp_path / "out"
    small = ("--env-steps", 2100, "--eval-episodes", 2, "--chunk", 24)
    command(udr, "--effects", path, "--out", out, *small)
    assert "in the readings of a sensor" in (out / "report.html").read_text()
