"""From the end of a search to an honest distribution over parameters."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from easi_jax.data.segments import Segments
from easi_jax.errors import UserError
from easi_jax.estimation import limits
from easi_jax.estimation.blocks import scattered
from easi_jax.estimation.doubts import Doubts, followed, without
from easi_jax.estimation.least_squares import inverted, raised_to_range
from easi_jax.estimation.levenberg_marquardt import RefineResult, refine
from easi_jax.estimation.normal_equations import RESOLVED, PairedFit
from easi_jax.estimation.pieces import effective_noise, finish_pieces, finish_rest
from easi_jax.estimation.polish import polish
from easi_jax.estimation.profile_score import adjust
from easi_jax.estimation.weights import excess, step_weights, times_noise
from easi_jax.model.distribution import Distribution, gaussian
from easi_jax.model.parameters import Parameter, ParameterSpace
from easi_jax.simulation.simulator import FORWARD_MODE, Simulator

RESTARTS = 2  # of the finish on noisy data, where it has more than one minimum
_SHARP = 1.0 / 3.0  # of a value: its standard deviation where logarithms will do
_FAR = 3.0  # standard deviations
_KNOWN = 0.5  # of the initial range's top: a standard deviation that says something
_SURELY = 3.0  # of the cost, that a place is worse by: 20 to 1
_WAY = 0.0, 0.125, 0.25, 0.5, 1.0  # from a fit to its mean with the initial range
_HIDDEN = 0.1  # of what a model errs by, that a parameter takes up unseen
UNSTATED = 2.0  # times the noise, that a model errs by with all doubts
# Of a uniform initial range, unit coordinates.
_MIDDLE, _INITIAL_VARIANCE = 0.5, 1.0 / 12.0


@flax.struct.dataclass
class Estimate:
    """What a search, and the refinement after it, say about the parameters.

    Attributes:
        distribution: the Gaussian that training samples from.
        search_cov: covariance found by the adversarial search, unit coordinates,
            ``(n, n)``.
        hessian: Fisher information of the data at the fit, logarithms that are below
            the low end of their initial range raised to it, ``(n, n)``: there it says
            how far they are known to be below, as a share of that end.
        noise: standard deviations that the information was computed with.
        cost: weighted error after each step of refinement (empty without).
        delta: corrections of the pieces' starts, ``(M, S)``: positions, velocities,
            and activations where these are unknown.
        fit: where the data alone lead, unit coordinates, ``(n,)``; the search's mean
            where nothing was refined.
        excess: weighted squared error there beyond what the noise makes, ``()``
            (`easi_jax.estimation.weights.excess`).
        simulated: control steps simulated since the search, ``()``; a derivative
            counts as one more.
        pieces: M segments that all this is about, with their weights.
        residuals: predicted minus measured, ``(M, H, 2 nv + N)``, at the best place
            that was looked at: before its score was adjusted, or doubts went beyond
            their bounds, or what nothing refines had its starts corrected.
        misfit: what the model errs by beyond the noise, in every step ``(2 nv,)`` or
            in each ``(H, 2 nv)``.
        start: what was known of starts, standard deviations ``(S,)``.
        doubts: of effects that the model may lack, means and standard deviations in
            those before any data, ``(k, 2)`` (`easi_jax.estimation.doubts`).
        doubted: these effects.
        steps: how far values without the model's physics steps are from those stated,
            unit coordinates, ``(n,)``; () where that was not looked at or cannot be
            told (`easi_jax.estimation.step_error`).
    """

    distribution: Distribution
    search_cov: jax.Array
    hessian: jax.Array
    noise: jax.Array
    cost: jax.Array
    delta: jax.Array
    fit: jax.Array
    excess: jax.Array
    simulated: jax.Array
    pieces: Segments
    residuals: jax.Array
    misfit: jax.Array
    start: jax.Array
    doubts: jax.Array
    doubted: tuple[Parameter, ...] = flax.struct.field(pytree_node=False, default=())
    steps: Any = ()


def estimate(
    paired: PairedFit,
    mean: jax.Array,
    cov: jax.Array,
    refined: bool,
    informed: bool = True,
    robust: int = 6,
    restarts: int = 0,
    adjusted: bool = False,
    rest: Segments | None = None,
    doubts: Doubts | None = None,
) -> Estimate:
    """The result of a search at ``mean``, ``cov`` (unit coordinates); pure.

    The covariance joins two sources: the search's own spread, and what the data leave
    open, ``(F + prior)^-1`` with F the Fisher information of the pieces and the initial
    range as prior. The mean is that of both, too: a direction that the data do not show
    keeps the initial spread about the middle of the initial range, wherever the search
    has drifted to; but not where that leads out of a bent valley (`_likelier`).
    Where the fit leaves more than the noise explains, the model lacks something, and
    the information counts for less (`trusted`). Without ``informed`` it is the
    search's own covariance alone. What may be as good as zero is stated as `_near_zero`
    says.

    Args:
        paired: the pieces, their noise as it is measured.
        refined: whether a fit follows.
        informed, robust, restarts: as in `begun`.
        adjusted: whether what the fitted starts add to the score is taken off
            (`easi_jax.estimation.profile_score`); not where starts are exact, nor where
            slopes are differences (`Simulator.by_differences`).
        rest: more of the recording, the pieces among it: the fit ends on that
            (`easi_jax.estimation.polish`).
        doubts: the fit ends with these, on the same pieces.
    """
    fit = begun(paired, mean, cov, refined, informed, robust, restarts=restarts)
    if not refined:
        return fit
    pieces = paired.segments if rest is None else rest
    whole = replace(paired, segments=pieces, start=fit.start)
    starts = fit.delta if rest is None else None
    ends = {"adjusted": adjusted, "doubts": doubts, "starts": starts}
    # What is as good as zero without doubts need not be with them: there is no slope.
    at = fit.fit if doubts is None else raised_to_range(paired.space, fit.fit)
    more = polished(whole, at, cov, informed, **ends)
    return replace(more, simulated=fit.simulated + more.simulated)


def begun(
    paired: PairedFit,
    mean: jax.Array,
    cov: jax.Array,
    refined: bool,
    informed: bool = True,
    robust: int | jax.Array = 6,
    near: bool | jax.Array = False,
    restarts: int = 0,
) -> Estimate:
    """The `estimate` before its last steps: where the fit is, and not yet all that is
    to be said of it; pure.

    Args:
        informed: whether the data have a part in the covariance.
        robust, near: as in `easi_jax.estimation.levenberg_marquardt.refine`.
        restarts: draws of the search's spread that it starts from as well.
    """
    paired = _floored(paired)
    if not refined:
        return _of_search(paired, mean, cov, informed)
    others = _draws(mean, cov, restarts) if restarts else None
    fit = refine(paired, mean, robust=robust, near=near, others=others)
    return _of_fit(paired, fit, cov, informed)


def polished(
    paired: PairedFit,
    center: jax.Array,
    cov: jax.Array,
    informed: bool = True,
    adjusted: bool = False,
    doubts: Doubts | None = None,
    starts: jax.Array | None = None,
) -> Estimate:
    """The `estimate` of a fit at ``center (n,)`` after `easi_jax.estimation.polish`;
    pure.

    Args:
        paired: pieces of the whole recording: cost, corrections of starts and
            information are theirs.
        cov: of the search, ``(n, n)``.
        informed, adjusted, doubts: as in `estimate`.
        starts: corrections that it begins with, ``(M, S)``; by default none.
    """
    paired = _floored(paired)
    if doubts is not None:
        wider = replace(paired, simulator=doubts.simulator, space=doubts.space)
        begin = jnp.concatenate([center, jnp.zeros(doubts.count)])
        all_ = polish(wider, begin, doubts.count, starts)
        fit, told = without(all_, doubts.count)
        # Their deviations, too, are those of a model that errs, at most as before.
        std = jnp.minimum(told[:, 1] * widened(all_.excess), 1.0)
        told = told.at[:, 1].set(std)
        found = _of_fit(paired, fit, cov, informed, (wider, all_))
        return replace(found, doubts=told, doubted=doubts.parameters)
    fit = polish(paired, center, starts=starts)
    if adjusted:
        fit = _adjusted(paired, fit)
    return _of_fit(paired, fit, cov, informed, (paired, fit))


def _floored(paired: PairedFit) -> PairedFit:
    """With the noise that a fit assumes."""
    given = paired.simulator, paired.segments, paired.noise
    return replace(paired, noise=effective_noise(*given))


def _of_search(
    paired: PairedFit, mean: jax.Array, cov: jax.Array, informed: bool
) -> Estimate:
    """What is stated of a search's end that nothing refines."""
    weight, pieces = paired.weight, paired.segments
    eq = paired.normal(mean, paired.unmoved, weight)
    # At starts as they are after a correction: as read they err by themselves.
    left = excess(paired.costs(mean[None], eq.start_step[None], weight)[0], weight)
    open_cov, seen, _ = _posterior(eq.hessian * trusted(left))
    spread = open_cov + seen @ cov @ seen.T
    center = _MIDDLE + seen @ (mean - _MIDDLE)
    simulated = jnp.asarray(1.0 * paired.points * pieces.count * pieces.horizon)
    ended = RefineResult(
        unit=mean,
        hessian=eq.hessian,
        cost=jnp.zeros(0),
        delta=eq.start_step,
        raised=mean,
        raised_hessian=eq.hessian,
        excess=left,
        simulated=simulated,
        gradients=jnp.zeros((0, mean.size)),
        residuals=eq.residuals,
        gain=eq.start_gain,
    )
    stated = (center, spread) if informed else (mean, cov)
    return _stated(paired, ended, cov, *stated)


