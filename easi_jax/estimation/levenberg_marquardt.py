"""A least-squares finish on paired data (multiple shooting).

Maximum likelihood under independent measurement noise: parameters and the true start of
every segment are fitted together by Levenberg-Marquardt (derivatives:
`easi_jax.estimation.normal_equations`; steps: `easi_jax.estimation.least_squares`).
Each round tries several dampings, and jumps of limits and the like
(`easi_jax.estimation.limits`). In the first rounds pieces that fit far worse than most
count less (`easi_jax.estimation.weights`). A first stage fits only the beginning of
each piece: over few milliseconds errors are nearly linear in the parameters, while over
contacts and stick-slip they have many minima. A limit that few pieces meet is missed
where all other parameters have been bent to those pieces: after several starts, what
fits far worse is left out, and what met no limit then begins at the limit that the rest
would meet.
Starting at the found mean, it is the natural last step where commands and states were
logged together; it says nothing about unpaired data or about distributions.
"""

import functools
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from easi_jax.estimation import limits, weights
from easi_jax.estimation.least_squares import (
    Damping,
    bounded_step,
    held_back,
    is_settled,
    moved,
    raised_to_range,
)
from easi_jax.estimation.normal_equations import Normal, PairedFit
from easi_jax.model.parameters import ParameterSpace

_TRIED = 10.0 ** np.arange(-2, 4)  # dampings together, relative to the last one
_DAMPING = Damping(falls=1.0, rises=100.0, least=1e-6, most=1e6)
# Information of a weak pull towards the start, whose deviation is three initial ranges:
# directions without any other stay where they are.
_PULL = 1.0 / 3.0**2
_SHARES = 0.0, 0.3, 1.0  # of the step of its start, of which each piece takes the best
_STEPS = 1 + len(_TRIED)  # places that a step is tried at: without one as well
_TINY = 1e-24  # below what a parameter that is nearly zero has of information
_BEGINNING = 0.02  # s of each piece that the first stage fits
_PATIENCE = 3, 6  # rounds without progress that end each stage
_BISECTED = 12  # rounds that a jump's reach is halved in: to a thousandth of it
_TOLD_APART = 0.05  # of the cost, which is minus a logarithm of likelihood
_ROUNDING = 1e-5  # of the cost: less progress is for `easi_jax.estimation.polish`
_ROUGH = 1e-3  # of the cost: less progress than that is not to be had by differences
_NEAR_ENOUGH = 1e-2  # of the cost, for the first stage
_MOVING, _LOOKING, _FINISHED = range(3)
_SHORT, _WHOLE, _DROPPING, _RETURNING, _RAISED = range(5)
_HELD = 8  # rounds in which limits move alone


@flax.struct.dataclass
class RefineResult:
    """Result of `refine`.

    Attributes:
        unit: parameters, unit coordinates, ``(n,)``.
        hessian: information at them, without the prior, ``(n, n)``.
        cost: half the weighted squared error, at ``unit`` as given, after each round of
            the last stage, and at the result, ``(I + 2,)``; the last value from where
            the fit had settled.
        delta: corrections of the starts, ``(M, S)``.
        raised: ``unit`` with logarithmic parameters raised to the low end of their
            initial range: below it they may be as good as zero, where the logarithm has
            no slope.
        raised_hessian: information there.
        excess: by how much the weighted squared error at ``unit`` exceeds what the
            noise accounts for (`easi_jax.estimation.weights.excess`), ``()``.
        simulated: control steps simulated, ``()``; a derivative counts as one more.
        gradients: of each piece at ``unit``, ``(M, n)``; none, ``(0, n)``, where the
            fit has only begun (`easi_jax.estimation.polish` tells them).
        residuals: predicted minus measured at ``unit``, ``(M, H, 2 nv + N)``, from the
            starts that the last corrections in ``delta`` were made of.
        gain: corrections of the starts per unit of parameter step, ``(M, S, n)``; none,
            ``(0, S, n)``, where the fit has only begun.
    """

    unit: jax.Array
    hessian: jax.Array
    cost: jax.Array
    delta: jax.Array
    raised: jax.Array
    raised_hessian: jax.Array
    excess: jax.Array
    simulated: jax.Array
    gradients: jax.Array
    residuals: jax.Array
    gain: jax.Array


