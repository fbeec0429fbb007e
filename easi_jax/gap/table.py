"""The effects that the workflow knows: names, places, parameters, where they start.

A `Place` is one effect at one joint, actuator, body or at the whole model. Its numbers
are columns of a long vector that holds every place; at their neutral values the model
is as given. Names and units: the log format's table of effects.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from easi_jax import backlash, effects
from easi_jax.effects import Effects
from easi_jax.errors import UserError
from easi_jax.parameters import ParameterSpace
from easi_jax.quantities import direct_solref, scalar_dofs

EFFECTS = (
    "coulomb_friction",
    "stribeck_friction",
    "viscous_damping",
    "quadratic_drag",
    "joint_stiffness",
    "constant_force",
    "torque_ripple",
    "armature",
    "backlash",
    "actuator_gain",
    "actuator_delay",
    "actuator_lag",
    "actuator_saturation",
    "actuator_deadband",
    "payload_mass",
    "com_offset",
    "gravity_tilt",
    "sensor_bias",
    "sensor_delay",
    "contact_friction",
    "contact_softness",
)


# Named only where they do clearly better than what most machines have.
RARE = (
    "stribeck_friction",
    "quadratic_drag",
    "joint_stiffness",
    "torque_ripple",
    "backlash",
    "actuator_saturation",
    "actuator_deadband",
    "com_offset",
    "gravity_tilt",
)


# Sizes beyond which an effect is as unlikely as a rare one: a motor is rarely 2.5 times
# weaker than its data sheet, but may well carry a load that nobody told of.
_UNUSUAL = {"actuator_gain": (0.4, 2.5), "gravity_tilt": (-0.25, 0.25)}


# Effects that are also quantities which a model states and a refit may move.
REFITTED = {
    "viscous_damping": "damping",
    "coulomb_friction": "frictionloss",
    "joint_stiffness": "stiffness",
}


@dataclass(frozen=True)
class Column:
    """One number of an effect.

    Attributes:
        field: of `Effects`.
        index: where in that field.
        parameter: its name for people; "" where it only chooses a shape.
        unit: SI.
        neutral: its value in a model without the effect.
        low, high: bounds.
        size: a small but visible change, for finite differences.
        of: what people are told is the value times this.
    """

    field: str
    index: tuple[int, ...]
    parameter: str
    unit: str
    neutral: float
    low: float
    high: float
    size: float
    of: float = 1.0


@dataclass(frozen=True)
class Place:
    """One effect at one place.

    Attributes:
        effect: its name.
        at: the joint, actuator, body or geom; "" for the whole model.
        kind: what ``at`` is.
        columns: its numbers.
        starts: values of the columns that a fit starts from, in turn.
        fitted: which columns a fit moves.
    """

    effect: str
    at: str
    kind: str
    columns: tuple[Column, ...]
    starts: tuple[tuple[float, ...], ...]
    fitted: tuple[bool, ...] = field(default=())

    def __post_init__(self) -> None:
        if not self.fitted:
            object.__setattr__(self, "fitted", (True,) * len(self.columns))

    @property
    def key(self) -> str:
        """``effect@at``."""
        return f"{self.effect}@{self.at}"

    def unlikely(self, values: np.ndarray) -> int:
        """For how many reasons few machines have it with these values of its columns:
        a rare effect, an unusual size."""
        low, high = _UNUSUAL.get(self.effect, (-np.inf, np.inf))
        usual = np.all((values >= low) & (values <= high))
        return (self.effect in RARE) + (not usual)


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
    dt: float
    longest: float


def name_of(m: mujoco.MjModel, kind: str, i: int) -> str:
    """Name of a joint, actuator or body."""
    obj = {"joint": m.joint, "actuator": m.actuator, "body": m.body}[kind]
    return str(obj(i).name)


_OBJECTS = {
    "joint": mujoco.mjtObj.mjOBJ_JOINT,
    "actuator": mujoco.mjtObj.mjOBJ_ACTUATOR,
    "body": mujoco.mjtObj.mjOBJ_BODY,
}


def object_id(m: mujoco.MjModel, kind: str, name: str) -> int:
    """Id of a named joint, actuator or body.

    Raises:
        UserError: the model has none of that name.
    """
    i = mujoco.mj_name2id(m, _OBJECTS[kind], name)
    if i < 0:
        raise UserError(f'the model has no {kind} "{name}"')
    return i


def places(m: mujoco.MjModel, s: Scales) -> list[Place]:
    """Every effect at every place of a model where it can sit."""
    out: list[Place] = []
    geared = backlash.geared(m)
    for j, (_, d) in scalar_dofs(m).items():
        out += _at_joint(m, j, s)
        if d in geared:
            out.append(_play(m, j, s))
    for a in range(m.nu):
        out += _at_actuator(m, a, s)
    moving = [b for b in range(1, m.nbody) if m.body_mass[b] > 0 and _moves(m, b)]
    for b in moving:
        out += _at_body(m, b)
    if np.linalg.norm(m.opt.gravity) > 0 and moving:
        out.append(
            Place(
                "gravity_tilt",
                "",
                "model",
                tuple(
                    Column("tilt", (i,), name, "rad", 0.0, -0.6, 0.6, 0.01)
                    for i, name in enumerate(("roll", "pitch"))
                ),
                ((0.0, 0.0),),
            )
        )
    if _contacts(m):
        slides, stiff, damped = _contact(m)
        out.append(
            Place(
                "contact_friction",
                "",
                "model",
                (
                    Column(
                        "friction", (), "friction", "1", 1.0, 0.05, 10.0, 0.05, slides
                    ),
                ),
                ((0.6,), (1.6,)),
            )
        )
        out.append(
            Place(
                "contact_softness",
                "",
                "model",
                (
                    Column(
                        *("softness", (0,), "stiffness", "1/s2"),
                        *(1.0, 1e-3, 50.0, 0.05, stiff),
                    ),
                    Column(
                        *("softness", (1,), "damping", "1/s"),
                        *(1.0, 1e-2, 50.0, 0.05, damped),
                    ),
                ),
                ((0.3, 0.5), (0.1, 0.3)),
            )
        )
    return out


def covered(place: Place, space: ParameterSpace) -> bool:
    """Whether the refit of the model's own parameters does what an effect does."""
    quantity = REFITTED.get(place.effect)
    own = {a for p in space.parameters for a in p.addresses}
    return quantity is not None and f"joint.{place.at}.{quantity}" in own