def _of_fit(
    paired: PairedFit,
    fit: RefineResult,
    cov: jax.Array,
    informed: bool,
    whole: tuple[PairedFit, RefineResult] | None = None,
) -> Estimate:
    """What is stated of a fit, after a search that ended with ``cov``.

    Args:
        whole: all that was fitted, effects in doubt behind the parameters, and where it
            ended, where the fit has come to its end.
    """

    def said(information: jax.Array) -> tuple[jax.Array, jax.Array]:
        known = _posterior(information)
        return _near_zero(paired.space, fit.unit, fit.raised, *known)

    # What predicts best, whatever it stands in for.
    center = paired.space.clip(said(fit.raised_hessian)[0])
    if whole is not None:
        center = _likelier(*whole, center, fit)
        pieces = whole[0].segments
        looked = 1.0 * len(_WAY) * pieces.count * pieces.horizon
        fit = replace(fit, simulated=fit.simulated + looked)
    left = scattered(fit.raised_hessian, fit.hessian, fit.gradients)
    spread = said(left * trusted(fit.excess))[1]
    return _stated(paired, fit, cov, center, spread if informed else cov)


def _likelier(
    paired: PairedFit, fit: RefineResult, center: jax.Array, own: RefineResult
) -> jax.Array:
    """The mean of ``fit`` and initial range ``center (n,)``, or as far on the way there
    from the fit, of which ``own`` is the parameters' part, as is not surely less likely
    by data and prior.

    Data that know products of parameters know a bent valley, in which a straight line
    towards the middle of the range soon predicts far worse. Starts and effects in doubt
    follow as the fit's slopes say. What the data say nothing of by itself costs
    nothing, and goes all of the way.
    """
    n = center.size
    fitted = jnp.where(limits.unmet(fit.hessian)[:n], center, own.raised)
    units = fitted + jnp.asarray(_WAY)[:, None] * (center - fitted)
    gone = units - own.unit
    step = jnp.concatenate([gone, gone @ followed(fit.hessian, n).T], 1)
    starts = own.delta + jnp.einsum("msn,kn->kms", own.gain, gone)
    each = paired.costs(fit.unit + step, starts, paired.weight)
    cost = jnp.where(jnp.isfinite(each[0]), each, 0.0).sum(1)
    cost += 0.5 * jnp.sum((units - _MIDDLE) ** 2, 1) / _INITIAL_VARIANCE
    likely = cost < cost[0] + _SURELY
    # As far as all before are likely, too; all of the way as it was given.
    last = jnp.argmin(jnp.append(likely[1:], False))
    return jnp.where(last == len(_WAY) - 1, center, units[last])


