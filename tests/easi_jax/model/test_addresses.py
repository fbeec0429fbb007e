import copy

import mujoco
import numpy as np
import pytest
from mujoco import mjx

from easi_jax.errors import UserError
from easi_jax.model.addresses import (
    describe,
    nominal,
    open_gates,
    places,
    resolve,
    split,
)
from easi_jax.model.quantities import SEED, TABLE

XML = """<mujoco><compiler autolimits="true"/>
  <option integrator="implicitfast"/>
  <worldbody>
  <geom name="floor" type="plane" size="1 1 1" friction="0.5"/>
  <geom name="wall" type="plane" size="1 1 1" pos="9 9 9" zaxis="0 1 0"
    friction="0.5" solref="-900 -30"/>
  <geom name="sign" size="0.1" contype="0" conaffinity="0"/>
  <body name="base" pos="0 0 1"><freejoint name="free"/>
    <geom name="base" type="box" size="0.1 0.1 0.1" friction="0.7"/>
    <body name="leg.left"><joint name="hip.left" axis="0 1 0" damping="0.3"/>
      <geom name="leg.left" type="capsule" size="0.02 0.1" friction="0.4"/></body>
    <body name="leg.right"><joint name="hip.right" axis="0 1 0" damping="0.3"/>
      <geom name="leg.right" type="capsule" size="0.02 0.1" friction="0.5"/>
      <geom name="knob" size="0.03"/></body>
    <body name="ghost"><joint name="ball" type="ball"/>
      <inertial pos="0 0 0" mass="0.1" diaginertia="1e-3 1e-3 1e-3"/></body>
  </body>
  <body name="post"><geom name="post" type="cylinder" size="0.02 0.1"/></body>
  </worldbody>
  <actuator>
    <position name="servo" joint="hip.left" kp="20" forcerange="-3 5"/>
    <motor name="motor" joint="hip.right"/>
    <velocity name="wheel" joint="hip.right" kv="2"/>
    <damper name="damper" joint="hip.right" kv="1" ctrlrange="0 1"/>
    <motor name="thruster" site="s" gear="0 0 1 0 0 0.1"/>
  </actuator></mujoco>""".replace(
    '<geom name="base"', '<site name="s"/><geom name="base"'
)


@pytest.fixture(scope="module")
def m() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(XML)


@pytest.mark.parametrize(
    ("address", "parts"),
    [
        ("joint.hip.damping", ("joint", "hip", "damping")),
        ("joint.hip.left.damping", ("joint", "hip.left", "damping")),
        ("option.gravity", ("option", "", "gravity")),
        ("geom.*.friction", ("geom", "*", "friction")),
    ],
)
def test_split(address: str, parts: tuple[str, str, str]) -> None:
    assert split(address) == parts


@pytest.mark.parametrize(
    ("address", "message"),
    [
        ("joints.hip.damping", 'unknown kind "joints".*did you mean "joint"'),
        ("joint.hip.left.dampng", 'no quantity "dampng".*did you mean "damping"'),
        ("joint.damping", "joint.NAME.QUANTITY"),
        ("", "unknown kind"),
        ("option.gravty", 'did you mean "gravity"'),
        ("joint.hip.lft.damping", 'names no joint.*did you mean "hip.left"'),
        ("joint.knee*.damping", "matches no joint of the model"),
        ("actuator.motor.kp", "no position servo"),
        ("actuator.servo.gain", "position servo: vary its kp"),
        ("actuator.wheel.gain", "velocity servo: vary its kv"),
        ("actuator.damper.kv", "not a fixed gain"),
        ("actuator.thruster.gear", "gear is a vector"),
        ("actuator.motor.time_constant", 'dyntype="filterexact"'),
        ("joint.ball.speed_limit", "only hinge and slide"),
        ("joint.free.springref", "only hinge and slide"),
        ("joint.hip.left.springref", "no stiffness"),
        ("body.post.mass", "cannot move"),
        ("body.world.mass", "names no body"),
        ("geom.sign.friction", "touches nothing"),
        ("geom.post.length", "cannot move"),
        ("geom.leg.right.length", "not that of this geom alone"),
        ("geom.base.length", "ambiguous"),
        ("geom.knob.length", "only a box"),
        ("geom.leg.left.friction", 'that of geom "floor" is not smaller'),
        ("option.viscosity", "implicitfast"),
    ],
)
def test_refused_with_the_reason(m: mujoco.MjModel, address: str, message: str) -> None:
    with pytest.raises(UserError, match=message) as error:
        resolve(m, [[address]])
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("flag", "address"),
    [
        ("frictionloss", "joint.hip.left.frictionloss"),
        ("damper", "joint.hip.left.damping"),
        ("spring", "joint.hip.left.damping"),  # MJX then leaves out both
        ("spring", "joint.hip.left.stiffness"),
        ("contact", "geom.base.friction"),
        ("actuation", "actuator.servo.kp"),
        ("gravity", "option.gravity"),
    ],
)
def test_refused_where_switched_off(flag: str, address: str) -> None:
    text = XML.replace(
        '<option integrator="implicitfast"/>',
        f'<option><flag {flag}="disable"/></option>',
    )
    off = mujoco.MjModel.from_xml_string(text)
    with pytest.raises(UserError, match=f'{flag}="disable"'):
        resolve(off, [[address]])


