"""A written model, loaded again, has every number that was meant.

What is meant is said here by hand, in the arrays of the compiled model, for each kind
of number that MuJoCo derives from others when it compiles.
"""

from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np
import pytest

from easi_jax.errors import UserError
from easi_jax.export.mjcf import identified_model
from easi_jax.io.models.mjcf import read_mjcf
from easi_jax.io.models.repaired_mjcf import deviations, repaired_model
from easi_jax.model.found_effects import EffectEntry
from easi_jax.model.parameters import ParameterSpace, declare
from easi_jax.simulation.simulator import Simulator

ROD = '<geom type="capsule" fromto="0 0 0 0 0.01 -0.2" size="0.02" mass="0.3"/>'
MOTOR = '<motor name="a" joint="j" ctrlrange="-1 1"/>'
JOINT = '<joint name="j" axis="0 1 0"/>'


def one(
    head: str = "",
    joint: str = JOINT,
    body: str = ROD,
    drive: str = MOTOR,
    tail: str = "",
) -> str:
    return f"""<mujoco>{head}<worldbody><body name="link">{joint}{body}
<body name="tip" pos="0 0 -.2" euler="10 20 30"><joint name="k" axis="0 1 0"/>
<geom name="end" size="0.013" pos="0.01 0 0"/></body></body></worldbody>
<actuator>{drive}</actuator>{tail}</mujoco>"""


ROOT = Path(__file__).parents[4]
KINDS = {
    "plain": one(),
    "fullinertia": one(
        body='<inertial pos="0 0 -0.1" mass="0.5" '
        'fullinertia="0.004 0.003 0.0015 1e-4 2e-4 3e-4"/><geom size="0.02"/>'
    ),
    "dampratio": one(
        joint='<joint name="j" axis="0 1 0" armature="0.01"/>',
        drive='<position name="a" joint="j" kp="20" dampratio="1" ctrlrange="-1 1"/>',
    ),
    "inheritrange": one(
        '<compiler inertiagrouprange="0 0"/>',
        '<joint name="j" axis="0 1 0" range="-90 80"/>',
        ROD + '<geom type="box" size="0.1 0.1 0.1" group="2" contype="0"/>',
        '<position name="a" joint="j" kp="20" inheritrange="0.9"/>',
    ),
    "inertiafromgeom": one(
        '<compiler inertiafromgeom="true"/>',
        body='<inertial pos="0 0 0" mass="9" diaginertia="1 1 1"/>' + ROD,
    ),
    "settotalmass": one(
        '<compiler boundmass="0.05" boundinertia="0.001" settotalmass="2"/>'
    ),
    "balanceinertia": one(
        '<compiler balanceinertia="true"/>',
        body='<inertial pos="0 0 -.1" mass="1" diaginertia="0.1 0.1 1"/>',
    ),
    "timeconst": one(
        drive='<position name="a" joint="j" kp="20" kv="1" timeconst="0.05"/>'
    ),
    "springdamper": one(joint='<joint name="j" axis="0 1 0" springdamper="0.3 0.8"/>'),
    "degrees and defaults": one(
        '<default><joint damping="0.1" stiffness="2" range="-60 50"/>'
        '<default class="wide"><joint range="-120 100" armature="0.02"/></default>'
        "</default>",
        '<joint name="j" class="wide" axis="0 1 0" springref="10" ref="5"/>',
    ),
    "numbers of many digits": one(
        "<option timestep='0.00123456789012'/>",
        '<joint name="j" axis="0.1 1 0.3" damping="0.12345678901234"/>',
    ),
    "tendon": one(
        drive='<position name="a" tendon="t" kp="3" dampratio="0.5"/>',
        tail='<tendon><fixed name="t" stiffness="2"><joint joint="j" coef="1"/>'
        '<joint joint="k" coef="-.5"/></fixed></tendon>',
    ),
    "free body": one(joint='<freejoint name="f" align="true"/>', drive=""),
    "key frames": one(
        tail='<keyframe><key name="home" qpos="0.1 0.2" ctrl="0.3"/></keyframe>'
    ),
}


@pytest.fixture
def file(tmp_path: Path) -> Callable[[str], Path]:
    def write(xml: str) -> Path:
        path = tmp_path / "robot.xml"
        path.write_text(xml)
        return path

    return write


