"""The constraint solver for batches of larger robots: Newton steps in lanes.

Same problem and same Newton directions as `easi_jax.simulation.constraint_solver`. Rows
that touch one joint (dry friction, limits) are kept apart from the dense ones, and the
search along a direction is a bracketed Newton iteration on the piecewise linear slope.
"""

from collections.abc import Callable
from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from mujoco.mjx._src.types import DisableBit, JointType

from easi_jax.simulation.constraint_problem import ConstraintProblem
from easi_jax.simulation.cpu import batch_last
from easi_jax.simulation.cpu.batch_last import (
    product,
    row_sum,
    total,
    transposed_product,
)

_LINE_STEPS = 2


class Rows(NamedTuple):
    """Where the constraint rows act.

    Attributes:
        dense: indices of the rows that may act on several dofs.
        single: indices of the rows that act on one dof only.
        dofs: the dof of each of those.
    """

    dense: np.ndarray
    single: np.ndarray
    dofs: tuple[int, ...]


def rows_of(model: Any, data: Any) -> Rows:
    """Which rows of ``efc_J`` have one entry, from the order in which MJX makes them:
    equalities, friction (dofs, tendons), limits (balls, hinges, tendons), contacts."""
    impl, off = data._impl, model.opt.disableflags
    dof = np.full(impl.efc_J.shape[0], -1)
    if impl.nf and not off & DisableBit.FRICTIONLOSS:
        dofs = np.flatnonzero(model._impl.dof_hasfrictionloss)
        dof[impl.ne : impl.ne + len(dofs)] = dofs
    if impl.nl and not off & DisableBit.LIMIT:
        limited = np.asarray(model.jnt_limited).astype(bool)
        balls = (model.jnt_type == JointType.BALL) & limited
        hinges = np.isin(model.jnt_type, (JointType.SLIDE, JointType.HINGE)) & limited
        first = impl.ne + impl.nf + int(balls.sum())
        dofs = np.asarray(model.jnt_dofadr)[hinges]
        dof[first : first + len(dofs)] = dofs
    single = np.flatnonzero(dof >= 0)
    return Rows(np.flatnonzero(dof < 0), single, tuple(dof[single].tolist()))


class Problem(NamedTuple):
    """A batch of convex problems; every array has its lanes last.

    Attributes:
        mass: ``(nv, nv)``.
        smooth: force without constraints ``(nv,)``.
        dense: Jacobian of the dense rows ``(nd, nv)``.
        signs: entries of the other rows ``(ns,)``.
        stiff, aref, low, high: of all rows, dense ones first ``(nd + ns,)``.
    """

    mass: Any
    smooth: Any
    dense: Any
    signs: Any
    stiff: Any
    aref: Any
    low: Any
    high: Any


