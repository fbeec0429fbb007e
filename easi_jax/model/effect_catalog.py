"""Every effect that a model may lack: one row holds all that is known of it.

A row names the numbers that an effect consists of (`easi_jax.model.effect_numbers`) at
each kind of place, how far a fit may move them and where it starts, how people are
told of it, and what it has to do with other effects. Whoever needs a fact of an effect
reads it here. What the numbers do to a simulation: `easi_jax.model.effects`.

Rows stand in the order in which the numbers of a place become columns of a fit.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property

import mujoco
import numpy as np

from easi_jax.model import effect_mjcf
from easi_jax.model.contact_pairs import ContactPair
from easi_jax.model.effect_numbers import NO_FORCE_LIMIT, NUMBERS, EffectNumber


@dataclass(frozen=True)
class Scales:
    """How large things are in the data; every effect is measured against it.

    Attributes:
        position, speed, acceleration: RMS per degree of freedom, ``(nv,)``.
        torque: RMS of what moves it, ``(nv,)``.
        inertia: about each degree of freedom, ``(nv,)``.
        command: RMS, ``(nu,)``.
        force: RMS of an actuator's force, ``(nu,)``.
        peak: its largest, but for two rows in 1,000, ``(nu,)``.
        span: range of positions, ``(nv,)``.
        touching: share of rows in which pairs of geoms touch, ``(P,)``
            (`easi_jax.model.contact_pairs`).
        dt: control step [s].
        longest: longest delay that is looked for [s].
    """

    position: np.ndarray
    speed: np.ndarray
    acceleration: np.ndarray
    torque: np.ndarray
    inertia: np.ndarray
    command: np.ndarray
    force: np.ndarray
    peak: np.ndarray
    span: np.ndarray
    touching: np.ndarray
    dt: float
    longest: float


@dataclass(frozen=True)
class Spot:
    """A joint, actuator, body or pair of geoms, or the whole model, in some data.

    Attributes:
        m: the model.
        i: id of the object; 0 for the whole model.
        s: how large things are in the data.
        pairs: of geoms that may touch: the one that it is, or all of the model.
    """

    m: mujoco.MjModel
    i: int
    s: Scales
    pairs: tuple[ContactPair, ...] = ()

    @cached_property
    def dof(self) -> int:
        """Of a joint."""
        return int(self.m.jnt_dofadr[self.i])

    @property
    def is_hinge(self) -> bool:
        """Whether a joint turns."""
        return bool(self.m.jnt_type[self.i] == mujoco.mjtJoint.mjJNT_HINGE)

    @property
    def torque(self) -> float:
        """At a joint [N or N m]."""
        return float(self.s.torque[self.dof])

    @property
    def speed(self) -> float:
        """Of a joint [m/s or rad/s]."""
        return max(float(self.s.speed[self.dof]), 1e-9)

    @property
    def position(self) -> float:
        """Of a joint [m or rad]."""
        return max(float(self.s.position[self.dof]), 1e-9)

    @property
    def inertia(self) -> float:
        """About a joint [kg or kg m^2]."""
        return float(self.s.inertia[self.dof])

    @property
    def play(self) -> float:
        """Of a joint: a range that free play is a share of [m or rad]."""
        return min(float(self.s.span[self.dof]), 1.0 if self.is_hinge else np.inf)

    @property
    def rotor(self) -> float:
        """Of a joint: most inertia that its drive may have [kg or kg m^2]."""
        own = float(self.m.dof_armature[self.dof])
        return own if own > 0 else 0.7 * self.inertia

    @property
    def slow_cycles(self) -> float:
        """Of a joint, per 2 pi of position: slower over the whole range, a ripple is a
        spring and a constant torque."""
        few = 1.5 if self.is_hinge else 4.0
        return few * 2 * np.pi / float(self.s.span[self.dof])

    @property
    def command(self) -> float:
        """Of an actuator."""
        return max(float(self.s.command[self.i]), 1e-9)

    @property
    def force(self) -> float:
        """Of an actuator [N or N m]."""
        return max(float(self.s.force[self.i]), 1e-9)

    @property
    def peak(self) -> float:
        """The largest force of an actuator [N or N m]."""
        return float(self.s.peak[self.i])

    @property
    def mass(self) -> float:
        """Of a body [kg]."""
        return float(self.m.body_mass[self.i])

    @property
    def size(self) -> float:
        """Of a body: its inertia's radius and how far its mass is from its frame
        [m]."""
        radius = float(np.sqrt(self.m.body_inertia[self.i].max() / self.mass))
        reach = float(np.linalg.norm(self.m.body_ipos[self.i]))
        return max(radius + reach, 1e-3)

    @property
    def friction(self) -> float:
        """Sliding friction of contacts."""
        return max(float(p.friction[0]) for p in self.pairs)

    @property
    def stiffness(self) -> float:
        """Of contacts [1/s^2]."""
        return float(np.mean([p.stiffness for p in self.pairs]))

    @property
    def damping(self) -> float:
        """Of contacts [1/s]."""
        return float(np.mean([p.damping for p in self.pairs]))


Told = Mapping[str, tuple[float, float, str]]  # value, standard deviation, unit


@dataclass(frozen=True)
class Part:
    """One number of an effect at a kind of place.

    Attributes:
        column: the number (`easi_jax.model.effect_numbers.NUMBERS`).
        name: what people know it by; "" where they are not told of it.
        bounds: of a fit: low, high.
        size: a small but visible change, for finite differences.
        without: its value in a model without the effect, where it is not the number's
            neutral value.
        of: what people are told is the value times this number of the model ...
        unit: ... and in this unit, where it is not the number's own.
    """

    column: str
    name: str
    bounds: Callable[[Spot], tuple[float, float]]
    size: Callable[[Spot], float]
    without: Callable[[Spot], float] | None = None
    of: Callable[[Spot], float] = lambda o: 1.0
    unit: str = ""

    @property
    def number(self) -> EffectNumber:
        """The number's row."""
        return NUMBERS[self.column]

    def neutral(self, o: Spot) -> float:
        """Its value in a model without the effect."""
        if self.without is not None:
            return self.without(o)
        return min(self.number.neutral, NO_FORCE_LIMIT)

    def told_unit(self, o: Spot) -> str:
        """The unit that people are told."""
        return self.unit or self.number.unit(o.m, o.i)


