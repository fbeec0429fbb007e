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
from mujoco.mjx._src import support
from mujoco.mjx._src.types import ConeType, DisableBit


def supported(model: Any) -> bool:
    """Whether `solve` covers this `mjx.Model` (otherwise use `mjx.forward`)."""
    return model.opt.cone == ConeType.PYRAMIDAL


def solve(model: Any, data: Any, iterations: int) -> Any:
    """Sets ``qacc``, ``qfrc_constraint`` and ``efc_force`` of an unbatched Data.

    Args:
        model: `mjx.Model` with pyramidal cones.
        data: `mjx.Data` after the smooth forward pass and `make_constraint`.
        iterations: Newton steps, all taken.
    """
    impl = data._impl
    jac, dd, aref = impl.efc_J, impl.efc_D, impl.efc_aref
    ne, nf = impl.ne, impl.nf
    mass = support.full_m(model, data)
    smooth = data.qfrc_smooth
    floss = impl.efc_frictionloss
    nefc = jac.shape[0]
    rows = jnp.arange(nefc)
    is_fri = (rows >= ne) & (rows < ne + nf)
    if model.opt.disableflags & DisableBit.FRICTIONLOSS:
        is_fri = jnp.zeros_like(is_fri)
    inf = jnp.asarray(jnp.inf, dd.dtype)
    # Force on a row is clip(-D x, low, high): two-sided, Huber or one-sided.
    high = jnp.where(is_fri, floss, inf)
    low = jnp.where(is_fri, -floss, jnp.where(rows < ne, -inf, 0.0))

    def force_of(x: jax.Array) -> tuple[jax.Array, jax.Array]:
        raw = -dd * x
        active = (raw > low) & (raw < high)
        return jnp.clip(raw, low, high), active

    def cost_of(a: jax.Array) -> jax.Array:
        x = jac @ a - aref
        force, _ = force_of(x)
        # s(x) = -(f x) - f^2/(2 D) holds on every piece, f being the clipped force.
        rows_cost = -force * x - 0.5 * force * force / dd
        da = a - data.qacc_smooth
        return 0.5 * da @ (mass @ da) + rows_cost.sum()

    start = data.qacc_smooth
    if not model.opt.disableflags & DisableBit.WARMSTART:
        warm = data.qacc_warmstart
        start = jnp.where(cost_of(warm) < cost_of(start), warm, start)

    def newton(a: jax.Array) -> jax.Array:
        x = jac @ a - aref
        force, active = force_of(x)
        grad = mass @ a - smooth - jac.T @ force
        hess = mass + (jac.T * (dd * active)) @ jac
        chol = jax.scipy.linalg.cho_factor(hess)
        p = -jax.scipy.linalg.cho_solve(chol, grad)
        jv = jac @ p
        slope0, curve0 = p @ grad + jv @ force, p @ (mass @ p)
        return a + p * _exact_step(x, jv, dd, low, high, slope0, curve0)

    qacc = start
    for _ in range(iterations):
        qacc = newton(qacc)
    force, _ = force_of(jac @ qacc - aref)
    return data.tree_replace(
        {
            "qacc": qacc,
            "qfrc_constraint": jac.T @ force,
            "_impl.efc_force": force,
        }
    )


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
    one of its limits.
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
    at = jax.lax.stop_gradient(jnp.where(finite & (at > 0), at, jnp.inf))
    below = jax.vmap(slope)(jnp.where(jnp.isfinite(at), at, 0.0)) <= 0
    known = jnp.isfinite(at)
    lo = jnp.max(jnp.where(known & below, at, 0.0), initial=0.0)
    hi = jnp.min(jnp.where(known & ~below, at, jnp.inf), initial=jnp.inf)
    mid = jax.lax.stop_gradient(jnp.where(jnp.isfinite(hi), 0.5 * (lo + hi), lo + 1.0))
    raw = -dd * (x + mid * jv)
    inside = (raw > low) & (raw < high)
    curve = curve0 + (jv * jv * dd * inside).sum()
    ok = curve > 0
    step = mid - slope(mid) / jnp.where(ok, curve, 1.0)
    return jnp.where(ok, jnp.maximum(step, 0.0), 0.0)