def same(got: mujoco.MjModel, want: mujoco.MjModel) -> None:
    """Every array of numbers, found by its type."""
    for name in dir(want):
        b = None if name[0] == "_" else getattr(want, name)
        if not isinstance(b, np.ndarray) or b.dtype.kind not in "fiub":
            continue
        if "adr" not in name or name in ("jnt_qposadr", "jnt_dofadr"):
            np.testing.assert_allclose(getattr(got, name), b, 1e-9, 1e-12, err_msg=name)
    for name in ("gravity", "timestep", "integrator", "disableflags"):
        np.testing.assert_allclose(
            getattr(got.opt, name), getattr(want.opt, name), 1e-12
        )


def moved(m: mujoco.MjModel) -> None:
    """Other masses, gains and friction, as a search leaves them."""
    m.body_mass[1] *= 1.2345678901
    m.body_inertia[1] *= 1.2345678901
    m.body_ipos[-1, 0] += 0.0123456789
    m.dof_armature[-1] += 0.0212345678
    m.dof_damping[-1] = 0.3123456789
    m.dof_frictionloss[-1] = 0.1123456789
    m.geom_friction[0, 0] = 0.3123456789
    if m.nu:
        m.actuator_gainprm[0, 0] *= 1.1123456789
        m.actuator_forcelimited[0] = True
        m.actuator_forcerange[0] = -3.1, 2.9
    m.opt.gravity[:] = 0.1234567891, 0.3, -9.7
    mujoco.mj_setConst(m, mujoco.MjData(m))


@pytest.mark.parametrize("kind", KINDS)
def test_identified_numbers(kind: str, file: Callable[[str], Path]) -> None:
    path = file(KINDS[kind])
    want = mujoco.MjModel.from_xml_path(str(path))
    moved(want)
    got = repaired_model(path, [], want)
    assert got.left == []
    same(mujoco.MjModel.from_xml_string(got.xml), want)


@pytest.mark.parametrize(
    "name",
    [
        *("fullinertia", "dampratio", "inertiafromgeom", "settotalmass"),
        *("inheritrange", "timeconst"),
    ],
)
def test_models_as_people_have_them(name: str) -> None:
    path = ROOT.parent / "shared" / "cases" / "model_xml" / f"{name}.xml"
    if not path.exists():
        pytest.skip("../shared/cases is not here")
    want = mujoco.MjModel.from_xml_path(str(path))
    moved(want)
    got = repaired_model(path, [], want)
    assert got.left == []
    same(mujoco.MjModel.from_xml_string(got.xml), want)


SCALED = EffectEntry("actuator_gain", "a", "actuator", {"gain": 0.85}, {})
LIMIT = EffectEntry("actuator_saturation", "a", "actuator", {"limit": 2.0}, {})
DRY = EffectEntry("coulomb_friction", "k", "joint", {"coulomb": 0.05}, {})
ROTOR = EffectEntry("armature", "k", "joint", {"armature": 0.02}, {})
LOAD = EffectEntry("payload_mass", "link", "body", {"mass": 0.2, "spread": 1}, {})
SHIFT = EffectEntry("com_offset", "link", "body", {"com.0": 0.01}, {})
GRIP = EffectEntry("contact_friction", "", "model", {"friction": 0.5}, {})
SPRING = EffectEntry(
    *("joint_stiffness", "k", "joint", {"stiffness": 1.0, "spring": 0.2}, {})
)


@pytest.mark.parametrize("kind", KINDS)
def test_effects(kind: str, file: Callable[[str], Path]) -> None:
    path = file(KINDS[kind])
    want = mujoco.MjModel.from_xml_path(str(path))
    # What springdamper and dampratio gave stays, whatever the load is.
    d, j, old = want.joint("k").dofadr[0], want.joint("k").id, want.body_mass[1]
    want.dof_frictionloss[d] += 0.05
    want.dof_armature[d] += 0.02
    want.body_mass[1] += 0.2
    want.body_inertia[1] *= 1 + 0.2 / old
    want.body_ipos[1, 0] += 0.01
    want.geom_friction[:, 0] *= 0.5
    k = want.jnt_stiffness[j] + 1.0
    q = want.jnt_qposadr[j]
    want.qpos_spring[q] = (want.jnt_stiffness[j] * want.qpos_spring[q] + 0.2) / k
    want.jnt_stiffness[j] = k
    entries = [DRY, LOAD, ROTOR, SHIFT, GRIP, SPRING]
    if want.nu:
        entries += [SCALED, LIMIT]
        want.actuator_gainprm[0, :3] *= 0.85
        want.actuator_forcelimited[0] = True
        want.actuator_forcerange[0] = -2, 2
    mujoco.mj_setConst(want, mujoco.MjData(want))
    got = repaired_model(path, entries)
    assert got.left == []
    same(mujoco.MjModel.from_xml_string(got.xml), want)


