"""Where the mass of a body can be."""

import mujoco
import numpy as np

from easi_jax.model.body_extent import room_for_mass

ROD = """<mujoco><worldbody><body name="rod"><joint axis="0 1 0"/>
<geom type="capsule" fromto="0 0 0 0 0 -0.4" size="0.02" mass="1"/></body>
<body name="turned" pos="1 0 0"><joint axis="0 1 0"/>
<geom type="box" pos="0.1 0 0" euler="0 0 90" size="0.3 0.05 0.05" mass="1"/></body>
<body name="bare" pos="2 0 0"><joint axis="0 1 0"/>
<inertial pos="0 0 0.5" mass="2" diaginertia="0.02 0.02 0.02"/></body>
</worldbody></mujoco>"""


def room(name: str) -> np.ndarray:
    m = mujoco.MjModel.from_xml_string(ROD)
    return np.array(room_for_mass(m, m.body(name).id))


def test_a_rod_has_its_mass_along_itself() -> None:
    low, high = room("rod")
    np.testing.assert_allclose([low[2], high[2]], [-0.22, 0.22], atol=5e-3)
    # A drive may sit beside it.
    assert 0.05 < high[0] < 0.15 and low[0] == -high[0]


def test_room_is_told_in_the_bodys_own_axes() -> None:
    low, high = room("turned")
    np.testing.assert_allclose(high - low, [0.3, 0.6, 0.3], atol=5e-3)


def test_without_a_geom_the_inertia_says_how_large_a_body_is() -> None:
    low, high = room("bare")
    # A cube of mass m and inertia m a^2 / 6.
    half = 0.5 * np.sqrt(6 * 0.02 / 2)
    np.testing.assert_allclose(high, half, rtol=1e-6)
    np.testing.assert_allclose(low, -half, rtol=1e-6)
