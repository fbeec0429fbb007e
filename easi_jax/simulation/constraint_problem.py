"""The convex problem that both constraint solvers solve; see
`easi_jax.simulation.constraint_solver`."""

from typing import NamedTuple

import jax
import jax.numpy as jnp


class ConstraintProblem(NamedTuple):
    """The convex problem: mass ``(nv, nv)``, constraint rows ``(nefc, ...)``."""

    mass: jax.Array
    smooth: jax.Array
    jac: jax.Array
    stiff: jax.Array
    aref: jax.Array
    low: jax.Array
    high: jax.Array

    def force(self, x: jax.Array) -> jax.Array:
        return jnp.clip(-self.stiff * x, self.low, self.high)

    def gradient(self, a: jax.Array) -> tuple[jax.Array, jax.Array]:
        force = self.force(self.jac @ a - self.aref)
        return self.mass @ a - self.smooth - self.jac.T @ force, force

    def hessian(self, a: jax.Array) -> jax.Array:
        raw = -self.stiff * (self.jac @ a - self.aref)
        active = (raw > self.low) & (raw < self.high)
        return self.mass + (self.jac.T * (self.stiff * active)) @ self.jac

    def cost(self, a: jax.Array, center: jax.Array) -> jax.Array:
        x = self.jac @ a - self.aref
        force, da = self.force(x), a - center
        # s(x) = -f x - f^2 / (2 D) on every piece, f being the clipped force.
        rows = -force * x - 0.5 * force * force / self.stiff
        return 0.5 * da @ (self.mass @ da) + rows.sum()
