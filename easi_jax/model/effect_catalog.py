"""Every effect that a model may lack: one row holds all that is known of it.

A row names the numbers that an effect consists of (`easi_jax.model.effect_numbers`) at
each kind of place, how far a fit may move them and where it starts, how people are
told of it, and what it has to do with other effects. Whoever needs a fact of an effect
reads it here. What the numbers do to a simulation: `easi_jax.model.effects`.

Rows stand in the order in which the numbers of a place become columns of a fit.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import mujoco
import numpy as np

from easi_jax.model import effect_mjcf
from easi_jax.model.body_extent import room_for_mass
from easi_jax.model.contact_pairs import ContactPair
from easi_jax.model.effect_numbers import NO_FORCE_LIMIT, NUMBERS, EffectNumber

RARE, COMMON = 1, -1  # rarity of effects; of others 0


@dataclass(frozen=True)
class Scales:
    """How large things are in the data; every effect is measured against it.

    Attributes:
        position, speed, acceleration: RMS per degree of freedom, ``(nv,)``.
        torque: median of what moves it, ``(nv,)``.
        most: the most of that, ``(nv,)``.
        inertia: about each degree of freedom, ``(nv,)``.
        alone: that a torque at each alone meets, the least of it, ``(nv,)``: less
            inertia than that cannot be taken from one.
        command: RMS, ``(nu,)``.
        force: RMS of an actuator's force, ``(nu,)``.
        peak: its largest, but for two rows in 1,000, ``(nu,)``.
        span: range of positions, ``(nv,)``.
        middle: of that range, ``(nv,)``.
        touching: share of rows in which pairs of geoms touch, ``(P,)``
            (`easi_jax.model.contact_pairs`).
        dt: control step [s].
        longest: longest delay that is looked for [s].
        hidden: degrees of freedom that nobody measured; none where it is empty. How far
            they move is what they may at most.
    """

    position: np.ndarray
    speed: np.ndarray
    acceleration: np.ndarray
    torque: np.ndarray
    most: np.ndarray
    inertia: np.ndarray
    alone: np.ndarray
    command: np.ndarray
    force: np.ndarray
    peak: np.ndarray
    span: np.ndarray
    middle: np.ndarray
    touching: np.ndarray
    dt: float
    longest: float
    hidden: tuple[bool, ...] = ()


@dataclass(frozen=True)
class Spot:
    """A joint, actuator, body or pair of geoms, or the whole model, in some data.

    Attributes:
        m: the model.
        kind: what it is.
        i: its id; 0 for the whole model.
        s: how large things are in the data.
        pairs: of geoms that may touch: the one that it is, or all of the model.
    """

    m: mujoco.MjModel
    kind: str
    i: int
    s: Scales
    pairs: tuple[ContactPair, ...] = ()

    @cached_property
    def sizes(self) -> Mapping[str, float]:
        """How large things are here, by name, SI units."""
        of_kind = {"joint": _of_joint, "actuator": _of_actuator, "body": _of_body}
        found = of_kind.get(self.kind, _of_contacts)(self)
        return {"1": 1.0, "dt": self.s.dt, "longest": self.s.longest, **found}

    @property
    def range(self) -> tuple[float, float]:
        """Where a joint may be: its limits; or half a turn about the middle of where it
        was in the data, or as far again as that."""
        m, d = self.m, int(self.m.jnt_dofadr[self.i])
        if m.jnt_limited[self.i]:
            low, high = m.jnt_range[self.i].tolist()
            return low, high
        is_hinge = m.jnt_type[self.i] == mujoco.mjtJoint.mjJNT_HINGE
        middle, span = float(self.s.middle[d]), float(self.s.span[d])
        far = max(0.5 * span, math.pi) if is_hinge else 1.5 * span
        return middle - far, middle + far

    @property
    def is_read(self) -> bool:
        """Whether the joint's position is measured."""
        hidden = self.s.hidden
        return not (hidden and hidden[int(self.m.jnt_dofadr[self.i])])


# What the model says of the forces in a log may be as far off.
_OFF = 2.0


