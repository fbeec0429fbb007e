"""The configuration space against MuJoCo's own functions."""

import mujoco
import numpy as np
import pytest

from easi_jax.model.joint_space import Configuration

XML = """
<mujoco><worldbody>
  <body><joint name="slide" type="slide"/><geom size=".1"/>
    <body><joint name="ball" type="ball"/><geom size=".1"/>
      <body><joint name="hinge"/><geom size=".1"/></body></body></body>
  <body><freejoint name="free"/><geom size=".1"/></body>
</worldbody></mujoco>
"""


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(XML)


def positions(model: mujoco.MjModel, rng: np.random.Generator) -> np.ndarray:
    qpos = rng.normal(size=model.nq)
    mujoco.mj_normalizeQuat(model, qpos)
    return qpos


@pytest.mark.parametrize("seed", range(5))
def test_difference_and_integrate_equal_mujoco(model, seed):
    rng = np.random.default_rng(seed)
    space = Configuration.of(model)
    a, b = positions(model, rng), positions(model, rng)
    expected = np.empty(model.nv)
    mujoco.mj_differentiatePos(model, expected, 1.0, a, b)
    np.testing.assert_allclose(space.difference(a, b), expected, atol=1e-12)

    tangent = rng.normal(size=model.nv)
    moved = a.copy()
    mujoco.mj_integratePos(model, moved, tangent, 1.0)
    np.testing.assert_allclose(space.integrate(a, tangent), moved, atol=1e-12)
    back = space.difference(a, space.integrate(a, tangent))
    np.testing.assert_allclose(back, tangent, atol=1e-12)


def test_broadcasts_and_ignores_the_sign_of_a_quaternion(model):
    rng = np.random.default_rng(9)
    space = Configuration.of(model)
    a = positions(model, rng)
    many = np.stack([positions(model, rng) for _ in range(4)])
    one_by_one = np.stack([space.difference(a, b) for b in many])
    np.testing.assert_allclose(space.difference(a, many), one_by_one, atol=1e-14)
    flipped = many.copy()
    flipped[:, 1:5] *= -1
    np.testing.assert_allclose(space.difference(a, flipped), one_by_one, atol=1e-14)
    assert np.all(space.difference(a, a) == 0)
