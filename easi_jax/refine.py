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

from easi_jax.information import Normal, normal_equations
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
        cost: half the weighted squared error after each iteration, ``(I,)``.
        accepted: whether each step lowered it, ``(I,)``.
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
) -> RefineResult:
    """Levenberg-Marquardt from ``unit (n,)``; pure, for use inside jit.

    Args:
        noise: standard deviations of the measurement, ``(2 nv,)``, above zero.
        prior_std: weak pull towards the start, in initial ranges, so that
            directions without any information stay where they are.
    """
    mesh = mesh or make_mesh()
    low, high = space.unit_bounds
    anchor = unit
    pull = jnp.full(space.size, 1.0 / prior_std**2)
    shape = (segments.count, segments.horizon, 2 * machine.mj_model.nv)
    weight = jnp.broadcast_to(segments.weight[:, None, None], shape)

    def equations(u: jax.Array, delta: jax.Array) -> tuple[Normal, jax.Array]:
        eq = normal_equations(machine, space, u, delta, segments, noise, weight, mesh)
        return eq, eq.cost + 0.5 * jnp.sum(pull * (u - anchor) ** 2)

    def step(carry: Any, _: None) -> Any:
        u, delta, eq, cost, damp = carry
        hess = eq.hessian + jnp.diag(pull)
        grad = eq.gradient + pull * (u - anchor)
        du = -jnp.linalg.solve(hess + jnp.diag(damp * jnp.diag(hess)), grad)
        trial = jnp.clip(u + du, low, high)
        shift = (
            delta + eq.start_step + jnp.einsum("mdn,n->md", eq.start_gain, trial - u)
        )
        new_eq, new_cost = equations(trial, shift)
        better = jnp.isfinite(new_cost) & (new_cost < cost)
        pick = lambda a, b: jax.tree.map(  # noqa: E731
            lambda x, y: jnp.where(better, x, y), a, b
        )
        carry = pick((trial, shift, new_eq, new_cost), (u, delta, eq, cost))
        damp = jnp.clip(jnp.where(better, damp * 0.2, damp * 8.0), 1e-9, 1e6)
        return (*carry, damp), (carry[3], better)

    delta0 = jnp.zeros((segments.qpos.shape[0], 2 * machine.mj_model.nv))
    eq0, cost0 = equations(unit, delta0)
    init = (unit, delta0, eq0, cost0, jnp.asarray(1e-3))
    (u, delta, eq, _, _), (costs, better) = jax.lax.scan(
        step, init, None, length=iterations
    )
    return RefineResult(u, eq.hessian, costs, better, delta)