def _moves(m: mujoco.MjModel, b: int) -> bool:
    while b:
        if m.body_dofnum[b]:
            return True
        b = int(m.body_parentid[b])
    return False


def _contact(m: mujoco.MjModel) -> tuple[float, float, float]:
    """Sliding friction, stiffness [1/s^2] and damping [1/s] of the model's contacts."""
    if m.npair:
        friction, solref = m.pair_friction[:, 0], m.pair_solref
    else:
        solid = (m.geom_contype > 0) | (m.geom_conaffinity > 0)
        friction, solref = m.geom_friction[solid, 0], m.geom_solref[solid]
    stiffness, damping = np.mean([direct_solref(m, s) for s in solref], axis=0)
    return float(friction.max()), float(stiffness), float(damping)


def _contacts(m: mujoco.MjModel) -> bool:
    if m.npair:
        return True
    solid = (m.geom_contype > 0) | (m.geom_conaffinity > 0)
    return int(solid.sum()) > 1


def _at_joint(m: mujoco.MjModel, j: int, s: Scales) -> list[Place]:
    d = int(m.jnt_dofadr[j])
    hinge = m.jnt_type[j] == mujoco.mjtJoint.mjJNT_HINGE
    unit, q = ("N m", "rad") if hinge else ("N", "m")
    per_speed = "N m s/rad" if hinge else "N s/m"
    at = name_of(m, "joint", j)
    torque, speed = float(s.torque[d]), max(float(s.speed[d]), 1e-9)
    big = 20 * torque
    small = 0.03 * torque

    def place(
        effect: str, *columns: Column, starts: Sequence[Sequence[float]]
    ) -> Place:
        return Place(
            effect, at, "joint", columns, tuple(tuple(map(float, x)) for x in starts)
        )

    # What the model has too much of is an effect of negative strength.
    damped, rubs = float(m.dof_damping[d]), float(m.dof_frictionloss[d])
    coulomb = Column("coulomb", (d,), "torque", unit, 0.0, -rubs, big, small)
    out = [
        place("coulomb_friction", coulomb, starts=[[0.0], [0.1 * torque]]),
        place(
            "viscous_damping",
            Column(
                "damping",
                (d,),
                "damping",
                per_speed,
                0.0,
                -damped,
                big / speed,
                small / speed,
            ),
            starts=[[0.0]],
        ),
        place(
            "quadratic_drag",
            Column(
                "drag",
                (d,),
                "coefficient",
                "N m s2/rad2" if hinge else "N s2/m2",
                0.0,
                0.0,
                big / speed**2,
                small / speed**2,
            ),
            starts=[[0.0]],
        ),
        place(
            "constant_force",
            Column("constant", (d,), "torque", unit, 0.0, -big, big, small),
            starts=[[0.0]],
        ),
    ]
    position = max(float(s.position[d]), 1e-9)
    stiff = torque / position
    out.append(
        place(
            "joint_stiffness",
            Column(
                "stiffness",
                (d,),
                "stiffness",
                "N m/rad" if hinge else "N/m",
                0.0,
                0.0,
                20 * stiff,
                0.03 * stiff,
            ),
            Column("spring", (d,), "rest", unit, 0.0, -big, big, small),
            starts=[[0.0, 0.0]],
        )
    )
    out.append(
        place(
            "stribeck_friction",
            Column("coulomb", (d,), "kinetic", unit, 0.0, 0.0, big, small),
            Column("static", (d,), "static", unit, 0.0, 0.0, big, small),
            Column(
                "stribeck",
                (d,),
                "velocity",
                "rad/s" if hinge else "m/s",
                1.0,
                0.005 * speed,
                3 * speed,
                0.05 * speed,
            ),
            starts=[
                [0.05 * torque, 0.05 * torque, 0.1 * speed],
                [0.05 * torque, 0.05 * torque, 0.4 * speed],
            ],
        )
    )
    inertia = float(s.inertia[d])
    out.append(
        place(
            "armature",
            Column(
                "armature",
                (d,),
                "armature",
                "kg m2" if hinge else "kg",
                0.0,
                0.0,
                20 * inertia,
                0.03 * inertia,
            ),
            starts=[[0.0]],
        )
    )
    out.append(
        place(
            "sensor_bias",
            Column(
                "bias",
                (d,),
                "bias",
                q,
                0.0,
                -0.5 * position,
                0.5 * position,
                0.01 * position,
            ),
            starts=[[0.0]],
        )
    )
    out.append(
        place(
            "sensor_delay",
            Column("late", (d,), "delay", "s", 0.0, 0.0, s.longest, 0.25 * s.dt),
            starts=[[0.5 * s.dt], [2.0 * s.dt], [0.3 * s.longest]],
        )
    )
    return out


