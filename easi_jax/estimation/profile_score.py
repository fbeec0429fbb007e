"""Parameters whose score is zero on average: starts that are fitted, paid for.

`easi_jax.estimation.levenberg_marquardt` fits the start of every piece with the
parameters. Each start takes its share of the noise, and where motion is no straight
line within the noise, the
parameters pay: at low speed a fitted start chooses the sign of a speed, and friction
comes out too high and too sure, however many pieces there are (the incidental
parameters of Neyman and Scott, 1948). The cure is the adjusted profile score of
McCullagh and Tibshirani (1990): at each parameter vector, what the score would be on
average if the model with the fitted starts were the truth is simulated, and taken off.
What is left is zero at the result. The noise of the simulated average is small, since
the same draws also give the score at their true starts, whose average is zero. In a
direction where it is not, or where scores with fitted starts scatter more than their
information says, the result is as much less sure (Godambe, 1960).
"""

from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp

from easi_jax.data.segments import Segments
from easi_jax.estimation.least_squares import (
    bounded_step,
    held_back,
    moved,
    raised_to_range,
)
from easi_jax.estimation.levenberg_marquardt import RefineResult
from easi_jax.estimation.limits import EDGE, beyond_edge
from easi_jax.estimation.normal_equations import RESOLVED, PairedFit
from easi_jax.model.parameters import ParameterSpace
from easi_jax.simulation.slopes import shift_readings, shift_start

_DRAWS = 2  # of the noise, for every piece
_ROUNDS = 20  # at most
_TURNS = 4  # looks at each start, a Gauss-Newton step between each two
_FARTHEST = 4.0  # standard deviations that a start may be off
_PULL = 12.0  # information of a uniform initial range, unit coordinates
_LONGEST = 4.0  # times the Newton step: the average changes with the parameters, too
_SHORT = 0.2  # a step which still loses what was known: it stays as it is
_SHORTEST = 0.02
_LOST = 0.2  # of what was known of a parameter: less must not be left by a step
_SETTLED = 1e-2  # half the squared score that is left, in its standard deviations
_NOISE, _FIRST, _MOVING, _RAISED, _DONE = range(5)


@flax.struct.dataclass
class Score:
    """The profile score of all pieces.

    Attributes:
        hessian: information, ``(n, n)``.
        gradient: of the cost with fitted starts, ``(n,)``.
        bias: what it is on average, ``(n,)``.
        scatter: covariance of their difference, as the draws show it, ``(n, n)``.
        cost, expected: half the weighted squared error, and its average, ``()``.
        delta: fitted shifts of the starts, ``(M, 2 nv)``.
    """

    hessian: jax.Array
    gradient: jax.Array
    bias: jax.Array
    scatter: jax.Array
    cost: jax.Array
    expected: jax.Array
    delta: jax.Array

    @classmethod
    def nothing(cls, size: int, starts: jax.Array) -> "Score":
        """Zeros for ``size`` parameters and starts like ``starts (M, 2 nv)``."""
        shapes = (size, size), (size,), (size,), (size, size), (), (), starts.shape
        return cls(*(jnp.zeros(shape, starts.dtype) for shape in shapes))

    @property
    def surplus(self) -> jax.Array:
        """Cost above its average, ``()``."""
        return self.cost - self.expected


@flax.struct.dataclass
class _Carry:
    """Of the rounds of `adjust`."""

    phase: jax.Array  # what is looked at: the noise, the start, steps, what is raised
    k: jax.Array
    at: jax.Array  # where the score is looked at next
    spread: jax.Array
    here: Any  # the best so far, and its score
    held: jax.Array  # what stays as it is
    length: jax.Array
    left: jax.Array
    seen: Any  # the score at the place looked at last


def less_scatter(hessian: jax.Array, scatter: jax.Array, count: int) -> jax.Array:
    """Information ``(n, n)`` of a score that scatters more than its ``hessian``.

    ``H S^-1 H``, where ``scatter`` S exceeds H by more than its own noise makes of
    ``count`` pieces (the largest eigenvalue of a Wishart matrix); H elsewhere.
    """
    size = jnp.sqrt(jnp.maximum(jnp.diag(hessian), 1e-30))
    scaled, spread = (
        0.5 * (x + x.T) / size[:, None] / size for x in (hessian, scatter)
    )
    values, vectors = jnp.linalg.eigh(scaled)
    seen = values > RESOLVED
    white = jnp.where(seen, vectors / jnp.sqrt(jnp.where(seen, values, 1.0)), 0.0)
    times, axes = jnp.linalg.eigh(white.T @ spread @ white)
    noise = (1.0 + jnp.sqrt(len(size) / count)) ** 2
    over = jnp.maximum(times / noise, 1.0)
    along = scaled @ white @ axes
    rest = scaled - (along * (1.0 - 1.0 / over)) @ along.T
    return jnp.where(jnp.isfinite(rest).all(), rest, scaled) * size[:, None] * size


