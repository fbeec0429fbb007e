"""The guard: silent where MJX does what MuJoCo does, and by name where it does not."""

import mujoco
import numpy as np
import pytest

from benchmarks.parity import load_plugins, paragraphs
from benchmarks.parity_models import feature_models
from easi_jax.errors import UserError
from easi_jax.model.parameters import ParameterSpace
from easi_jax.simulation import engine, guard
from easi_jax.simulation.simulator import Simulator

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
    found = guard.compare(m, np.zeros((2, 2)), np.ones((2, 2)))
    assert found.error == np.inf and found.deviates
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


def test_weak_forces_that_are_wrong_are_found_beside_strong_constraints() -> None:
    """Springs are a thousandth of what a stiff constraint does."""
    rest = '<equality><joint joint1="elbow" solref="0.004 1"/></equality>'
    found = _compare(ARM, '<flag spring="disable"/>', rest)
    assert found.deviates and found.force_error > 0.5
    assert found.causes == ("passive forces (dampers)",)


def test_state_that_mjx_does_not_carry_is_a_deviation() -> None:
    """One step from a fresh start looks right: a yielded spring, a sleeping body."""
    text = ARM.replace('damping="0.2"', 'springyield="0.2"')
    assert "springyield" in _compare(text).refusal
    assert "sleep" in _compare(ARM, '<flag sleep="enable"/>').refusal


def test_every_feature_of_the_table_is_a_model() -> None:
    load_plugins()
    models = feature_models()
    assert len(models) > 150
    for name, text in models.items():
        m = mujoco.MjModel.from_xml_string(text)
        assert m.nv, name


def test_the_table_says_what_deviates_and_what_is_refused() -> None:
    row = {"engine": "mjx", "error": 1e-14, "causes": [], "refusal": "", "seconds": 1.0}
    row |= {"native_error": 0.0, "native_refusal": ""}
    deviates = {"engine": "mujoco", "error": 0.2, "causes": ["weld constraints"]}
    refused = {"engine": "mujoco", "error": None, "refusal": "no flex"}
    text = "\n".join(
        paragraphs(
            {
                "command": "c",
                "features": {"a": row, "b": row | deviates, "c": row | refused},
            }
        )
    )
    assert "agrees on 1, deviates on 1, refuses 1" in text
    assert "| b | mujoco | 2.0e-01 | 0 | weld constraints |" in text
    assert "| c | mujoco |  | 0 | refused: no flex |" in text


def _model(flags: str = "", rest: str = "") -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(ARM.format(flags=flags, rest=rest))


def test_auto_takes_native_where_mjx_deviates_and_mjx_is_refused() -> None:
    weld = _model(rest='<equality><weld body1="lower"/></equality>')
    found, why = engine.automatic(weld)
    assert found == "mujoco" and "weld constraints" in why
    with engine.using("mjx"), pytest.raises(UserError, match="weld constraints"):
        engine.resolved(None, weld)
    assert engine.automatic(_model())[0] == "mjx"
    with engine.using("mjx"):
        assert engine.resolved(None, _model()) == "mjx"


def test_sleeping_bodies_are_refused_by_both_engines() -> None:
    asleep = _model('<flag sleep="enable"/>')
    with pytest.raises(UserError, match="sleep"):
        Simulator(asleep, ParameterSpace(()), engine="mujoco")
    with engine.using("mjx"), pytest.raises(UserError, match="sleep"):
        Simulator(asleep, ParameterSpace(()))
