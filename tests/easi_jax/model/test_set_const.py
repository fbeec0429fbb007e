"""Derived constants equal MuJoCo's own after a change of masses."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx

from easi_jax.model.set_const import set_const, spd_inverse

ARM = """<mujoco><worldbody>
  <camera name="watch" mode="trackcom" pos="1 1 1"/>
  <body name="a" pos="0 0 1">
    <joint name="a" axis="0 1 0" armature="0.01"/>
    <geom type="capsule" size="0.02" fromto="0 0 0 0.3 0 0"/>
    <site name="s0" pos="0.1 0 0.05"/>
    <camera name="hand" mode="trackcom"/>
    <body pos="0.3 0 0">
      <joint name="b" axis="0 0 1" pos="0.01 0 0"/>
      <geom type="box" size="0.1 0.02 0.03" pos="0.1 0 0" euler="10 20 30"/>
      <site name="s1" pos="0.1 0 0.05"/>
      <body pos="0.2 0.1 0">
        <joint name="c" type="slide" axis="1 1 0"/><geom size="0.05"/>
      </body>
    </body>
  </body></worldbody>
  <tendon>
    <spatial name="t" armature="0.3"><site site="s0"/><site site="s1"/></spatial>
    <fixed name="f"><joint joint="a" coef="0.5"/><joint joint="c" coef="2"/></fixed>
  </tendon>
  <actuator><motor joint="b" gear="3"/><motor tendon="t"/><motor tendon="f"/></actuator>
</mujoco>"""

LEGGED = """<mujoco><worldbody>
  <geom type="plane" size="1 1 1"/>
  <body name="still" pos="3 0 0"><geom size="0.1"/></body>
  <body name="torso" pos="0 0 1"><freejoint/>
    <geom type="box" size="0.2 0.1 0.05" pos="0.03 0 0.01"/>
    <body pos="0.2 0.1 0"><joint axis="0 1 0" damping="1"/>
      <geom type="capsule" size="0.02" fromto="0 0 0 0 0 -0.3"/>
      <body pos="0 0 -0.3"><joint axis="1 1 0"/><geom size="0.04" pos="0 0 -0.1"/>
        <body pos="0.1 0 0"><geom name="welded" size="0.03"/></body></body>
    </body>
    <body pos="-0.2 -0.1 0"><joint axis="0 1 0" armature="0.02"/>
      <geom type="cylinder" size="0.02 0.1" pos="0 0 -0.1"/></body>
  </body></worldbody></mujoco>"""

BALL = """<mujoco><worldbody>
  <body pos="0 0 1"><joint type="slide" axis="1 0 0" armature="0.5"/>
    <joint type="slide" axis="0 0 1"/><geom type="box" size="0.1 0.2 0.3"/>
    <body pos="0.1 0 0.3"><joint type="ball" armature="0.02"/>
      <geom type="ellipsoid" size="0.1 0.05 0.2" pos="0.1 0.2 0.1" euler="10 30 0"
        contype="0" conaffinity="0"/>
    </body>
  </body>
  <body pos="2 0 0"><freejoint/><geom type="box" size="0.1 0.2 0.3"/></body>
  <body pos="4 0 0"><joint type="slide" axis="1 0 0" armature="0.5"/>
    <joint type="slide" axis="0 0 1"/><geom type="box" size="0.1 0.2 0.3"/></body>
  </worldbody></mujoco>"""

FIELDS = (
    "body_subtreemass",
    "body_invweight0",
    "dof_invweight0",
    "dof_M0",
    "tendon_invweight0",
    "actuator_acc0",
    "cam_poscom0",
)


@pytest.mark.parametrize("xml", [ARM, LEGGED, BALL], ids=["arm", "legged", "ball"])
def test_equals_set_const_of_mujoco(xml: str) -> None:
    m = mujoco.MjModel.from_xml_string(xml)
    rng = np.random.default_rng(0)
    scale = rng.uniform(0.4, 2.5, m.nbody)
    armature = m.dof_armature + rng.uniform(0.0, 0.1, m.nv)
    # One armature for all degrees of freedom of a joint, as MJCF has it.
    armature = np.array([armature[m.jnt_dofadr[j]] for j in m.dof_jntid])
    with jax.enable_x64(True):
        put = mjx.put_model(m, impl="jax")
        got = jax.jit(set_const)(
            put.replace(
                body_mass=put.body_mass * scale,
                body_inertia=put.body_inertia * scale[:, None],
                dof_armature=jnp.asarray(armature),
            )
        )
        got = {f: np.asarray(getattr(got, f)) for f in FIELDS} | {
            "meaninertia": float(got.stat.meaninertia)
        }
    before = {f: getattr(m, f).copy() for f in FIELDS}
    m.body_mass *= scale
    m.body_inertia *= scale[:, None]
    m.dof_armature[:] = armature
    mujoco.mj_setConst(m, mujoco.MjData(m))
    for field in FIELDS:
        want = getattr(m, field)
        np.testing.assert_allclose(got[field], want, rtol=1e-9, atol=1e-12)
        if want.size:
            assert not np.allclose(before[field], want)
    # mj_setConst leaves it; the compiler sets it so.
    assert got["meaninertia"] == pytest.approx(m.dof_M0.mean(), rel=1e-9)


@pytest.mark.parametrize("n", [1, 24, 30])
def test_inverse(n: int) -> None:
    a = np.random.default_rng(n).normal(size=(n, n))
    a = a @ a.T + np.eye(n)
    with jax.enable_x64(True):
        got = np.asarray(jax.jit(spd_inverse)(jnp.asarray(a)))
    np.testing.assert_allclose(got, np.linalg.inv(a), rtol=1e-8, atol=1e-9)