def refine(
    paired: PairedFit,
    unit: jax.Array,
    iterations: int = 40,
    robust: int | jax.Array = 6,
    near: bool | jax.Array = False,
    others: jax.Array | None = None,
) -> RefineResult:
    """Levenberg-Marquardt from ``unit (n,)``; pure, for use inside jit.

    Args:
        iterations: rounds of a stage at most; fewer where the cost has settled.
        robust: in so many first rounds, pieces that fit far worse than most count
            less.
        near: whether ``unit`` is already about the best, so that there is only the last
            stage, and a short one. Otherwise a first stage fits the beginning of each
            piece alone; the second starts from its result, or from ``unit`` where that
            fits better.
        others: ``(K, n)`` more places to start from; what fits best is the result. One
            that comes to within a standard deviation of it is followed no further.
    """
    fit = _Fit(paired, paired.weight, unit, iterations)
    starts = unit[None] if others is None else jnp.concatenate([unit[None], others])
    stages = _Stage.all(starts, near, robust, others is not None)
    place, costs = fit.place(unit, paired.unmoved), jnp.zeros(iterations + 2)
    begin = _Found(place, place, costs, jnp.zeros(unit.size, bool))
    # As a scan, so that a stage is compiled once.
    found, (at, hessian, steps) = jax.lax.scan(fit.stage, begin, stages)
    best = found.best
    return RefineResult(
        unit=best.unit,
        hessian=best.hessian,
        cost=found.costs,
        delta=best.shift,
        raised=at[-1],
        raised_hessian=hessian[-1],
        excess=weights.excess(best.pieces, fit.weight),
        simulated=1.0 * fit.points * paired.segments.count * steps.sum(),
        gradients=jnp.zeros((0, unit.size)),
        residuals=best.residuals,
        gain=jnp.zeros((0, best.shift.shape[1], unit.size)),
    )


