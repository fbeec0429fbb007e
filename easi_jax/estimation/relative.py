"""What a fit says given the masses and lengths that the owner of a machine knows.

Motion leaves some directions open, such as one factor of all masses and forces. A mass
or a length that is taken from the model settles such a direction, and all else moves
with it. It does not move along a straight line: what is moved off a pole has to be put
onto its cart, a sum and no product. So the fit is made again with what is taken held,
and value and spread are those of that fit.
"""

import functools
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from easi_jax.devices import distributed
from easi_jax.devices.mesh import placed
from easi_jax.devices.runtime import quick_compile
from easi_jax.estimation.doubts import doubted
from easi_jax.estimation.identifiability import (
    WEAK,
    identifiability,
    seed_result,
    settled,
)
from easi_jax.estimation.normal_equations import PairedFit
from easi_jax.estimation.posterior import Estimate, no_region, polished
from easi_jax.model.distribution import covariance
from easi_jax.model.parameters import Parameter, ParameterSpace
from easi_jax.model.results import Relative, SeedResult
from easi_jax.simulation.simulator import Simulator

Effects = tuple[Parameter, ...]


def seed_results(
    simulator: Simulator,
    space: ParameterSpace,
    estimates: Sequence[Estimate],
    free_starts: bool = True,
    adjusted: bool = False,
) -> list[SeedResult]:
    """Each seed's result, with what it is given what an owner knows.

    Args:
        simulator: what was fitted, with ``space`` or another's parameters.
        free_starts, adjusted: as the fits were made
            (`easi_jax.estimation.posterior.estimate`).
    """

    @functools.cache
    def held(taken: tuple[int, ...], doubts: Effects) -> tuple[ParameterSpace, Any]:
        """The other parameters, and their fit."""
        given = [space.parameters[i] for i in taken]
        rest = tuple(p for p in space.parameters if p not in given)
        rest = ParameterSpace(rest)
        fixed = {a: p.nominal for p in given for a in p.addresses}
        machine = simulator.rebuilt(space=rest, fixed={**simulator.fixed, **fixed})
        wider = doubted(machine, rest, doubts)

        def fit(unit: Any, pieces: Any, noise: Any, misfit: Any, start: Any) -> Any:
            paired = PairedFit(
                *(machine, rest, pieces, noise),
                free_starts=free_starts,
                start=start,
                misfit=misfit,
            )
            nothing = jnp.eye(rest.size)
            return polished(paired, unit, nothing, adjusted=adjusted, doubts=wider)

        compiled: list[Any] = []

        def run(*args: Any) -> Estimate:
            args = placed(args)
            if not compiled:
                compiled.append(jax.jit(fit).lower(*args).compile(quick_compile()))
            return distributed.local(compiled[0](*args))

        return rest, run

    def relative(found: Estimate) -> Relative | None:
        ident = identifiability(space, np.asarray(found.hessian))
        gain, taken = settled(space, ident)
        if not taken or not found.cost.size:  # nothing to settle, or no fit
            return None
        low, high = (np.asarray(b, float) for b in space.unit_bounds)
        nominal = np.asarray(space.to_unit(space.nominal), float)
        scaled = np.asarray(found.fit, float) * ident.scale
        off = scaled[taken] - nominal[taken] * ident.scale[taken]
        start = np.clip((scaled - gain @ off) / ident.scale, low, high)
        rest, fit = held(tuple(taken), found.doubted)
        at = np.delete(np.arange(space.size), taken)
        new = fit(
            jnp.asarray(start[at], found.fit.dtype),
            *(found.pieces, found.noise, found.misfit, found.start),
        )
        result = result_of(rest, new)
        # Known closely, and not only to be known so by data of this kind.
        wide = np.sqrt(np.diag(result.unit_covariance)) * rest.log_width
        flags = np.array(result.flags)
        mean, std = np.array(space.nominal, float), np.zeros(space.size)
        known = np.zeros(space.size, bool)
        mean[at], std[at] = result.mean, result.std
        known[at] = (flags == "determined") & (wide < WEAK)
        return Relative(
            taken={space.names[i]: float(space.nominal[i]) for i in taken},
            mean=mean.tolist(),
            std=std.tolist(),
            determined=known.tolist(),
            gain=gain.tolist(),
        )

    return [replace(result_of(space, e), relative=relative(e)) for e in estimates]


def result_of(space: ParameterSpace, found: Estimate) -> SeedResult:
    """What one fit says, without what an owner knows."""
    stated = found.distribution.mean, covariance(found.distribution)
    result = seed_result(space, *stated, found.hessian, found.fit)
    return replace(result, no_region=no_region(found))
