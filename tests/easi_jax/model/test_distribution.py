"""Samples of the three kinds of distribution."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from easi_jax.model import distribution
from easi_jax.model.parameters import Parameter, ParameterSpace

SPACE = ParameterSpace(
    (
        Parameter("mass", ("body.a.mass",), 1.0, (0.5, 2.0), (0.25, 4.0)),
        Parameter("gain", ("actuator.a.kp",), 5.0, (2.0, 8.0), (0.0, 40.0), log=False),
    )
)


@pytest.fixture(scope="module")
def samples() -> Any:
    many = jax.jit(
        lambda d: jax.vmap(lambda k: distribution.draw(SPACE, d, k))(
            jax.random.split(jax.random.key(0), 20_000)
        )
    )
    return lambda d: np.asarray(many(d), np.float64)


def test_gaussian_moments_in_unit_coordinates(samples: Any) -> None:
    mean, cov = np.array([0.5, 0.4]), np.array([[0.01, 0.006], [0.006, 0.02]])
    dist = distribution.gaussian(SPACE, mean, cov)
    unit = np.asarray(SPACE.to_unit(samples(dist)))
    np.testing.assert_allclose(unit.mean(0), mean, atol=0.005)
    np.testing.assert_allclose(np.cov(unit.T), cov, atol=0.0006)
    np.testing.assert_allclose(distribution.covariance(dist), cov, atol=1e-6)


def test_what_is_sure_stays_sure_beside_what_is_not() -> None:
    """Two parameters known to 1e-5 of the third's spread, correlated."""
    other = Parameter("other", ("body.b.mass",), 1.0, (0.5, 2.0), (0.25, 4.0))
    three = ParameterSpace((*SPACE.parameters, other))
    corr = np.array([[1.0, 0.95, 0.3], [0.95, 1.0, 0.2], [0.3, 0.2, 1.0]])
    std = np.array([3e-6, 5e-6, 0.3])
    dist = distribution.gaussian(three, np.full(3, 0.5), corr * np.outer(std, std))
    found = distribution.covariance(dist) / np.outer(std, std)
    np.testing.assert_allclose(found, corr, atol=1e-5)


def test_a_wide_gaussian_stays_inside_the_bounds(samples: Any) -> None:
    x = samples(distribution.gaussian(SPACE, jnp.full(2, 0.5), 9.0 * jnp.eye(2)))
    low, high = SPACE.bounds
    assert (x >= low * (1 - 1e-5)).all() and (x <= high * (1 + 1e-5)).all()
    # It wanted to leave on both sides, and was not cut further in.
    np.testing.assert_allclose(x.min(0), low, atol=1e-4)
    np.testing.assert_allclose(x.max(0), high, rtol=1e-4)


def test_uniform_fills_its_range_and_no_more(samples: Any) -> None:
    low, high = np.array([0.6, 3.0]), np.array([0.9, 30.0])
    x = samples(distribution.uniform(SPACE, low, high))
    assert (x >= low - 1e-5).all() and (x <= high + 1e-5).all()
    share = (x - low) / (high - low)
    np.testing.assert_allclose(share.mean(0), 0.5, atol=0.01)
    np.testing.assert_allclose(share.std(0), 12**-0.5, atol=0.01)
    assert abs(np.corrcoef(x.T)[0, 1]) < 0.03


def test_point_has_no_spread(samples: Any) -> None:
    x = samples(distribution.point(SPACE, np.array([0.7, 11.0])))
    np.testing.assert_allclose(x, np.tile([0.7, 11.0], (len(x), 1)), rtol=1e-6)


def test_all_kinds_are_one_compiled_program() -> None:
    kinds = (
        distribution.gaussian(SPACE, jnp.full(2, 0.5), jnp.eye(2)),
        distribution.uniform(SPACE, [0.5, 2.0], [1.0, 3.0]),
        distribution.point(SPACE, [0.5, 2.0]),
    )
    shapes = {str(jax.tree.map(lambda x: (x.shape, x.dtype), d)) for d in kinds}
    assert len(shapes) == 1


def test_a_singular_covariance_can_be_drawn(samples: Any) -> None:
    x = samples(distribution.gaussian(SPACE, jnp.full(2, 0.5), jnp.zeros((2, 2))))
    np.testing.assert_allclose(x.mean(0), [1.0, 5.0], rtol=1e-4)
