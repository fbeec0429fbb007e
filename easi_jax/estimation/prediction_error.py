"""Errors of open-loop predictions of measured pieces, and what noise explains of
them."""

import jax
import jax.numpy as jnp

from easi_jax.estimation.least_squares import A, array_module
from easi_jax.estimation.weights import huber

# Second differences of white noise, their variance, and how many of them count as one
# independent number (1 + 2 (16 + 1) / 36).
_DIFFERENCED, _ALIKE = 6.0, 1.94
# Powers of the step, that the variance of a model's own error grows with: it is wrong
# at the start, speeds by a force that errs at random, speeds or positions by one that
# is wrong.
_POWERS = 0.0, 1.0, 2.0, 4.0
_TOLD = 1e-6  # of a model's squared errors: noise below it is told from none
_MOVING, _STILL = 0.75, 0.1  # quantile of pieces, and share of it that none errs below
_SCORED = 30  # rounds of Fisher scoring, which squares its error in each
# Times that of the rows: where nothing moves a fit leaves no error; those of a slow
# sensor may hold a hundred times as much motion.
_LEAST_NOISE = 1e-3
_SAME_NOISE = 1.05  # times the noise that rows tell: as much


def rms_of_steps(error: jax.Array, instead: jax.Array) -> jax.Array:
    """RMS ``(n,)`` of errors ``(M, H, n)``; a piece that is not finite counts as an
    error of ``instead (n,)`` in each of its steps."""
    known = jnp.isfinite(error).all((1, 2), keepdims=True)
    return jnp.sqrt(jnp.mean(jnp.where(known, error, instead) ** 2, axis=(0, 1)))


def misfit_of(error: jax.Array, noise: jax.Array, weight: jax.Array) -> jax.Array:
    """What a model errs by beyond the noise, standard deviations ``(H, 2 nv)``; pure.

    What a model lacks adds up along a piece: the variance is in proportion to a power
    of the step, the likeliest of `_POWERS`, none of them included. Errors of a model
    hang together within a piece, so that its steps count for less than as many
    independent ones: the variance is scaled up by the number of steps that count as
    one, ``H var(mean of a piece) / var(step)``.

    Args:
        error: ``(M, H, 2 nv)``; a piece that is not finite counts nothing.
        noise: of the readings, ``(2 nv,)``; infinite where nobody measured, and
            nothing is known of an error.
        weight: of each number, ``(M, H, 2 nv)``; 0 where nothing was read.
    """
    fine, known = _finite(error)[:, None, None], jnp.isfinite(noise)
    error = jnp.where(fine & known, error, 0.0)
    weight, noise = jnp.where(fine, weight, 0.0), jnp.where(known, noise, 1.0)
    steps = weight.sum(0)  # (H, c)
    mean = (weight * error**2).sum(0) / jnp.maximum(steps, 1e-30)
    beyond = _grown(mean, noise**2, steps)
    own = weight.sum(1)  # (M, c)
    whole = jnp.maximum(own.sum(0), 1e-30)
    size = error / jnp.sqrt(noise**2 + beyond)
    each = (weight * size).sum(1) / jnp.maximum(own, 1e-30)
    together = (own * each**2).sum(0) / whole
    square = (weight * size**2).sum((0, 1)) / whole
    # Of a piece that has been read in all of its steps the count is H.
    most = (weight > 0).sum(1).max(0)
    alike = most * together / jnp.maximum(square, 1e-30)
    return jnp.sqrt(beyond * jnp.clip(alike, 1.0, jnp.maximum(most, 1.0)))


