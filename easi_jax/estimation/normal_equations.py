"""What measured segments say about the parameters: Fisher information.

Derivatives are those of `easi_jax.simulation.slopes` or, on MJX beyond three degrees of
freedom, central differences in single precision: derivatives of an arm of six compile
for minutes, and batches of larger robots simulate many times faster than derivatives go
through them (`easi_jax.simulation.cpu.batch_last`). The start state of each segment is
unknown within what was measured of it, or less, and eliminated (Schur complement). The
inverse is the Cramer-Rao bound.
"""

from dataclasses import dataclass
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
from jax.sharding import Mesh

from easi_jax.data.segments import Segments
from easi_jax.devices.mesh import make_mesh, replicated, sharded_map
from easi_jax.devices.runtime import on_cpu
from easi_jax.estimation.weights import step_weights
from easi_jax.model.parameters import ParameterSpace
from easi_jax.simulation import slopes
from easi_jax.simulation.simulator import Simulator

RESOLVED = 1e-5  # smallest eigenvalue of a float32 correlation matrix worth its name
_LANES = 64  # simulations at once of a smaller robot, whose loop is one piece then
# Of an initial range, for differences along a parameter: of 0.01 a bend of a drive's
# limit looks like knowledge where there is none, of 0.001 rounding does.
_STEP = 0.004
_MOVE = 1e-4, 0.1  # at least and at most, along a start [m, rad, m/s, rad/s]


@flax.struct.dataclass
class Normal:
    """Normal equations of one Gauss-Newton step, the starts eliminated.

    Attributes:
        hessian: ``(n, n)``, information in unit coordinates.
        gradients: of each piece, ``(M, n)``.
        costs: half the weighted squared error of each piece, ``(M,)``; inf where the
            simulation is not finite, which leaves no other trace here.
        start_step: ``(M, S)`` correction of each start at zero parameter step.
        start_gain: ``(M, S, n)``: correction per unit of parameter step.
        residuals: predicted minus measured, ``(M, H, 2 nv + N)``.
    """

    hessian: jax.Array
    gradients: jax.Array
    costs: jax.Array
    start_step: jax.Array
    start_gain: jax.Array
    residuals: jax.Array

    @classmethod
    def nothing(cls, size: int, starts: jax.Array, weight: jax.Array) -> "Normal":
        """Zeros for ``size`` parameters, starts like ``starts (M, S)``, and as many
        measured numbers as ``weight (M, H, 2 nv)``."""
        m, s = starts.shape
        shapes = (size, size), (m, size), (m,), (m, s), (m, s, size), weight.shape
        return cls(*(jnp.zeros(shape, starts.dtype) for shape in shapes))

    @property
    def gradient(self) -> jax.Array:
        """Of all pieces, ``(n,)``."""
        return self.gradients.sum(0)


