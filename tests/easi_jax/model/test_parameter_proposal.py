"""Proposals: what moves something, tied only where it is alike, read back as it is."""

from pathlib import Path

import mujoco
import numpy as np
import pytest

from easi_jax.io.models.parameter_file import read_parameter_file
from easi_jax.model.addresses import resolve
from easi_jax.model.mujoco_warnings import warnings_to
from easi_jax.model.parameter_proposal import as_text, propose, space_of

LINK = '<geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.02" mass="0.5"/>'
TINY = f"""<mujoco><worldbody><body name="arm"><joint name="j" axis="0 1 0"/>{LINK}
<body name="frame" pos="0 0 -0.3"><joint name="k" axis="0 1 0" armature="0.01"/>
<inertial pos="0 0 0" mass="{{}}" diaginertia="1e-6 1e-6 1e-6"/></body></body>
</worldbody><actuator><motor name="a" joint="j"/></actuator></mujoco>"""
CHAIN = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
LEGS = ("FL", "FR", "RL", "RR")


def serial() -> str:
    """An arm whose joints have the same numbers."""
    bodies = "".join(
        f'<body name="{n}_link" pos="0 0 -0.3"><joint name="{n}_joint" axis="0 1 0" '
        f'damping="0.1"/>{LINK}'
        for n in CHAIN
    )
    drives = "".join(f'<position name="{n}" joint="{n}_joint" kp="50"/>' for n in CHAIN)
    return (
        f"<mujoco><worldbody>{bodies}{'</body>' * len(CHAIN)}</worldbody>"
        f"<actuator>{drives}</actuator></mujoco>"
    )


def legged(odd: str = "") -> str:
    """Four legs, hips of the right ones mirrored, calves of the rear ones mounted
    turned; ``odd`` has another damping."""
    legs, drives = "", ""
    for n in LEGS:
        side = 1 if n[1] == "L" else -1
        ends = (-0.5, 0.9) if side > 0 else (-0.9, 0.5)
        calf = (-0.4, 2.2) if n[0] == "F" else (0.647, 3.247)
        damping = 0.7 if n == odd else 0.2
        legs += f"""<body name="{n}_hip" pos="0 {side * 0.1} 0"><joint
name="{n}_hip_joint" axis="1 0 0" damping="{damping}" range="{ends[0]} {ends[1]}"/>
{LINK}<body name="{n}_calf" pos="0 0 -0.3"><joint name="{n}_calf_joint" axis="0 1 0"
damping="0.2" range="{calf[0]} {calf[1]}"/>{LINK}</body></body>"""
        for part in ("hip", "calf"):
            drives += (
                f'<position name="{n}_{part}" joint="{n}_{part}_joint" kp="20" '
                'forcerange="-23 23"/>'
            )
    return f"""<mujoco><compiler angle="radian"/><worldbody><geom name="floor"
type="plane" size="5 5 .1"/><body name="trunk" pos="0 0 1"><freejoint/>
<geom size=".1 .1 .05" type="box" mass="5"/>{legs}</body></worldbody>
<actuator>{drives}</actuator></mujoco>"""


MODELS = {
    "tiny body": TINY.format("1e-6"),
    "light body": TINY.format("0.003"),
    "serial arm": serial(),
    "legs": legged(),
    "negative gain": f"""<mujoco><worldbody><body name="b"><joint name="j"/>{LINK}
</body></worldbody><actuator><general name="a" joint="j" gainprm="-3"/>
<motor name="idle" joint="j" gear="0"/></actuator></mujoco>""",
    "far scales": """<mujoco><worldbody><body name="big"><joint name="j" type="slide"
damping="1e-9" frictionloss="123456.789"/><geom size="3" mass="7654321.123"/></body>
<body name="small"><joint name="k" damping="3.3e-13"/><geom size=".001" pos=".01 0 0"
mass="2.34567e-6"/></body></worldbody><actuator><position name="a" joint="j"
kp="1e10"/><velocity name="v" joint="k" kv="1e-12"/></actuator></mujoco>""",
    "odd names": f"""<mujoco><worldbody><body name="a b"><joint name="j[0].x"/>{LINK}
<body name="c" pos="0 0 -.3"><joint name="j[1].x" type="slide"/>{LINK}</body></body>
</worldbody><actuator><motor name="m:1" joint="j[0].x" forcelimited="true"
forcerange="-2 2"/></actuator></mujoco>""",
    "passive, no gravity": f"""<mujoco><option gravity="0 0 0"/><worldbody>
<body name="b"><joint name="j"/>{LINK}</body></worldbody></mujoco>""",
}


def addresses(xml: str, tie: bool = True) -> list[str]:
    m = mujoco.MjModel.from_xml_string(xml)
    return [p.parameter.addresses[0] for p in propose(m, tie)]