def _scatter(x: jax.Array) -> jax.Array:
    """Covariance of one of the draws ``x (K, n)``, ``(n, n)``."""
    off = x - x.mean(0)
    return off.T @ off / (len(x) - 1)


def adjust(paired: PairedFit, fit: RefineResult) -> tuple[RefineResult, jax.Array]:
    """From a best fit to where its score less the average is zero; pure.

    Noise that was assumed too high is taken as high as the fit's cost shows.

    Returns:
        The fit there, its information less what its score scatters beyond it; and half
        the squared score that is left, in its standard deviations, at the start and at
        the result, ``(2,)``.
    """
    space, segments, noise = paired.space, paired.segments, paired.noise
    shape = (segments.count, _DRAWS, segments.horizon + 1, len(noise))
    draws = jax.random.normal(jax.random.key(0), shape)
    off = jnp.zeros_like(noise) if paired.misfit is None else paired.misfit
    later = jnp.where(jnp.isfinite(off), jnp.hypot(noise, off), 0.0)
    root = _Root(paired, paired.weight, draws)
    spread = jnp.concatenate([noise[None], jnp.atleast_2d(later)])
    begin = root.begin(raised_to_range(space, fit.unit), spread)
    end, rounds = jax.lax.scan(root.search, begin, jnp.array([False, True]))
    u, found = end.here
    points = (1 + _DRAWS) * _TURNS * paired.points * rounds.sum()
    adjusted = replace(
        fit,
        unit=u,
        hessian=root.worth(found),
        # Scatter is in the score's worth already.
        gradients=jnp.zeros_like(fit.gradients),
        delta=found.delta,
        raised=raised_to_range(space, u),
        raised_hessian=root.worth(end.seen),
        simulated=fit.simulated + 1.0 * segments.count * segments.horizon * points,
    )
    return adjusted, end.left


