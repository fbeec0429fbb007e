"""Errors of open-loop predictions of measured pieces, and what noise explains of
them."""

import jax
import jax.numpy as jnp

from easi_jax.estimation.weights import huber


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
        error: ``(M, H, 2 nv)``.
        weight: of each segment, ``(M,)``.
    """
    share = weight / weight.sum()
    square = jnp.einsum("m,mhc->c", share, error**2) / error.shape[1]
    together = error.shape[1] * (share @ error.mean(1) ** 2)
    alike = jnp.clip(together / jnp.maximum(square, 1e-30), 1.0, error.shape[1])
    return jnp.sqrt(jnp.maximum(square - noise**2, 0.0) * alike)


def outlier_weights(
    error: jax.Array, noise: jax.Array, misfit: jax.Array, limit: float
) -> jax.Array:
    """Weight of each segment ``(M,)``: 1, or less beyond ``limit`` median errors.

    Huber's weight on the RMS over a segment of the error in units of its expectation.
    """
    expected = noise**2 + misfit**2
    return huber(jnp.sqrt((error**2 / expected).mean((1, 2))), limit)
