"""Errors of open-loop predictions of measured pieces, and what noise explains of
them."""

from typing import Any

import jax
import jax.numpy as jnp

from easi_jax.data.segments import Segments
from easi_jax.simulation import open_loop
from easi_jax.simulation.simulator import Simulator
from easi_jax.simulation.slopes import shift_start


def errors_and_floor(
    simulator: Simulator,
    model: Any,
    held: Segments,
    fit: Segments,
    noise: jax.Array,
    key: jax.Array,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """RMS over all steps of the position error on ``held``, on ``fit``, and what the
    first would be for a perfect model, ``(nv,)`` each.

    For the floor noise ``(2 nv,)`` is drawn for starts and targets and pushed through
    the model. A piece whose prediction is not finite counts as an error of the largest
    motion in a piece that is held out, and in the floor as the noise alone.
    """
    nv = simulator.mj_model.nv
    k_start, k_end = jax.random.split(key)
    z = noise * jax.random.normal(k_start, (held.count, 2 * nv))
    moved = shift_start(simulator, held, z)
    # One simulation, since compiling it takes longer than running it.
    every = jax.tree.map(lambda *x: jnp.concatenate(x), held, fit, moved)
    states = open_loop.predict(simulator, model, every)
    target = (every.next_qpos, every.next_qvel)
    error = open_loop.prediction_residuals(simulator, states, target)[..., :nv]
    sharp, noisy = (
        jax.tree.map(lambda x, at=at: x[at], states)
        for at in (slice(held.count), slice(held.count + fit.count, None))
    )
    shift = open_loop.prediction_residuals(simulator, sharp, noisy)[..., :nv]
    shift = shift + noise[:nv] * jax.random.normal(k_end, shift.shape)
    first, second = error[: held.count], error[held.count : held.count + fit.count]
    largest = jnp.abs(open_loop.motion(simulator, held)[..., :nv]).max((0, 1))
    return (
        rms_of_steps(first, largest),
        rms_of_steps(second, largest),
        rms_of_steps(shift, noise[:nv]),
    )


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
    size = jnp.sqrt((error**2 / expected).mean((1, 2)))
    return jnp.minimum(1.0, limit * jnp.median(size) / jnp.maximum(size, 1e-30))
