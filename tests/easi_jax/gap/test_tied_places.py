"""What like places have alike is one effect."""

import json
from pathlib import Path

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from easi_jax.data.scales import scales_of
from easi_jax.gap import effect_search
from easi_jax.gap.candidates import places
from easi_jax.gap.effect_set import Model
from easi_jax.gap.effect_vector import Layout
from easi_jax.gap.model_comparison import simplest
from easi_jax.gap.table import Place, covered
from easi_jax.io.models.effects_file import read_effects
from easi_jax.model.found_effects import FoundEffects, joined
from easi_jax.model.parameter_proposal import like_places
from easi_jax.model.parameters import Parameter, ParameterSpace
from tests.commands import command
from tests.easi_jax.gap.test_lengths import DT, recorded_of
from tests.easi_jax.gap.test_statistics import of_loss
from train import gap
from train._excite_problem import from_gap

LEG = """<body name="{n}_thigh" pos="{x} 0 1"><joint name="{n}_hip" axis="0 1 0"
damping="0.1"/><geom type="capsule" fromto="0 0 0 0 0 -0.2" size="0.02" mass="0.5"/>
<body name="{n}_calf" pos="0 0 -0.2"><joint name="{n}_knee" axis="0 1 0" damping="{d}"
{{more}}/><geom type="capsule" fromto="0 0 0 0 0 -0.2" size="0.02" mass="0.3"/></body>
</body>"""
DRIVES = (
    '<motor name="{n}_hip" joint="{n}_hip"/><motor name="{n}_knee" joint="{n}_knee"/>'
)


def robot_xml(odd: float = 0.1) -> str:
    """Two legs; ``odd`` is the damping of one knee; ``more`` in braces at both."""
    legs = LEG.format(n="left", x=0, d=0.1) + LEG.format(n="right", x=1, d=odd)
    drives = "".join(DRIVES.format(n=n) for n in ("left", "right"))
    return (
        '<mujoco><option timestep="0.002"/><compiler autolimits="true"/><worldbody>'
        f"{legs}</worldbody><actuator>{drives}</actuator></mujoco>"
    )


def robot(odd: float = 0.1) -> mujoco.MjModel:
    """The model of its owner."""
    return mujoco.MjModel.from_xml_string(robot_xml(odd).format(more=""))


@pytest.fixture(scope="module")
def offered() -> dict[str, Place]:
    m = robot()
    return {p.key: p for p in places(m, scales_of(m, [recorded_of(m, 0)]))}


def test_joints_are_alike_by_depth_and_by_what_the_model_states() -> None:
    assert like_places(robot(), "joint") == {
        "*_hip": ("left_hip", "right_hip"),
        "*_knee": ("left_knee", "right_knee"),
    }
    assert [*like_places(robot(odd=0.2), "joint")] == ["*_hip"]
    chain = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><body><joint name="wrist_1"/><geom size="0.1"/><body>'
        '<joint name="wrist_2"/><geom size="0.1"/></body></body></worldbody></mujoco>'
    )
    assert like_places(chain, "joint") == {}


def test_a_tied_number_moves_all_of_its_places(offered: dict[str, Place]) -> None:
    m, tied = robot(), offered["coulomb_friction@*_knee"]
    assert tied.tied == ("left_knee", "right_knee") and tied.kind == "joint"
    single = offered["coulomb_friction@left_knee"]
    layout = Layout(m, [*offered.values()])
    x = layout.neutral.copy()
    x[layout.where(tied)], x[layout.where(single)] = 0.3, 0.2
    friction = np.asarray(layout.effects(jnp.asarray(x, jnp.float32)).coulomb)
    np.testing.assert_allclose(friction, [0.0, 0.5, 0.0, 0.3], atol=1e-6)
    lag = offered["actuator_lag@*_knee"]
    x = layout.neutral.copy()
    x[layout.where(lag)] = 0.01
    late = np.asarray(layout.effects(jnp.asarray(x, jnp.float32)).lag)
    np.testing.assert_allclose(late, [0.0, 0.01, 0.0, 0.01], atol=1e-7)


