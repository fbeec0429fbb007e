"""A least-squares finish on paired data (multiple shooting).

Maximum likelihood under independent measurement noise: parameters and the true start of
every segment are fitted together by Levenberg-Marquardt (derivatives:
`easi_jax.estimation.normal_equations`). Each round tries several dampings, and jumps of
single
parameters: a speed limit that no simulation reaches has no slope, yet the data may show
that it is lower. Noise digs a dip into the edge of such a plateau: what fits hardly
better there is put back onto the plateau, where nothing is known of it. The common
scale of all masses and forces jumps as well. In the first rounds pieces that fit far
worse than most count less. A first stage fits only the beginning of each piece: over
few milliseconds errors are nearly linear in the parameters, while over contacts and
stick-slip they have many minima. A limit that few pieces meet is missed where all other
parameters have been bent to those pieces: after several starts, what fits far worse is
left out, and what met no limit then begins at the limit that the rest would meet.
Starting at the found mean, it is the natural last step where commands and states were
logged together; it says nothing about unpaired data or about distributions.
"""

import functools
from dataclasses import replace
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from easi_jax.data.segments import Segments
from easi_jax.estimation.identifiability import forces
from easi_jax.estimation.least_squares import (
    Damping,
    bounded_step,
    held_back,
    is_settled,
    moved,
)
from easi_jax.estimation.normal_equations import Normal, PairedFit
from easi_jax.model.parameters import ParameterSpace
from easi_jax.simulation.simulator import Simulator