Starts = tuple[tuple[float, ...], ...]


@dataclass(frozen=True)
class Site:
    """An effect at a kind of place.

    Attributes:
        parts: its numbers. Where the last one says which kind it is of
            (`EffectNumber.is_shape`), each of its bounds is tried as an effect of its
            own; a fit does not move it.
        starts: values of the parts that a fit starts from, in turn; several where the
            predictions have no slope at the neutral values, or more than one valley.
        able: whether it can be there, beside what its numbers refuse.
    """

    parts: tuple[Part, ...]
    starts: Callable[[Spot], Starts] = lambda o: ((0.0,),)
    able: Callable[[Spot], bool] = lambda o: True

    def offered(self, o: Spot) -> bool:
        """Whether the effect can be at a place."""
        numbers = (p.number for p in self.parts)
        return self.able(o) and all(n.refuse(o.m, o.i) is None for n in numbers)


@dataclass(frozen=True)
class Effect:
    """All that is known of an effect.

    Attributes:
        name: as the log format has it.
        sites: where it can sit: joint, actuator, body, geom (a pair of them) or model
            (the whole of it), and what it is there.
        sentence: what a roboticist would say; names of parameters, ``at``, ``kind``
            and ``pair`` in braces.
        is_rare: few machines have it; it is named only where it does clearly better
            than what most machines have.
        usual: values outside these are as unlikely as a rare effect.
        contains: an effect that it is with some of its numbers at zero.
        refits: kind and quantity of the model (`easi_jax.model.quantities`) that says
            the same, and that a refit may move.
        is_shared: all actuators may have it alike, as one bus or one controller makes
            it.
        is_sine: its numbers are amplitude, cycles and phase of a sine; the cycles that
            a fit starts from come from a grid.
        told: parameters as people know them, from the numbers.
        mjcf: how MJCF says it; None where it has no word for it.
    """

    name: str
    sites: Mapping[str, Site]
    sentence: str
    is_rare: bool = False
    usual: tuple[float, float] = (-np.inf, np.inf)
    contains: str = ""
    refits: tuple[str, str] = ("", "")
    is_shared: bool = False
    is_sine: bool = False
    told: Callable[[Told], Told] = lambda got: got
    mjcf: effect_mjcf.InMjcf | None = None

    @property
    def is_shift(self) -> bool:
        """Whether it is a shift in time."""
        return all(p.number.is_shift for s in self.sites.values() for p in s.parts)


def _bounds(low: float, high: float) -> Callable[[Spot], tuple[float, float]]:
    return lambda o: (low, high)


