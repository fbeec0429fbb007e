"""The last Gauss-Newton steps of a fit, and what is told of the place where they end.

What makes a fit long, its many trials, jumps and restarts, has to find the valley; a
tenth of a long recording shows where that is. How far along it the best place lies is a
matter of all the data, and near it a few steps are enough.

Of a limit that nothing meets the data say only that it is no lower. Noise digs dips
into the edge of such a plateau: a value there may fit a little better, and its
curvature looks like knowledge. So every limit that is met is put onto the plateau as
well, with all else fitted anew, and stays there unless the dip is surely better
(`easi_jax.estimation.limits`). Of limits that the data know well a look at the cost
there says beforehand that nothing can make up for it.
"""

from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from easi_jax.estimation import limits
from easi_jax.estimation.least_squares import (
    Damping,
    bounded_step,
    held_back,
    is_settled,
    moved,
    raised_to_range,
)
from easi_jax.estimation.levenberg_marquardt import RefineResult
from easi_jax.estimation.normal_equations import Normal, PairedFit
from easi_jax.estimation.weights import excess

_LOOKS = 8, 48  # at most: at the fit, then after each step; with doubts
_STALE = 4  # looks without progress that end it
_ROUNDING = 3e-6  # of the cost, that single precision takes for progress
_SETTLED = 0.01  # of the cost, that the next step is foretold to gain
_STARTED = 1e-4  # of the cost: what starts gain by that says nothing of a misfit
_STEPPING, _RAISING, _FINISHED = range(3)
_PULL = 0.1  # information added to a unit coordinate, for what the data do not show
_BEGUN = 1e-6  # damping of the first step
_DAMPING = Damping(falls=0.1, rises=10.0, wakes=1e-2)
_SHORTER, _LONGER = 0.3, 3.0  # share of its step that a start takes, likewise
_FIRST, _ON = -1, -2  # in place of a limit
_MOVES = 0.25 * 0.5 ** np.arange(8)[::-1]  # initial ranges, that a limit is moved by
# Of the cost: what steps after a fit has settled gain at most. Where friction makes the
# cost rough, every step gains some of that, and none leads anywhere.
_AT_REST = 0.1
_HOPING = 2  # looks in vain at a plateau
# Of the cost, that a plateau is worse by with all else held, over the share of it that
# all else cannot take up: ten times what an edge has to be better by, and no hope.
_HOPEFUL = 30.0
_NEARER = 0.5  # of what a place is worse by, that each look at a plateau leaves at most


@flax.struct.dataclass
class _Look:
    """Where it looks, and the best place so far."""

    k: jax.Array
    progressed: jax.Array  # the look that brought some last
    phase: jax.Array
    unit: jax.Array
    starts: jax.Array
    share: jax.Array  # of its step that each start takes, at most all
    damping: jax.Array
    best: tuple[jax.Array, jax.Array, Normal]  # parameters, starts, what is seen there
    used: jax.Array  # pieces that the simulation gets through at the fit
    least: jax.Array  # cost of the best place
    seen: jax.Array  # information at the place looked at last
    cost: jax.Array
    # Cost of a place that it is compared with; inf where there is none.
    rival: jax.Array
    settled: jax.Array  # whether steps would gain next to nothing more
    rise: jax.Array  # of the cost on the plateau of each limit, with all else held


def polish(
    paired: PairedFit,
    unit: jax.Array,
    doubts: int = 0,
    starts: jax.Array | None = None,
) -> RefineResult:
    """A fit ``unit (n,)`` after steps on all pieces of ``paired``, which may come from
    others; pure, for use inside jit.

    Args:
        doubts: how many of the last parameters are effects of which something is known
            before: a unit coordinate of 0, with a standard deviation of 1. The last
            step of all takes them beyond their bounds where the data lead there.
        starts: corrections that it begins with, ``(M, S)``; by default none.

    Returns:
        The place of least cost among the fit's own, its starts as they were measured,
        and those after each step; limits on the plateau beyond, where that is as
        likely. Information, starts and costs, ``(K,)`` and infinite where it had
        settled, are those of ``paired``. A piece that the simulation does not get
        through at ``unit`` counts nothing; at a place where one of the others explodes
        the cost is infinite.
    """
    space, segments, weight = paired.space, paired.segments, paired.weight
    doubted = jnp.arange(space.size) >= space.size - doubts
    known, most = jnp.where(doubted, 1.0, 0.0), _LOOKS[doubts > 0]
    starts = paired.unmoved if starts is None else starts
    # The fit itself, and on, then each limit: as a scan, so that a look is compiled
    # once. Exact data dig no dips.
    own = tuple(i for i in limits.of(space) if i < space.size - doubts)
    own = own if paired.free_starts else ()
    ways = [_FIRST, _ON, *own] if own else [_FIRST]
    fit = _Steps(paired, weight, known, most, own)
    begin = fit.begin(unit, starts)
    end, simulated = jax.lax.scan(fit.trip, begin, jnp.array(ways))
    unit, starts, told = end.best
    below = (raised_to_range(space, unit) != unit).any()
    if doubts:
        new = moved(space, unit, fit.step(unit, told, 0.0, doubted)[1])
        unit = jnp.where(doubted, new, space.clip(new))
    whole = 1.0 * segments.count * segments.horizon
    return RefineResult(
        unit=unit,
        hessian=told.hessian,
        cost=jnp.where(end.used.any(), end.cost, jnp.inf),
        delta=starts,
        raised=raised_to_range(space, unit),
        raised_hessian=jnp.where(below, end.seen, told.hessian),
        excess=excess(jnp.where(end.used, told.costs, jnp.inf), weight),
        simulated=whole * simulated.sum(),
        gradients=told.gradients,
        residuals=told.residuals,
        gain=told.start_gain,
    )


