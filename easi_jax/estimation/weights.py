"""What each measured number, and each piece, counts in a fit."""

import jax
import jax.numpy as jnp

from easi_jax.data.segments import Segments
from easi_jax.estimation.least_squares import A, array_module

_NOISIER = 1.2  # times the noise as it is given, that it may be
_OUTLYING = 9.0  # times the median cost: such a piece counts half
_APART = 4.0  # standard deviations of a typical piece's cost: what fits far worse


def step_weights(
    segments: Segments, noise: jax.Array, misfit: jax.Array | None = None
) -> jax.Array:
    """Weight of each measured number, ``(M, H, 2 nv)``, and of sensors: 1 where the
    model is exact, 0 of what is not measured."""
    share = jnp.where(jnp.isfinite(noise), 1.0, 0.0)
    if misfit is not None:
        known = jnp.isfinite(noise)
        share = share / (1.0 + jnp.where(known, misfit / noise, 0.0) ** 2)
    return segments.weight[:, None, None] * share * readings(segments, noise.shape[0])


def readings(segments: Segments, size: int) -> jax.Array:
    """Which numbers there are, 1 or 0, ``(M, H, size)``: positions and velocities, and
    what was read of sensors."""
    given, shape = segments.read, (segments.count, segments.horizon)
    if isinstance(given, tuple):
        return jnp.ones((*shape, size))
    motion = jnp.ones((*shape, size - given.shape[-1]))
    return jnp.concatenate([motion, given], -1)


def excess(costs: jax.Array, weight: jax.Array) -> jax.Array:
    """Weighted squared error beyond what the noise makes, ``()``, with room for a noise
    that is a fifth larger than it is thought to be.

    Args:
        costs: half the weighted squared error of each piece, ``(M,)``; those that are
            not finite count nothing.
        weight: of each measured number, ``(M, H, 2 nv)``.
    """
    told = jnp.isfinite(costs)
    numbers = jnp.where(told, weight.sum((1, 2)), 0.0).sum()
    error = 2.0 * jnp.where(told, costs, 0.0).sum()
    return jnp.maximum(error - _NOISIER**2 * numbers, 0.0)


def times_noise(excess: jax.Array, weight: jax.Array) -> jax.Array:
    """RMS error in units of the noise, ``()``, of what leaves an `excess`; ``weight``
    as there."""
    share = excess / jnp.maximum(weight.sum(), 1e-30)
    return jnp.sqrt(share + _NOISIER**2)


def huber(size: A, limit: float, least: float = 0.0) -> A:
    """Huber's weight of each error by its ``size (M,)``: less than 1 beyond ``limit``
    median sizes, or ``least`` where these are smaller; NaN of one that is."""
    xp = array_module(size)
    typical = xp.maximum(xp.nanmedian(size), least)
    return xp.minimum(1.0, limit * typical / xp.maximum(size, 1e-30))


def robust(costs: jax.Array, weight: jax.Array) -> jax.Array:
    """Weight of each piece by its cost ``(M,)``: what fits far worse counts less.

    Cauchy's weights about the median, or what the noise makes of a typical piece where
    that is more: a machine that rests in most pieces errs by nothing there. Few pieces
    that meet a limit which is still wrong would otherwise bend every other parameter
    until they fit.

    Args:
        weight: of each measured number, ``(M, H, 2 nv)``.
    """
    numbers = 0.5 * weight.sum((1, 2))
    used = numbers > 0
    typical = jnp.nanmedian(jnp.where(used & jnp.isfinite(costs), costs, jnp.nan))
    typical = jnp.nan_to_num(typical)  # where there is none
    usual = jnp.nanmedian(jnp.where(used, numbers, jnp.nan))
    typical = jnp.maximum(typical, jnp.nan_to_num(usual))
    ratio = costs / jnp.maximum(_OUTLYING * typical, 1e-30)
    return jnp.where(jnp.isfinite(ratio), 1.0 / (1.0 + ratio), 0.0)


def far_worse(costs: jax.Array, weight: jax.Array) -> jax.Array:
    """Pieces that fit far worse than typical ones, and than the noise makes them, by
    their ``costs (M,)``, ``(M,)``.

    Args:
        weight: of each measured number, ``(M, H, 2 nv)``.
    """
    numbers = weight.sum((1, 2))
    share = costs / jnp.maximum(0.5 * numbers, 1e-30)
    typical = jnp.nanmedian(jnp.where(numbers > 0, share, jnp.nan))
    typical = jnp.maximum(typical, 1.0)
    spread = jnp.sqrt(2.0 / jnp.maximum(numbers, 1e-30))
    return (numbers > 0) & ~(share <= typical * (1.0 + _APART * spread))