def _stated(
    paired: PairedFit,
    fit: RefineResult,
    cov: jax.Array,
    center: jax.Array,
    spread: jax.Array,
) -> Estimate:
    noise, misfit = paired.noise, paired.misfit
    misfit = jnp.zeros_like(noise) if misfit is None else misfit
    return Estimate(
        # Where next to nothing is known, what others do may lead anywhere.
        distribution=gaussian(paired.space, paired.space.clip(center), spread),
        search_cov=cov,
        hessian=fit.raised_hessian,
        noise=noise,
        cost=fit.cost,
        delta=fit.delta,
        fit=fit.unit,
        excess=fit.excess,
        simulated=fit.simulated,
        pieces=paired.segments,
        residuals=fit.residuals,
        misfit=misfit,
        start=paired.spread,
        doubts=jnp.zeros((0, 2)),
    )


def finish(
    simulator: Simulator,
    space: ParameterSpace,
    mean: jax.Array,
    cov: jax.Array,
    trajectories: Segments,
    noise: jax.Array,
    noisy: bool,
    refined: bool,
    informed: bool = True,
    mesh: Mesh | None = None,
    restarts: int | None = None,
    steps: int | None = None,
    most: int | None = None,
) -> Estimate:
    """`estimate` from whole trajectories ``(B, T, 1, ...)``; pure, for use inside jit.

    Args:
        noisy: whether any of ``noise (2 nv,)`` is above zero; otherwise starts are
            exact.
        refined, informed: as in `estimate`.
        restarts: more starts; not given: `RESTARTS` with noise, none for larger robots.
        steps, most: as in `finish_pieces` and `finish_rest`.
    """
    if restarts is None:
        restarts = RESTARTS if noisy and not simulator.wide else 0
    pieces = finish_pieces(simulator, trajectories, steps, most)
    return estimate(
        PairedFit(simulator, space, pieces, noise, mesh, noisy),
        mean,
        cov,
        refined,
        informed,
        restarts=restarts,
        adjusted=True,
        rest=finish_rest(simulator, trajectories, noisy, steps, most),
    )


