"""Distributions over parameters, as a pytree that training and search pass on."""

from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from easi_jax.model.parameters import ParameterSpace


@flax.struct.dataclass
class Distribution:
    """A Gaussian in unit coordinates, or a uniform range in SI units.

    Both kinds are one pytree, so that training under either is one compiled
    program. ``uniform`` chooses.

    Attributes:
        mean: unit coordinates, ``(n,)``.
        factor: a square root A of the covariance A A', ``(n, n)``.
        low, high: uniform range, SI units, ``(n,)``.
        uniform: 1.0 for the uniform range, 0.0 for the Gaussian, ``()``.
    """

    mean: jax.Array
    factor: jax.Array
    low: jax.Array
    high: jax.Array
    uniform: jax.Array


def gaussian(space: ParameterSpace, mean: Any, cov: Any) -> Distribution:
    """A Gaussian with unit-coordinate ``mean (n,)`` and ``cov (n, n)``.

    Eigenvalues that rounding has made negative count as zero. The root is that of the
    correlations: beside a parameter of which nothing is known, one that is known to a
    thousandth of it would otherwise get a spread that is rounding alone.
    """
    mean, cov = jnp.asarray(mean), jnp.asarray(cov)
    std = jnp.sqrt(jnp.maximum(jnp.diag(cov), 0.0))
    size = jnp.where(std > 0, std, 1.0)
    scaled = cov / size[:, None] / size
    values, vectors = jnp.linalg.eigh(0.5 * (scaled + scaled.T))
    si = space.to_si(mean)
    return Distribution(
        mean=mean,
        factor=size[:, None] * vectors * jnp.sqrt(jnp.maximum(values, 0.0)),
        low=si,
        high=si,
        uniform=jnp.zeros(()),
    )


def uniform(space: ParameterSpace, low: Any, high: Any) -> Distribution:
    """Uniform in ``[low, high]`` SI units, ``(n,)``, as UDR has it."""
    n = space.size
    return Distribution(
        mean=jnp.full(n, 0.5),
        factor=jnp.zeros((n, n)),
        low=jnp.asarray(low, jnp.result_type(float)),
        high=jnp.asarray(high, jnp.result_type(float)),
        uniform=jnp.ones(()),
    )


def point(space: ParameterSpace, theta: Any) -> Distribution:
    """All mass at ``theta (n,)`` SI units (the Oracle's distribution)."""
    return uniform(space, theta, theta)


def draw(space: ParameterSpace, dist: Distribution, key: jax.Array) -> jax.Array:
    """One sample ``(n,)`` in SI units, inside the physical bounds."""
    k_u, k_g = jax.random.split(key)
    flat = dist.low + (dist.high - dist.low) * jax.random.uniform(k_u, (space.size,))
    low, high = space.unit_bounds
    z = dist.mean + dist.factor @ jax.random.normal(k_g, (space.size,))
    # Again in SI units: rounding must not make a zero negative.
    si = jnp.clip(space.to_si(jnp.clip(z, low, high)), *space.bounds)
    return jnp.where(dist.uniform > 0, flat, si)


def covariance(dist: Distribution) -> np.ndarray:
    """Covariance in unit coordinates, ``(n, n)``, double precision."""
    factor = np.asarray(dist.factor, float)
    return factor @ factor.T
