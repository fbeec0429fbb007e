"""What a model may lack without anybody knowing it, beside the parameters that are
asked for.

A command that comes late moves every parameter, by the same amount in every piece, and
so no scatter shows it. Whoever trusts the model in this states values that are sure and
wrong. So the last steps of a fit to measured logs are made with such effects as
nuisances, each with a prior about nothing: what the data tell of them is taken off the
parameters, and what they leave open widens what is stated.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import jax
import jax.numpy as jnp
import numpy as np

from easi_jax.estimation.levenberg_marquardt import RefineResult
from easi_jax.model import effects
from easi_jax.model.addresses import describe
from easi_jax.model.parameters import Parameter, ParameterSpace
from easi_jax.simulation.simulator import Simulator

LATE = "commands come late"
_LATE = 0.005  # s, or a control step, that commands may well be late: a deviation
_FARTHEST = 3.0  # deviations that a simulation goes
_NEVER = 1e-4  # deviations: at none at all the slope would be that of an early command
_SHOWN = 4.0  # standard deviations from nothing, that are worth a note
_SMALL = 0.02  # deviations before any data: nobody would look for so little


@dataclass(frozen=True, eq=False)
class Doubts:
    """A machine with effects that its model may lack.

    Attributes:
        simulator: with these effects.
        space: parameters asked for, then effects: 0 is nothing, 1 a deviation of what
            is likely before any data.
        names: of the effects.
        units: of the effects.
    """

    simulator: Simulator
    space: ParameterSpace
    names: tuple[str, ...]
    units: tuple[str, ...]

    @property
    def count(self) -> int:
        """Number of effects."""
        return len(self.names)

    @cached_property
    def deviations(self) -> np.ndarray:
        """Of each effect before any data, SI, ``(k,)``."""
        low, high = self.space.initial
        return (high - low)[-self.count :]


def doubts_of(simulator: Simulator, space: ParameterSpace) -> Doubts | None:
    """The doubts that measured logs are fitted with; None where there are none, since
    nothing is commanded, or since the model has its own word for it."""
    m, base = simulator.mj_model, simulator.base
    told = base.effects is not None and effects.has_command_memory(base.present)
    if not m.nu or told:
        return None
    places = tuple(f"effect.delay.{m.actuator(i).name or i}" for i in range(m.nu))
    unit, (_, most) = describe(m, places)
    usual = max(_LATE, simulator.dt)
    never = _NEVER * usual
    late = Parameter(
        *(LATE, places, never, (never, usual)),
        bounds=(never, min(_FARTHEST * usual, most)),
        unit=unit,
        log=False,
    )
    wider = ParameterSpace((*space.parameters, late))
    machine = simulator.rebuilt(space=wider)
    return Doubts(machine, wider, (LATE,), (unit,))


def without(fit: RefineResult, count: int) -> tuple[RefineResult, jax.Array]:
    """A fit with ``count`` effects of a prior of 1, reduced to the parameters: what it
    says of them whatever the effects are; and means and standard deviations of these,
    ``(k, 2)``."""
    n = len(fit.unit) - count

    def less(hessian: jax.Array) -> jax.Array:
        across, own = hessian[:n, n:], hessian[n:, n:] + jnp.eye(count)
        return hessian[:n, :n] - across @ jnp.linalg.solve(own, across.T)

    whole = fit.hessian + jnp.diag(jnp.where(jnp.arange(n + count) < n, 0.0, 1.0))
    size = 1.0 / jnp.sqrt(jnp.maximum(jnp.diag(whole), 1e-12))
    scaled = whole * size[:, None] * size + 1e-6 * jnp.eye(n + count)
    variance = jnp.diag(jnp.linalg.inv(scaled)) * size**2
    told = jnp.stack([fit.unit[n:], jnp.sqrt(variance[n:])], 1)
    reduced = replace(
        fit,
        unit=fit.unit[:n],
        hessian=less(fit.hessian),
        raised=fit.raised[:n],
        raised_hessian=less(fit.raised_hessian),
    )
    return reduced, told


def told(doubts: Doubts, found: np.ndarray) -> list[str]:
    """Notes on effects that the data show; ``found (k, 2)`` as of `without`."""
    step = doubts.simulator.dt / doubts.simulator.substeps
    notes = []
    for name, unit, size, (mean, std) in zip(
        doubts.names, doubts.units, doubts.deviations, found, strict=True
    ):
        if mean <= _SHOWN * std or mean <= _SMALL:
            continue
        by = f"{name}, by {mean * size:.2g} ± {std * size:.1g} {unit}, which the model "
        held = "does not know: values are stated as if it did"
        if mean * size < step:
            notes.append(
                f"{by}{held} (a timestep of {step:g} s makes about half of itself; a "
                "smaller one predicts better)"
            )
        else:
            notes.append(
                f"{by}{held}, so they are truer, but alone they do not predict better. "
                "train.gap with these logs names what is missing; then give --effects"
            )
    return notes