def _grown(mean: jax.Array, noise: jax.Array, weight: jax.Array) -> jax.Array:
    """Variance of a model's own error at each step, ``(H, c)``.

    Of each power of the step the likeliest factor (mean squares of Gaussian errors, by
    Fisher scoring), and of these the likeliest power; the lowest where they are alike.

    Args:
        mean: squares of errors, ``(H, c)``; variance of the ``noise (c,)``.
        weight: of each mean, ``(H, c)``.
    """
    share = jnp.arange(1, len(mean) + 1) / len(mean)
    shape = share[:, None] ** jnp.array(_POWERS)  # (H, P)
    shape = shape[:, None]  # (H, 1, P)
    # In its units, so that single precision has them; it is no less than a part of what
    # the model errs by, for nothing is told from that.
    whole = (weight * mean).sum(0) / jnp.maximum(weight.sum(0), 1e-30)
    noise = jnp.maximum(jnp.maximum(noise, _TOLD * whole), 1e-30)
    mean = (mean / noise)[..., None]
    weight = (weight / jnp.maximum(weight.max(0), 1e-30))[..., None]

    def scored(_: int, factor: jax.Array) -> jax.Array:
        w = weight * shape / (1.0 + factor * shape) ** 2
        down = jnp.maximum((w * shape).sum(0), 1e-30)
        return jnp.maximum((w * (mean - 1.0)).sum(0) / down, 0.0)

    begin = jnp.zeros((mean.shape[1], len(_POWERS)), mean.dtype)
    factor = jax.lax.fori_loop(0, _SCORED, scored, begin)
    total = 1.0 + factor * shape
    surprise = (weight * (jnp.log(total) + mean / total)).sum(0)
    best = jnp.argmin(surprise, axis=1)[:, None]
    return noise * jnp.take_along_axis(factor * shape, best[None], 2)[..., 0]


def white_noise(error: jax.Array, there: jax.Array | None = None) -> jax.Array:
    """Noise of readings, ``(n,)``, by what errors of predictions leave white; pure.

    Second differences of readings as near to each other as any keep white noise and
    little of what a model errs by, which is smooth; the median over pieces keeps out
    those in which it jumps. In the readings themselves fast motion would pass for
    noise. Pieces in which next to nothing is left, as of encoders at rest, do not
    count: they say nothing of what readings of motion are off by.

    Args:
        error: ``(M, H, n)``; at least three steps.
        there: which numbers were read, 1 or 0, ``(M, H, n)``; all where None.

    Not a number for those of which no piece has three readings.
    """
    there = jnp.ones_like(error) if there is None else there
    row = jnp.arange(error.shape[1])[:, None]
    latest = jax.lax.cummax(jnp.where(there > 0, row, -1), axis=1)
    # Rows of the reading before that of each row, and of the one before this.
    first = jnp.pad(latest[:, :-1], [(0, 0), (1, 0), (0, 0)], constant_values=-1)
    second = jnp.take_along_axis(first, jnp.maximum(first, 0), 1)
    before, earlier = (
        jnp.take_along_axis(error, jnp.maximum(at, 0), 1) for at in (first, second)
    )
    known = (there > 0) & (first > 0) & (second >= 0)
    # Beyond a gap more is left of what the model errs by.
    span = jnp.where(known, row - second, jnp.nan)
    known &= span <= jnp.nanmedian(span, (0, 1))
    bent = jnp.where(known, error - 2.0 * before + earlier, 0.0) ** 2
    count = known.sum(1)
    square = bent.sum(1) / count  # 0 / 0: none
    square = jnp.where(square > 0, square, jnp.nan)
    usual = jnp.nanquantile(square, _MOVING, axis=0)
    square = jnp.where(square >= _STILL * usual, square, jnp.nan)
    free = count.sum(0) / jnp.maximum((count > 0).sum(0), 1)
    # A chi-square's median (Wilson and Hilferty, PNAS 17, 1931).
    free = jnp.maximum(1.0 + (free - 1.0) / _ALIKE, 0.5)
    median = jnp.nanmedian(square, 0) / _DIFFERENCED
    return jnp.sqrt(median) / (1.0 - 2.0 / (9.0 * free)) ** 1.5


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
    error: jax.Array,
    noise: jax.Array,
    misfit: jax.Array,
    limit: float,
    there: jax.Array | None = None,
) -> jax.Array:
    """Weight of each piece ``(M,)``: 1, or less beyond ``limit`` median errors, or
    expected ones where these are larger.

    Huber's weight on the RMS over a piece of the error in units of its expectation;
    0 of what is not finite. ``there``: which numbers were read, 1 or 0, all where None.
    """
    square = error**2 / (noise**2 + misfit**2)
    there = jnp.ones_like(square) if there is None else there
    size = jnp.sqrt((there * square).sum((1, 2)) / jnp.maximum(there.sum((1, 2)), 1.0))
    fine = _finite(error)
    return jnp.where(fine, huber(jnp.where(fine, size, jnp.nan), limit, 1.0), 0.0)


def _finite(error: jax.Array) -> jax.Array:
    """Which segments of ``error (M, H, n)`` are, ``(M,)`` bool."""
    return jnp.isfinite(error).all((1, 2))
