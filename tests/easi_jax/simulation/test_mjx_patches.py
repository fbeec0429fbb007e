"""Closed chains in fast motion against MuJoCo C."""

import jax
import mujoco
import numpy as np
import pytest
from mujoco import mjx

from easi_jax.simulation import step as physics

XML = """<mujoco><option timestep="0.002" tolerance="1e-14" iterations="100"/>
  <worldbody>
    <site name="post" pos="0.5 0 0"/>
    <body><joint name="crank" axis="0 1 0"/><geom size=".02" fromto="0 0 0 0 0 .2"
      type="capsule"/>
      <body name="coupler" pos="0 0 .2"><joint name="coupler" axis="0 1 0"/>
        <geom size=".02" fromto="0 0 0 .5 0 .1" type="capsule"/>
        <site name="end" pos=".5 0 .1"/></body></body>
    <body name="rocker" pos=".5 0 0"><joint name="rocker" axis="0 1 0"/>
      <geom size=".02" fromto="0 0 0 0 0 .3" type="capsule"/>
      <site name="tip" pos="0 0 .3"/></body>
  </worldbody>
  <equality>{}</equality></mujoco>"""
KINDS = {
    "sites": '<connect site1="end" site2="tip"/>',
    "bodies": '<connect body1="coupler" body2="world" anchor=".5 0 .1"/>',
}


@pytest.mark.parametrize("kind", KINDS)
def test_a_closed_chain_in_fast_motion_equals_c_and_not_mjx(kind: str) -> None:
    m = mujoco.MjModel.from_xml_string(XML.format(KINDS[kind]))
    m.geom_contype[:] = 0
    d = mujoco.MjData(m)
    d.qvel[:] = (9.0, -4.0, 6.0)
    with jax.enable_x64(True):
        put = mjx.put_model(m, impl="jax")
        data = mjx.put_data(m, d, impl="jax")
        ours = jax.jit(physics.mjx_step)(put, data)
        theirs = jax.jit(mjx.step)(put, data)
    mujoco.mj_step(m, d)
    np.testing.assert_allclose(ours.qacc, d.qacc, rtol=1e-9, atol=1e-9)
    assert np.abs(np.asarray(theirs.qacc) - d.qacc).max() > 0.1