def _play(m: mujoco.MjModel, j: int, s: Scales) -> Place:
    """Backlash; the drive's share of the inertia is fitted with it."""
    d = int(m.jnt_dofadr[j])
    hinge = m.jnt_type[j] == mujoco.mjtJoint.mjJNT_HINGE
    own = float(m.dof_armature[d])
    most = own if own > 0 else 0.7 * float(s.inertia[d])
    reach = min(float(s.span[d]), 1.0 if hinge else np.inf)
    return Place(
        "backlash",
        name_of(m, "joint", j),
        "joint",
        (
            Column(
                *("width", (d,), "width", "rad" if hinge else "m"),
                *(0.0, 0.0, 0.5 * reach, 0.005 * reach),
            ),
            Column(
                *("rotor", (d,), "", "kg m2" if hinge else "kg"),
                *(0.6 * most, 0.1 * most, 0.98 * most, 0.1 * most),
            ),
        ),
        tuple((w * reach, 0.6 * most) for w in (0.01, 0.03, 0.1)),
    )


def _at_actuator(m: mujoco.MjModel, a: int, s: Scales) -> list[Place]:
    at = name_of(m, "actuator", a)
    command, force = max(float(s.command[a]), 1e-9), max(float(s.force[a]), 1e-9)
    peak = float(s.peak[a])
    dt = s.dt

    def place(
        effect: str, *columns: Column, starts: Sequence[Sequence[float]]
    ) -> Place:
        return Place(
            effect, at, "actuator", columns, tuple(tuple(map(float, x)) for x in starts)
        )

    return [
        place(
            "actuator_gain",
            Column("gain", (a,), "gain", "1", 1.0, 0.02, 10.0, 0.02),
            starts=[[1.0]],
        ),
        place(
            "actuator_delay",
            Column("delay", (a,), "delay", "s", 0.0, 0.0, s.longest, 0.25 * dt),
            starts=[[0.5 * dt], [2.0 * dt], [0.3 * s.longest]],
        ),
        place(
            "actuator_lag",
            Column("lag", (a,), "time_constant", "s", 0.0, 0.0, 0.5, 0.25 * dt),
            starts=[[dt], [0.03], [0.1]],
        ),
        place(
            "actuator_saturation",
            Column(
                "limit",
                (a,),
                "limit",
                "N m",
                1e9,
                0.02 * force,
                max(4.0 * force, peak),
                0.02 * force,
            ),
            # A limit that is seldom met shows at the largest forces alone.
            starts=[[x * force] for x in (2.2, 1.5, 1.0, 0.6)]
            + [[x * peak] for x in (0.8, 0.5) if peak > 3.0 * force],
        ),
        *(
            Place(
                "actuator_deadband",
                at,
                "actuator",
                (
                    Column(
                        "deadband",
                        (a,),
                        "width",
                        "ctrl",
                        0.0,
                        0.0,
                        2 * command,
                        0.02 * command,
                    ),
                    Column("jump", (a,), "", "1", 0.0, 0.0, 1.0, 0.1),
                ),
                tuple((w * command, jump) for w in (0.08, 0.3, 0.7)),
                (True, False),
            )
            for jump in (0.0, 1.0)
        ),
    ]


