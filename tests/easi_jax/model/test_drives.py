"""Effects of drives: where they are offered, what they do to each kind of drive, in a
simulation and in a written model."""

from pathlib import Path

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from easi_jax.errors import UserError
from easi_jax.io.models.repaired_mjcf import repaired_model
from easi_jax.model import addresses, effects
from easi_jax.model.effect_catalog import CATALOG, Spot
from easi_jax.model.effect_numbers import EffectEntry
from easi_jax.model.native_model import NativeModel, Template
from tests.easi_jax.model.test_effect_catalog import scales

COLUMNS = {
    "drive_stiffness": "kp",
    "drive_damping": "kv",
    "actuator_strength": "strength",
}
# What a factor of 0.5 makes of a drive; effects that have no meaning there, or are
# another's twin, are left out.
DRIVES = {
    '<position {at} kp="4" kv="0.2"/>': {
        "drive_stiffness": '<position {at} kp="2" kv="0.2"/>',
        "drive_damping": '<position {at} kp="4" kv="0.1"/>',
        "actuator_strength": '<position {at} kp="2" kv="0.1"/>',
    },
    '<position {at} kp="4"/>': {"drive_stiffness": '<position {at} kp="2"/>'},
    '<velocity {at} kv="0.6"/>': {"drive_damping": '<velocity {at} kv="0.3"/>'},
    '<intvelocity {at} kp="4" kv="0.2" actrange="-1 1"/>': {
        "drive_stiffness": '<intvelocity {at} kp="2" kv="0.2" actrange="-1 1"/>',
        "drive_damping": '<intvelocity {at} kp="4" kv="0.1" actrange="-1 1"/>',
        "actuator_strength": '<intvelocity {at} kp="2" kv="0.1" actrange="-1 1"/>',
    },
    # A limit of the force stays.
    '<position {at} kp="4" kv="0.2" gear="3" timeconst="0.03" forcerange="-1 2"/>': {
        "actuator_strength": '<position {at} kp="2" kv="0.1" gear="3" timeconst="0.03" '
        'forcerange="-1 2"/>'
    },
    # It aims at half of the command and 0.2 more.
    '<general {at} gainprm="2" biastype="affine" biasprm="0.8 -4 -0.2"/>': {
        "drive_stiffness": '<general {at} gainprm="1" biastype="affine" '
        'biasprm="0.4 -2 -0.2"/>'
    },
    # MuJoCo makes a rate gain of 0.8 of the damping ratio.
    '<position {at} kp="4" dampratio="{ratio}"/>': {
        "drive_stiffness": '<position {at} kp="2" kv="0.8"/>',
        "drive_damping": '<position {at} kp="4" kv="0.4"/>',
        "actuator_strength": '<position {at} kp="2" kv="0.4"/>',
    },
    "<motor {at}/>": {},
    '<damper {at} kv="1" ctrlrange="0 1"/>': {},
}
CASES = [(d, e) for d, made in DRIVES.items() for e in made]


def xml(drive: str, at: str = 'joint="j"') -> str:
    at = f'name="a" {at}'
    ratio = 0.8 / (2 * np.sqrt(4 * 0.05))  # by the inertia that the actuator moves
    return f"""<mujoco><worldbody><body><joint name="j" axis="0 1 0"/>
<inertial pos="0 0 0" mass="1" diaginertia="0.05 0.05 0.05"/></body></worldbody>
<tendon><fixed name="t"><joint joint="j" coef="1"/></fixed></tendon>
<actuator>{drive.format(at=at, ratio=ratio)}</actuator></mujoco>"""


@pytest.mark.parametrize("at", ['joint="j"', 'tendon="t"'])
@pytest.mark.parametrize(("drive", "effect"), CASES)
def test_as_mujoco_compiles_it(
    drive: str, effect: str, at: str, tmp_path: Path
) -> None:
    given = mujoco.MjModel.from_xml_string(xml(drive, at))
    want = mujoco.MjModel.from_xml_string(xml(DRIVES[drive][effect], at))
    column = COLUMNS[effect]
    e = effects.none(given).replace(**{column: jnp.array([0.5])})
    m = effects.with_effects(NativeModel(Template(given, False)), e, (column,))  # type: ignore[arg-type]
    path = tmp_path / "robot.xml"
    path.write_text(xml(drive, at))
    entry = EffectEntry(effect, "a", "actuator", {column: 0.5}, {})
    written = repaired_model(path, [entry])
    assert written.left == []
    read = mujoco.MjModel.from_xml_string(written.xml)
    for name in ("actuator_gainprm", "actuator_biasprm", "actuator_forcerange"):
        meant = getattr(want, name)
        np.testing.assert_allclose(getattr(m, name), meant, 1e-6, err_msg=name)
        np.testing.assert_allclose(getattr(read, name), meant, 1e-9, err_msg=name)
    np.testing.assert_allclose(read.actuator_dynprm, want.actuator_dynprm)


def test_both_gains_by_the_same_factor_are_the_strength() -> None:
    m = mujoco.MjModel.from_xml_string(xml(next(iter(DRIVES))))
    same = jnp.array([0.6])
    made = [
        effects.with_effects(NativeModel(Template(m, False)), e)  # type: ignore[arg-type]
        for e in (
            effects.none(m).replace(kp=same, kv=same),
            effects.none(m).replace(strength=same),
        )
    ]
    for name in ("actuator_gainprm", "actuator_biasprm"):
        np.testing.assert_allclose(getattr(made[0], name), getattr(made[1], name))


@pytest.mark.parametrize("drive", DRIVES)
def test_where_they_are_offered(drive: str) -> None:
    """Each wherever it is not another one's twin; a motor has its gain alone."""
    m = mujoco.MjModel.from_xml_string(xml(drive))
    spot = Spot(m, "actuator", 0, scales(m))
    found = {e for e in COLUMNS if CATALOG[e].sites["actuator"].offered(spot)}
    if "gear" in drive or "general" in drive:
        assert found == {*COLUMNS}
    else:
        assert found == {*DRIVES[drive]}
    assert CATALOG["actuator_gain"].sites["actuator"].offered(spot)


def test_what_a_factor_cannot_change_is_told() -> None:
    for drive, field, why in (
        ('<position {at} kp="4"/>', "kv", "its kv is 0"),
        ('<velocity {at} kv="1"/>', "kp", "its kp is 0"),
        ("<motor {at}/>", "kp", "it is no drive"),
        ("<muscle {at} lengthrange='-1 1'/>", "strength", "constant or affine"),
    ):
        m = mujoco.MjModel.from_xml_string(xml(drive))
        with pytest.raises(UserError, match=why):
            addresses.resolve(m, [(f"effect.{field}.a",)])
