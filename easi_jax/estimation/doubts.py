"""What a model may lack without anybody knowing it, beside the parameters that are
asked for.

A command that comes late moves every parameter, by the same amount in every piece, and
so no scatter shows it. Whoever trusts the model in this states values that are sure and
wrong. So the last steps of a fit to measured logs are made with such effects as
nuisances, each with a prior about nothing: what the data tell of them is taken off the
parameters, and what they leave open widens what is stated. Commands that come late are
always in doubt (`doubts_of`); where they show, or the model errs by more than the
noise, a lag, drives, friction, constant forces, the zeros of joints and a tilted base
are too (`all_doubts`).
"""

import itertools
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from easi_jax.errors import UserError
from easi_jax.estimation.levenberg_marquardt import RefineResult
from easi_jax.model import effects
from easi_jax.model.addresses import describe, places
from easi_jax.model.effect_catalog import Scales
from easi_jax.model.effect_numbers import NUMBERS
from easi_jax.model.joint_space import joint_name, scalar_dofs
from easi_jax.model.parameters import Parameter, ParameterSpace
from easi_jax.simulation.simulator import Simulator

LATE, LAG = "commands come late", "commands act through a lag"
_LATE = 0.005  # s, or a control step, that commands may well be late: a deviation
_FARTHEST = 3.0  # deviations that a late command's simulation goes
_NEVER = 1e-4  # deviations: at none at all the slope would be that of an early command
_SHOWN = 4.0  # standard deviations from nothing, that are worth a note
_SMALL = 0.02  # deviations before any data: nobody would look for so little
# Deviations of what else is in doubt: data sheets of drives are seldom better, and
# seals and cables seldom lighter.
_STRENGTH = 0.05  # of a drive's force
_FORCE = 0.05  # of what moves a joint: dry friction, a constant force
# Of a joint's zero: half a degree, as set by eye or by a stop; of a slide's motion.
_ZERO = np.radians(0.5), 0.01
_ASKEW = float(np.radians(1.0))  # rad, that a base is off the level
_ROOM = 10.0  # deviations that these go
_EACH = 6  # joints or drives at most that have doubts of their own
_HINGE = int(mujoco.mjtJoint.mjJNT_HINGE)
_SETS_FORCE = ("gain", "strength", "gear", "kp", "kv")


@dataclass(frozen=True, eq=False)
class Doubts:
    """A machine with effects that its model may lack.

    Attributes:
        simulator: with these effects.
        space: parameters asked for, then effects: 0 is nothing, 1 a deviation of what
            is likely before any data.
        parameters: the effects.
    """

    simulator: Simulator
    space: ParameterSpace
    parameters: tuple[Parameter, ...]

    @property
    def count(self) -> int:
        """Number of effects."""
        return len(self.parameters)


def doubted(
    simulator: Simulator, space: ParameterSpace, parameters: Sequence[Parameter]
) -> Doubts | None:
    """The machine with effects in doubt; None where there are none."""
    if not parameters:
        return None
    wider = ParameterSpace((*space.parameters, *parameters))
    return Doubts(simulator.rebuilt(space=wider), wider, tuple(parameters))


def doubts_of(simulator: Simulator, space: ParameterSpace) -> Doubts | None:
    """The doubts that measured logs are fitted with; None where there are none, since
    nothing is commanded, or since the model has its own word for it."""
    return doubted(simulator, space, _late(simulator))