def _adjusted(paired: PairedFit, fit: RefineResult) -> RefineResult:
    """The fit with its score adjusted, where the simulation gets that far."""
    if not paired.free_starts or paired.simulator.mj_model.nv > FORWARD_MODE:
        return fit
    found, left = adjust(paired, fit)
    fine = jnp.isfinite(left[1])
    kept = jax.tree.map(partial(jnp.where, fine), found, fit)
    return replace(kept, simulated=found.simulated)


def trusted(excess: jax.Array) -> jax.Array:
    """Share of the information that is left where the model errs beyond the noise.

    What a model lacks makes errors that no parameter takes up, and others that one
    does: it shows as a wrong value, the same one in every piece, so that more data do
    not help. A parameter is taken to hide a share `_HIDDEN` of what is left over.
    """
    return 1.0 / (1.0 + _HIDDEN * excess)


def widened(excess: jax.Array) -> jax.Array:
    """How many times wider spreads are for what the model errs by beyond the noise."""
    return 1.0 / jnp.sqrt(trusted(excess))


def errs_by(found: Estimate) -> jax.Array:
    """RMS error of an estimate's predictions in units of the noise, ``()``; pure."""
    weight = step_weights(found.pieces, found.noise, found.misfit)
    return times_noise(found.excess, weight)