@dataclass(frozen=True)
class _Steps:
    """What all looks have in common.

    Attributes:
        paired: the pieces.
        weight: of each measured number, ``(M, H, 2 nv)``.
        known: information before any data of a coordinate about 0, ``(n,)``.
        looks: at most.
        limits: parameters that are looked at on their plateaus as well.
    """

    paired: PairedFit
    weight: jax.Array
    known: jax.Array
    looks: int
    limits: tuple[int, ...] = ()

    def begin(self, unit: jax.Array, starts: jax.Array) -> _Look:
        """Before anything was looked at."""
        nothing = Normal.nothing(unit.size, starts, self.weight)
        return _Look(
            k=jnp.asarray(0),
            progressed=jnp.asarray(0),
            phase=jnp.asarray(_STEPPING),
            unit=unit,
            starts=starts,
            share=jnp.ones(len(starts)),
            damping=jnp.asarray(_BEGUN),
            best=(unit, starts, nothing),
            used=jnp.ones(len(starts), bool),
            least=jnp.asarray(jnp.inf),
            seen=nothing.hessian,
            cost=jnp.full(self.looks, jnp.inf),
            rival=jnp.asarray(jnp.inf),
            settled=jnp.asarray(False),
            rise=jnp.zeros(unit.size),
        )

    def trip(self, found: _Look, way: jax.Array) -> tuple[_Look, jax.Array]:
        """The steps from where ``found`` begins, those on from there, or those from the
        plateau of a limit: the likelier end of both, and simulations of each piece.

        Args:
            way: which limit; `_FIRST` or `_ON`. Where it had not settled it goes on, so
                that a plateau is not praised for what any more steps would have gained.
        """
        first = way == _FIRST
        unit, starts, told = found.best
        place, going, tried = unit, first, jnp.asarray(0)
        if self.limits:
            met = ~limits.unmet(told.hessian)
            here, most = jnp.arange(unit.size) == way, self.paired.space.unit_bounds[1]
            place = limits.beyond_edge(unit, here, most)
            hopeful = met & self.hopeful(told, found.rise)
            going |= hopeful[way] & (place != unit).any()
            on = (way == _ON) & met[np.array(self.limits)].any()
            place, rise = jax.lax.cond(
                on, self.nearby, lambda found: (place, found.rise), found
            )
            found = replace(found, rise=rise)
            tried = jnp.where(on, len(self.moves) + len(self.limits), 0)
            going |= on & (~found.settled | (place != unit).any())
        fresh = replace(
            found,
            k=jnp.asarray(0),
            progressed=jnp.asarray(0),
            unit=place,
            starts=starts,
            share=jnp.ones_like(found.share),
            damping=jnp.asarray(_BEGUN),
            best=(place, starts, told),
            least=jnp.asarray(jnp.inf),
            rival=jnp.where(first, jnp.inf, found.least),
            phase=jnp.where(going, _STEPPING, _FINISHED),
        )
        end = jax.lax.while_loop(lambda c: c.phase < _FINISHED, self.look, fresh)
        flat = (way >= 0) & limits.unmet(end.best[2].hessian)[way]
        allowed = limits.edge(unit[way], told.hessian[way, way])
        allowed = jnp.where(flat, allowed, 0.0)
        taken = first | going & (end.least < found.least + allowed)
        best = jax.tree.map(partial(jnp.where, taken), end, found)
        best = replace(best, cost=jnp.where(first, end.cost, found.cost))
        return best, end.k * self.paired.points + tried

    @property
    def moves(self) -> np.ndarray:
        """Of none, then of single limits, ``(K, n)``."""
        space = self.paired.space
        ways = np.eye(space.size)[list(self.limits)]
        moved = np.concatenate([_MOVES, -_MOVES])[:, None, None] * ways
        return np.vstack([np.zeros(space.size), *moved])

    def hopeful(self, told: Normal, rise: jax.Array) -> jax.Array:
        """Limits whose plateaus may be as likely as the best place, ``(n,)`` bool."""
        hessian = told.hessian + jnp.diag(jnp.maximum(self.known, _PULL))
        alone = jnp.diag(hessian) * jnp.diag(jnp.linalg.inv(hessian))
        return ~(rise > _HOPEFUL * jnp.maximum(alone, 1.0))

    def nearby(self, found: _Look) -> tuple[jax.Array, jax.Array]:
        """The place of least cost among the best one and those with a limit moved a
        little, ``(n,)``: where a limit moves past what single rows need, the cost has
        kinks, at which steps end. And `_Look.rise`."""
        unit, starts, _ = found.best
        space, count = self.paired.space, len(self.moves)
        own = np.eye(space.size, dtype=bool)[list(self.limits)]
        flat = limits.beyond_edge(unit, jnp.asarray(own), space.unit_bounds[1])
        units = space.clip(unit + jnp.asarray(self.moves, unit.dtype))
        units = jnp.concatenate([units, flat])
        shifts = jnp.broadcast_to(starts, (len(units), *starts.shape))
        weight = self.weight * found.used[:, None, None]
        each = self.paired.costs(units, shifts, weight)
        cost = jnp.where(found.used, each, 0.0).sum(1)
        least = jnp.where(jnp.arange(count) > 0, _AT_REST, 0.0)
        rise = found.rise.at[np.array(self.limits)].set(cost[count:] - cost[0])
        return units[jnp.argmin(cost[:count] + least)], rise

    def step(
        self, at: jax.Array, told: Normal, damping: Any, loose: Any = False
    ) -> tuple[jax.Array, jax.Array]:
        """Gradient and step at ``at (n,)``; no bound holds back what is ``loose``."""
        gradient = told.gradient + self.known * at
        free = ~held_back(at, gradient, *self.paired.space.unit_bounds) | loose
        hessian = told.hessian + jnp.diag(jnp.maximum(self.known, _PULL))
        return gradient, bounded_step(hessian, gradient, free, damping)

    def look(self, c: _Look) -> _Look:
        """What is seen at a place, and where to look next."""
        space = self.paired.space
        weight = self.weight * c.used[:, None, None]
        eq = self.paired.normal(c.unit, c.starts, weight)
        stepping = c.phase == _STEPPING
        alone = jnp.isinf(c.rival)
        used = jnp.where(alone & (c.k == 0), jnp.isfinite(eq.costs), c.used)
        cost = jnp.where(used, eq.costs, 0.0).sum()
        cost += 0.5 * jnp.sum(self.known * c.unit**2)
        better = stepping & ((c.k == 0) | (cost < c.least))
        best = jax.tree.map(
            partial(jnp.where, better),
            (c.unit, c.starts, eq),
            c.best,
        )
        damping = _DAMPING.after(c.damping, better)
        # A start that is thrown across a change of sign of a speed would hide what all
        # others gain.
        thrown = ~(eq.costs <= c.best[2].costs) & (c.k > 0)
        longer = jnp.where(better, jnp.minimum(_LONGER * c.share, 1.0), c.share)
        share = jnp.where(thrown, _SHORTER * c.share, longer)
        at, starts, told = best
        gradient, du = self.step(at, told, damping)
        new = space.clip(moved(space, at, du))
        follow = starts + share[:, None] * told.start_step
        follow = follow + told.start_gain @ (new - at)
        progress = ~is_settled(c.least - cost, cost, _AT_REST, _ROUNDING)
        progressed = jnp.where(better & progress, c.k, c.progressed)
        foretold = -0.5 * gradient @ du
        # Parameters may be right while the starts are still as they were measured.
        rough = jnp.where(alone, _STARTED, _ROUNDING)
        still = is_settled(jnp.abs(c.least - cost), cost, _SETTLED, rough)
        settled = still & (foretold < _SETTLED)
        settled |= ~alone & better & (c.k > 0) & (foretold < _AT_REST)
        stale = c.k - progressed >= _STALE
        done = ~stepping | settled | stale | (c.k + 1 >= self.looks)
        worse = jnp.maximum(c.least - c.rival, 0.0)
        hopeless = cost - c.rival > _NEARER * worse + limits.EDGE
        hopeless &= better & (c.k > 0) | (c.k - progressed >= _HOPING)
        done |= ~alone & hopeless
        raised = raised_to_range(space, at)
        below = (raised != at).any() & stepping
        over = jnp.where(below, _RAISING, _FINISHED)
        here = jnp.arange(self.looks) == c.k
        return _Look(
            k=c.k + 1,
            progressed=progressed,
            phase=jnp.where(done, over, _STEPPING),
            unit=jnp.where(done, raised, new),
            starts=jnp.where(done, starts, follow),
            share=share,
            damping=damping,
            best=best,
            used=used,
            least=jnp.where(better, cost, c.least),
            seen=eq.hessian,
            cost=jnp.where(here & stepping, cost, c.cost),
            rival=c.rival,
            settled=jnp.where(
                stepping, stale | settled & (rough * cost < _AT_REST), c.settled
            ),
            rise=c.rise,
        )