def test_patterns(m: mujoco.MjModel) -> None:
    both = places(m, "joint.hip.*.damping")
    assert [m.joint(i).name for _, _, i in both] == ["hip.left", "hip.right"]
    # what cannot have an effect is passed over
    masses = {m.body(i).name for _, _, i in places(m, "body.*.mass")}
    assert masses == {"base", "leg.left", "leg.right", "ghost"}
    rubbing = {m.geom(i).name for _, _, i in places(m, "geom.*.friction")}
    assert "sign" not in rubbing and {"floor", "base", "knob"} <= rubbing
    # what could, but not so, is not
    with pytest.raises(UserError, match="no position servo"):
        places(m, "actuator.*.kp")
    # varied together, neither geom hides the other
    assert resolve(
        m,
        [
            [
                "geom.leg.left.friction",
                "geom.floor.friction",
                "geom.wall.friction",
                "geom.post.friction",
            ]
        ],
    )


def test_special_characters_are_plain() -> None:
    m = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><body name="a[0]"><joint name="j[0]+"/>'
        '<geom size="1"/></body></worldbody></mujoco>'
    )
    assert places(m, "joint.j[0]*.damping") == places(m, "joint.j[0]+.damping")


@pytest.mark.parametrize(
    ("first", "second"),
    [
        ("joint.hip.left.damping", "joint.*.damping"),
        ("body.leg.left.com_z", "geom.leg.left.length"),
        ("actuator.wheel.kv", "actuator.*heel.kv"),
    ],
)
def test_one_number_has_one_owner(m: mujoco.MjModel, first: str, second: str) -> None:
    with pytest.raises(UserError, match="set the same number") as error:
        resolve(m, [[first], [second]])
    assert first in str(error.value) and second in str(error.value)
    if first.split(".")[-1] == second.split(".")[-1]:
        resolve(m, [[first, second]])  # tied, there is no conflict


def test_values_of_the_model(m: mujoco.MjModel) -> None:
    assert nominal(m, ["joint.hip.*.damping"]) == 0.3
    assert nominal(m, ["actuator.servo.kp"]) == 20
    assert nominal(m, ["actuator.servo.kv"]) == 0
    assert nominal(m, ["actuator.wheel.kv"]) == 2
    assert nominal(m, ["geom.leg.left.length"]) == pytest.approx(0.24)
    assert nominal(m, ["option.gravity"]) == pytest.approx(9.81)
    # solref 0.02 1: stiffness 1/(0.02)^2, damping 2/0.02
    assert nominal(m, ["geom.base.contact_stiffness"]) == pytest.approx(2500)
    assert nominal(m, ["geom.base.contact_damping"]) == pytest.approx(100)
    m = copy.deepcopy(m)
    m.geom_solref[m.geom("base").id] = 0.02, 0.0  # as stiff as can be said
    assert np.isfinite(nominal(m, ["geom.base.contact_stiffness"]))
    for address, message in (
        ("actuator.motor.force_limit", "states no value"),
        ("actuator.servo.force_limit", "not symmetric"),
        ("body.*.mass", "different values"),
    ):
        with pytest.raises(UserError, match=message):
            nominal(m, [address])


def test_units_and_bounds(m: mujoco.MjModel) -> None:
    assert describe(m, ["joint.hip.*.damping"]) == ("N m s/rad", (0.0, np.inf))
    assert describe(m, ["actuator.servo.kp"])[0] == "N m/rad"
    unit, (low, _) = describe(m, ["geom.leg.left.length"])
    assert (unit, low) == ("m", pytest.approx(0.04))  # a ball, then
    assert describe(m, ["body.base.com_x"])[1] == (-np.inf, np.inf)