def _of_joint(o: Spot) -> dict[str, float]:
    m, s, d = o.m, o.s, int(o.m.jnt_dofadr[o.i])
    is_hinge = m.jnt_type[o.i] == mujoco.mjtJoint.mjJNT_HINGE
    torque, span = float(s.torque[d]), float(s.span[d])
    speed, position = (max(float(x[d]), 1e-9) for x in (s.speed, s.position))
    inertia, armature = float(s.inertia[d]), float(m.dof_armature[d])
    return {
        "torque": torque,
        "speed": speed,
        "position": position,
        "inertia": inertia,
        # Dry friction that the motion was not stopped by.
        "holding": _OFF * max(float(s.most[d]), torque),
        "torque per speed": torque / speed,
        "torque per squared speed": torque / speed**2,
        "torque per position": torque / position,
        # Of the model.
        "armature": armature,
        "damping": float(m.dof_damping[d]),
        "frictionloss": float(m.dof_frictionloss[d]),
        # Most of the inertia that a drive may have.
        "drive": armature if armature > 0 else 0.7 * float(s.alone[d]),
        # What free play is a share of.
        "reach": min(span, 1.0 if is_hinge else np.inf),
        # Cycles per 2 pi of position: slower over the whole range, a ripple is a spring
        # and a constant torque.
        "slow cycles": (1.5 if is_hinge else 4.0) * 2 * np.pi / span,
    }


def _of_actuator(o: Spot) -> dict[str, float]:
    command, force = (max(float(x[o.i]), 1e-9) for x in (o.s.command, o.s.force))
    return {"command": command, "force": force, "peak": float(o.s.peak[o.i])}


def _of_body(o: Spot) -> dict[str, float]:
    mass = float(o.m.body_mass[o.i])
    radius = float(np.sqrt(o.m.body_inertia[o.i].max() / mass))
    reach = float(np.linalg.norm(o.m.body_ipos[o.i]))
    size = max(radius + reach, 1e-3)
    room = zip("xyz", *room_for_mass(o.m, o.i), strict=True)
    inside = {
        f"{k}{way}": x for k, *ends in room for way, x in zip("-+", ends, strict=True)
    }
    return {"mass": mass, "size": size, **inside}


def _of_contacts(o: Spot) -> dict[str, float]:
    """What the model has."""
    if not o.pairs:
        return {}
    return {
        "friction": max(float(p.friction[0]) for p in o.pairs),
        "stiffness": float(np.mean([p.stiffness for p in o.pairs])),
        "damping": float(np.mean([p.damping for p in o.pairs])),
    }


Told = Mapping[str, tuple[float, float, str]]  # value, standard deviation, unit
Starts = tuple[tuple[float, ...], ...]
Limit = float | Callable[[Mapping[str, float]], float]


@dataclass(frozen=True)
class Part:
    """One number of an effect at a kind of place.

    Attributes:
        column: the number (`easi_jax.model.effect_numbers.NUMBERS`).
        name: what people know it by; "" where they are not told of it.
        scale: which of `Spot.sizes` the following are multiples of.
        low, high: bounds of a fit; or functions of all sizes.
        size: a small but visible change, for finite differences.
        without: its value in a model without the effect; None: its neutral value.
        of: people are told the value times this one of the sizes ...
        unit: ... and in this unit, where it is not the number's own.
    """

    column: str
    name: str
    scale: str
    low: Limit
    high: Limit
    size: float
    without: float | None = None
    of: str = "1"
    unit: str = ""

    @property
    def number(self) -> EffectNumber:
        """The number's row."""
        return NUMBERS[self.column]

    @property
    def usual(self) -> float:
        """Its value without the effect, whatever the place."""
        return self.number.neutral if self.without is None else self.without

    def bounds(self, o: Spot) -> tuple[float, float]:
        """Low and high of a fit."""
        sizes = o.sizes
        low, high = (
            x(sizes) if callable(x) else x * sizes[self.scale]
            for x in (self.low, self.high)
        )
        return low, high

    def neutral(self, o: Spot) -> float:
        """Its value in a model without the effect."""
        if self.without is not None:
            return self.without * o.sizes[self.scale]
        return min(self.number.neutral, NO_FORCE_LIMIT)