@pytest.mark.parametrize("tie", [True, False])
@pytest.mark.parametrize("name", MODELS)
def test_the_reader_accepts_what_is_proposed(
    name: str, tie: bool, tmp_path: Path
) -> None:
    m = mujoco.MjModel.from_xml_string(MODELS[name])
    proposals = propose(m, tie)
    path = tmp_path / "p.yaml"
    path.write_text(as_text(proposals, ["head"], {}))
    read = read_parameter_file(path, m)
    want = space_of(proposals)
    assert read.names == want.names and read.addresses == want.addresses
    np.testing.assert_array_equal(read.nominal, want.nominal)
    np.testing.assert_array_equal(read.initial, want.initial)
    np.testing.assert_array_equal(read.bounds, want.bounds)
    resolve(m, read.addresses)  # no two set the same number


def test_joints_of_a_chain_are_apart() -> None:
    found = addresses(MODELS["serial arm"])
    assert not [a for a in found if "*" in a]
    assert {f"joint.{n}_joint.damping" for n in CHAIN} <= {*found}


def test_legs_are_tied_and_can_be_parted() -> None:
    m = mujoco.MjModel.from_xml_string(MODELS["legs"])
    proposals = {p.parameter.addresses[0]: p for p in propose(m)}
    assert proposals["joint.*_calf_joint.damping"].tied == tuple(
        f"{n}_calf_joint" for n in LEGS
    )
    assert {"joint.*_hip_joint.damping", "actuator.*_hip.kp"} <= proposals.keys()
    assert "body.*_calf.mass" in proposals
    text = as_text(list(proposals.values()), [], {})
    assert "# one value for FL_hip, FR_hip, RL_hip, RR_hip" in text
    apart = addresses(MODELS["legs"], tie=False)
    assert not [a for a in apart if "*" in a]
    assert {f"joint.{n}_calf_joint.damping" for n in LEGS} <= {*apart}


def test_a_leg_of_its_own_is_not_tied() -> None:
    found = addresses(legged(odd="RR"))
    assert "joint.RR_hip_joint.damping" in found
    assert "joint.*_hip_joint.damping" not in found
    assert "joint.*_calf_joint.damping" in found


def test_drives_of_another_kind_are_not_tied() -> None:
    """A filter before one of two muscles."""
    kinds = (
        '<motor name="pull_a" joint="a"/><motor name="pull_b" joint="b"/>',
        '<motor name="pull_a" joint="a"/><general name="pull_b" joint="b" '
        'dyntype="filter" dynprm="0.02"/>',
    )
    like, unlike = (
        addresses(
            f"""<mujoco><worldbody><body><joint name="a"/>{LINK}</body>
            <body pos="1 0 0"><joint name="b"/>{LINK}</body></worldbody>
            <actuator>{drives}</actuator></mujoco>"""
        )
        for drives in kinds
    )
    assert [a for a in like if a == "actuator.pull_*.gain"]
    assert {"actuator.pull_a.gain", "actuator.pull_b.gain"} <= {*unlike}


def test_what_moves_nothing_is_left_out() -> None:
    """A body of a milligram, a base that is fixed, a drive without gear."""
    assert "body.frame.mass" not in addresses(MODELS["tiny body"])
    assert "body.frame.mass" in addresses(MODELS["light body"])
    fixed = f"""<mujoco><worldbody><body name="base">{LINK}<body name="mast">{LINK}
    <body name="arm"><joint name="j" axis="0 1 0"/>{LINK}</body></body></body>
    </worldbody></mujoco>"""
    found = addresses(fixed)
    assert "body.arm.mass" in found
    assert not {"body.base.mass", "body.mast.mass"} & {*found}
    assert not [a for a in addresses(MODELS["negative gain"]) if "idle" in a]


def test_masses_that_only_their_own_joint_moves_are_proposed() -> None:
    """A carriage on its slide and a turntable, whose inertia MuJoCo keeps apart; and no
    model without inertia is simulated on the way."""
    xml = f"""<mujoco><worldbody>
      <body name="carriage"><joint name="x" type="slide" axis="1 0 0"/>{LINK}</body>
      <body name="table" pos="0 1 0"><joint name="z" axis="0 0 1"/>
        <geom type="cylinder" size=".2 .02" mass="2"/></body>
    </worldbody></mujoco>"""
    said: list[str] = []
    with warnings_to(said.append):
        found = addresses(xml)
    assert {"body.carriage.mass", "body.table.mass"} <= {*found}
    assert not said


@pytest.mark.parametrize("name", ['m"1', "a\\left", "leg[0]", "ä b"])
def test_odd_names_are_read_back(name: str, tmp_path: Path) -> None:
    spec = mujoco.MjSpec.from_string(MODELS["serial arm"])
    spec.actuators[0].name = name
    m = spec.compile()
    path = tmp_path / "p.yaml"
    path.write_text(as_text(propose(m), [], {}), encoding="utf-8")
    assert read_parameter_file(path, m).addresses == space_of(propose(m)).addresses


def test_ranges_follow_the_inertia_where_nothing_weighs() -> None:
    """A rotor that carries a milligram."""
    m = mujoco.MjModel.from_xml_string(MODELS["tiny body"])
    found = {p.parameter.name: p.parameter for p in propose(m)}
    for quantity in ("damping", "frictionloss"):
        # Torque at 10 rad/s against what turns the rotor to that speed in a second.
        low, high = found[f"k_{quantity}"].initial
        speed = 10 if quantity == "damping" else 1
        assert low * speed < 0.01 * 0.1 < 0.5 * high * speed < 0.1