def test_a_force_limit_only_narrows(file: Callable[[str], Path]) -> None:
    """As in the simulator: what the drive cannot give stays so."""
    drive = '<motor name="a" joint="j" forcerange="-1 3"/>'
    got = repaired_model(file(one(drive=drive)), [LIMIT])
    m = mujoco.MjModel.from_xml_string(got.xml)
    np.testing.assert_allclose(m.actuator_forcerange[0], [-1, 2])


def test_lag_and_delay_leave_the_rest(file: Callable[[str], Path]) -> None:
    path = file(KINDS["key frames"])
    entries = [
        EffectEntry("actuator_lag", "a", "actuator", {"lag": 0.03}, {}),
        EffectEntry("actuator_delay", "a", "actuator", {"delay": 0.01}, {}),
    ]
    got = repaired_model(path, entries)
    assert got.left == []
    m = mujoco.MjModel.from_xml_string(got.xml)
    assert m.na == 1 and m.actuator_dynprm[0, 0] == 0.03
    assert m.actuator_delay[0] == 0.01 and m.actuator_history[0, 0] >= 6
    np.testing.assert_allclose(m.key_qpos[0], [0.1, 0.2])
    np.testing.assert_allclose(m.key_ctrl[0], [0.3])


def test_a_key_frame_is_at_rest_behind_a_lag(file: Callable[[str], Path]) -> None:
    """The command has arrived, as far as its range goes; other activations stay."""
    drives = MOTOR + (
        '<general name="f" joint="k" dyntype="filter" dynprm="0.1"/>'
        '<motor name="c" joint="k"/>'
    )
    keys = '<keyframe><key ctrl="1.5 0.4 0.5" act="0.7"/><key/></keyframe>'
    lags = [EffectEntry("actuator_lag", a, "actuator", {"lag": 0.03}, {}) for a in "ca"]
    got = repaired_model(file(one(drive=drives, tail=keys)), lags)
    assert got.left == []
    m = mujoco.MjModel.from_xml_string(got.xml)
    np.testing.assert_allclose(m.key_act, [[1.0, 0.7, 0.5], [0.0, 0.0, 0.0]])


def test_a_lag_before_a_filter_is_left(file: Callable[[str], Path]) -> None:
    entry = EffectEntry("actuator_lag", "a", "actuator", {"lag": 0.03}, {})
    got = repaired_model(file(KINDS["timeconst"]), [entry, DRY])
    assert got.left == ["actuator_lag@a"]
    m = mujoco.MjModel.from_xml_string(got.xml)
    assert m.actuator_dynprm[0, 0] == 0.05
    assert m.joint("k").frictionloss[0] == 0.05


def test_places_without_a_name(file: Callable[[str], Path]) -> None:
    """They have the name that they are read with."""
    path = file(one(joint='<joint axis="0 1 0"/>', drive=""))
    name = read_mjcf(path, tell=lambda _: None).joint(0).name
    entry = EffectEntry("viscous_damping", name, "joint", {"damping": 0.2}, {})
    got = repaired_model(path, [entry])
    assert got.left == []
    assert mujoco.MjModel.from_xml_string(got.xml).dof_damping[0] == 0.2


def test_softer_contacts_where_the_time_constant_is_the_least_that_is_safe(
    file: Callable[[str], Path],
) -> None:
    """Half the damping is a longer time constant; twice has to be said directly."""
    for factor, solref in ((0.5, [0.08, 0.5]), (2.0, [-625.0, -100.0])):
        path = file(one("<option timestep='0.02'/>"))
        columns = {"softness.0": 1.0, "softness.1": factor}
        entry = EffectEntry("contact_softness", "", "model", columns, {})
        got = repaired_model(path, [entry])
        assert got.left == []
        m = mujoco.MjModel.from_xml_string(got.xml)
        np.testing.assert_allclose(m.geom_solref[0], solref)