@dataclass(frozen=True)
class Site:
    """An effect at a kind of place.

    Attributes:
        parts: its numbers. Where the last one says which kind it is of
            (`EffectNumber.is_shape`), each of its bounds is tried as an effect of its
            own; a fit does not move it.
        starts: values of the parts, as multiples of their scales, that a fit starts
            from, in turn; several where the predictions have no slope at the neutral
            values, or more than one valley. NaN: from a grid.
        more: further starts, as values, from the sizes.
        able: whether it can be there, beside what its numbers refuse.
        rarity: of the effect at such places, more than elsewhere.
    """

    parts: tuple[Part, ...]
    starts: Starts = ((0.0,),)
    more: Callable[[Mapping[str, float]], Starts] = lambda sizes: ()
    able: Callable[[Spot], bool] = lambda o: True
    rarity: int = 0

    def offered(self, o: Spot) -> bool:
        """Whether the effect can be at a place."""
        numbers = (p.number for p in self.parts)
        return self.able(o) and all(n.refuse(o.m, o.i) is None for n in numbers)

    def starts_at(self, o: Spot) -> Starts:
        """Values of all parts but a shape that a fit starts from, in turn."""
        scales = [o.sizes[p.scale] for p in self.parts]
        scaled = (
            tuple(x * scale for x, scale in zip(start, scales, strict=False))
            for start in self.starts
        )
        return (*scaled, *self.more(o.sizes))


@dataclass(frozen=True)
class Effect:
    """All that is known of an effect.

    Attributes:
        name: as the log format has it.
        sentence: what a roboticist would say; names of parameters, ``at``, ``kind``
            and ``pair`` in braces.
        sites: where it can sit: joint, actuator, body, geom (a pair of them) or model
            (the whole of it), and what it is there.
        rarity: `RARE` where few machines have it, which is named only where it does
            clearly better than what others have; `COMMON` where nearly all have it.
        usual: values outside these are as unlikely as a rare effect.
        contains: an effect that it is with some of its numbers at zero.
        refits: kind and quantity of the model (`easi_jax.model.quantities`) that says
            the same, and that a refit may move.
        is_shared: all actuators may have it alike, as one bus or one controller makes
            it.
        rests: its second number over its first is where it rests, and lies within the
            range of its joint.
        is_sine: its numbers are amplitude, cycles and phase of a sine; the cycles that
            a fit starts from come from a grid.
        told: parameters as people know them, from the numbers.
        mjcf: how MJCF says it; None where it has no word for it.
    """

    name: str
    sentence: str
    sites: Mapping[str, Site]
    rarity: int = 0
    usual: tuple[float, float] = (-np.inf, np.inf)
    contains: str = ""
    refits: tuple[str, str] = ("", "")
    is_shared: bool = False
    rests: bool = False
    is_sine: bool = False
    told: Callable[[Told], Told] = lambda got: got
    mjcf: effect_mjcf.InMjcf | None = None

    @property
    def is_shift(self) -> bool:
        """Whether it is a shift in time."""
        return all(p.number.is_shift for s in self.sites.values() for p in s.parts)


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


def _has(what: str) -> Callable[[Mapping[str, float]], float]:
    """The lower bound of what the model may have too much of: an effect of negative
    strength."""
    return lambda sizes: -sizes[what]


def _holding(sizes: Mapping[str, float]) -> float:
    return sizes["holding"]


def _longest(sizes: Mapping[str, float]) -> float:
    return sizes["longest"]


def _late(sizes: Mapping[str, float]) -> Starts:
    return ((0.3 * sizes["longest"],),)


def _seldom_met(sizes: Mapping[str, float]) -> Starts:
    """A limit that is seldom met shows at the largest forces alone."""
    force, peak = sizes["force"], sizes["peak"]
    return tuple((x * peak,) for x in (0.8, 0.5) if peak > 3.0 * force)


