"""A least-squares finish on paired data (multiple shooting).

Maximum likelihood under independent measurement noise: parameters and the true start
of every segment are fitted together by Levenberg-Marquardt with forward-mode
derivatives through the simulation. Starting at the found mean, it is the natural last
step where commands and states were logged together; it says nothing about unpaired
data or about distributions.
"""

from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
from jax.sharding import Mesh

from easi_jax.information import normal_equations
from easi_jax.machine import Machine
from easi_jax.mesh import make_mesh
from easi_jax.parameters import ParameterSpace
from easi_jax.segments import Segments


@flax.struct.dataclass
class RefineResult:
    """Result of `refine`.

    Attributes:
        unit: parameters, unit coordinates, ``(n,)``.
        hessian: information at them, without the prior, ``(n, n)``.
        cost: half the weighted squared error, at the start and after each iteration,
            ``(I + 1,)``.
        accepted: whether each lowered it, ``(I + 1,)``.
        delta: corrections of the starts, ``(M, 2 nv)``.
    """

    unit: jax.Array
    hessian: jax.Array
    cost: jax.Array
    accepted: jax.Array
    delta: jax.Array


def refine(
    machine: Machine,
    space: ParameterSpace,
    unit: jax.Array,
    segments: Segments,
    noise: jax.Array,
    iterations: int = 12,
    prior_std: float = 3.0,
    mesh: Mesh | None = None,
    misfit: jax.Array | None = None,
) -> RefineResult:
    """Levenberg-Marquardt from ``unit (n,)``; pure, for use inside jit.

    Args:
        noise: standard deviations of the measurement, ``(2 nv,)``, above zero.
        prior_std: weak pull towards the start, in initial ranges, so that
            directions without any information stay where they are.
        misfit: what the model itself errs by in every step, standard deviations
            ``(2 nv,)`` on top of the noise; inf leaves a channel's steps out.
    """
    mesh = mesh or make_mesh()
    low, high = space.unit_bounds
    anchor = unit
    pull = jnp.full(space.size, 1.0 / prior_std**2)
    weight = step_weights(segments, noise, misfit)

    def step(carry: Any, _: None) -> Any:
        # Evaluates a trial, keeps the better, proposes the next: the simulation is
        # in the program once.
        u, shift, best_u, best_shift, best, best_cost, damp = carry
        eq = normal_equations(machine, space, u, shift, segments, noise, weight, mesh)
        cost = eq.cost + 0.5 * jnp.sum(pull * (u - anchor) ** 2)
        better = jnp.isfinite(cost) & (cost < best_cost)
        new, old = (u, shift, eq, cost), (best_u, best_shift, best, best_cost)
        kept = jax.tree.map(lambda a, b: jnp.where(better, a, b), new, old)
        best_u, best_shift, best, best_cost = kept
        damp = jnp.clip(jnp.where(better, damp * 0.2, damp * 8.0), 1e-9, 1e6)
        hess = best.hessian + jnp.diag(pull)
        grad = best.gradient + pull * (best_u - anchor)
        du = -jnp.linalg.solve(hess + jnp.diag(damp * jnp.diag(hess)), grad)
        u = jnp.clip(best_u + du, low, high)
        gain = jnp.einsum("mdn,n->md", best.start_gain, u - best_u)
        shift = best_shift + best.start_step + gain
        return (u, shift, *kept, damp), (best_cost, better)

    shift = jnp.zeros((segments.qpos.shape[0], 2 * machine.mj_model.nv))
    blank = jax.tree.map(
        lambda x: jnp.zeros(x.shape, x.dtype),
        jax.eval_shape(
            lambda u: normal_equations(
                machine, space, u, shift, segments, noise, weight, mesh
            ),
            unit,
        ),
    )
    init = (unit, shift, unit, shift, blank, jnp.asarray(jnp.inf), jnp.asarray(1e-3))
    (_, _, u, shift, eq, _, _), (costs, better) = jax.lax.scan(
        step, init, None, length=iterations + 1
    )
    return RefineResult(u, eq.hessian, costs, better, shift)


def step_weights(
    segments: Segments, noise: jax.Array, misfit: jax.Array | None = None
) -> jax.Array:
    """Weight of each measured number, ``(M, H, 2 nv)``: 1 where the model is exact."""
    share = jnp.ones_like(noise)
    if misfit is not None:
        share = 1.0 / (1.0 + (misfit / noise) ** 2)
    shape = (segments.count, segments.horizon, noise.shape[0])
    return jnp.broadcast_to(segments.weight[:, None, None] * share, shape)
