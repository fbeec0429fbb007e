"""How far an estimate scatters between blocks of the data.

Information counts every reading as if its error were its own. Errors that hang together
(a filter, a friction that the model has another law for) leave more scatter than that.
The gradients of the pieces show it: summed over blocks of neighbouring pieces, they
have the information as their covariance if the model is right (the sandwich estimator;
Huber 1967, White 1982). Bias they do not show, for it is the same in every block
(`easi_jax.estimation.doubts`).
"""

import jax
import jax.numpy as jnp
import numpy as np
from scipy import stats

from easi_jax.estimation.normal_equations import RESOLVED

FEWEST = 20  # blocks
_MOST = 40
# Of a block. Two neighbours share half their rows, so that blocks of four have little
# in common.
_PIECES = 4
# Probability of less scatter with a right model: of more, the information stands.
_SURE = 0.95
# Standard errors of a correlation of neighbours that is none, which 2.5 % exceed.
_ALIKE = 1.96


def enough(pieces: int) -> bool:
    """Whether there are blocks enough."""
    return pieces // _PIECES >= FEWEST


def too_few(count: int, what: str) -> list[str]:
    """A note where spreads are those of the noise model, for want of blocks of
    ``what``, of which there are ``count``; none where they are not."""
    if enough(count):
        return []
    return [
        f"spreads are those of the noise model: {count} {what} make fewer than "
        f"{FEWEST} blocks, too few to see how values scatter between"
    ]


def scattered(
    information: jax.Array, hessian: jax.Array, gradients: jax.Array
) -> jax.Array:
    """Information ``(n, n)`` that is left where blocks scatter surely more than noise
    makes them; pure. As it was where there are fewer than 20 blocks.

    Along each principal direction of ``hessian``, scaled to a unit diagonal, the
    variance is multiplied by that of the blocks' gradients over what it should be.
    Where neighbouring blocks surely lean the same way, errors hang together for longer
    than a block: blocks are twice as long there. What neighbours still have in common
    is added (Newey and West 1987, one lag).

    Args:
        information: what counts, ``(n, n)``; at another place than ``hessian`` where a
            logarithm has no slope at the fit.
        hessian: of the same data where ``gradients (M, n)`` are from, pieces in order.
    """
    pieces = len(gradients)
    if not enough(pieces):
        return information
    # What has no slope at the fit has no direction of its own in this scale.
    largest = jnp.maximum(jnp.diag(hessian), jnp.diag(information))
    size = jnp.sqrt(jnp.maximum(largest, 1e-12))
    values, vectors = jnp.linalg.eigh(hessian / size[:, None] / size)
    along = gradients / size @ vectors  # (M, n)
    most = min(_MOST, pieces // _PIECES)
    extra, alike = _more(along, values, most)
    if most >= 2 * FEWEST:
        longer, _ = _more(along, values, most // 2)
        extra = jnp.where(alike > _ALIKE / np.sqrt(most), longer, extra)
    # Variance is added, so that information is never more than it was (Woodbury).
    scaled = information / size[:, None] / size
    own = jnp.maximum((vectors * (scaled @ vectors)).sum(0), RESOLVED)
    root = vectors * jnp.sqrt(extra / own)
    seen = scaled @ root
    taken = seen @ jnp.linalg.solve(jnp.eye(len(size)) + root.T @ seen, seen.T)
    left = (scaled - 0.5 * (taken + taken.T)) * size[:, None] * size
    return jnp.where(extra.any(), left, information)


def _more(
    along: jax.Array, values: jax.Array, count: int
) -> tuple[jax.Array, jax.Array]:
    """Variance beyond that of the noise, as a share of it, and the correlation of
    neighbours, by ``count`` blocks of gradients ``(M, n)`` along directions with that
    information ``(n,)``; 0 where it may be chance."""
    pieces = len(along)
    block = jnp.arange(pieces) * count // pieces
    sums = jax.ops.segment_sum(along, block, count)
    sums -= sums.mean(0)
    variance = (sums**2).sum(0)
    alike = (sums[1:] * sums[:-1]).sum(0) / jnp.maximum(variance, 1e-30)
    ratio = variance / jnp.maximum(values, RESOLVED) * count / (count - 1)
    free = count - 1
    more = (values > RESOLVED) & (ratio > float(stats.chi2.ppf(_SURE, free)) / free)
    # The variance of Student's t: a ratio from few blocks is itself not sure.
    longer = (1.0 + 2.0 * jnp.maximum(alike, 0.0)) * free / (free - 2)
    return jnp.where(more, jnp.maximum(ratio * longer - 1.0, 0.0), 0.0), alike