def _alone(
    column: str, name: str, scale: str, low: Limit, high: Limit, size: float
) -> Site:
    return Site((Part(column, name, scale, low, high, size),))


def _inside(sizes_of: str) -> tuple[Limit, Limit]:
    """Lowest and highest shift of a center of mass along an axis."""
    return (
        lambda sizes: sizes[f"{sizes_of}-"],
        lambda sizes: sizes[f"{sizes_of}+"],
    )


def _vector(
    field: str, names: str | tuple[str, ...], scale: str, high: float, size: float
) -> Site:
    parts = tuple(
        Part(f"{field}.{i}", name, scale, -high, high, size)
        for i, name in enumerate(names)
    )
    return Site(parts, ((0.0,) * len(parts),))


# A motor is rarely 2.5 times weaker than its data sheet, but may well carry a load that
# nobody told of.
_USUAL = (0.4, 2.5)


def _factor(
    column: str, low: float, able: Callable[[Spot], bool] = lambda o: True
) -> Site:
    part = Part(column, "factor", "1", low, 10.0, 0.02)
    return Site((part,), ((1.0,),), able=able)


def _holds_both(o: Spot) -> bool:
    """Whether a drive has feedback of its position and of its speed."""
    return all(NUMBERS[c].refuse(o.m, o.i) is None for c in ("kp", "kv"))


def _contact_friction(column: str) -> Site:
    slides = Part(column, "friction", "1", 0.05, 10.0, 0.05, of="friction")
    return Site((slides,), ((0.6,), (1.6,)), able=lambda o: bool(o.pairs))


def _contact_softness(field: str) -> Site:
    stiff = Part(f"{field}.0", *("stiffness", "1", 1e-3, 50.0, 0.05))
    damped = Part(f"{field}.1", *("damping", "1", 1e-2, 50.0, 0.05))
    parts = (
        replace(stiff, of="stiffness", unit="1/s^2"),
        replace(damped, of="damping", unit="1/s"),
    )
    return Site(parts, ((0.3, 0.5), (0.1, 0.3)), able=lambda o: bool(o.pairs))