class _Newton:
    """Newton's method in lanes for problems of one shape."""

    def __init__(self, dofs: tuple[int, ...], steps: int) -> None:
        self.dofs = dofs
        self.steps = steps
        # Traced once for all the programs and transformations that it is part of.
        self._traced = jax.jit(self._solve, inline=True)

    def __call__(self, p: Problem, warm: jax.Array, start: jax.Array) -> Any:
        """Acceleration ``(nv, lanes)``, force on the rows, force on the joints."""
        return batch_last.from_stored(self._traced, (*p, warm, start), p.stiff[0] > 0)

    def _solve(self, *args: jax.Array) -> Any:
        p, (warm, start) = Problem(*args[:-2]), args[-2:]
        nv = p.mass.shape[0]
        few = max(p.stiff.shape[0], nv) - p.stiff.shape[0]
        stiff = jnp.pad(p.stiff, ((0, few), (0, 0)), constant_values=1.0)
        hold = batch_last.holding(batch_last.secret_ones(stiff))
        better = self._cost(p, warm, start, hold) < self._cost(p, start, start, hold)
        a = jnp.where(better, warm, start)

        settled = jnp.sqrt(jnp.finfo(a.dtype).eps)

        def going(state: Any) -> jax.Array:
            return state[1] < self.steps

        def step(state: Any) -> Any:
            a, k = state
            new = self._step(p, a, hold)
            # A full Newton step is exact where no row changes: a small one was the
            # last. A short one is small too, where the line search finds no way.
            moved = jnp.abs(new - a).max(0) > settled * jnp.abs(new).max(0)
            return new, jnp.where(moved.any(), k + 1, self.steps)

        a, _ = jax.lax.while_loop(going, step, (a, jnp.asarray(0)))
        force = jnp.clip(-p.stiff * hold(self._along(p, a) - p.aref), p.low, p.high)
        return a, force, self._back(p, force)

    def _along(self, p: Problem, a: Any) -> jax.Array:
        """``J a``."""
        parts = [product(p.dense, a)] if p.dense.shape[0] else []
        if self.dofs:
            picked = [a[j] * p.signs[k] for k, j in enumerate(self.dofs)]
            parts.append(jnp.stack(picked))
        return jnp.concatenate(parts)

    def _back(self, p: Problem, force: jax.Array) -> jax.Array:
        """``J' force``."""
        nd, nv = p.dense.shape[:2]
        if nd:
            rows = list(transposed_product(p.dense, force[:nd]))
        else:
            rows = [jnp.zeros_like(force[0])] * nv
        for k, j in enumerate(self.dofs):
            rows[j] = rows[j] + p.signs[k] * force[nd + k]
        return jnp.stack(rows)

    def _cost(
        self, p: Problem, a: Any, center: Any, hold: batch_last.Hold
    ) -> jax.Array:
        x = hold(self._along(p, a) - p.aref)
        force, da = jnp.clip(-p.stiff * x, p.low, p.high), a - center
        rows = -force * x - 0.5 * force * force / p.stiff
        return row_sum(0.5 * da * hold(product(p.mass, da))) + row_sum(rows)

    def _step(self, p: Problem, a: jax.Array, hold: batch_last.Hold) -> jax.Array:
        nd, nv = p.dense.shape[:2]
        x = hold(self._along(p, a) - p.aref)
        raw = -p.stiff * x
        force = jnp.clip(raw, p.low, p.high)
        grad = hold(product(p.mass, a) - p.smooth - self._back(p, force))
        weight = jnp.where((raw > p.low) & (raw < p.high), p.stiff, 0.0)
        at: dict[int, list[int]] = {}
        for k, j in enumerate(self.dofs):
            at.setdefault(j, []).append(nd + k)

        def column(j: int) -> jax.Array:
            terms = [p.mass[j:, j]]
            terms += [
                p.dense[r, j:] * (p.dense[r, j] * weight[r])[None] for r in range(nd)
            ]
            out = total(terms)
            if j not in at:
                return out
            corner = out[:1] + total([weight[r][None] for r in at[j]])
            return jnp.concatenate([corner, out[1:]])

        chol = batch_last.factor(column, nv, hold)
        y = batch_last.solve_lower(chol, -grad, hold)
        way = batch_last.solve_upper(chol, y, hold)
        jv = hold(self._along(p, way))
        mw = hold(product(p.mass, way))
        descent = hold(total([way[i] * grad[i] for i in range(nv)]))
        curve = hold(total([way[i] * mw[i] for i in range(nv)]))
        t = self._line(p, x, jv, descent, hold(row_sum(jv * force)), curve, hold)
        return jnp.stack([a[i] + way[i] * t for i in range(nv)])

    def _line(
        self,
        p: Problem,
        x: jax.Array,
        jv: jax.Array,
        descent: jax.Array,
        pushed: jax.Array,
        curve0: jax.Array,
        hold: batch_last.Hold,
    ) -> jax.Array:
        """Where the cost at ``x + t jv`` is least, ``(lanes,)``; see
        `easi_jax.simulation.constraint_solver._exact_step`.

        Args:
            descent: slope of the cost at t = 0; its curvature there is ``-descent``,
                since the way is Newton's.
            pushed: what the rows' forces take off that slope.
            curve0: curvature without the rows.
        """
        slope0 = hold(descent + pushed)

        def at(t: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
            raw = -p.stiff * (x + t * jv)
            inside = (raw > p.low) & (raw < p.high)
            force = hold(jv * jnp.clip(raw, p.low, p.high))
            bend = hold(jv * jv * jnp.where(inside, p.stiff, 0.0))
            slope = hold(slope0 + t * curve0 - row_sum(force))
            return t, slope, hold(curve0 + row_sum(bend))

        def closer(ends: Any, point: Any) -> Any:
            """The bracket with one more point in it."""
            (lo, hi), below = ends, point[1] <= 0
            up = below & (point[0] >= lo[0])
            down = ~below & (point[0] <= hi[0])
            pick = partial(jax.tree.map, jnp.where)
            return pick((up,) * 3, point, lo), pick((down,) * 3, point, hi)

        zero = jnp.zeros_like(slope0)
        lo, hi = (zero, descent, -descent), (zero + jnp.inf, zero + 1.0, zero + 1.0)
        lo, hi = closer((lo, hi), at(zero + 1.0))
        for _ in range(_LINE_STEPS):
            middle = jnp.where(jnp.isfinite(hi[0]), 0.5 * (lo[0] + hi[0]), 2 * lo[0])
            points = []
            for end, otherwise in ((lo, _secant(lo, hi)), (hi, middle)):
                t = end[0] - end[1] / end[2]
                inside = (t > lo[0]) & (t < hi[0]) & jnp.isfinite(t)
                points.append(at(hold(jnp.where(inside, t, otherwise))))
            for point in points:
                lo, hi = closer((lo, hi), point)
        t = _secant(lo, hi)
        return jnp.where(curve0 > 0, t, 0.0)


def _secant(lo: Any, hi: Any) -> jax.Array:
    """Zero of the line through both ends; exact where no row changes in between."""
    rise = hi[1] - lo[1]
    between = lo[0] - lo[1] * (hi[0] - lo[0]) / jnp.where(rise > 0, rise, 1.0)
    beyond = lo[0] - lo[1] / lo[2]
    return jnp.where(jnp.isfinite(hi[0]), jnp.where(rise > 0, between, lo[0]), beyond)


@lru_cache(maxsize=64)
def solution(
    dofs: tuple[int, ...], steps: int
) -> Callable[..., tuple[jax.Array, jax.Array, jax.Array]]:
    """The solver ``f(problem, warm, start)``, unbatched, for `Rows.dofs`.

    ``problem``'s arrays are without lanes; it takes ``steps`` Newton steps at most,
    from the better of ``start``, the acceleration without constraints, and ``warm``.
    Returns acceleration, force on each row (dense ones first), force on each joint.
    Derivatives are those of the converged solution.
    """
    newton = batch_last.lanes(_Newton(dofs, steps))

    @jax.custom_jvp
    def solve(p: Problem, warm: jax.Array, start: jax.Array) -> Any:
        return newton(p, warm, start)

    def slope(primals: Any, tangents: Any) -> Any:
        p, dp = primals[0], tangents[0]
        a, force, joint = solve(*primals)

        def residual(q: Problem, at: jax.Array) -> Any:
            whole = _whole(q, dofs)
            grad, f = whole.gradient(at)
            return grad, f, whole.jac.T @ f

        _, (grad, _, _) = jax.jvp(lambda q: residual(q, a), (p,), (dp,))
        da = -solve_spd(_whole(p, dofs).hessian(a), grad)
        _, (_, df, dj) = jax.jvp(residual, (p, a), (dp, da))
        return (a, force, joint), (da, df, dj)

    solve.defjvp(slope)
    return solve


def _whole(p: Problem, dofs: tuple[int, ...]) -> ConstraintProblem:
    jac = p.dense
    if dofs:
        single = jnp.eye(p.mass.shape[0], dtype=p.mass.dtype)[np.array(dofs)]
        jac = jnp.concatenate([jac, p.signs[:, None] * single])
    return ConstraintProblem(p.mass, p.smooth, jac, p.stiff, p.aref, p.low, p.high)


@batch_last.lanes
def solve_spd(a: jax.Array, b: jax.Array) -> jax.Array:
    """``a^-1 b`` for a symmetric positive definite ``a`` ``(n, n)`` and ``(n,)``."""

    def solve(a: jax.Array, b: jax.Array) -> jax.Array:
        hold = batch_last.holding(batch_last.secret_ones(b))
        chol = batch_last.factor(lambda j: a[j:, j], a.shape[0], hold)
        y = batch_last.solve_lower(chol, b, hold)
        return jnp.stack(batch_last.solve_upper(chol, y, hold))

    return batch_last.from_stored(solve, (a, b), a[0, 0] > 0)