@dataclass(frozen=True)
class _Root:
    """What all rounds have in common.

    Attributes:
        fit: the pieces.
        weight: of each measured number, ``(M, H, 2 nv)``.
        draws: standard normal, ``(M, K, H + 1, 2 nv)``: of each start, then of what is
            measured after each step.
    """

    fit: PairedFit
    weight: jax.Array
    draws: jax.Array

    @property
    def space(self) -> ParameterSpace:
        return self.fit.space

    def score(self, unit: jax.Array, spread: jax.Array) -> Score:
        """The score at ``unit (n,)``, each start at its best.

        Args:
            spread: standard deviations of the noise of starts, then of what comes
                after, of each step or of all, ``(1 + H or 2, 2 nv)``.
        """
        fit = self.fit

        def one(item: Any) -> Any:
            s, w, e = item

            def fitted(s: Segments) -> Any:
                def turn(d: jax.Array, _: Any) -> Any:
                    r, jac = fit._pushed(unit, d, s)
                    parts = fit._equations(r, jac, d, w, s.weight)
                    ahead = jnp.clip(d + parts[3], -most, most)
                    return ahead, (d, r, jac, parts)

                _, turns = jax.lax.scan(
                    turn, jnp.zeros(most.shape), None, length=_TURNS
                )
                return jax.tree.map(lambda x: x[-1], turns)

            def draw(real: Any, item: Any) -> Any:
                """The measured piece, then those that ``e`` would have made of it."""
                k, e = item
                d, r, jac = real
                first, later = e[0] * spread[0], e[1:] * spread[1:]
                new = shift_start(fit.simulator, s, d + first)
                new = shift_readings(fit.simulator, new, r + later)
                new = jax.tree.map(partial(jnp.where, k), new, s)
                *found, parts = fitted(new)
                # The truth of what is made is known: its score is zero on average.
                known = fit._equations(-later, jac, -first, w, s.weight)[1]
                fine = jnp.isfinite(parts[2]) & (parts[2] > 0)
                over = jnp.where(fine, parts[1] - known, 0.0)
                real = jax.tree.map(partial(jnp.where, k), real, tuple(found))
                return real, (*parts[:3], over, known)

            none = most, w, jnp.broadcast_to(w[..., None], (*w.shape, ways))
            none = jax.tree.map(jnp.zeros_like, none)
            drawn = jnp.arange(1 + len(e)) > 0
            e = jnp.concatenate([0.0 * e[:1], e])
            real, (hess, *rest) = jax.lax.scan(draw, none, (drawn, e))
            grad, cost, over, known = rest
            over, known = over[1:], known[1:]
            bias, expected = over.mean(0), cost[1:].mean()
            scatter = _scatter(over + known) + _scatter(over) / len(over)
            return hess[0], grad[0], bias, scatter, cost[0], expected, real[0]

        most, ways = _FARTHEST * fit.noise, fit._directions
        hess, grad, bias, scatter, cost, expected, delta = fit._each(
            one, 1 + fit._directions, self.weight, self.draws
        )
        return Score(
            hessian=hess.sum(0),
            gradient=grad.sum(0),
            bias=bias.sum(0),
            scatter=scatter.sum(0),
            cost=cost.sum(),
            expected=expected.sum(),
            delta=delta,
        )

    def begin(self, unit: jax.Array, spread: jax.Array) -> _Carry:
        """At ``unit (n,)``, before anything was looked at."""
        none = Score.nothing(unit.size, self.fit.unmoved)
        return _Carry(
            phase=jnp.asarray(_NOISE),
            k=jnp.asarray(0),
            at=unit,
            spread=spread,
            here=(unit, none),
            held=jnp.zeros(unit.size, bool),
            length=jnp.asarray(1.0),
            left=jnp.full(2, jnp.inf),
            seen=none,
        )

    def newton(
        self, unit: jax.Array, s: Score, held: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """The step, and what is left."""
        a = s.gradient - s.bias
        free = ~held_back(unit, a, *self.space.unit_bounds) & ~held
        step = bounded_step(s.hessian + _PULL * jnp.eye(unit.size), a, free)
        left = -0.5 * a @ step
        return step, jnp.where(jnp.isfinite(left), left, jnp.inf)

    def worth(self, s: Score) -> jax.Array:
        """Information that a score is worth, ``(n, n)``."""
        return less_scatter(s.hessian, s.scatter, self.fit.segments.count)

    def told(self, unit: jax.Array, s: Score) -> jax.Array:
        """Information of each parameter, of a logarithm by its SI value, ``(n,)``."""
        space = self.space
        down = jnp.where(space.log, jnp.exp(-2.0 * space.log_width * unit), 1.0)
        return jnp.diag(s.hessian) * down

    def search(self, found: _Carry, again: jax.Array) -> tuple[_Carry, jax.Array]:
        """From where it begins; then from what was found, with that beyond its limit
        which was held."""
        edges = found.held
        beyond = beyond_edge(found.here[0], edges, self.space.unit_bounds[1])
        begun = jnp.where(again, beyond, found.at)
        phase = jnp.where(edges.any(), _FIRST, _DONE)
        start = replace(
            self.begin(begun, found.spread),
            phase=jnp.where(again, phase, _NOISE),
            left=found.left,
            seen=found.seen,
        )
        end = jax.lax.while_loop(lambda c: c.phase < _DONE, self.round, start)
        # The limit stays where it says clearly more than that it may not be met.
        freed = end.here[1].surplus < found.here[1].surplus + EDGE
        freed = ~again | edges.any() & freed
        first = jnp.where(again, found.left[0], end.left[0])
        end = replace(end, left=end.left.at[0].set(first))
        return jax.tree.map(partial(jnp.where, freed), end, found), end.k

    def round(self, c: _Carry) -> _Carry:
        """The score at a place, and where to look next."""
        s = self.score(c.at, c.spread)
        moving, short = c.phase == _MOVING, c.length < _SHORT
        # Beyond a limit that was met there is no score, which makes nothing right.
        u, found = c.here
        lost = self.told(c.at, s) < _LOST * self.told(u, found)
        lost &= (jnp.diag(found.hessian) > _PULL) & moving
        held = jnp.where(short, c.held | lost, c.held)
        before = self.newton(u, found, held)[1]
        left = self.newton(c.at, s, held)[1]
        better = ((c.phase == _FIRST) | moving & (left < before)) & ~lost.any()
        here = jax.tree.map(partial(jnp.where, better), (c.at, s), c.here)
        u, found = here
        step, rest = self.newton(u, found, held)
        # A step that gains little may have been too short.
        longer = jnp.where(left < 0.25 * before, 1.0, 2.0)
        length = c.length * jnp.where(better, longer, 1.0 / 3.0)
        length = jnp.where(short & lost.any(), 1.0, length)
        length = jnp.where(moving, jnp.minimum(length, _LONGEST), 1.0)
        ended = (rest < _SETTLED) | (c.k > _ROUNDS) | (length < _SHORTEST)
        phase = jnp.where(c.phase < _MOVING, c.phase + 1, c.phase)
        phase = jnp.where((c.phase >= _FIRST) & ended, _RAISED, phase)
        phase = jnp.where(c.phase == _RAISED, _DONE, phase)
        ahead = self.space.clip(moved(self.space, u, length * step))
        raised = jnp.where(phase == _RAISED, raised_to_range(self.space, u), c.at)
        # Noise that was assumed too high.
        share = jnp.clip(s.cost / jnp.maximum(s.expected, 1e-30), 0.0, 1.0)
        quiet = jnp.where(c.phase == _NOISE, jnp.sqrt(share), 1.0)
        told = jnp.where(c.phase == _FIRST, rest, c.left.at[1].set(rest))
        return _Carry(
            phase=phase,
            k=c.k + 1,
            at=jnp.where(phase == _MOVING, ahead, raised),
            spread=c.spread * quiet,
            here=here,
            held=held,
            length=length,
            left=jnp.where(c.phase == _RAISED, c.left, told),
            seen=s,
        )