def all_doubts(
    simulator: Simulator, space: ParameterSpace, scales: Scales
) -> Doubts | None:
    """Doubts where the model is known to lack something: late commands and their lag,
    the strength of drives, dry friction, constant forces and zeros of joints, of each
    kind what no parameter that is asked for sets. Of more than six joints or drives all
    have the same strength or friction.

    Args:
        scales: of the logs.
    """
    m = simulator.mj_model
    asked = _asked(simulator, space)
    drives = {m.actuator(a).name or str(a): _STRENGTH for a in range(m.nu)}
    joints, zeros, (turn, way) = {}, {}, _ZERO
    for j, (_, d) in scalar_dofs(m).items():
        if not scales.hidden or not scales.hidden[d]:
            name, hinge = joint_name(m, j), m.jnt_type[j] == _HINGE
            joints[name] = _FORCE * float(scales.torque[d])
            zeros[name] = turn if hinge else way * float(scales.position[d])
    kinds = (
        ("strength", "the strength of {} is another", drives, _SETS_FORCE),
        ("coulomb", "{} has more dry friction", joints, ("frictionloss", "coulomb")),
        ("constant", "a constant force acts on {}", joints, ("constant", "springref")),
        ("bias", "readings of {} have an offset", zeros, ()),
    )
    found = [*_late(simulator), *_lagging(simulator), *_tilted(m, asked)]
    for field, text, sizes, same in kinds:
        free = [
            name
            for name in sizes
            if asked.isdisjoint((name, quantity) for quantity in same)
            and _possible(m, f"effect.{field}.{name}")
        ]
        together = len(free) > _EACH
        if together and field in ("constant", "bias"):
            continue  # of one sign and size in all joints: nobody's effect
        for group in [free] if together else [[name] for name in free]:
            shown = "every joint or drive" if together else f'"{group[0]}"'
            size = float(np.median([sizes[name] for name in group]))
            found.append(_parameter(m, field, text.format(shown), group, size))
    return doubted(simulator, space, found)


def _asked(simulator: Simulator, space: ParameterSpace) -> set[tuple[str, str]]:
    """Names and quantities of all places that parameters and fixed values set; no name
    of the whole model."""
    m, out = simulator.mj_model, set[tuple[str, str]]()
    for address in (*itertools.chain(*space.addresses), *simulator.fixed):
        for kind, quantity, i in places(m, address):
            at = NUMBERS[quantity].on if kind == "effect" else kind
            named = at in ("joint", "actuator", "body")
            out.add((getattr(m, at)(i).name if named else "", quantity))
    return out


def _late(simulator: Simulator) -> tuple[Parameter, ...]:
    """Commands that come late, where the model has no word of its own for it."""
    m, base = simulator.mj_model, simulator.base
    told = base.effects is not None and effects.has_command_memory(base.present)
    if not m.nu or told:
        return ()
    drives = [m.actuator(i).name or str(i) for i in range(m.nu)]
    return (_on_the_way(simulator, "delay", LATE, drives),)


def _lagging(simulator: Simulator) -> tuple[Parameter, ...]:
    """Commands that act through a lag, where they may come late, of drives without an
    activation of their own."""
    m = simulator.mj_model
    drives = [
        m.actuator(i).name or str(i)
        for i in range(m.nu)
        if m.actuator_dyntype[i] == mujoco.mjtDyn.mjDYN_NONE
    ]
    if not drives or not _late(simulator):
        return ()
    return (_on_the_way(simulator, "lag", LAG, drives),)


def _tilted(
    m: mujoco.MjModel, asked: Collection[tuple[str, str]]
) -> Iterator[Parameter]:
    """A base that stands askew; of a machine that floats nobody reads an angle so."""
    floats = (m.jnt_type == mujoco.mjtJoint.mjJNT_FREE).any()
    for i, way in enumerate(("roll", "pitch")):
        address = f"effect.tilt.{i}"
        if floats or ("", f"tilt.{i}") in asked or not _possible(m, address):
            continue
        yield Parameter(
            *(f"the base has a {way}", (address,), 0.0, (0.0, _ASKEW)),
            bounds=(-_ROOM * _ASKEW, _ROOM * _ASKEW),
            unit="rad",
            log=False,
        )


def _on_the_way(
    simulator: Simulator, field: str, name: str, drives: Sequence[str]
) -> Parameter:
    """A time that commands of ``drives`` take."""
    given = tuple(f"effect.{field}.{drive}" for drive in drives)
    unit, (_, most) = describe(simulator.mj_model, given)
    usual = max(_LATE, simulator.dt)
    never = _NEVER * usual
    return Parameter(
        *(name, given, never, (never, usual)),
        bounds=(never, min(_FARTHEST * usual, most)),
        unit=unit,
        log=False,
    )