def test_what_differs_is_listed(file: Callable[[str], Path]) -> None:
    m = mujoco.MjModel.from_xml_path(str(file(KINDS["plain"])))
    other = mujoco.MjModel.from_xml_path(str(file(KINDS["plain"])))
    assert deviations(m, other) == []
    other.body_mass[1] = 0.4
    other.actuator_ctrllimited[0] = False
    other.opt.timestep = 0.004
    assert deviations(m, other) == [
        "actuator_ctrllimited of a: 1 in place of 0",
        "body_mass of link: 0.3 in place of 0.4",
        "opt.timestep: 0.002 in place of 0.004",
    ]


def test_what_mjcf_cannot_say_is_listed(file: Callable[[str], Path]) -> None:
    """A number that MuJoCo always computes from others."""
    path = file(KINDS["plain"])
    want = mujoco.MjModel.from_xml_path(str(path))
    want.body_invweight0[1] = 7.0
    want.dof_damping[0] = 0.25
    got = repaired_model(path, [], want)
    assert mujoco.MjModel.from_xml_string(got.xml).dof_damping[0] == 0.25
    assert got.left and all("body_invweight0 of link" in x for x in got.left)


def test_numbers_read_as_people_write_them(file: Callable[[str], Path]) -> None:
    xml = repaired_model(file(KINDS["plain"]), [DRY]).xml
    assert 'frictionloss="0.05"' in xml and 'mass="0.3"' in xml
    assert "00000000" not in xml and "99999999" not in xml


def test_nothing_is_left_in_the_working_folder(
    file: Callable[[str], Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """MuJoCo writes its warnings to a file unless it is told not to."""
    path = file(KINDS["settotalmass"])
    empty = tmp_path / "empty"
    empty.mkdir()
    monkeypatch.chdir(empty)
    repaired_model(path, [DRY])
    assert list(empty.iterdir()) == []


def test_a_gain_beside_a_damping_ratio_as_identified(
    file: Callable[[str], Path],
) -> None:
    """In double precision, although simulations have less."""
    path = file(KINDS["dampratio"])
    m = mujoco.MjModel.from_xml_path(str(path))
    space = ParameterSpace((declare(m, "kp", "actuator.a.kp"),))
    theta = np.array([23.456789012345])
    got = identified_model(path, Simulator(m, space, 0.002), theta, [LOAD])
    assert got.left == []
    new = mujoco.MjModel.from_xml_string(got.xml)
    np.testing.assert_allclose(new.actuator_gainprm[0, 0], theta[0], 1e-12)
    np.testing.assert_allclose(
        new.actuator_biasprm[0, 1:3], [-theta[0], m.actuator_biasprm[0, 2]], 1e-12
    )
    np.testing.assert_allclose(new.body_mass[1], 0.5, 1e-12)


def test_a_model_that_mujoco_cannot_write(file: Callable[[str], Path]) -> None:
    path = file("<mujoco><worldbody><body><joint/></body></worldbody></mujoco>")
    with pytest.raises(UserError, match=r"robot\.xml: MuJoCo cannot write"):
        repaired_model(path, [])


def test_a_delay_acts_between_two_steps_and_adds_to_the_models(
    file: Callable[[str], Path],
) -> None:
    drive = '<motor name="a" joint="j" delay="0.01" nsample="8"/>'
    late = EffectEntry("actuator_delay", "a", "actuator", {"delay": 0.005}, {})
    m = mujoco.MjModel.from_xml_string(
        repaired_model(file(one(drive=drive)), [late]).xml
    )
    assert m.actuator_delay[0] == pytest.approx(0.015)
    plain = '<motor name="a" joint="j"/>'
    m = mujoco.MjModel.from_xml_string(
        repaired_model(file(one(drive=plain)), [late]).xml
    )
    d, force = mujoco.MjData(m), []
    d.ctrl[0] = 1.0
    for _ in range(5):
        mujoco.mj_step(m, d)
        force.append(float(d.actuator_force[0]))
    steps = 0.005 / m.opt.timestep
    want = np.clip(np.arange(5) - steps + 1, 0, 1)
    np.testing.assert_allclose(force, want, atol=1e-6)
    # Less than a step MuJoCo cannot say.
    short = EffectEntry("actuator_delay", "a", "actuator", {"delay": 1e-4}, {})
    got = repaired_model(file(one(drive=plain)), [short])
    assert got.left == ["actuator_delay@a"]
