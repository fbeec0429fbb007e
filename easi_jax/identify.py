"""From the end of a search to an honest distribution over parameters."""

import flax.struct
import jax
import jax.numpy as jnp
from jax.sharding import Mesh

from easi_jax.distribution import Distribution, gaussian
from easi_jax.information import PairedFit
from easi_jax.machine import Machine
from easi_jax.parameters import ParameterSpace
from easi_jax.refine import refine, step_weights
from easi_jax.replay import motion
from easi_jax.segments import Segments

FLOOR = 1e-3  # of the motion: what a model is never trusted to be better than
_RESOLVED = 1e-5  # smallest eigenvalue of a float32 correlation matrix worth its name
_INITIAL_VARIANCE = 1.0 / 12.0  # of a uniform initial range, unit coordinates


@flax.struct.dataclass
class Estimate:
    """What a search, and the refinement after it, say about the parameters.

    Attributes:
        distribution: the Gaussian that training samples from.
        search_mean: mean found by the adversarial search, unit coordinates, ``(n,)``.
        search_cov: its covariance, ``(n, n)``.
        hessian: Fisher information of the data at the final mean, ``(n, n)``.
        noise: standard deviations that the information was computed with.
        cost: weighted error after each step of refinement (empty without).
        delta: corrections of the pieces' starts within their noise, ``(M, 2 nv)``.
    """

    distribution: Distribution
    search_mean: jax.Array
    search_cov: jax.Array
    hessian: jax.Array
    noise: jax.Array
    cost: jax.Array
    delta: jax.Array


def effective_noise(
    machine: Machine, segments: Segments, noise: jax.Array
) -> jax.Array:
    """Noise ``(2 nv,)``, not below a thousandth of the motion's RMS per channel."""
    moved = motion(machine, segments)
    w = segments.weight[:, None, None]
    square = (moved**2 * w).sum((0, 1)) / jnp.maximum(w.sum() * moved.shape[1], 1.0)
    return jnp.maximum(noise, jnp.maximum(FLOOR * jnp.sqrt(square), 1e-9))


def estimate(
    machine: Machine,
    space: ParameterSpace,
    mean: jax.Array,
    cov: jax.Array,
    pieces: Segments,
    noise: jax.Array,
    refined: bool,
    informed: bool = True,
    mesh: Mesh | None = None,
    misfit: jax.Array | None = None,
    robust: int | jax.Array = 6,
    free_starts: bool = True,
    near: bool | jax.Array = False,
) -> Estimate:
    """The result of a search at ``mean``, ``cov`` (unit coordinates); pure.

    The covariance joins two sources: the search's own spread, and what the data leave
    open, ``(F + prior)^-1`` with F the Fisher information of ``pieces`` and the
    initial range as prior. A direction that the data do not show keeps the initial
    spread, whatever the search has drifted to. Without ``informed`` it is the search's
    own covariance alone. ``misfit (2 nv,)`` is what the model itself errs by in every
    step, on top of the noise; it, ``robust``, ``free_starts`` and ``near`` go to
    `easi_jax.refine.refine`.
    """
    assumed = effective_noise(machine, pieces, noise)
    n = space.size
    if refined:
        fit = refine(
            machine,
            space,
            mean,
            pieces,
            assumed,
            mesh=mesh,
            misfit=misfit,
            robust=robust,
            free_starts=free_starts,
            near=near,
        )
        center, hessian = fit.unit, fit.hessian
        cost, delta = fit.cost, fit.delta
    else:
        weight = step_weights(pieces, assumed, misfit)
        zero = jnp.zeros((pieces.count, len(noise)))
        paired = PairedFit(machine, space, pieces, assumed, mesh, free_starts)
        eq = paired.normal(mean, zero, weight)
        center, hessian = mean, eq.hessian
        cost, delta = jnp.zeros(0), eq.start_step
    open_cov, seen = _posterior(hessian)
    own = jnp.zeros((n, n)) if refined else seen @ cov @ seen.T
    return Estimate(
        distribution=gaussian(space, center, open_cov + own if informed else cov),
        search_mean=mean,
        search_cov=cov,
        hessian=hessian,
        noise=assumed,
        cost=cost,
        delta=delta,
    )


def _posterior(hessian: jax.Array) -> tuple[jax.Array, jax.Array]:
    """``(F + prior)^-1``, and the filter of directions that the data show.

    F spans ten decades, and single precision leaves noise where it should be zero that
    a plain inverse would take for knowledge. So F is scaled to a unit diagonal, what is
    below `_RESOLVED` there counts as not seen, and seen and unseen are inverted apart.
    """
    size = jnp.sqrt(jnp.maximum(jnp.diag(hessian), 1.0 / _INITIAL_VARIANCE))
    scaled = hessian / size[:, None] / size
    values, vectors = jnp.linalg.eigh(0.5 * (scaled + scaled.T))
    seen = values > _RESOLVED
    prior = vectors.T @ (vectors / (_INITIAL_VARIANCE * size**2)[:, None])
    total = jnp.where(seen[:, None] == seen, prior, 0.0)
    total = total + jnp.diag(jnp.where(seen, values, 0.0))
    root = jnp.sqrt(jnp.diag(total))
    back = vectors / size[:, None] / root
    cov = back @ jnp.linalg.inv(total / root[:, None] / root) @ back.T
    return cov, jnp.eye(hessian.shape[0]) - cov / _INITIAL_VARIANCE