_TRIED = 10.0 ** np.arange(-2, 4)  # dampings together, relative to the last one
_DAMPING = Damping(falls=1.0, rises=100.0, least=1e-6, most=1e6)
_SHARES = 0.0, 0.3, 1.0  # of the step of its start, of which each piece takes the best
_TINY = 1e-24  # below what a parameter that is nearly zero has of information
_SHORT = 0.02  # s of each piece that the first stage fits
_PATIENCE = 3, 6  # rounds without progress that end each stage
_BISECTED = 12  # rounds that a jump's reach is halved in: to a thousandth of it
_UNSEEN = 1.0  # information of a unit coordinate: nothing
_TOLD_APART = 0.05  # of the cost, which is minus a logarithm of likelihood
_ROUNDING = 3e-6  # of the cost, which the best of many trials takes for progress
_ROUGH = 1e-3  # of the cost: less progress than that is not to be had by differences
_NEAR_ENOUGH = 1e-2  # of the cost, for the first stage
_MOVING, _LOOKING, _FINISHED = range(3)
_FARTHEST = 0.8, 2.5  # jump that is tried, in initial ranges, in log ratios
EDGE = 4.0  # of the cost, that a place beyond a plateau's edge has to be better by
_SHALLOW = 0.1  # of what its curvature foretells, that the cost rises beyond a dip
DUG = 50 * EDGE  # of the cost, starts as they are: more than that noise does not dig
_INSIDE = 0.4  # initial ranges beyond the edge, where a plateau is entered
_NOISIER = 1.2  # times the noise as it is given, that it may be
_OUTLYING = 9.0  # times the median cost: such a piece counts half
_APART = 4.0  # standard deviations of a typical piece's cost: what fits far worse
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
            noise accounts for (`excess`), ``()``.
        simulated: control steps simulated, ``()``; a derivative counts as one more.
    """

    unit: jax.Array
    hessian: jax.Array
    cost: jax.Array
    delta: jax.Array
    raised: jax.Array
    raised_hessian: jax.Array
    excess: jax.Array
    simulated: jax.Array


def refine(
    simulator: Simulator,
    space: ParameterSpace,
    unit: jax.Array,
    segments: Segments,
    noise: jax.Array,
    iterations: int = 40,
    prior_std: float = 3.0,
    mesh: Mesh | None = None,
    misfit: jax.Array | None = None,
    robust: int | jax.Array = 6,
    free_starts: bool = True,
    near: bool | jax.Array = False,
    others: jax.Array | None = None,
    start: jax.Array | None = None,
) -> RefineResult:
    """Levenberg-Marquardt from ``unit (n,)``; pure, for use inside jit.

    Args:
        iterations: rounds of a stage at most; fewer where the cost has settled.
        noise: standard deviations of the measurement, ``(2 nv,)``, above zero;
            infinite for what is not measured.
        prior_std: weak pull towards the start, in initial ranges, so that
            directions without any information stay where they are.
        misfit: what the model itself errs by in every step, standard deviations
            ``(2 nv,)`` on top of the noise; inf leaves a channel's steps out.
        robust: in so many first rounds, pieces that fit far worse than most count
            less.
        free_starts: whether the true starts are fitted too, or those given are exact.
        near: whether ``unit`` is already about the best, so that there is only the last
            stage, and a short one. Otherwise a first stage fits the beginning of each
            piece alone; the second starts from its result, or from ``unit`` where that
            fits better.
        others: ``(K, n)`` more places to start from; what fits best is the result. One
            that comes to within a standard deviation of it is followed no further.
        start: what is known of starts, as in `PairedFit`.
    """
    whole = PairedFit(simulator, space, segments, noise, mesh, free_starts, None, start)
    low, high = space.unit_bounds
    anchor = unit
    pull = jnp.full(space.size, 1.0 / prior_std**2)
    weight = step_weights(segments, noise, misfit)
    short = min(segments.horizon, max(1, round(_SHORT / simulator.dt)))
    begin = jnp.arange(segments.horizon) < short
    unmoved = whole.unmoved

    away = functools.partial(_distance, space, anchor)

    def prior(u: jax.Array) -> jax.Array:
        return 0.5 * jnp.sum(pull * away(u) ** 2, axis=-1)

    n, count = space.size, segments.count
    shares = jnp.asarray(_SHARES if free_starts else _SHARES[:1])
    steps = 1 + len(_TRIED)  # trials before the jumps
    plain = len(shares) * steps
    ways, farthest = jumps(space)
    fresh = jnp.zeros((2, len(ways))), jnp.tile(jnp.asarray(farthest), (2, 1))
    hopped = slice(steps, steps + 2 * len(ways))
    rounding = _ROUGH if simulator.by_differences else _ROUNDING
    places = plain + 2 * len(ways) + 1  # that a round looks at
    sides = jnp.array([[1.0], [-1.0]])

    def step(
        carry: Any,
        weight: jax.Array,
        first: jax.Array,
        moving: jax.Array,
        trusting: jax.Array,
        again: jax.Array,
        loose: jax.Array,
        item: _Stage,
    ) -> Any:
        u, shift, damp, unchanged, raised, pieces, *_ = carry
        paired = whole
        if short < segments.horizon:
            simulated = jnp.where(item.short, short, segments.horizon)
            paired = replace(whole, steps=simulated)
        unchanged, raised = (
            jnp.where(again, x, y)
            for x, y in zip(fresh, (unchanged, raised), strict=True)
        )
        trust = jnp.where(trusting, 1.0, _trust(pieces, segments.weight > 0))
        left_out = moving & item.dropping & _far_worse(pieces, weight)
        trust = jnp.where(left_out, 0.0, trust)
        trusted = weight * trust[:, None, None]
        # Bisection, per parameter and side, between where a change has left the cost
        # as it was and where it has raised it: at the edge of a plateau it may fall.
        reach = 0.5 * (unchanged + raised)
        hops = jnp.clip(u + (reach * sides)[..., None] * ways, low, high)
        if simulator.by_differences:
            at = u, shift, damp, hops, item
            eq, units, shifts, each = swept(paired, *at, loose, weight, trusted)
        else:
            eq = paired.normal(u, shift, trusted)
            units, shifts = trials(u, shift, damp, hops, item, loose, eq)
            each = paired.costs(units, shifts, weight)
        here = _data(each[:1], trust)
        units, shifts, each = best_starts(units, shifts, each)
        data = _data(each, trust)
        costs = data + prior(units)
        # What was put onto a plateau does not leave it for a dip.
        flat = on_plateau(item, eq)
        entering = jnp.tile(EDGE * jnp.append(flat, False)[: len(ways)], 2)
        costs = costs.at[hopped].add(jnp.where(moving, entering, 0.0))
        costs = jnp.where(jnp.isfinite(costs), costs, jnp.inf)
        damped = costs[1 : 1 + len(_TRIED)]
        tried = damp * jnp.asarray(_TRIED)[jnp.argmin(damped)]
        damp = jnp.where(moving, _DAMPING.after(tried, damped.min() < costs[0]), damp)
        home = len(costs) - 1
        costs = costs.at[hopped].add(jnp.where(loose.all(), 0.0, jnp.inf))
        # Where the fit began is where it was led astray.
        costs = costs.at[home].add(jnp.where(item.held > 0, jnp.inf, 0.0))
        best = jnp.where(first & (costs[home] < costs[0]), home, 0)
        best = jnp.where(moving, jnp.argmin(costs), best)
        level = data[hopped].reshape(2, -1)
        same, worse = level == here, ~(level <= here)
        chosen = (jnp.arange(level.size) == best - hopped.start).reshape(level.shape)
        unchanged = jnp.where(
            moving & same, reach, jnp.where(chosen.any(0), 0.0, unchanged)
        )
        raised = jnp.where(moving & (worse | chosen), reach, raised)
        # Over a jump upwards the cost hardly rises, though its curvature foretells it.
        up = jnp.diagonal(hops[0])
        foretold = 0.5 * jnp.diag(eq.hessian) * (up - u) ** 2
        rise = level[0, :n] - here
        dip = (foretold > 2 * EDGE / _SHALLOW) & (rise < _SHALLOW * foretold)
        dip &= rise < DUG
        above = beyond_edge(u, dip, up)
        new = (
            units[best],
            shifts[best],
            damp,
            unchanged,
            raised,
            each[best],
            eq.hessian,
            above,
        )
        told = jnp.where(first, home, 0)
        return new, each[told].sum() + prior(units[told])

    def on_plateau(item: _Stage, eq: Normal) -> jax.Array:
        """Which parameters were put onto a plateau, and are there, ``(n,)``."""
        return item.freed & (jnp.diag(eq.hessian) < _UNSEEN)

    def trials(
        u: Any, shift: Any, damp: Any, hops: Any, item: _Stage, loose: Any, eq: Normal
    ) -> Any:
        """Where the cost is tried: here, Newton steps of what is ``loose``, jumps of
        single parameters, and where the fit began."""
        slope = jax.jvp(away, (u,), (jnp.ones(n),))[1]
        grad = eq.gradient + pull * slope * away(u)
        hess = eq.hessian + jnp.diag(pull * slope**2 + _TINY)
        # There the prior alone would draw them back to the edge.
        free = ~held_back(u, grad, low, high) & loose & ~on_plateau(item, eq)
        du = bounded_step(hess, grad, free, damp * _TRIED)
        newton = space.clip(moved(space, u, du))
        followed = jnp.einsum("mdn,kn->kmd", eq.start_gain, newton - u)
        near = jnp.concatenate([u[None], newton])
        shifted = shift + jnp.concatenate([unmoved[None], followed])
        shifted = shifted + shares[:, None, None, None] * eq.start_step
        units = [*[near] * len(shares), hops.reshape(-1, n), item.begun[None]]
        stay = jnp.broadcast_to(shift, (2 * len(ways), *shift.shape))
        shifts = [shifted.reshape(-1, *shift.shape), stay, unmoved[None]]
        return jnp.concatenate(units), jnp.concatenate(shifts)

    def best_starts(units: Any, shifts: Any, each: Any) -> Any:
        """Those trials that differ in their starts alone as one: given the parameters,
        each piece takes the start that suits it.

        A step that suits most starts throws some across a change of sign of a speed,
        and their cost would hide what all others gain.
        """
        tried = each[:plain].reshape(len(shares), -1, count)
        chosen = jnp.argmin(jnp.where(jnp.isfinite(tried), tried, jnp.inf), axis=0)
        least = jnp.take_along_axis(tried, chosen[None], axis=0)[0]
        starts = shifts[:plain].reshape(len(shares), -1, *unmoved.shape)
        starts = jnp.take_along_axis(starts, chosen[None, ..., None], axis=0)[0]
        return (
            jnp.concatenate([units[:steps], units[plain:]]),
            jnp.concatenate([starts, shifts[plain:]]),
            jnp.concatenate([least, each[plain:]]),
        )

    def swept(
        paired: PairedFit,
        u: Any,
        shift: Any,
        damp: Any,
        hops: Any,
        item: _Stage,
        loose: Any,
        weight: Any,
        trusted: Any,
    ) -> Any:
        """Derivatives, then trials, by one simulation that is compiled once."""
        points = paired.around(u, shift)
        most = max(places, points[0].shape[0])

        def padded(x: jax.Array) -> jax.Array:
            last = jnp.broadcast_to(x[:1], (most - x.shape[0], *x.shape[1:]))
            return jnp.concatenate([x, last])

        def turn(points: Any, weights: jax.Array) -> Any:
            eq, each = paired.sweep(points[0], points[1], weights)
            told = trials(u, shift, damp, hops, item, loose, eq)
            return jax.tree.map(padded, told), (eq, told, each[:places])

        points = jax.tree.map(padded, points)
        out = jax.lax.scan(turn, points, jnp.stack([trusted, weight]))[1]
        (eq, (units, shifts), _), (_, _, each) = (
            jax.tree.map(lambda x, i=i: x[i], out) for i in range(2)
        )
        return eq, units, shifts, each

    def stage(found: Any, item: Any) -> Any:
        """From parameters and shifts ``found``, or ``item.begun``, to a best fit."""
        (u, shift), best, freed, limits = found
        u = jnp.where(item.restart, item.begun, u)
        shift = jnp.where(item.restart, unmoved, shift)
        from_best = item.look | item.dropping
        u = jnp.where(from_best, best[0], jnp.where(item.freed, freed, u))
        u = jnp.where(item.raised, raised_to_range(space, u), u)
        shift = jnp.where(from_best | item.freed, best[1], shift)
        phase = jnp.where(item.freed & (freed == best[0]).all(), _FINISHED, item.phase)
        even = ~_far_worse(best[4], weight).any()
        after = item.dropping | (item.held > 0)
        phase = jnp.where(after & even, _FINISHED, phase)
        used = jnp.where(item.short, weight * begin[:, None], weight)
        init = (
            *(u, shift, jnp.asarray(1e-3), *fresh),
            *(jnp.ones(count), jnp.zeros((n, n)), u),
        )

        def going(state: Any) -> jax.Array:
            return state[0] < _FINISHED

        def round_(state: Any) -> Any:
            phase, k, costs, carry = state
            at = carry[0]
            # The first round only looks, and the last: cost and information at the
            # result.
            fitting = phase == _MOVING
            moving = fitting & (k > 0)
            trusting = ~moving | (k > item.robust)
            first = fitting & (k == 0)
            done = jnp.maximum(k - item.held, 0)
            loose = limits | (k > item.held) | (item.held == 0)
            # A jump that did not help then may help now.
            again = done % _BISECTED == 0
            now = trusting, again, loose
            carry, cost = step(carry, used, first, moving, *now, item)
            costs = jnp.where(jnp.arange(iterations + 2) >= done, cost, costs)
            gain = costs[jnp.maximum(done - item.patience, 0)] - cost
            settled = is_settled(gain, cost, _TOLD_APART, item.rough)
            settled &= done > item.least
            over = settled | (done >= iterations)
            phase = jnp.where(fitting, jnp.where(over, _LOOKING, _MOVING), _FINISHED)
            # From here it goes to where an earlier start has led.
            off = at - best[0]
            merged = (off @ best[3] @ off < 1.0) & (cost < best[2][-1] + 1.0)
            merged &= item.whole & ~item.first & ~item.freed & fitting
            costs = jnp.where(merged, jnp.inf, costs)
            return jnp.where(merged, _FINISHED, phase), k + 1, costs, carry

        start = (phase, jnp.asarray(0), jnp.zeros(iterations + 2), init)
        _, rounds, costs, carry = jax.lax.while_loop(going, round_, start)
        steps = rounds * jnp.where(item.short, short, segments.horizon)
        u, shift, _, _, raised, each, hessian, up = carry
        # A plateau is wide, and likelier than a dip that noise may have dug.
        flat = item.freed & (freed != best[0]) & (jnp.diag(hessian) < _UNSEEN)
        least = best[2][-1] + EDGE * flat.sum()
        better = item.whole & (item.first | (costs[-1] < least))
        better &= phase != _FINISHED
        best = jax.tree.map(
            lambda new, old: jnp.where(better, new, old),
            (u, shift, costs, hessian, each),
            best,
        )
        # What met no limit: to where the first piece would. And starts that were bent,
        # so that none had to be met: as measured.
        bent = item.dropping & _far_worse(each, weight)
        shift = jnp.where(bent[:, None], unmoved, shift)
        unmet = jnp.diag(hessian) < _UNSEEN
        down = jnp.clip(u - raised[1, :n], low, high)
        u = jnp.where(item.dropping & unmet, down, u)
        limits = jnp.where(item.dropping, unmet, limits)
        out = (u, shift), best, jnp.where(item.look, up, freed), limits
        return out, (u, hessian, steps)

    starts = unit[None] if others is None else jnp.concatenate([unit[None], others])
    # As a scan, so that a stage is compiled once.
    none = unit, unmoved, jnp.zeros(iterations + 2), jnp.zeros((n, n)), jnp.ones(count)
    stages = _stages(starts, near, robust, rounding, others is not None)
    begun = (unit, unmoved), none, unit, jnp.zeros(n, bool)
    found, looked = jax.lax.scan(stage, begun, stages)
    u, shift, costs, hessian, each = found[1]
    points = whole.points + places
    if simulator.by_differences:  # one simulation for both, see `swept`
        points = 2 * max(whole.points, places)
    simulated = 1.0 * points * count * looked[2].sum()
    return RefineResult(
        *(u, hessian, costs, shift, looked[0][-1], looked[1][-1]),
        excess(each, weight),
        simulated,
    )


@flax.struct.dataclass
class _Stage:
    """One stage of the fit, or a look at the result; see `_stages`."""

    begun: jax.Array  # where this fit began
    phase: jax.Array
    restart: jax.Array
    short: jax.Array
    whole: jax.Array
    first: jax.Array
    dropping: jax.Array
    held: jax.Array  # rounds in which limits move alone
    look: jax.Array
    freed: jax.Array
    raised: jax.Array
    robust: jax.Array
    patience: jax.Array
    least: jax.Array  # rounds
    rough: jax.Array


def _stages(
    starts: jax.Array, near: Any, robust: Any, rounding: float, apart: bool
) -> _Stage:
    """The beginnings of the pieces, then all of them, from each start ``(K, n)``; with
    ``apart``, a fit without what fits far worse, and one of all from there; then a look
    at the result, a fit of what may not be at a plateau's edge, and a look at what is
    raised."""
    begun, fits = 2 * len(starts), 2 * (len(starts) + apart)
    at = jnp.arange(fits + 3)
    look, freed = (at == fits) | (at == fits + 2), at == fits + 1
    after = (at >= begun) & (at < fits)
    dropping = after & (at % 2 == 0)
    held = jnp.where(after & ~dropping, _HELD, 0)
    short = (at < begun) & (at % 2 == 0)
    wanted = jnp.where(near, at == 1, True) | freed
    near |= freed
    robust = jnp.where(short | after, 0, robust)
    patience = jnp.where(short | near, *_PATIENCE)
    bisected = jnp.where(short | near, 0, _BISECTED)
    return _Stage(
        begun=starts[jnp.minimum(at // 2, len(starts) - 1)],
        phase=jnp.where(look, _LOOKING, jnp.where(wanted, _MOVING, _FINISHED)),
        restart=short,
        short=short,
        whole=~short & ~look & ~dropping & wanted,
        first=at == 1,
        dropping=dropping,
        held=held,
        look=look,
        freed=freed,
        raised=at == fits + 2,
        robust=robust,
        patience=patience,
        # Without what fits far worse, limits are looked for once the rest has settled.
        least=jnp.maximum(robust + patience, bisected) + dropping * _BISECTED,
        rough=jnp.where(short, _NEAR_ENOUGH, rounding),
    )


def jumps(space: ParameterSpace) -> tuple[np.ndarray, np.ndarray]:
    """Directions of jumps, ``(n + 1 or n, n)``, and how far each may go: single
    parameters in unit coordinates, and the common scale of all masses and forces, along
    which motion changes least, in log ratios."""
    # A start range may be narrow, and wrong.
    wide = np.maximum(_FARTHEST[0], _FARTHEST[1] / space.log_width)
    single = np.eye(space.size), np.where(space.log, wide, _FARTHEST[0])
    scaled = forces(space) * space.log
    if scaled.sum() < 2:
        return single
    common = scaled / space.log_width
    return np.vstack([single[0], common]), np.append(single[1], _FARTHEST[1])


def excess(costs: jax.Array, weight: jax.Array) -> jax.Array:
    """Weighted squared error beyond what the noise makes, ``()``, with room for a noise
    that is a fifth larger than it is thought to be.

    Args:
        costs: half the weighted squared error of each piece, ``(M,)``; those that are
            not finite count nothing.
        weight: of each measured number, ``(M, H, 2 nv)``.
    """
    told = jnp.isfinite(costs)
    numbers = jnp.where(told, weight.sum((1, 2)), 0.0).sum()
    error = 2.0 * jnp.where(told, costs, 0.0).sum()
    return jnp.maximum(error - _NOISIER**2 * numbers, 0.0)


def _data(each: jax.Array, trust: jax.Array) -> jax.Array:
    """Cost of the data, of pieces ``each (T, M)``; without trust they may be infinitely
    bad."""
    return jnp.where(trust > 0, each * trust, 0.0).sum(1)


def _trust(pieces: jax.Array, used: jax.Array) -> jax.Array:
    """Weight of each piece by its cost ``(M,)``: what fits far worse counts less.

    Cauchy's weights about the median. Few pieces that meet a limit which is still
    wrong would otherwise bend every other parameter until they fit.
    """
    typical = jnp.nanmedian(jnp.where(used & jnp.isfinite(pieces), pieces, jnp.nan))
    typical = jnp.nan_to_num(typical)  # where there is none
    ratio = pieces / jnp.maximum(_OUTLYING * typical, 1e-30)
    return jnp.where(jnp.isfinite(ratio), 1.0 / (1.0 + ratio), 0.0)


def _far_worse(costs: jax.Array, weight: jax.Array) -> jax.Array:
    """Pieces that fit far worse than typical ones, and than the noise makes them, by
    their ``costs (M,)``, ``(M,)``.

    Args:
        weight: of each measured number, ``(M, H, 2 nv)``.
    """
    numbers = weight.sum((1, 2))
    share = costs / jnp.maximum(0.5 * numbers, 1e-30)
    typical = jnp.nanmedian(jnp.where(numbers > 0, share, jnp.nan))
    typical = jnp.maximum(typical, 1.0)
    spread = jnp.sqrt(2.0 / jnp.maximum(numbers, 1e-30))
    return (numbers > 0) & ~(share <= typical * (1.0 + _APART * spread))


def _distance(space: ParameterSpace, anchor: jax.Array, unit: jax.Array) -> jax.Array:
    """How far ``unit`` is from ``anchor`` for the prior, in initial ranges.

    Below its initial range a logarithmic parameter counts by its SI value: it may be
    as good as zero there, where the data have no slope and must not lose to the prior.
    """
    width = space.log_width

    def scale(u: jax.Array) -> jax.Array:
        below = jnp.expm1(width * jnp.minimum(u, 0.0)) / width
        return jnp.where(space.log & (u < 0), below, u)

    return scale(unit) - scale(anchor)


def raised_to_range(space: ParameterSpace, unit: jax.Array) -> jax.Array:
    """``unit`` with logarithms raised to the low end of their initial range: further
    down they have no slope, and no way back."""
    return jnp.where(space.log, jnp.maximum(unit, 0.0), unit)


def beyond_edge(unit: jax.Array, limits: jax.Array, most: jax.Array) -> jax.Array:
    """``unit (n,)`` with ``limits (n,)`` on the plateau beyond the edge of a dip."""
    middle = jnp.minimum(most, jnp.maximum(0.5, unit + _INSIDE))
    return jnp.where(limits, middle, unit)


def step_weights(
    segments: Segments, noise: jax.Array, misfit: jax.Array | None = None
) -> jax.Array:
    """Weight of each measured number, ``(M, H, 2 nv)``: 1 where the model is exact, 0
    of what is not measured."""
    share = jnp.where(jnp.isfinite(noise), 1.0, 0.0)
    if misfit is not None:
        known = jnp.isfinite(noise)
        share = share / (1.0 + jnp.where(known, misfit / noise, 0.0) ** 2)
    shape = (segments.count, segments.horizon, noise.shape[0])
    return jnp.broadcast_to(segments.weight[:, None, None] * share, shape)
