"""The constraint solver of the physics step, shaped for large batches.

MuJoCo's convex problem (MuJoCo documentation, "Computation", eq. for the primal):

    min_a  1/2 (a - a0)' M (a - a0) + sum_i s_i(J_i a - aref_i)

with s_i quadratic for equalities, Huber for dry friction, one-sided quadratic for
limits and pyramidal contacts. The cost along a Newton direction is piecewise
quadratic, so its minimum is found exactly from the breakpoints: no bracketing, no
`while_loop`, a fixed number of Newton steps. Batches vectorize, and forward-mode
derivatives are those of the converged solution. Elliptic cones and tendon friction
stay with MJX's own solver.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from mujoco.mjx._src import support
from mujoco.mjx._src.types import ConeType, DisableBit

from easi_jax.simulation.constraint_problem import ConstraintProblem
from easi_jax.simulation.cpu import batched_newton


def supported(model: Any) -> bool:
    """Whether `solve` covers this `mjx.Model` (otherwise use `mjx.forward`)."""
    return model.opt.cone == ConeType.PYRAMIDAL


def newton_steps(iterations: int, rows: int) -> int:
    """Newton steps to take: MuJoCo's limit, or as many as ``rows`` can need.

    MuJoCo allows 100 and stops at a tolerance, mostly after two or three; a batch takes
    the same number everywhere. With the exact line search a step settles most rows at
    once: three are exact for two joints with friction and limits (tests/test_solver).
    """
    return min(iterations, 4 + rows // 8)


def solve(model: Any, data: Any, iterations: int, wide: bool = False) -> Any:
    """Sets ``qacc``, ``qfrc_constraint`` and ``efc_force`` of an unbatched Data.

    Args:
        model: `mjx.Model` with pyramidal cones.
        data: `mjx.Data` after the smooth forward pass and `make_constraint`.
        iterations: Newton steps at most (see `newton_steps`).
        wide: for batches of robots too large to be written out entry by entry.
    """
    impl = data._impl
    mass = support.full_m(model, data)
    rows = jnp.arange(impl.efc_J.shape[0])
    dry = (rows >= impl.ne) & (rows < impl.ne + impl.nf)
    dry &= not model.opt.disableflags & DisableBit.FRICTIONLOSS
    floss = impl.efc_frictionloss
    # Force on a row is clip(-D x, low, high): two-sided, Huber or one-sided.
    high = jnp.where(dry, floss, jnp.inf)
    low = jnp.where(dry, -floss, jnp.where(rows < impl.ne, -jnp.inf, 0.0))
    problem = ConstraintProblem(
        mass, data.qfrc_smooth, impl.efc_J, impl.efc_D, impl.efc_aref, low, high
    )
    if wide:
        return _solve_wide(model, data, problem, iterations)
    fixed = jax.lax.stop_gradient(problem)
    smooth, warm = jax.lax.stop_gradient((data.qacc_smooth, data.qacc_warmstart))
    qacc = smooth
    if not model.opt.disableflags & DisableBit.WARMSTART:
        better = fixed.cost(warm, smooth) < fixed.cost(smooth, smooth)
        qacc = jnp.where(better, warm, smooth)
    for _ in range(newton_steps(iterations, impl.efc_J.shape[0])):
        qacc = _newton(fixed, qacc)
    # Implicit function theorem: one more step from the solution is zero in value
    # and has the solution's derivative. The iterations need none.
    grad, _ = problem.gradient(qacc)
    step = -_solve_spd(fixed.hessian(qacc), grad)
    qacc = qacc + step - jax.lax.stop_gradient(step)
    _, force = problem.gradient(qacc)
    return data.tree_replace(
        {
            "qacc": qacc,
            "qfrc_constraint": impl.efc_J.T @ force,
            "_impl.efc_force": force,
        }
    )


def _solve_wide(model: Any, data: Any, p: ConstraintProblem, iterations: int) -> Any:
    rows = batched_newton.rows_of(model, data)
    order = np.concatenate([rows.dense, rows.single])
    problem = batched_newton.Problem(
        p.mass,
        p.smooth,
        p.jac[rows.dense],
        p.jac[rows.single, np.array(rows.dofs, int)],
        *(x[order] for x in (p.stiff, p.aref, p.low, p.high)),
    )
    cold = model.opt.disableflags & DisableBit.WARMSTART
    warm = data.qacc_smooth if cold else data.qacc_warmstart
    find = batched_newton.solution(rows.dofs, newton_steps(iterations, len(order)))
    qacc, force, joint = find(problem, warm, data.qacc_smooth)
    force = force[np.argsort(order)]
    return data.tree_replace(
        {"qacc": qacc, "qfrc_constraint": joint, "_impl.efc_force": force}
    )


def _newton(problem: ConstraintProblem, a: jax.Array) -> jax.Array:
    """One Newton step with an exact line search."""
    mass, _, jac, stiff, aref, low, high = problem
    grad, force = problem.gradient(a)
    p = -_solve_spd(problem.hessian(a), grad)
    x, jv = jac @ a - aref, jac @ p
    slope0, curve0 = p @ grad + jv @ force, p @ (mass @ p)
    return a + p * _exact_step(x, jv, stiff, low, high, slope0, curve0)


def _solve_spd(a: jax.Array, b: jax.Array) -> jax.Array:
    return jax.scipy.linalg.cho_solve(jax.scipy.linalg.cho_factor(a), b)


def _exact_step(
    x: jax.Array,
    jv: jax.Array,
    dd: jax.Array,
    low: jax.Array,
    high: jax.Array,
    slope0: jax.Array,
    curve0: jax.Array,
) -> jax.Array:
    """Minimizer over t >= 0 of the cost at ``x + t jv``.

    The derivative ``slope0 + t curve0 - sum jv clip(-D (x + t jv), low, high)``
    grows with t and is linear between the breakpoints, where a row's force reaches
    one of its limits. A row that the direction barely moves has its breakpoint very
    far off, so the minimum is counted from the nearer end of its piece: counted from
    the middle, it would be lost in rounding.
    """

    def slope(t: jax.Array) -> jax.Array:
        force = jnp.clip(-dd * (x + t * jv), low, high)
        return slope0 + t * curve0 - (jv * force).sum()

    moving = jv != 0
    safe = jnp.where(moving, jv, 1.0)
    limits = jnp.concatenate([low, high])
    finite = jnp.concatenate([moving, moving]) & jnp.isfinite(limits)
    at = -(jnp.where(finite, limits, 0.0) / jnp.tile(dd, 2) + jnp.tile(x, 2))
    at = at / jnp.tile(safe, 2)
    at = jnp.where(finite & (at > 0), at, jnp.inf)
    below = jax.vmap(slope)(jnp.where(jnp.isfinite(at), at, 0.0)) <= 0
    known = jnp.isfinite(at)
    lo = jnp.max(jnp.where(known & below, at, 0.0), initial=0.0)
    hi = jnp.min(jnp.where(known & ~below, at, jnp.inf), initial=jnp.inf)
    mid = jnp.where(jnp.isfinite(hi), 0.5 * (lo + hi), lo + 1.0)
    raw = -dd * (x + mid * jv)
    inside = (raw > low) & (raw < high)
    curve = curve0 + (jv * jv * dd * inside).sum()
    ok = curve > 0
    step = lo - slope(lo) / jnp.where(ok, curve, 1.0)
    return jnp.where(ok, jnp.clip(step, lo, hi), 0.0)