@dataclass(frozen=True)
class PairedFit:
    """Predicted against measured segments, each start free within what is known of it.

    Attributes:
        simulator, space: what is simulated, and its parameters.
        segments: M of H control steps.
        noise: standard deviations of measured positions and velocities, ``(2 nv,)``;
            infinite for what is not measured.
        mesh: devices that share the segments; all of them by default.
        free_starts: whether starts are free, or known exactly.
        steps: control steps of each piece that are simulated, all by default; the
            others are to weigh nothing.
        start: standard deviations of the true starts about those of the segments,
            ``(S,)``: positions, velocities, and activations where these are free; by
            default the noise, and activations that are known.
        misfit: what the model itself errs by, standard deviations on top of the noise,
            in every step ``(2 nv,)`` or in each ``(H, 2 nv)``; inf leaves steps out.
    """

    simulator: Simulator
    space: ParameterSpace
    segments: Segments
    noise: jax.Array
    mesh: Mesh | None = None
    free_starts: bool = True
    steps: int | jax.Array | None = None
    start: jax.Array | None = None
    misfit: jax.Array | None = None

    @property
    def weight(self) -> jax.Array:
        """Of each measured number, ``(M, H, 2 nv)``."""
        return step_weights(self.segments, self.noise, self.misfit)

    @property
    def spread(self) -> jax.Array:
        """Standard deviations of a start, ``(S,)``."""
        return self.noise if self.start is None else self.start

    @property
    def unmoved(self) -> jax.Array:
        """No shift of any start, ``(M, S)``."""
        return jnp.zeros((self.segments.count, len(self.spread)))

    def normal(self, unit: jax.Array, delta: jax.Array, weight: jax.Array) -> Normal:
        """Gauss-Newton system at parameters ``unit (n,)`` and start shifts ``delta``.

        Args:
            delta: ``(M, S)``.
            weight: of each measured number, ``(M, H, 2 nv)``.
        """
        if self.simulator.by_differences:
            units, deltas = self.around(unit, delta)
            return self.sweep(units, deltas, weight)[0]

        def one(item: Any) -> Any:
            s, d, w = item
            r, jac = self._pushed(unit, d, s)
            return self._equations(r, jac, d, w, s.weight)

        native = self.simulator.engine == "mujoco"
        points = self.points if native else 1
        hessian, *rest = self._each(one, points, delta, weight)
        return Normal(hessian.sum(0), *rest)

    def information(self, unit: jax.Array) -> jax.Array:
        """Of the data at ``unit (n,)``, starts as they were measured, ``(n, n)``."""
        return self.normal(unit, self.unmoved, self.weight).hessian

    def around(self, unit: jax.Array, delta: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Points whose `sweep` holds the derivatives at ``unit (n,)`` and ``delta
        (M, S)``: themselves, then steps up, then steps down; ``(K, n)``,
        ``(K, M, S)``."""
        n, m, size = self.space.size, self._directions, delta.shape[1]
        low, high = self.space.unit_bounds
        along = jnp.full(n, _STEP)
        steps = jnp.concatenate([along, jnp.clip(self.spread, *_MOVE)])
        ways = jnp.eye(m, n + size) * steps
        ways = jnp.concatenate([jnp.zeros((1, n + size)), ways, -ways])
        # Between bounds a parameter may have less than its step to go.
        units = jnp.clip(unit + ways[:, :n], low, high)
        return units, delta + ways[:, None, n:]

    def sweep(
        self, units: jax.Array, deltas: jax.Array, weight: jax.Array
    ) -> tuple[Normal, jax.Array]:
        """Simulates every piece from several points ``(K, n)``, ``(K, M, S)``.

        One simulation for derivatives and for trials, so that it is compiled once.

        Returns:
            The system of `normal`, where the first points are those of `around`; the
            `costs` ``(K, M)``.
        """
        n, m = self.space.size, self._directions

        def one(item: Any) -> Any:
            s, d, w = item
            r = jax.vmap(lambda u, x: self._residual(u, x, s))(units, d)
            up, down = slice(1, m + 1), slice(m + 1, 2 * m + 1)
            gone = jnp.concatenate(
                [
                    jnp.diagonal(units[up][:n] - units[down][:n]),
                    jnp.diagonal((d[up] - d[down])[n:]),
                ]
            )
            safe = jnp.where(gone > 0, gone, 1.0)
            jac = jnp.moveaxis(r[up] - r[down], 0, -1) / safe
            cost = jax.vmap(lambda a, b: self._cost(a, b, w, s.weight))(r, d)
            return self._equations(r[0], jac, d[0], w, s.weight), cost

        shifts = jnp.swapaxes(deltas, 0, 1)
        equations, cost = self._each(one, units.shape[0], shifts, weight)
        return Normal(equations[0].sum(0), *equations[1:]), cost.T

    def _equations(
        self, r: jax.Array, jac: jax.Array, d: jax.Array, w: Any, share: jax.Array
    ) -> Any:
        """One piece's part of `Normal`, from its residual and slopes; ``share`` is what
        the piece counts."""
        n, size = self.space.size, self.spread
        root = jnp.sqrt(w) / self.noise
        # A piece of weight zero may hold anything; one that the simulation does not
        # get through has no slopes.
        on = (w > 0) & jnp.isfinite(r).all() & jnp.isfinite(jac).all()
        rw = jnp.where(on, r * root, 0.0).reshape(-1)
        jw = jnp.where(on[..., None], jac * root[..., None], 0.0)
        jw = jw.reshape(rw.shape[0], -1)
        given = jnp.concatenate([jw[:, :n], rw[:, None]], 1)
        cost = self._cost(r, d, w, share)
        if not self.free_starts:
            both = given.T @ given
            still = jnp.zeros(len(d)), jnp.zeros((len(d), n))
            return both[:n, :n], both[:n, n], cost, *still, r
        # Of a start something is known, too: a shift of one deviation costs half of
        # what the piece counts. What starts explain is taken off before squares are
        # summed, for a broad one explains nearly all of it.
        held = jnp.where(share > 0, jnp.sqrt(share), 1.0)
        b = jw[:, n:] * size
        known = jnp.zeros((len(d), n + 1)).at[:, n].set(held * d / size)
        normal = b.T @ b + held**2 * jnp.eye(len(d))
        follow = jnp.linalg.solve(normal, b.T @ given + held * known)
        left = jnp.concatenate([given - b @ follow, known - held * follow])
        both = left.T @ left
        step = -size[:, None] * follow
        return both[:n, :n], both[:n, n], cost, step[:, n], step[:, :n], r

    def _cost(
        self, r: jax.Array, d: jax.Array, w: jax.Array, share: jax.Array
    ) -> jax.Array:
        square = jnp.where(w > 0, w * (r / self.noise) ** 2, 0.0).sum()
        total = 0.5 * (square + share * jnp.sum((d / self.spread) ** 2))
        return jnp.where(jnp.isfinite(total), total, jnp.inf)

    def costs(self, unit: jax.Array, delta: jax.Array, weight: jax.Array) -> jax.Array:
        """The costs of `normal`, for several points at once.

        Args:
            unit: ``(K, n)``.
            delta: ``(K, M, S)``.
            weight: of each measured number, ``(M, H, 2 nv)``.

        Returns:
            ``(K, M)``; inf where the simulation is not finite.
        """

        def one(item: Any) -> jax.Array:
            s, d, w = item

            def cost(u: jax.Array, x: jax.Array) -> jax.Array:
                return self._cost(self._residual(u, x, s), x, w, s.weight)

            return jax.vmap(cost)(unit, d)

        shifts = jnp.swapaxes(delta, 0, 1)
        return self._each(one, unit.shape[0], shifts, weight).T

    def residuals(self, unit: jax.Array, delta: jax.Array) -> jax.Array:
        """Predicted minus measured ``(M, H, 2 nv + N)``, at ``unit (n,)`` and ``delta
        (M, S)``."""
        return self._each(lambda item: self._residual(unit, item[1], item[0]), 1, delta)

    @property
    def points(self) -> int:
        """Simulations of each piece that `normal` takes, a derivative as one."""
        if self.simulator.engine == "mjx":
            return 1 + self._directions * (1 + self.simulator.by_differences)
        size = self._directions - self.space.size
        turn = slopes.parts_and_turns(self.simulator, self.segments, size)[1]
        return 1 + self.space.size + 2 * (int(turn.max(initial=-1)) + 1)

    @property
    def _directions(self) -> int:
        return self.space.size + (len(self.spread) if self.free_starts else 0)

    def _each(self, one: Any, points: int, *items: jax.Array) -> Any:
        """``one`` of every segment with its ``items``, shared among the devices.

        ``points``: simulations that ``one`` makes of a segment.
        """
        mesh = self.mesh or make_mesh()
        share = -(-self.segments.count // mesh.size)
        one_piece = self.simulator.engine == "mjx" and not self.simulator.wide
        at_once = _LANES if one_piece and on_cpu() else self.simulator.batch
        wanted = at_once // points
        batch = min(share, max(1, wanted))
        rounds = -(-share // batch)
        batch = -(-share // rounds)  # even ones: a shorter last one compiles again

        def local(block: Any) -> Any:
            return jax.lax.map(one, block, batch_size=batch)

        given = (self.segments, *items)
        out = sharded_map(local, mesh, given, multiple=batch)
        # Whole before anybody sums it: in the same order whoever holds the devices.
        return replicated(out, mesh)

    def _pushed(
        self, unit: jax.Array, d: jax.Array, s: Segments
    ) -> tuple[jax.Array, jax.Array]:
        """Residual ``(H, 2 nv)`` of one segment and its slopes ``(..., directions)``
        along parameters and, where starts are free, along the start."""
        given = self.simulator, self.space, unit, d, s
        return slopes.linearized(*given, self.steps, self.free_starts)

    def _residual(self, unit: jax.Array, d: jax.Array, s: Segments) -> jax.Array:
        """Predicted minus measured, ``(H, 2 nv)``, of one segment; its start moved."""
        return slopes.residuals(self.simulator, self.space, unit, d, s, self.steps)
