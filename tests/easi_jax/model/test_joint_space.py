"""The configuration space against MuJoCo's own functions."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from easi_jax.model.joint_space import (
    Configuration,
    dofs,
    scalar_dofs,
    tangent_names,
    tangent_units,
    turns_fully,
)

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


def test_jax_gives_what_numpy_gives(model):
    rng = np.random.default_rng(3)
    space = Configuration.of(model)
    a = np.stack([positions(model, rng) for _ in range(6)])
    b = np.stack([positions(model, rng) for _ in range(6)])
    with jax.enable_x64(True):
        tangent = space.difference(jnp.asarray(a), b)
        moved = space.integrate(a, tangent)
        many = space.integrate(jnp.asarray(np.stack([a, b])), tangent)
    np.testing.assert_allclose(many[0], moved, atol=1e-12)
    assert isinstance(tangent, jax.Array) and isinstance(moved, jax.Array)
    np.testing.assert_allclose(tangent, space.difference(a, b), atol=1e-12)
    back = space.integrate(a, np.asarray(tangent))
    np.testing.assert_allclose(moved, back, atol=1e-12)


def test_names_and_units_follow_the_layout(model):
    names = dict(zip(tangent_names(model), tangent_units(model), strict=True))
    assert len(names) == model.nv
    assert (names["slide"], names["ball.2"], names["hinge"]) == ("m", "rad", "rad")
    assert (names["free.2"], names["free.3"]) == ("m", "rad")
    assert scalar_dofs(model) == {0: (0, 0), 2: (5, 4)}
    assert list(dofs(model, 3)) == [5, 6, 7, 8, 9, 10]


@pytest.mark.parametrize(
    ("range", "turns"),
    [
        ("", True),
        ('range="-6.28319 6.28319"', True),
        ('range="-3.1416 3.1416"', True),
        ('range="-3 3"', False),
        ('type="slide" range="-9 9"', False),
    ],
)
def test_where_a_full_turn_fits(range, turns):
    m = mujoco.MjModel.from_xml_string(
        '<mujoco><compiler angle="radian"/><worldbody><body>'
        f'<joint name="j" {range}/><geom size=".1"/></body></worldbody></mujoco>'
    )
    assert turns_fully(m, 0) is turns