def no_region(found: Estimate) -> str:
    """Why no region can be stated of an estimate; empty where one can.

    With all that is likely in doubt the model still errs by so much more than the noise
    that what moves the parameters is nothing that anybody thought of.
    """
    times = float(errs_by(found))
    if times <= UNSTATED:
        return ""
    return (
        f"no region is stated: the model errs by {times:.2g} times the noise, more "
        "than late commands, friction, constant forces, zeros of joints, a tilted "
        "base and the strength of drives explain. How far values are from the truth "
        "cannot be said, only that they predict best. train.gap with these logs names "
        "what is missing; then give --effects"
    )


def diverged(found: Estimate, names: Sequence[str]) -> str:
    """Why an estimate of parameters ``names`` is none; empty where it is one."""
    stated = found.distribution.mean[:, None], found.distribution.factor
    bad = np.isfinite(np.concatenate(stated, 1)).min(1) == 0
    if found.cost.size and not np.isfinite(found.cost).any():
        return "no simulation of the measured pieces stays finite"
    if bad.any():
        odd = ", ".join(n for n, b in zip(names, bad, strict=True) if b)
        return f"its mean or its spread is not finite for {odd}"
    if not np.isfinite(found.hessian).all():
        return "what the data say of the parameters is not finite"
    return ""


def sound(
    seeds: Sequence[int], estimates: Sequence[Estimate], names: Sequence[str]
) -> tuple[dict[int, Estimate], dict[int, str]]:
    """Estimates of parameters ``names`` by seed, and why other seeds have none.

    Raises:
        UserError: every fit diverged.
    """
    every = dict(zip(seeds, estimates, strict=True))
    why = {seed: diverged(found, names) for seed, found in every.items()}
    lost = {seed: reason for seed, reason in why.items() if reason}
    if len(lost) == len(every):
        seed, reason = next(iter(lost.items()))
        raise UserError(
            f"the fit diverged (seed {seed}: {reason}): narrow the initial ranges, "
            "lower the model's timestep, or try another seed"
        )
    return {s: e for s, e in every.items() if s not in lost}, lost