def test_bodies_that_are_alike_may_be_heavier_alike(offered: dict[str, Place]) -> None:
    """Where each has its own; directions of left and right are mirror images."""
    m, tied = robot(), offered["payload_mass@*_calf"]
    assert tied.tied == ("left_calf", "right_calf") and tied.kind == "body"
    layout = Layout(m, [*offered.values()])
    x = layout.neutral.copy()
    x[layout.where(tied)] = 0.1
    heavier = np.asarray(layout.effects(jnp.asarray(x, jnp.float32)).mass)
    calves = [m.body(f"{n}_calf").id for n in ("left", "right")]
    np.testing.assert_allclose(np.flatnonzero(heavier), calves)
    assert not any(p.tied for p in offered.values() if p.effect == "com_offset")
    assert [*like_places(m, "body")] == ["*_thigh", "*_calf"]


def test_what_several_have_is_one_at_each() -> None:
    """Of a mass that may spread or not, the one that acts at the center of mass."""
    m = robot()
    given = m, ParameterSpace(()), scales_of(m, [recorded_of(m, 0)])
    offered = effect_search.Places(*given)
    every = {p.key: p for p in offered.offered}
    for key, names in (
        ("payload_mass@*_calf", ["left_calf", "right_calf"]),
        ("coulomb_friction@*_hip", ["left_hip", "right_hip"]),
        ("actuator_delay@", ["left_hip", "left_knee", "right_hip", "right_knee"]),
    ):
        singles = offered.singles(every[key])
        assert [p.at for p in singles] == names and not any(p.tied for p in singles)
        fitted = [sum(p.fitted) for p in (every[key], singles[0])]
        assert fitted[0] == fitted[1]
    assert [*offered.groups()] == ["*_hip", "*_knee"]


def test_a_next_test_is_chosen_for_the_first_of_like_places(tmp_path: Path) -> None:
    """Of commands that all come late, and of what may be in their place."""
    others = ["actuator_lag@*_hip", "actuator_lag@*_knee", "armature@left_knee"]
    late = {"effect": "actuator_delay", "at": "*", "indistinguishable": others}
    path = tmp_path / "gap.json"
    path.write_text(json.dumps({"effects": [late]}))
    pairs, strengths = from_gap(path, robot(), [])
    first = "actuator_delay@left_hip"
    lags = ["actuator_lag@left_hip", "actuator_lag@left_knee", "armature@left_knee"]
    assert pairs == [(first, k) for k in lags] + [(k, first) for k in lags]
    assert not strengths


def test_drives_that_are_all_alike_are_tied() -> None:
    """Two wheels; what all actuators have alike by itself is offered once."""
    wheel = """<body pos="0 {y} 1"><joint name="{n}_wheel" axis="0 1 0" {range}/>
    <geom size="0.1" mass="0.5"/></body>"""
    bodies = wheel.format(n="left", y=1, range='range="-70 10"')
    bodies += wheel.format(n="right", y=-1, range='range="-10 70"')
    drives = "".join(
        f'<motor name="{n}_motor" joint="{n}_wheel"/>' for n in ("left", "right")
    )
    m = mujoco.MjModel.from_xml_string(
        f'<mujoco><compiler autolimits="true"/><worldbody>{bodies}</worldbody>'
        f"<actuator>{drives}</actuator></mujoco>"
    )
    found = {p.key: p for p in places(m, scales_of(m, [recorded_of(m, 0)]))}
    assert found["actuator_gain@*_motor"].tied == ("left_motor", "right_motor")
    assert "actuator_delay@*_motor" not in found and "actuator_delay@" in found
    spring = found["joint_stiffness@*_wheel"]
    np.testing.assert_allclose(np.rad2deg(spring.rests), [-10.0, 10.0])
    assert not spring.possible(np.array([2.0, -0.5 * 2.0]))


def test_what_the_refit_does_at_one_place_is_not_offered_at_all(
    offered: dict[str, Place],
) -> None:
    p = Parameter("d", ("joint.left_knee.damping",), 0.1, (0.02, 0.5), (0.0, 1.0), "")
    space, m = ParameterSpace((p,)), robot()
    assert covered(offered["viscous_damping@*_knee"], space, m)
    assert not covered(offered["viscous_damping@*_hip"], space, m)