def _at_body(m: mujoco.MjModel, b: int) -> list[Place]:
    at = name_of(m, "body", b)
    mass = float(m.body_mass[b])
    size = _extent(m, b)
    # A point and a spread-out mass are one name with two shapes.
    out = [
        Place(
            "payload_mass",
            at,
            "body",
            (
                Column(
                    "mass", (b,), "mass", "kg", 0.0, -0.9 * mass, 20 * mass, 0.03 * mass
                ),
                Column("spread", (b,), "", "1", 0.0, 0.0, 1.0, 0.1),
            ),
            ((0.0, spread),),
            (True, False),
        )
        for spread in (0.0, 1.0)
    ]
    out.append(
        Place(
            "com_offset",
            at,
            "body",
            tuple(
                Column("com", (b, i), axis, "m", 0.0, -2 * size, 2 * size, 0.02 * size)
                for i, axis in enumerate("xyz")
            ),
            ((0.0, 0.0, 0.0),),
        )
    )
    if m.opt.integrator != mujoco.mjtIntegrator.mjINT_RK4:
        # Enough to hold its weight at 1 m/s.
        most = 20.0 * mass
        out.append(
            Place(
                "quadratic_drag",
                at,
                "body",
                (
                    Column(
                        *("resistance", (b,), "coefficient", "N s2/m2"),
                        *(0.0, 0.0, most, 0.003 * most),
                    ),
                ),
                ((0.0,),),
            )
        )
    out.append(
        Place(
            "constant_force",
            at,
            "body",
            tuple(
                Column(
                    "force", (b, i), axis, "N", 0.0, -200 * mass, 200 * mass, 0.1 * mass
                )
                for i, axis in enumerate("xyz")
            ),
            ((0.0, 0.0, 0.0),),
        )
    )
    return out


