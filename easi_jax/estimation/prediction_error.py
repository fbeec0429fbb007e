"""Errors of open-loop predictions of measured pieces, and what noise explains of
them."""

import jax
import jax.numpy as jnp

from easi_jax.estimation.least_squares import A, array_module
from easi_jax.estimation.weights import huber

# Second differences of white noise, their variance, and how many of them count as one
# independent number (1 + 2 (16 + 1) / 36).
_DIFFERENCED, _ALIKE = 6.0, 1.94
_LEAST_NOISE = 1e-2  # times that of the rows: where nothing moves a fit leaves no error
_SAME_NOISE = 1.05  # times the noise that rows tell: as much


def rms_of_steps(error: jax.Array, instead: jax.Array) -> jax.Array:
    """RMS ``(n,)`` of errors ``(M, H, n)``; a piece that is not finite counts as an
    error of ``instead (n,)`` in each of its steps."""
    known = jnp.isfinite(error).all((1, 2), keepdims=True)
    return jnp.sqrt(jnp.mean(jnp.where(known, error, instead) ** 2, axis=(0, 1)))


def misfit_of(error: jax.Array, noise: jax.Array, weight: jax.Array) -> jax.Array:
    """What a model errs by beyond the noise, standard deviations ``(2 nv,)``.

    Errors of a model hang together within a segment, so that its steps count for less
    than as many independent ones: the variance is scaled up by the number of steps
    that count as one, ``H var(mean of a segment) / var(step)``.

    Args:
        error: ``(M, H, 2 nv)``; a segment that is not finite counts nothing.
        weight: of each segment, ``(M,)``.
    """
    fine = _finite(error)
    error = jnp.where(fine[:, None, None], error, 0.0)
    weight = jnp.where(fine, weight, 0.0)
    share = weight / jnp.maximum(weight.sum(), 1e-30)
    square = jnp.einsum("m,mhc->c", share, error**2) / error.shape[1]
    together = error.shape[1] * (share @ error.mean(1) ** 2)
    alike = jnp.clip(together / jnp.maximum(square, 1e-30), 1.0, error.shape[1])
    return jnp.sqrt(jnp.maximum(square - noise**2, 0.0) * alike)


def white_noise(error: jax.Array) -> jax.Array:
    """Noise of readings, ``(n,)``, by what errors of predictions leave white; pure.

    Second differences along a piece keep white noise and little of what a model errs
    by, which is smooth; the median over pieces keeps out those in which it jumps. In
    the readings themselves fast motion would pass for noise.

    Args:
        error: ``(M, H, n)``; at least three steps.
    """
    bent = jnp.diff(error, 2, axis=1)
    square = jnp.nanmedian((bent**2).mean(1), 0) / _DIFFERENCED
    # A chi-square's median (Wilson and Hilferty, PNAS 17, 1931).
    free = bent.shape[1] / _ALIKE
    return jnp.sqrt(square) / (1.0 - 2.0 / (9.0 * jnp.maximum(free, 0.5))) ** 1.5


def believed(seen: A, told: A, least: A | float = 0.0) -> A:
    """Noise ``(n,)`` as the errors of a fit show it, where that is no more than rows
    alone tell: rows may take motion for noise, and a model its own errors.

    Args:
        seen: in the errors.
        told: by rows alone.
        least: what resolution makes.
    """
    xp = array_module(told)
    seen = xp.maximum(seen, xp.maximum(least, _LEAST_NOISE * told))
    return xp.where(seen < _SAME_NOISE * told, seen, told)


def outlier_weights(
    error: jax.Array, noise: jax.Array, misfit: jax.Array, limit: float
) -> jax.Array:
    """Weight of each segment ``(M,)``: 1, or less beyond ``limit`` median errors.

    Huber's weight on the RMS over a segment of the error in units of its expectation;
    0 of what is not finite.
    """
    expected = noise**2 + misfit**2
    size = jnp.sqrt((error**2 / expected).mean((1, 2)))
    fine = _finite(error)
    return jnp.where(fine, huber(jnp.where(fine, size, jnp.nan), limit), 0.0)


def _finite(error: jax.Array) -> jax.Array:
    """Which segments of ``error (M, H, n)`` are, ``(M,)`` bool."""
    return jnp.isfinite(error).all((1, 2))
