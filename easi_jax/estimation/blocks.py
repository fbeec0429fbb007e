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
from scipy import stats

from easi_jax.estimation.normal_equations import RESOLVED

FEWEST = 20  # blocks
_MOST = 40
# Of a block. Two neighbours share half their rows, so that blocks of four have little
# in common.
_PIECES = 4
# Probability of less scatter with a right model: of more, the information stands.
_SURE = 0.95


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
    Neighbours that lean the same way count as one longer block (Newey and West 1987,
    one lag).

    Args:
        information: what counts, ``(n, n)``; at another place than ``hessian`` where a
            logarithm has no slope at the fit.
        hessian: of the same data where ``gradients (M, n)`` are from, pieces in order.
    """
    pieces = len(gradients)
    if not enough(pieces):
        return information
    count = min(_MOST, pieces // _PIECES)
    block = jnp.arange(pieces) * count // pieces
    sums = jax.ops.segment_sum(gradients, block, count)
    # What has no slope at the fit has no direction of its own in this scale.
    largest = jnp.maximum(jnp.diag(hessian), jnp.diag(information))
    size = jnp.sqrt(jnp.maximum(largest, 1e-12))
    values, vectors = jnp.linalg.eigh(hessian / size[:, None] / size)
    along = ((sums - sums.mean(0)) / size) @ vectors  # (count, n)
    variance = (along**2).sum(0)
    alike = (along[1:] * along[:-1]).sum(0) / jnp.maximum(variance, 1e-30)
    ratio = variance / jnp.maximum(values, RESOLVED) * count / (count - 1)
    free = count - 1
    more = (values > RESOLVED) & (ratio > float(stats.chi2.ppf(_SURE, free)) / free)
    # The variance of Student's t: a ratio from few blocks is itself not sure.
    longer = (1.0 + 2.0 * jnp.maximum(alike, 0.0)) * free / (free - 2)
    extra = jnp.where(more, jnp.maximum(ratio * longer - 1.0, 0.0), 0.0)
    # Variance is added, so that information is never more than it was (Woodbury).
    scaled = information / size[:, None] / size
    own = jnp.maximum((vectors * (scaled @ vectors)).sum(0), RESOLVED)
    root = vectors * jnp.sqrt(extra / own)
    seen = scaled @ root
    taken = seen @ jnp.linalg.solve(jnp.eye(len(size)) + root.T @ seen, seen.T)
    left = (scaled - 0.5 * (taken + taken.T)) * size[:, None] * size
    return jnp.where(more.any(), left, information)