_ROWS = (
    Effect(
        "payload_mass",
        'body "{at}" carries {mass} more, at its center of mass',
        {
            "body": Site(
                (
                    Part("mass", "mass", "mass", -0.9, 20, 0.03),
                    Part("spread", "", "1", 0.0, 1.0, 0.1),
                )
            )
        },
        refits=("body", "mass"),
        mjcf=effect_mjcf.BODY,
    ),
    Effect(
        "com_offset",
        'the mass of body "{at}" sits elsewhere',
        {
            "body": Site(
                tuple(
                    Part(f"com.{i}", axis, "size", *_inside(axis), 0.02)
                    for i, axis in enumerate("xyz")
                ),
                ((0.0, 0.0, 0.0),),
            )
        },
        rarity=RARE,
        mjcf=effect_mjcf.BODY,
    ),
    Effect(
        "coulomb_friction",
        'joint "{at}" has about {torque} of dry friction',
        {
            "joint": Site(
                (
                    Part(
                        *("coulomb", "torque", "torque"),
                        *(_has("frictionloss"), _holding, 0.03),
                    ),
                ),
                ((0.0,), (0.1,)),
            )
        },
        rarity=COMMON,
        refits=("joint", "frictionloss"),
        mjcf=effect_mjcf.COULOMB,
    ),
    Effect(
        "viscous_damping",
        'joint "{at}" has {damping} of viscous damping',
        {
            "joint": _alone(
                *("damping", "damping", "torque per speed", _has("damping"), 20, 0.03)
            )
        },
        rarity=COMMON,
        refits=("joint", "damping"),
        mjcf=effect_mjcf.DAMPING,
    ),
    Effect(
        "quadratic_drag",
        '{kind} "{at}" has a drag of {coefficient} on the squared speed',
        {
            "joint": _alone(
                *("drag", "coefficient", "torque per squared speed", 0.0, 20, 0.03)
            ),
            # More than enough to hold the body's weight at 1 m/s.
            "body": Site(
                (Part("resistance", "coefficient", "mass", 0.0, 20, 0.06),),
                able=lambda o: o.m.opt.integrator != mujoco.mjtIntegrator.mjINT_RK4,
            ),
        },
        rarity=RARE,
    ),
    Effect(
        "constant_force",
        'a constant force acts at {kind} "{at}"',
        {
            "joint": _alone("constant", "torque", "torque", -20, 20, 0.03),
            "body": replace(_vector("force", "xyz", "mass", 200, 0.1), rarity=RARE),
        },
    ),
    Effect(
        "joint_stiffness",
        'joint "{at}" is pulled by a spring of {stiffness}',
        {
            "joint": Site(
                (
                    Part(
                        *("stiffness", "stiffness", "torque per position"),
                        *(0.0, 20, 0.03),
                    ),
                    Part("spring", "rest", "torque", -20, 20, 0.03),
                ),
                ((0.0, 0.0),),
            )
        },
        rarity=RARE,
        contains="constant_force",
        rests=True,
        refits=("joint", "stiffness"),
        told=_told_spring,
        mjcf=effect_mjcf.SPRING,
    ),
    Effect(
        "stribeck_friction",
        'joint "{at}" has dry friction of {static} at rest that falls to {kinetic} in '
        "motion",
        {
            "joint": Site(
                (
                    Part("coulomb", "kinetic", "torque", 0.0, _holding, 0.03),
                    Part("static", "static", "torque", 0.0, _holding, 0.03),
                    Part("stribeck", "velocity", "speed", 0.005, 3, 0.05),
                ),
                ((0.05, 0.05, 0.1), (0.05, 0.05, 0.4)),
            )
        },
        rarity=RARE,
        contains="coulomb_friction",
        told=_told_stribeck,
    ),
    Effect(
        "armature",
        'joint "{at}" carries {armature} of inertia',
        {
            "joint": _alone(
                *("armature", "armature", "inertia", _has("armature"), 20, 0.03)
            )
        },
        rarity=COMMON,
        refits=("joint", "armature"),
        mjcf=effect_mjcf.ARMATURE,
    ),
    Effect(
        "sensor_bias",
        'the reading of joint "{at}" is off by {bias}',
        {
            "joint": Site(
                (Part("bias", "bias", "position", -1.5, 1.5, 0.01),),
                able=lambda o: o.is_read,
            )
        },
    ),
    Effect(
        "sensor_delay",
        'the reading of "{at}" comes {delay} late',
        {
            "joint": Site(
                (Part("late", "delay", "dt", 0.0, _longest, 0.25),),
                ((0.5,), (2.0,)),
                _late,
                able=lambda o: o.is_read,
            )
        },
    ),
    Effect(
        "backlash",
        'joint "{at}" has {width} of free play',
        {
            "joint": Site(
                (
                    Part("width", "width", "reach", 0.0, 0.5, 0.005),
                    # The drive's share of the inertia is fitted with it.
                    Part("rotor", "", "drive", 0.1, 0.98, 0.1, without=0.6),
                ),
                ((0.01, 0.6), (0.03, 0.6), (0.1, 0.6)),
            )
        },
        rarity=RARE,
    ),
    Effect(
        "torque_ripple",
        'joint "{at}" has a torque ripple of {amplitude}, {cycles_per_rev} cycles per '
        "revolution",
        {
            "joint": Site(
                (
                    Part("ripple", "amplitude", "torque", 0.0, 20, 0.03),
                    Part("cycles", "cycles_per_rev", "slow cycles", 1.0, 50, 0.02),
                    Part("phase", "phase", "1", -20.0, 20.0, 0.1),
                ),
                ((0.03, np.nan, 0.0), (0.03, np.nan, np.pi / 2)),
            )
        },
        rarity=RARE,
        is_sine=True,
        told=_told_ripple,
    ),
    Effect(
        "actuator_gain",
        'actuator "{at}" gives {gain} times what it is told',
        {"actuator": Site((Part("gain", "gain", "1", 0.02, 10.0, 0.02),), ((1.0,),))},
        usual=_USUAL,
        refits=("actuator", "gain"),
        mjcf=effect_mjcf.DRIVE,
    ),
    Effect(
        "drive_stiffness",
        'drive "{at}" holds its position with {factor} times its kp',
        {"actuator": _factor("kp", 0.02)},
        usual=_USUAL,
        refits=("actuator", "kp"),
        mjcf=effect_mjcf.DRIVE,
    ),
    Effect(
        "drive_damping",
        'drive "{at}" damps its motion with {factor} times its kv',
        {"actuator": _factor("kv", 0.0)},
        # Where it is more than the model has, a joint with more damping is the same,
        # and more common.
        rarity=RARE,
        usual=_USUAL,
        refits=("actuator", "kv"),
        mjcf=effect_mjcf.DRIVE,
    ),
    Effect(
        "actuator_strength",
        'actuator "{at}" gives {factor} times its force',
        # A motor's is its gain. Without kp it is the drive's damping, without kv its
        # stiffness. A limit of the force is another effect, and stays.
        {"actuator": _factor("strength", 0.02, able=_holds_both)},
        usual=_USUAL,
        mjcf=effect_mjcf.DRIVE,
    ),
    Effect(
        "actuator_delay",
        'commands arrive at actuator "{at}" {delay} late',
        {
            "actuator": Site(
                (Part("delay", "delay", "dt", 0.0, _longest, 0.25),),
                ((0.5,), (2.0,)),
                _late,
            )
        },
        is_shared=True,
        mjcf=effect_mjcf.DELAY,
    ),
    Effect(
        "actuator_lag",
        'actuator "{at}" responds with a time constant of {time_constant}',
        {
            "actuator": Site(
                (Part("lag", "time_constant", "dt", 0.0, lambda sizes: 0.5, 0.25),),
                ((1.0,),),
                lambda sizes: ((0.03,), (0.1,)),
            )
        },
        refits=("actuator", "time_constant"),
        is_shared=True,
        mjcf=effect_mjcf.LAG,
    ),
    Effect(
        "actuator_saturation",
        'actuator "{at}" gives no more than {limit}',
        {
            "actuator": Site(
                (
                    Part(
                        *("limit", "limit", "force", 0.02),
                        lambda sizes: max(4.0 * sizes["force"], sizes["peak"]),
                        0.02,
                    ),
                ),
                ((2.2,), (1.5,), (1.0,), (0.6,)),
                _seldom_met,
            )
        },
        rarity=RARE,
        refits=("actuator", "force_limit"),
        mjcf=effect_mjcf.LIMIT,
    ),
    Effect(
        "actuator_deadband",
        'actuator "{at}" ignores commands below {width}',
        {
            "actuator": Site(
                (
                    Part("deadband", "width", "command", 0.0, 2, 0.02),
                    Part("jump", "", "1", 0.0, 1.0, 0.1),
                ),
                ((0.08,), (0.3,), (0.7,)),
            )
        },
        rarity=RARE,
    ),
    Effect(
        "gravity_tilt",
        "the base is tilted (roll {roll}, pitch {pitch})",
        {"model": _vector("tilt", ("roll", "pitch"), "1", 0.6, 0.01)},
        rarity=RARE,
        usual=(-0.25, 0.25),
        mjcf=effect_mjcf.TILT,
    ),
    Effect(
        "contact_friction",
        "contacts{pair} have a sliding friction of {friction}",
        {"model": _contact_friction("friction"), "geom": _contact_friction("slip")},
        mjcf=effect_mjcf.FRICTION,
    ),
    Effect(
        "contact_softness",
        "contacts{pair} have a stiffness of {stiffness}",
        {"model": _contact_softness("softness"), "geom": _contact_softness("give")},
        mjcf=effect_mjcf.SOFTNESS,
    ),
)
# Beside these, what owners write (`easi_jax.model.own_effects`).
CATALOG: dict[str, Effect] = {row.name: row for row in _ROWS}
EFFECTS = tuple(CATALOG)