def _extent(m: mujoco.MjModel, b: int) -> float:
    """Size of a body: its farthest geom, or its inertia's radius [m]."""
    radius = float(np.sqrt(m.body_inertia[b].max() / m.body_mass[b]))
    reach = float(np.linalg.norm(m.body_ipos[b]))
    return max(radius + reach, 1e-3)


def ripples(
    m: mujoco.MjModel, j: int, s: Scales, cycles: Sequence[float]
) -> list[Place]:
    """A torque ripple at a joint, for each of some numbers of cycles."""
    d = int(m.jnt_dofadr[j])
    hinge = m.jnt_type[j] == mujoco.mjtJoint.mjJNT_HINGE
    torque = float(s.torque[d])
    unit = "N m" if hinge else "N"
    # Slower over the whole range, it is a spring and a constant torque.
    slow = (1.5 if hinge else 4.0) * 2 * np.pi / float(s.span[d])
    return [
        Place(
            "torque_ripple",
            name_of(m, "joint", j),
            "joint",
            (
                Column(
                    "ripple",
                    (d,),
                    "amplitude",
                    unit,
                    0.0,
                    0.0,
                    20 * torque,
                    0.03 * torque,
                ),
                Column(
                    "cycles",
                    (d,),
                    "cycles_per_rev",
                    "1",
                    1.0,
                    slow,
                    50 * slow,
                    0.02 * slow,
                ),
                Column("phase", (d,), "phase", "rad", 0.0, -20.0, 20.0, 0.1),
            ),
            tuple((0.03 * torque, float(c), p) for p in (0.0, np.pi / 2)),
        )
        for c in cycles
    ]


class Layout:
    """The long vector of all columns, and how it becomes `Effects`."""

    def __init__(self, m: mujoco.MjModel, found: Sequence[Place]) -> None:
        self.columns: list[Column] = []
        self._index: dict[tuple[str, tuple[int, ...]], int] = {}
        for place in found:
            for c in place.columns:
                key = (c.field, c.index)
                if key not in self._index:
                    self._index[key] = len(self.columns)
                    self.columns.append(c)
        self._none = effects.none(m)
        self.neutral = np.array([c.neutral for c in self.columns], np.float64)

    def __len__(self) -> int:
        return len(self.columns)

    def where(self, place: Place) -> np.ndarray:
        """Indices of a place's columns in the vector."""
        return np.array([self._index[(c.field, c.index)] for c in place.columns], int)

    def effects(self, x: jax.Array) -> Effects:
        """The effects of a vector ``(n,)``; pure."""
        changed = {}
        by_field: dict[str, list[int]] = {}
        for i, c in enumerate(self.columns):
            by_field.setdefault(c.field, []).append(i)
        for name, rows in by_field.items():
            leaf = jnp.asarray(getattr(self._none, name), jnp.float32)
            index = tuple(
                np.array(k)
                for k in zip(*(self.columns[i].index for i in rows), strict=True)
            )
            values = x[np.array(rows)].astype(jnp.float32)
            changed[name] = leaf.at[index].set(values) if index else values[0]
        return self._none.replace(**changed)  # type: ignore[attr-defined]