def test_the_tied_one_wins_where_it_predicts_as_well(offered: dict[str, Place]) -> None:
    loss = 1.0 + 0.01 * np.random.default_rng(0).normal(size=10)

    def with_(place: str, times: float) -> Model:
        model = of_loss(times * loss)
        model.places = [offered[place]]
        return model

    base, keys = of_loss(9 * loss), ("armature@left_knee", "armature@*_knee")
    for times, wins in ((1.02, 1), (2.0, 0)):
        one, tied = with_(keys[0], 1.0), with_(keys[1], times)
        scatter = 1 + 0.1 * np.cos(np.arange(10))
        tied.loss = tied.loss * scatter
        assert simplest([one, tied], base).places[0].key == keys[wins]


def write_logs(folder: Path, m: mujoco.MjModel, late: int = 0) -> list[Path]:
    """Two recordings of a machine whose commands arrive some rows late."""
    names = [m.joint(j).name for j in range(m.njnt)]
    head = ["time", *(f"qpos.{n}" for n in names), *(f"ctrl.{n}" for n in names)]
    for k in range(2):
        run = recorded_of(m, k, 400)
        sent = np.r_[run.ctrl[late:], np.repeat(run.ctrl[-1:], late, 0)]
        rows = np.c_[run.time, run.qpos, sent]
        text = {"delimiter": ",", "header": ",".join(head), "comments": ""}
        np.savetxt(folder / f"run{k}.csv", rows[: len(rows) - late], "%.9g", **text)
    return [folder / f"run{k}.csv" for k in range(2)]


def test_commands_that_all_come_late_are_one_entry(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Hips are like hips, and knees like knees: nothing is at a place of its own."""
    monkeypatch.setattr(
        *(effect_search, "places"),
        lambda *a: [p for p in places(*a) if p.effect == "actuator_delay"],
    )
    monkeypatch.setattr(effect_search, "ripples", lambda *a: [])
    (tmp_path / "robot.xml").write_text(robot_xml().format(more=""))
    logs, out = write_logs(tmp_path, robot(), late=1), tmp_path / "out"
    command(
        *(gap, "--model", tmp_path / "robot.xml", "--data", *logs, "--out", out),
        *("--engine", "mujoco"),
    )
    told = json.loads((out / "gap.json").read_text())
    (found,) = told["effects"]
    assert (found["effect"], found["at"]) == ("actuator_delay", "*")
    assert found["kind"] == "actuator" and len(found["places"]) == 4
    assert found["gap_after"] == pytest.approx(told["gap"]["after"])
    assert found["parameters"]["delay"]["value"] == pytest.approx(DT, rel=0.2)
    assert "4 actuators alike (" in (out / "report.html").read_text()
    entries = read_effects(out / "effects.yaml")[0]
    assert sorted(e.at for e in entries) == sorted(found["places"])


@pytest.mark.slow
def test_what_both_knees_have_is_named_once(tmp_path: Path) -> None:
    """Both knees turn heavier than the model says."""
    (tmp_path / "robot.xml").write_text(robot_xml().format(more=""))
    m = mujoco.MjModel.from_xml_string(robot_xml().format(more='armature="0.01"'))
    logs, out = write_logs(tmp_path, m), tmp_path / "out"
    command(
        *(gap, "--model", tmp_path / "robot.xml", "--data", *logs, "--out", out),
        *("--engine", "mujoco"),
    )
    told = json.loads((out / "gap.json").read_text())
    (found,) = told["effects"]
    assert (found["effect"], found["at"]) == ("armature", "*_knee")
    assert found["places"] == ["left_knee", "right_knee"]
    assert found["parameters"]["armature"]["value"] == pytest.approx(0.01, rel=0.05)
    mended = mujoco.MjModel.from_xml_path(str(out / "model.xml"))
    np.testing.assert_allclose(mended.dof_armature[[1, 3]], 0.01, rtol=0.05)
    found_effects = FoundEffects(tuple(read_effects(out / "effects.yaml")[0]))
    space, stay = joined(m, ParameterSpace(()), found_effects)
    assert not stay and [len(p.addresses) for p in space.parameters] == [2]