@pytest.mark.parametrize(
    ("target", "unit"),
    [
        ('joint="ball"', "N m/ctrl"),
        ('tendon="hinges"', "N m/ctrl"),
        ('tendon="slides"', "N/ctrl"),
        ('tendon="both"', "N/ctrl"),
        ('tendon="cord"', "N/ctrl"),
    ],
)
def test_units_of_drives_that_pull_at_more_than_one_joint(
    target: str, unit: str
) -> None:
    def fixed(name: str, *joints: str) -> str:
        parts = "".join(f'<joint joint="{j}" coef="1"/>' for j in joints)
        return f'<fixed name="{name}">{parts}</fixed>'

    bodies = "".join(
        f'<body><joint name="{name}" type="{kind}"/><geom size=".1"/></body>'
        for name, kind in (("a", "hinge"), ("b", "hinge"), ("c", "slide"))
    )
    m = mujoco.MjModel.from_xml_string(
        f"""<mujoco><worldbody>{bodies}<site name="p"/><body><joint name="ball"
        type="ball"/><geom size=".1"/><site name="q" pos="0 0 1"/></body></worldbody>
        <tendon>{fixed("hinges", "a", "b")}{fixed("slides", "c")}{
            fixed("both", "a", "c")
        }<spatial name="cord"><site site="p"/><site site="q"/></spatial></tendon>
        <actuator><motor name="m" {target}/></actuator></mujoco>"""
    )
    assert describe(m, ["actuator.m.gain"])[0] == unit


def test_open_gates_copies_and_opens(m: mujoco.MjModel) -> None:
    opened = open_gates(
        m,
        [
            "joint.hip.left.frictionloss",
            "actuator.motor.force_limit",
            "actuator.motor.kv",
            "geom.base.contact_stiffness",
        ],
    )
    dof, motor = m.joint("hip.left").dofadr[0], m.actuator("motor").id
    assert (m.dof_frictionloss[dof], opened.dof_frictionloss[dof]) == (0, SEED)
    assert not m.actuator_forcelimited[motor] and opened.actuator_forcelimited[motor]
    assert opened.actuator_forcerange[motor, 1] >= 1e6
    assert opened.actuator_biastype[motor] == mujoco.mjtBias.mjBIAS_AFFINE
    assert opened.geom_solref[m.geom("base").id].tolist() == [-2500, -100]
    assert opened.opt.viscosity == m.opt.viscosity == 0
    # as good as the original
    for start in (0.3, -2.0):
        ends = []
        for model in (m, opened):
            model = copy.deepcopy(model)
            model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
            d = mujoco.MjData(model)
            d.qvel[-5:], d.ctrl[:] = start, 0.3
            for _ in range(100):
                mujoco.mj_step(model, d)
            ends.append(np.concatenate([d.qpos, d.qvel]))
        np.testing.assert_allclose(*ends, atol=1e-5)


def test_contact_needs_a_geom_that_decides() -> None:
    text = """<mujoco><worldbody>
      <geom name="floor" type="plane" size="1 1 1" priority="{}"/>
      <body name="b" pos="0 0 1"><freejoint/>
        <geom name="ball" size="0.1" condim="{}"/></body></worldbody></mujoco>"""
    over = mujoco.MjModel.from_xml_string(text.format(1, 3))
    assert resolve(over, [["geom.floor.friction"]])
    with pytest.raises(UserError, match="priority"):
        resolve(over, [["geom.ball.friction"]])
    smooth = mujoco.MjModel.from_xml_string(
        text.format(0, 3)
        .replace("<geom", "<geom condim='1'", 1)
        .replace('condim="3"', 'condim="1"')
    )
    with pytest.raises(UserError, match="condim 1"):
        resolve(smooth, [["geom.ball.friction"]])
    assert resolve(smooth, [["geom.ball.contact_stiffness"]])


def test_every_entry_is_a_leaf_of_mjx() -> None:
    """A misspelt or static field would fail only when it is first used."""
    leaves = {f.name for f in mjx.Model.fields()} | {"speed_limit"}
    options = {f.name for f in mjx._src.types.Option.fields()}
    m = mujoco.MjModel.from_xml_string(XML)
    for kind, rows in TABLE.items():
        for name, row in rows.items():
            for entry in row.entries(m, 0):
                head, _, tail = entry.field.partition(".")
                assert head in leaves | {"opt"}, (kind, name)
                assert not tail or tail in options, (kind, name)