@flax.struct.dataclass
class _Stage:
    """One stage of the fit, or a look at the result."""

    begun: jax.Array  # where this fit began
    first: jax.Array
    wanted: jax.Array
    short: jax.Array  # from there, the beginnings of the pieces alone
    dropping: jax.Array  # without what fits far worse
    raised: jax.Array  # a look only
    whole: jax.Array  # what it finds may be the result
    robust: jax.Array  # rounds
    patience: jax.Array
    least: jax.Array  # rounds at least
    held: jax.Array  # rounds in which limits move alone

    @classmethod
    def all(cls, starts: jax.Array, near: Any, robust: Any, apart: bool) -> "_Stage":
        """The beginnings of the pieces, then all of them, from each start ``(K, n)``;
        with ``apart``, a fit without what fits far worse, and one of all from there;
        then a look at what is raised."""
        kinds = [_SHORT, _WHOLE] * len(starts) + [_DROPPING, _RETURNING] * apart
        at = np.arange(len(kinds) + 1)
        kind = np.array([*kinds, _RAISED])
        short, whole, dropping, returning, raised = (
            jnp.asarray(kind == k) for k in range(5)
        )
        wanted = jnp.where(near, at == 1, True)
        quick = short | near
        robust = jnp.where(short | dropping | returning, 0, robust)
        patience = jnp.where(quick, *_PATIENCE)
        # Without what fits far worse, limits are looked for once the rest has settled.
        least = jnp.maximum(robust + patience, jnp.where(quick, 0, _BISECTED))
        return cls(
            begun=starts[np.minimum(at // 2, len(starts) - 1)],
            first=jnp.asarray(at == 1),
            wanted=wanted,
            short=short,
            dropping=dropping,
            raised=raised,
            whole=wanted & (whole | returning),
            robust=robust,
            patience=patience,
            least=least + dropping * _BISECTED,
            held=jnp.where(returning, _HELD, 0),
        )


@flax.struct.dataclass
class _Place:
    """Where a stage is, and what it knows."""

    unit: jax.Array
    shift: jax.Array
    damping: jax.Array
    reach: limits.Reach
    pieces: jax.Array  # their costs
    hessian: jax.Array  # of the place before
    residuals: jax.Array  # likewise


@flax.struct.dataclass
class _Found:
    """What a stage hands on."""

    last: _Place
    best: _Place
    costs: jax.Array  # by rounds, of the fit that ended at the best place
    unmet: jax.Array  # parameters that met no limit


@flax.struct.dataclass
class _Now:
    """What a round may do."""

    item: _Stage
    first: jax.Array  # only look, and at where the fit began as well
    moving: jax.Array
    trusting: jax.Array  # all pieces alike
    anew: jax.Array  # a jump that did not help then may help now
    loose: jax.Array  # what steps move, (n,)


_State = tuple[jax.Array, jax.Array, jax.Array, _Place]  # phase, rounds, costs


@dataclass(frozen=True)
class _Fit:
    """What all rounds have in common.

    Attributes:
        whole: the pieces.
        weight: of each measured number, ``(M, H, 2 nv)``.
        anchor: where the prior draws to, ``(n,)``.
        iterations: rounds of a stage at most.
    """

    whole: PairedFit
    weight: jax.Array
    anchor: jax.Array
    iterations: int

    @property
    def space(self) -> ParameterSpace:
        return self.whole.space

    @property
    def shares(self) -> jax.Array:
        return jnp.asarray(_SHARES if self.whole.free_starts else _SHARES[:1])

    @property
    def places(self) -> int:
        """That a round looks at: steps, jumps, and where the fit began."""
        jumps = 2 * len(limits.jumps(self.space)[0])
        return len(self.shares) * _STEPS + jumps + 1

    @property
    def points(self) -> int:
        """Simulations of each piece in a round, a derivative as one."""
        if self.whole.simulator.by_differences:  # one for both, see `swept`
            return 2 * max(self.whole.points, self.places)
        return self.whole.points + self.places

    @property
    def rounding(self) -> float:
        return _ROUGH if self.whole.simulator.by_differences else _ROUNDING

    @property
    def short(self) -> int:
        """Control steps that a first stage fits."""
        steps = max(1, round(_BEGINNING / self.whole.simulator.dt))
        return min(self.whole.segments.horizon, steps)

    def place(self, unit: jax.Array, shift: jax.Array) -> _Place:
        """Where a stage begins."""
        n, fresh = self.space.size, limits.Reach.fresh(self.space)
        none = jnp.ones(len(shift)), jnp.zeros((n, n)), jnp.zeros(self.weight.shape)
        return _Place(unit, shift, jnp.asarray(1e-3), fresh, *none)

    def stage(self, found: _Found, item: _Stage) -> tuple[_Found, Any]:
        """From where ``found`` ended, or ``item.begun``, to a best fit; parameters and
        information that it saw last, and control steps of each piece."""
        phase, place = self.start(found, item)
        end = jax.lax.while_loop(
            lambda state: state[0] < _FINISHED,
            functools.partial(self.round, found, item),
            (phase, jnp.asarray(0), jnp.zeros_like(found.costs), place),
        )
        horizon = self.whole.segments.horizon
        steps = end[1] * jnp.where(item.short, self.short, horizon)
        looked = end[3].unit, end[3].hessian, steps
        return self.end(found, item, phase, end), looked

    def start(self, found: _Found, item: _Stage) -> tuple[jax.Array, _Place]:
        """The phase and the place that a stage begins with."""
        best, unmoved = found.best, self.whole.unmoved
        u = jnp.where(item.short, item.begun, found.last.unit)
        shift = jnp.where(item.short, unmoved, found.last.shift)
        from_best = item.raised | item.dropping
        u = jnp.where(from_best, best.unit, u)
        u = jnp.where(item.raised, raised_to_range(self.space, u), u)
        shift = jnp.where(from_best, best.shift, shift)
        even = ~weights.far_worse(best.pieces, self.weight).any()
        still = (item.dropping | (item.held > 0)) & even
        phase = jnp.where(item.wanted & ~still, _MOVING, _FINISHED)
        return jnp.where(item.raised, _LOOKING, phase), self.place(u, shift)

    def round(self, found: _Found, item: _Stage, state: _State) -> _State:
        """A step, and whether it was the last one."""
        phase, k, costs, place = state
        # The first round only looks, and the last: cost and information at the result.
        fitting = phase == _MOVING
        moving = fitting & (k > 0)
        done = jnp.maximum(k - item.held, 0)
        now = _Now(
            item=item,
            first=fitting & (k == 0),
            moving=moving,
            trusting=~moving | (k > item.robust),
            anew=done % _BISECTED == 0,
            loose=found.unmet | (k > item.held) | (item.held == 0),
        )
        new, cost = self.step(place, now)
        costs = jnp.where(jnp.arange(self.iterations + 2) >= done, cost, costs)
        gain = costs[jnp.maximum(done - item.patience, 0)] - cost
        rough = jnp.where(item.short, _NEAR_ENOUGH, self.rounding)
        over = is_settled(gain, cost, _TOLD_APART, rough) & (done > item.least)
        over |= done >= self.iterations
        phase = jnp.where(fitting, jnp.where(over, _LOOKING, _MOVING), _FINISHED)
        # From here it goes to where an earlier start has led.
        best = found.best
        off = place.unit - best.unit
        merged = (off @ best.hessian @ off < 1.0) & (cost < found.costs[-1] + 1.0)
        merged &= item.whole & ~item.first & fitting
        costs = jnp.where(merged, jnp.inf, costs)
        return jnp.where(merged, _FINISHED, phase), k + 1, costs, new

    def end(
        self, found: _Found, item: _Stage, phase: jax.Array, state: _State
    ) -> _Found:
        """What a stage that began with ``phase`` hands on."""
        _, _, costs, at = state
        best, unmet = found.best, limits.unmet(at.hessian)
        better = item.whole & (item.first | (costs[-1] < found.costs[-1]))
        better &= phase != _FINISHED
        # What met no limit: to where the first piece would. And starts that were bent,
        # so that none had to be met: as measured.
        bent = item.dropping & weights.far_worse(at.pieces, self.weight)
        down = at.reach.down(self.space, at.unit)
        last = replace(
            at,
            unit=jnp.where(item.dropping & unmet, down, at.unit),
            shift=jnp.where(bent[:, None], self.whole.unmoved, at.shift),
        )
        return _Found(
            last=last,
            best=jax.tree.map(partial(jnp.where, better), at, best),
            costs=jnp.where(better, costs, found.costs),
            unmet=jnp.where(item.dropping, unmet, found.unmet),
        )

    def step(self, at: _Place, now: _Now) -> tuple[_Place, jax.Array]:
        """The best of the places that are tried from ``at``, and the cost there."""
        moving, space = now.moving, self.space
        begins = jnp.arange(self.whole.segments.horizon) < self.short
        weight = jnp.where(now.item.short, self.weight * begins[:, None], self.weight)
        trust = self.trust(at.pieces, weight, now)
        reach = jax.tree.map(
            partial(jnp.where, now.anew), limits.Reach.fresh(space), at.reach
        )
        hops = reach.ends(space, at.unit)
        eq, (units, shifts), each = self.look(at, hops, weight, trust, now)
        here = _data(each[:1], trust)
        units, shifts, each = self.best_starts(units, shifts, each)
        data = _data(each, trust)
        costs = data + self.prior(units) + self.barred(now)
        costs = jnp.where(jnp.isfinite(costs), costs, jnp.inf)
        home = len(costs) - 1
        looking = jnp.where(now.first & (costs[home] < costs[0]), home, 0)
        best = jnp.where(moving, jnp.argmin(costs), looking)
        damped = costs[1:_STEPS]
        damping = at.damping * jnp.asarray(_TRIED)[jnp.argmin(damped)]
        damping = _DAMPING.after(damping, damped.min() < costs[0])
        level = data[_STEPS:home].reshape(2, -1)
        taken = (jnp.arange(level.size) == best - _STEPS).reshape(level.shape)
        told = reach.after(level, here, moving & taken)
        new = _Place(
            unit=units[best],
            shift=shifts[best],
            damping=jnp.where(moving, damping, at.damping),
            reach=jax.tree.map(partial(jnp.where, moving), told, reach),
            pieces=each[best],
            hessian=eq.hessian,
            residuals=eq.residuals,
        )
        shown = jnp.where(now.first, home, 0)
        return new, each[shown].sum() + self.prior(units[shown])

    def trust(self, pieces: jax.Array, weight: jax.Array, now: _Now) -> jax.Array:
        """Weight of each piece by its cost, ``(M,)``."""
        robust = weights.robust(pieces, weight)
        left_out = now.moving & now.item.dropping & weights.far_worse(pieces, weight)
        return jnp.where(left_out, 0.0, jnp.where(now.trusting, 1.0, robust))

    def barred(self, now: _Now) -> jax.Array:
        """Cost on top, of steps, jumps, and where the fit began: infinite where these
        are not allowed now."""
        jumps = jnp.where(now.loose.all(), 0.0, jnp.inf)
        jumps = jnp.full(2 * len(limits.jumps(self.space)[0]), jumps)
        # Where the fit began is where it was led astray.
        home = jnp.where(now.item.held > 0, jnp.inf, 0.0)
        return jnp.concatenate([jnp.zeros(_STEPS), jumps, home[None]])

    def away(self, unit: jax.Array) -> jax.Array:
        """How far ``unit (..., n)`` is from ``anchor``, in initial ranges.

        Below its initial range a logarithmic parameter counts by its SI value: it may
        be as good as zero there, where the data have no slope and must not lose to the
        prior.
        """
        width = self.space.log_width

        def scale(u: jax.Array) -> jax.Array:
            below = jnp.expm1(width * jnp.minimum(u, 0.0)) / width
            return jnp.where(self.space.log & (u < 0), below, u)

        return scale(unit) - scale(self.anchor)

    def prior(self, unit: jax.Array) -> jax.Array:
        """Its cost, ``(...)``."""
        return 0.5 * jnp.sum(_PULL * self.away(unit) ** 2, axis=-1)

    def trials(
        self, at: _Place, hops: jax.Array, now: _Now, eq: Normal
    ) -> tuple[jax.Array, jax.Array]:
        """Where the cost is tried: here, Newton steps of what is loose, jumps, and
        where the fit began; parameters and starts."""
        u, shift, unmoved = at.unit, at.shift, self.whole.unmoved
        away, slope = jax.jvp(self.away, (u,), (jnp.ones(u.size),))
        grad = eq.gradient + _PULL * slope * away
        hess = eq.hessian + jnp.diag(_PULL * slope**2 + _TINY)
        free = ~held_back(u, grad, *self.space.unit_bounds) & now.loose
        du = bounded_step(hess, grad, free, at.damping * _TRIED)
        newton = self.space.clip(moved(self.space, u, du))
        followed = jnp.einsum("mdn,kn->kmd", eq.start_gain, newton - u)
        near = jnp.concatenate([u[None], newton])
        shifted = shift + jnp.concatenate([unmoved[None], followed])
        shifted = shifted + self.shares[:, None, None, None] * eq.start_step
        hops = hops.reshape(-1, u.size)
        units = [*[near] * len(self.shares), hops, now.item.begun[None]]
        stay = jnp.broadcast_to(shift, (len(hops), *shift.shape))
        shifts = [shifted.reshape(-1, *shift.shape), stay, unmoved[None]]
        return jnp.concatenate(units), jnp.concatenate(shifts)

    def look(
        self,
        at: _Place,
        hops: jax.Array,
        weight: jax.Array,
        trust: jax.Array,
        now: _Now,
    ) -> tuple[Normal, tuple[jax.Array, jax.Array], jax.Array]:
        """Derivatives with what pieces are trusted, then trials and their costs of all
        pieces, ``(K, M)``."""
        paired, trusted = self.whole, weight * trust[:, None, None]
        if self.short < paired.segments.horizon:
            steps = jnp.where(now.item.short, self.short, paired.segments.horizon)
            paired = replace(paired, steps=steps)
        tries = functools.partial(self.trials, at, hops, now)
        if paired.simulator.by_differences:
            return self.swept(paired, at, tries, trusted, weight)
        eq = paired.normal(at.unit, at.shift, trusted)
        tried = tries(eq)
        return eq, tried, paired.costs(*tried, weight)

    def swept(
        self,
        paired: PairedFit,
        at: _Place,
        tries: Callable[[Normal], tuple[jax.Array, jax.Array]],
        trusted: jax.Array,
        weight: jax.Array,
    ) -> tuple[Normal, tuple[jax.Array, jax.Array], jax.Array]:
        """Derivatives, then trials, by one simulation that is compiled once."""
        points = paired.around(at.unit, at.shift)
        most = max(self.places, points[0].shape[0])

        def padded(x: jax.Array) -> jax.Array:
            last = jnp.broadcast_to(x[:1], (most - x.shape[0], *x.shape[1:]))
            return jnp.concatenate([x, last])

        def turn(points: Any, weights: jax.Array) -> Any:
            eq, each = paired.sweep(points[0], points[1], weights)
            tried = tries(eq)
            return jax.tree.map(padded, tried), (eq, tried, each[: self.places])

        points = jax.tree.map(padded, points)
        out = jax.lax.scan(turn, points, jnp.stack([trusted, weight]))[1]
        (eq, tried, _), (_, _, each) = (
            jax.tree.map(lambda x, i=i: x[i], out) for i in range(2)
        )
        return eq, tried, each

    def best_starts(
        self, units: jax.Array, shifts: jax.Array, each: jax.Array
    ) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Those trials that differ in their starts alone as one: given the parameters,
        each piece takes the start that suits it.

        A step that suits most starts throws some across a change of sign of a speed,
        and their cost would hide what all others gain.
        """
        plain, count = len(self.shares) * _STEPS, each.shape[1]
        tried = each[:plain].reshape(-1, _STEPS, count)
        chosen = jnp.argmin(jnp.where(jnp.isfinite(tried), tried, jnp.inf), axis=0)
        least = jnp.take_along_axis(tried, chosen[None], axis=0)[0]
        starts = shifts[:plain].reshape(-1, _STEPS, *shifts.shape[1:])
        starts = jnp.take_along_axis(starts, chosen[None, ..., None], axis=0)[0]
        return (
            jnp.concatenate([units[:_STEPS], units[plain:]]),
            jnp.concatenate([starts, shifts[plain:]]),
            jnp.concatenate([least, each[plain:]]),
        )


def _data(each: jax.Array, trust: jax.Array) -> jax.Array:
    """Cost of the data, of pieces ``each (T, M)``; without trust they may be infinitely
    bad."""
    return jnp.where(trust > 0, each * trust, 0.0).sum(1)
