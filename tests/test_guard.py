"""The guard: silent where MJX does what MuJoCo does, and by name where it does not."""

import mujoco
import numpy as np
import pytest

from easi_jax.simulation import guard

ARM = """
<mujoco>
  <option>{flags}</option>
  <worldbody>
    <body name="upper">
      <joint name="shoulder" axis="0 1 0" stiffness="5" damping="0.2"/>
      <geom type="capsule" size="0.03" fromto="0 0 0 0 0 -0.4"/>
      <body name="lower" pos="0 0 -0.4">
        <joint name="elbow" axis="0 1 0"/>
        <geom type="capsule" size="0.03" fromto="0 0 0 0 0.1 -0.4"/>
      </body>
    </body>
  </worldbody>
  {rest}
</mujoco>
"""
BOX = """
<mujoco>
  <worldbody>
    <geom type="plane" size="1 1 1"/>
    <body pos="0 0 0.12"><freejoint/><geom type="box" size="0.1 0.1 0.1"/></body>
  </worldbody>
</mujoco>
"""


def _compare(text: str, flags: str = "", rest: str = "") -> guard.Deviation:
    m = mujoco.MjModel.from_xml_string(text.format(flags=flags, rest=rest))
    return guard.compare(m, *guard.random_states(m, seed=1))


def test_an_arm_agrees() -> None:
    found = _compare(ARM)
    assert found.error < 1e-8 and not found.deviates and not found.causes
    assert found.states == 16 and "agrees" in str(found)


@pytest.mark.parametrize(
    ("flags", "rest", "named"),
    [
        ("", '<equality><weld body1="lower"/></equality>', "weld constraints"),
        ('<flag spring="disable"/>', "", "passive forces (dampers)"),
    ],
)
def test_what_deviates_is_named(flags: str, rest: str, named: str) -> None:
    found = _compare(ARM, flags, rest)
    assert found.deviates and found.error > 0.01
    assert found.causes == (named,)
    assert str(found).endswith(f"of a step's acceleration: {named}")


def test_contacts_are_named_by_their_pair() -> None:
    assert _compare(BOX).causes == ("contacts of box and plane",)


def test_what_mjx_refuses_is_a_deviation_too() -> None:
    rest = '<actuator><cylinder joint="elbow" timeconst="1"/></actuator>'
    m = mujoco.MjModel.from_xml_string(ARM.format(flags="", rest=rest))
    m.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICIT
    found = guard.deviation(m, np.zeros((2, 2)), np.ones((2, 2)))
    assert found is not None and found.error == np.inf and found.deviates
    assert "mjINT_IMPLICIT" in str(found)


def test_random_states_touch_and_stay_in_their_ranges() -> None:
    m = mujoco.MjModel.from_xml_string(BOX)
    qpos, qvel, act, ctrl = guard.random_states(m, seed=3, k=40)
    assert qpos.shape == (40, 7) and qvel.shape == (40, 6)
    assert act.shape == (40, 0) and ctrl.shape == (40, 0)
    again = guard.random_states(m, seed=3, k=40)[0]
    np.testing.assert_array_equal(qpos, again)
    d, touching = mujoco.MjData(m), 0
    for q in qpos:
        d.qpos[:] = q
        mujoco.mj_forward(m, d)
        touching += d.ncon > 0
    assert touching > 10