def _parameter(
    m: mujoco.MjModel, field: str, name: str, group: Sequence[str], size: float
) -> Parameter:
    """An effect at the places of a ``group``, alike, of a deviation ``size``."""
    given = tuple(f"effect.{field}.{place}" for place in group)
    unit, (least, most) = describe(m, given)
    neutral = NUMBERS[field].neutral
    low, high = neutral - _ROOM * size, min(most, neutral + _ROOM * size)
    # A force that only brakes has no slope at none at all.
    none = neutral + _NEVER * size if least >= neutral else neutral
    return Parameter(
        *(name, given, none, (none, neutral + size)),
        bounds=(none if least >= neutral else max(least, low), high),
        unit=unit,
        log=False,
    )


def _possible(m: mujoco.MjModel, address: str) -> bool:
    """Whether a model has such an effect at all."""
    try:
        describe(m, (address,))
    except UserError:
        return False
    return True


def followed(hessian: jax.Array, n: int) -> jax.Array:
    """How effects of a prior of 1 follow the first ``n`` of what ``hessian`` is about,
    the parameters, ``(k, n)``."""
    own = hessian[n:, n:] + jnp.eye(len(hessian) - n)
    return -jnp.linalg.solve(own, hessian[n:, :n])


def without(fit: RefineResult, count: int) -> tuple[RefineResult, jax.Array]:
    """A fit with ``count`` effects of a prior of 1, reduced to the parameters: what it
    says of them whatever the effects are; and means and standard deviations of these,
    ``(k, 2)``."""
    n = len(fit.unit) - count

    def less(hessian: jax.Array) -> jax.Array:
        return hessian[:n, :n] + hessian[:n, n:] @ followed(hessian, n)

    whole = fit.hessian + jnp.diag(jnp.where(jnp.arange(n + count) < n, 0.0, 1.0))
    size = 1.0 / jnp.sqrt(jnp.maximum(jnp.diag(whole), 1e-12))
    scaled = whole * size[:, None] * size + 1e-6 * jnp.eye(n + count)
    variance = jnp.diag(jnp.linalg.inv(scaled)) * size**2
    told = jnp.stack([fit.unit[n:], jnp.sqrt(variance[n:])], 1)
    slopes, gain, follow = fit.gradients, fit.gain, followed(fit.hessian, n)
    reduced = replace(
        fit,
        unit=fit.unit[:n],
        hessian=less(fit.hessian),
        raised=fit.raised[:n],
        raised_hessian=less(fit.raised_hessian),
        gradients=slopes[:, :n] + slopes[:, n:] @ follow,
        gain=gain[..., :n] + gain[..., n:] @ follow,
    )
    return reduced, told


def shown(
    parameters: Sequence[Parameter], found: np.ndarray, step: float
) -> list[Parameter]:
    """Effects that the data show, but for what the model's own ``step`` [s] makes;
    arguments as for `told`."""
    return [
        p
        for p, (mean, std) in zip(parameters, found, strict=True)
        if _is_shown(mean, std) and not _within_a_step(p, mean, step)
    ]


def _is_shown(mean: float, std: float) -> bool:
    return abs(mean) > _SHOWN * std and abs(mean) > _SMALL


def _within_a_step(p: Parameter, mean: float, step: float) -> bool:
    return p.name == LATE and mean * (p.initial[1] - p.initial[0]) < step


def told(
    parameters: Sequence[Parameter], found: np.ndarray, step: float
) -> Iterator[str]:
    """Notes on effects that the data show.

    Args:
        parameters: in doubt.
        found: ``(k, 2)``, as of `without`.
        step: of the physics [s].
    """
    for p, (mean, std) in zip(parameters, found, strict=True):
        size = p.initial[1] - p.initial[0]
        if not _is_shown(mean, std):
            continue
        by = (
            f"{p.name}, by {mean * size:.2g} ± {std * size:.1g} {p.unit}".rstrip()
            + ", which the model does not know: values are stated as if it did"
        )
        if _within_a_step(p, mean, step):
            yield (
                f"{by} (a timestep of {step:g} s makes about half of itself; a smaller "
                "one predicts better)"
            )
        else:
            yield (
                f"{by}, so they are truer, but alone they do not predict better. "
                "train.gap with these logs names what is missing; then give --effects"
            )