def _posterior(hessian: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """``(F + prior)^-1``, the filter of directions that the data show, and the
    variance of each parameter along those alone, ``(n,)``; what is below `RESOLVED`
    counts as not seen (`easi_jax.estimation.least_squares.inverted`)."""
    n = hessian.shape[0]
    prior = jnp.full(n, 1.0 / _INITIAL_VARIANCE, hessian.dtype)
    cov, shown = inverted(hessian, prior, RESOLVED)
    return cov, jnp.eye(n) - cov / _INITIAL_VARIANCE, shown


def _draws(mean: jax.Array, cov: jax.Array, count: int) -> jax.Array:
    """``count`` draws of a Gaussian, ``(count, n)``; always the same ones."""
    values, vectors = jnp.linalg.eigh(0.5 * (cov + cov.T))
    root = vectors * jnp.sqrt(jnp.maximum(values, 0.0))
    return mean + jax.random.normal(jax.random.key(0), (count, mean.size)) @ root.T


def _near_zero(
    space: ParameterSpace,
    unit: jax.Array,
    raised: jax.Array,
    cov: jax.Array,
    seen: jax.Array,
    shown: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """Mean and covariance, also where a logarithmic parameter may be as good as zero.

    The mean lies where the fit ``unit`` and the middle of the initial range meet, by
    what is known of either (``cov``, ``seen`` and ``shown`` are of `_posterior`). But
    the likelihood is a Gaussian in the SI value, not in its logarithm. Where its
    standard deviation is no small part of the value, mean and variance of the logarithm
    are those under that likelihood and the initial range as prior. The others follow
    the SI value along the covariance, ``cov`` at ``raised``: ``unit`` with what lies
    below its initial range raised to the low end, for further down the logarithm has no
    slope and its spread would mean nothing. ``shown (n,)`` are variances along what the
    data show: a direction that they do not show makes nothing as good as zero.
    """
    width = jnp.asarray(space.log_width)
    std = jnp.sqrt(jnp.diag(cov))
    value = jnp.exp(width * (unit - raised))  # in the SI value at `raised`
    straight = raised + (value - 1.0) / width  # along it
    shrunk = _MIDDLE + seen @ (straight - _MIDDLE)
    # What the data and the priors of the other parameters say of each.
    shown = jnp.maximum(shown, 1e-12)
    precision = jnp.maximum(1.0 / shown - 1.0 / _INITIAL_VARIANCE, 1e-3)
    pull = (shrunk - _MIDDLE) / shown / precision
    error = width / jnp.sqrt(precision)
    top = jnp.exp(width * (1.0 - raised))  # of the initial range
    # What lies below its range has no slope there to be known by.
    known = (error < _KNOWN * top) | (unit < raised)
    weak = space.log & known & (error > _SHARP * value)
    told = 1.0 + width * (_MIDDLE + pull - raised)
    # What the data say next to nothing of they do not place far from where it may be.
    told = jnp.clip(told, -_FAR * error, top + _FAR * error)
    mean, x_std, log_mean, log_std = _of_logarithm(raised, width, told, error)
    moved = jnp.where(weak, raised + (mean - 1.0) / width - shrunk, 0.0)
    # The others follow the weak ones all together (these may be known by their sum
    # only): what moves with them, and what is left once they are known.
    among = jnp.where(weak[:, None] & weak, cov, 0.0)
    follow = jnp.where(weak[:, None], 0.0, cov @ _inverse(among, std))
    rest = jnp.where(weak[:, None] | weak, 0.0, cov - follow @ among @ follow.T)
    # The weak ones' own spread is that of the logarithm, but the others follow the SI
    # value; among themselves they keep their correlations.
    wide = follow * (x_std / width / std) + jnp.diag(jnp.where(weak, log_std / std, 0))
    return (
        jnp.where(weak, log_mean, unit + shrunk - straight + follow @ moved),
        rest + wide @ among @ wide.T,
    )


def _inverse(cov: jax.Array, std: jax.Array) -> jax.Array:
    """``cov^-1`` in the directions that single precision tells from none: what the
    data know by its sum alone may be one direction short."""
    values, vectors = jnp.linalg.eigh(cov / std[:, None] / std)
    inverse = jnp.where(values > RESOLVED, 1.0 / values, 0.0)
    return (vectors * inverse) @ vectors.T / std[:, None] / std


def _of_logarithm(
    at: jax.Array, width: jax.Array, value: jax.Array, error: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """Mean and standard deviation of x, then of u, all ``(n,)``.

    x = exp(width (u - at)) is a Gaussian of mean ``value`` and standard deviation
    ``error``, and u was one about 0.5 before.
    """
    u = jnp.linspace(-8.0, 4.0, 2401)
    x = jnp.exp(width[:, None] * (u - at[:, None]))
    score = -0.5 * ((x - value[:, None]) / error[:, None]) ** 2
    p = jax.nn.softmax(score - 0.5 * (u - _MIDDLE) ** 2 / _INITIAL_VARIANCE, axis=1)

    def moments(v: jax.Array) -> tuple[jax.Array, jax.Array]:
        mean = (p * v).sum(1)
        return mean, jnp.sqrt((p * (v - mean[:, None]) ** 2).sum(1))

    return *moments(x), *moments(jnp.broadcast_to(u, x.shape))