def _size(size: float) -> Callable[[Spot], float]:
    return lambda o: size


def _torque(o: Spot) -> float:
    return 0.03 * o.torque


def _either_way(o: Spot) -> tuple[float, float]:
    return -20 * o.torque, 20 * o.torque


def _up(o: Spot) -> tuple[float, float]:
    return 0.0, 20 * o.torque


def _late(o: Spot) -> tuple[float, float]:
    return 0.0, o.s.longest


def _instant(o: Spot) -> float:
    return 0.25 * o.s.dt


def _delays(o: Spot) -> Starts:
    return (0.5 * o.s.dt,), (2.0 * o.s.dt,), (0.3 * o.s.longest,)


_SHAPE = {"bounds": _bounds(0.0, 1.0), "size": _size(0.1)}


def _told_spring(got: Told) -> Told:
    """With the position at rest in place of the torque at zero."""
    (k, dk, unit), (s, ds, _) = got["stiffness"], got["rest"]
    rest = s / k if k > 0 else 0.0
    relative = math.hypot(ds / s if s else 0.0, dk / k if k > 0 else 0.0)
    length = "rad" if "rad" in unit else "m"
    return {**got, "rest": (rest, abs(rest) * relative, length)}


def _told_stribeck(got: Told) -> Told:
    """With all of the friction at rest in place of what it has beyond the kinetic."""
    (kinetic, dk, unit), (extra, de, _) = got["kinetic"], got["static"]
    return {**got, "static": (kinetic + extra, math.hypot(dk, de), unit)}


def _told_ripple(got: Told) -> Told:
    """With the phase within half a turn."""
    phase, dp, unit = got["phase"]
    return {**got, "phase": (math.remainder(phase, 2 * math.pi), dp, unit)}


def _force_starts(o: Spot) -> Starts:
    # A limit that is seldom met shows at the largest forces alone.
    seldom = [(x * o.peak,) for x in (0.8, 0.5) if o.peak > 3.0 * o.force]
    return (*((x * o.force,) for x in (2.2, 1.5, 1.0, 0.6)), *seldom)


def _alone(
    column: str,
    name: str,
    bounds: Callable[[Spot], tuple[float, float]],
    size: Callable[[Spot], float],
    starts: Callable[[Spot], Starts] = lambda o: ((0.0,),),
    able: Callable[[Spot], bool] = lambda o: True,
) -> Site:
    """An effect that is one number."""
    return Site((Part(column, name, bounds, size),), starts, able)


def _contact_friction(column: str) -> Site:
    slides = Part(
        *(column, "friction", _bounds(0.05, 10.0), _size(0.05)),
        of=lambda o: o.friction,
    )
    return Site((slides,), lambda o: ((0.6,), (1.6,)), lambda o: bool(o.pairs))


def _contact_softness(field: str) -> Site:
    parts = (
        Part(
            *(f"{field}.0", "stiffness", _bounds(1e-3, 50.0), _size(0.05)),
            of=lambda o: o.stiffness,
            unit="1/s^2",
        ),
        Part(
            *(f"{field}.1", "damping", _bounds(1e-2, 50.0), _size(0.05)),
            of=lambda o: o.damping,
            unit="1/s",
        ),
    )
    return Site(parts, lambda o: ((0.3, 0.5), (0.1, 0.3)), lambda o: bool(o.pairs))


def _vector(
    field: str,
    names: str | tuple[str, ...],
    high: Callable[[Spot], float],
    size: Callable[[Spot], float],
) -> Site:
    parts = tuple(
        Part(f"{field}.{i}", name, lambda o: (-high(o), high(o)), size)
        for i, name in enumerate(names)
    )
    return Site(parts, lambda o: ((0.0,) * len(parts),))


