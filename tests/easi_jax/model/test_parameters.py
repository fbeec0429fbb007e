import dataclasses
import math

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from easi_jax.errors import UserError
from easi_jax.model.parameters import Parameter, ParameterSpace, declare

MASS = Parameter("mass", ("body.cart.mass",), 0.3, (0.1, 0.9), (1e-3, math.inf), "kg")
LOSS = Parameter("loss", ("joint.cart.frictionloss",), 0.1, (0.0, 0.3), (0.0, 10.0))
COM = Parameter("com", ("body.cart.com_x",), 0.0, (-0.1, 0.1), (-math.inf, math.inf))
SPACE = ParameterSpace((MASS, LOSS, COM))


def test_unit_cube_is_the_initial_range() -> None:
    low, high = SPACE.initial
    np.testing.assert_allclose(SPACE.to_si(jnp.zeros(3)), low, atol=1e-7)
    np.testing.assert_allclose(SPACE.to_si(jnp.ones(3)), high, rtol=1e-6)
    # log where the range is positive (geometric middle), linear elsewhere
    middle = SPACE.to_si(jnp.full(3, 0.5))
    np.testing.assert_allclose(middle, [0.3, 0.15, 0.0], rtol=1e-5, atol=1e-7)
    assert SPACE.log.tolist() == [True, False, False]
    np.testing.assert_allclose(SPACE.log_width, [math.log(9), 1, 1], rtol=1e-6)


def test_round_trip_in_batches_under_jit_and_outside_the_cube() -> None:
    u = jax.random.uniform(jax.random.key(0), (5, 4, 3), minval=-1.0, maxval=2.0)
    back = jax.jit(lambda x: SPACE.to_unit(SPACE.to_si(x)))(u)
    np.testing.assert_allclose(back, u, atol=2e-5)


def test_derivatives_are_finite_everywhere() -> None:
    for u in (-20.0, 0.0, 20.0):
        assert jnp.isfinite(jax.jacfwd(SPACE.to_si)(jnp.full(3, u))).all()


def test_bounds_in_the_unit_cube() -> None:
    low, high = SPACE.unit_bounds
    np.testing.assert_allclose(SPACE.to_si(low)[:2], [1e-3, 0.0], rtol=1e-5)
    assert high[0] == jnp.inf and low[2] == -jnp.inf
    clipped = SPACE.to_si(SPACE.clip(jnp.array([[-9.0] * 3, [99.0] * 3])))
    assert clipped[0, 0] == pytest.approx(1e-3, rel=1e-5)
    assert clipped[0, 1] == 0.0 and clipped[1, 1] == pytest.approx(10.0)
    zero = SPACE.with_scale(True).to_unit(jnp.zeros(3))
    assert zero[0] == -jnp.inf


def test_changes_return_new_spaces() -> None:
    linear = SPACE.with_scale(False)
    assert not linear.log.any() and SPACE.log.any()
    scaled = SPACE.select(["loss", "mass"]).scaled(0.5, 2.0)
    assert scaled.names == ("loss", "mass")
    np.testing.assert_allclose(scaled.initial, [[0.05, 0.15], [0.2, 0.6]])
    # a range that starts at zero cannot be logarithmic
    from_zero = ParameterSpace((MASS,)).with_initial([1e-3], [0.3])
    assert from_zero.log.all()
    assert hash(SPACE) == hash(ParameterSpace((MASS, LOSS, COM)))
    assert SPACE.addresses[0] == ("body.cart.mass",)


def test_scaled_range_stops_at_the_bounds() -> None:
    tight = dataclasses.replace(MASS, bounds=(0.05, 1.0))
    space = ParameterSpace((tight,)).scaled(0.01, 100.0)
    np.testing.assert_allclose(np.ravel(space.initial), [0.05, 1.0])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"initial": (0.9, 0.1)}, "reversed"),
        ({"initial": (0.3, 0.3)}, "reversed or empty"),
        ({"bounds": (1.0, 0.1)}, "reversed"),
        ({"bounds": (0.5, 2.0)}, "nominal 0.3 is outside"),
        ({"bounds": (0.2, 2.0)}, r"initial \[0.1, 0.9\] is outside"),
        ({"nominal": math.nan}, "finite"),
        ({"initial": (0.1, math.inf)}, "finite"),
        ({"bounds": (math.nan, 1.0)}, "must be numbers"),
        ({"addresses": ()}, "no address"),
        ({"addresses": ("body.mass",)}, "body.NAME"),
        ({"name": ""}, "no name"),
    ],
)
def test_bad_parameter(changes: dict, message: str) -> None:
    with pytest.raises(UserError, match=message):
        dataclasses.replace(MASS, **changes)


def test_bad_space() -> None:
    with pytest.raises(UserError, match="twice"):
        ParameterSpace((MASS, MASS))
    with pytest.raises(UserError, match=r'"mas" .*did you mean "mass"'):
        SPACE.select(["mas"])
    with pytest.raises(UserError, match="2 and 2 values for 3"):
        SPACE.with_initial([1, 2], [3, 4])
    with pytest.raises(UserError, match="reversed"):
        SPACE.scaled(2.0, 1.0)
    with pytest.raises(UserError, match=r'"com".*reversed or empty'):
        SPACE.scaled(0.5, 2.0)  # its nominal is 0


def test_declare_reads_the_model() -> None:
    m = mujoco.MjModel.from_xml_string(
        """<mujoco><worldbody><body name="b"><joint name="j"/>
        <joint name="s" type="slide" damping="2"/>
        <geom name="g" type="capsule" size="0.1 0.2"/></body></worldbody></mujoco>"""
    )
    length = declare(m, "length", "geom.g.length")
    assert (length.nominal, length.unit) == (pytest.approx(0.6), "m")
    assert length.bounds[0] == pytest.approx(0.2)
    with pytest.raises(UserError, match="nominal is 0"):
        declare(m, "d", "joint.j.damping")
    with pytest.raises(UserError, match="units differ"):
        declare(m, "d", "joint.*.damping", nominal=1.0)


def test_a_model_may_have_nothing_to_vary() -> None:
    space = ParameterSpace(())
    assert space.size == 0 and space.names == ()
    assert space.bounds[0].shape == space.initial[1].shape == (0,)