_ROWS = (
    Effect(
        "payload_mass",
        {
            "body": Site(
                (
                    Part(
                        *("mass", "mass", lambda o: (-0.9 * o.mass, 20 * o.mass)),
                        lambda o: 0.03 * o.mass,
                    ),
                    Part("spread", "", **_SHAPE),
                )
            )
        },
        'body "{at}" carries {mass} more',
        refits=("body", "mass"),
        mjcf=effect_mjcf.BODY,
    ),
    Effect(
        "com_offset",
        {"body": _vector("com", "xyz", lambda o: 2 * o.size, lambda o: 0.02 * o.size)},
        'the mass of body "{at}" sits elsewhere',
        is_rare=True,
        mjcf=effect_mjcf.BODY,
    ),
    Effect(
        "coulomb_friction",
        {
            # What the model has too much of is an effect of negative strength.
            "joint": _alone(
                "coulomb",
                "torque",
                lambda o: (-float(o.m.dof_frictionloss[o.dof]), 20 * o.torque),
                _torque,
                lambda o: ((0.0,), (0.1 * o.torque,)),
            )
        },
        'joint "{at}" has about {torque} of dry friction',
        refits=("joint", "frictionloss"),
        mjcf=effect_mjcf.COULOMB,
    ),
    Effect(
        "viscous_damping",
        {
            "joint": _alone(
                "damping",
                "damping",
                lambda o: (-float(o.m.dof_damping[o.dof]), 20 * o.torque / o.speed),
                lambda o: _torque(o) / o.speed,
            )
        },
        'joint "{at}" has {damping} of viscous damping',
        refits=("joint", "damping"),
        mjcf=effect_mjcf.DAMPING,
    ),
    Effect(
        "quadratic_drag",
        {
            "joint": _alone(
                "drag",
                "coefficient",
                lambda o: (0.0, 20 * o.torque / o.speed**2),
                lambda o: _torque(o) / o.speed**2,
            ),
            # Enough to hold the body's weight at 1 m/s.
            "body": _alone(
                "resistance",
                "coefficient",
                lambda o: (0.0, 20.0 * o.mass),
                lambda o: 0.003 * (20.0 * o.mass),
                able=lambda o: o.m.opt.integrator != mujoco.mjtIntegrator.mjINT_RK4,
            ),
        },
        '{kind} "{at}" has a drag of {coefficient} on the squared speed',
        is_rare=True,
    ),
    Effect(
        "constant_force",
        {
            "joint": _alone("constant", "torque", _either_way, _torque),
            "body": _vector(
                "force", "xyz", lambda o: 200 * o.mass, lambda o: 0.1 * o.mass
            ),
        },
        'a constant force acts at {kind} "{at}"',
    ),
    Effect(
        "joint_stiffness",
        {
            "joint": Site(
                (
                    Part(
                        *("stiffness", "stiffness"),
                        lambda o: (0.0, 20 * (o.torque / o.position)),
                        lambda o: 0.03 * (o.torque / o.position),
                    ),
                    Part("spring", "rest", _either_way, _torque),
                ),
                lambda o: ((0.0, 0.0),),
            )
        },
        'joint "{at}" is pulled by a spring of {stiffness}',
        is_rare=True,
        contains="constant_force",
        refits=("joint", "stiffness"),
        told=_told_spring,
        mjcf=effect_mjcf.SPRING,
    ),
    Effect(
        "stribeck_friction",
        {
            "joint": Site(
                (
                    Part("coulomb", "kinetic", _up, _torque),
                    Part("static", "static", _up, _torque),
                    Part(
                        *("stribeck", "velocity"),
                        lambda o: (0.005 * o.speed, 3 * o.speed),
                        lambda o: 0.05 * o.speed,
                    ),
                ),
                lambda o: tuple(
                    (0.05 * o.torque, 0.05 * o.torque, share * o.speed)
                    for share in (0.1, 0.4)
                ),
            )
        },
        'joint "{at}" has dry friction of {static} at rest that falls to {kinetic} in '
        "motion",
        is_rare=True,
        contains="coulomb_friction",
        told=_told_stribeck,
    ),
    Effect(
        "armature",
        {
            "joint": _alone(
                "armature",
                "armature",
                lambda o: (-float(o.m.dof_armature[o.dof]), 20 * o.inertia),
                lambda o: 0.03 * o.inertia,
            )
        },
        'joint "{at}" carries {armature} of inertia',
        refits=("joint", "armature"),
        mjcf=effect_mjcf.ARMATURE,
    ),
    Effect(
        "sensor_bias",
        {
            "joint": _alone(
                "bias",
                "bias",
                lambda o: (-1.5 * o.position, 1.5 * o.position),
                lambda o: 0.01 * o.position,
            )
        },
        'the reading of joint "{at}" is off by {bias}',
    ),
    Effect(
        "sensor_delay",
        {"joint": _alone("late", "delay", _late, _instant, _delays)},
        'the reading of "{at}" comes {delay} late',
    ),
    Effect(
        "backlash",
        {
            "joint": Site(
                (
                    Part(
                        *("width", "width", lambda o: (0.0, 0.5 * o.play)),
                        lambda o: 0.005 * o.play,
                    ),
                    # The drive's share of the inertia is fitted with it.
                    Part(
                        *("rotor", ""),
                        lambda o: (0.1 * o.rotor, 0.98 * o.rotor),
                        lambda o: 0.1 * o.rotor,
                        without=lambda o: 0.6 * o.rotor,
                    ),
                ),
                lambda o: tuple((w * o.play, 0.6 * o.rotor) for w in (0.01, 0.03, 0.1)),
            )
        },
        'joint "{at}" has {width} of free play',
        is_rare=True,
    ),
    Effect(
        "torque_ripple",
        {
            "joint": Site(
                (
                    Part("ripple", "amplitude", _up, _torque),
                    Part(
                        *("cycles", "cycles_per_rev"),
                        lambda o: (o.slow_cycles, 50 * o.slow_cycles),
                        lambda o: 0.02 * o.slow_cycles,
                    ),
                    Part("phase", "phase", _bounds(-20.0, 20.0), _size(0.1)),
                ),
                lambda o: tuple((_torque(o), np.nan, p) for p in (0.0, np.pi / 2)),
            )
        },
        'joint "{at}" has a torque ripple of {amplitude}, {cycles_per_rev} cycles per '
        "revolution",
        is_rare=True,
        is_sine=True,
        told=_told_ripple,
    ),
    Effect(
        "actuator_gain",
        {
            "actuator": _alone(
                *("gain", "gain", _bounds(0.02, 10.0), _size(0.02)),
                lambda o: ((1.0,),),
            )
        },
        'actuator "{at}" gives {gain} times what it is told',
        # A motor is rarely 2.5 times weaker than its data sheet, but may well carry a
        # load that nobody told of.
        usual=(0.4, 2.5),
        refits=("actuator", "gain"),
        mjcf=effect_mjcf.GAIN,
    ),
    Effect(
        "actuator_delay",
        {"actuator": _alone("delay", "delay", _late, _instant, _delays)},
        'commands arrive at actuator "{at}" {delay} late',
        is_shared=True,
        mjcf=effect_mjcf.DELAY,
    ),
    Effect(
        "actuator_lag",
        {
            "actuator": _alone(
                *("lag", "time_constant", _bounds(0.0, 0.5), _instant),
                lambda o: ((o.s.dt,), (0.03,), (0.1,)),
            )
        },
        'actuator "{at}" responds with a time constant of {time_constant}',
        refits=("actuator", "time_constant"),
        is_shared=True,
        mjcf=effect_mjcf.LAG,
    ),
    Effect(
        "actuator_saturation",
        {
            "actuator": _alone(
                "limit",
                "limit",
                lambda o: (0.02 * o.force, max(4.0 * o.force, o.peak)),
                lambda o: 0.02 * o.force,
                _force_starts,
            )
        },
        'actuator "{at}" gives no more than {limit}',
        is_rare=True,
        refits=("actuator", "force_limit"),
        mjcf=effect_mjcf.LIMIT,
    ),
    Effect(
        "actuator_deadband",
        {
            "actuator": Site(
                (
                    Part(
                        *("deadband", "width", lambda o: (0.0, 2 * o.command)),
                        lambda o: 0.02 * o.command,
                    ),
                    Part("jump", "", **_SHAPE),
                ),
                lambda o: tuple((w * o.command,) for w in (0.08, 0.3, 0.7)),
            )
        },
        'actuator "{at}" ignores commands below {width}',
        is_rare=True,
    ),
    Effect(
        "gravity_tilt",
        {"model": _vector("tilt", ("roll", "pitch"), _size(0.6), _size(0.01))},
        "the base is tilted (roll {roll}, pitch {pitch})",
        is_rare=True,
        usual=(-0.25, 0.25),
        mjcf=effect_mjcf.TILT,
    ),
    Effect(
        "contact_friction",
        {"model": _contact_friction("friction"), "geom": _contact_friction("slip")},
        "contacts{pair} have a sliding friction of {friction}",
        mjcf=effect_mjcf.FRICTION,
    ),
    Effect(
        "contact_softness",
        {"model": _contact_softness("softness"), "geom": _contact_softness("give")},
        "contacts{pair} have a stiffness of {stiffness}",
        mjcf=effect_mjcf.SOFTNESS,
    ),
)
CATALOG: Mapping[str, Effect] = {row.name: row for row in _ROWS}
EFFECTS = tuple(CATALOG)
SHARED = tuple(name for name, row in CATALOG.items() if row.is_shared)
