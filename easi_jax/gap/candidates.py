"""Where each effect can sit in a model, its numbers there, and what fits start from."""

from collections.abc import Sequence

import mujoco
import numpy as np

from easi_jax.gap.table import Column, Place, Scales, name_of
from easi_jax.model import backlash
from easi_jax.model.contact_pairs import contact_pairs
from easi_jax.model.effect_catalog import EFFECT_TABLE
from easi_jax.model.quantities import linear_drive, scalar_dofs

_SELDOM = 0.02  # of the rows: a pair of geoms that touches less says nothing
_PAIRS = 12  # at most, that are looked at one by one


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
    if m.nu > 1:
        out += _shared(s)
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
    pairs = contact_pairs(m)
    if pairs:
        slides = max(float(p.friction[0]) for p in pairs)
        stiff, damped = (
            float(np.mean([getattr(p, name) for p in pairs]))
            for name in ("stiffness", "damping")
        )
        out += _contacts("", "model", (), slides, stiff, damped)
    often = [k for k in np.argsort(-s.touching) if s.touching[k] > _SELDOM]
    if len(often) > 1 and EFFECT_TABLE["slip"].refuse(m, 0) is None:
        for k in sorted(often[:_PAIRS]):
            p = pairs[k]
            values = float(p.friction[0]), p.stiffness, p.damping
            out += _contacts(p.name, "geom", (int(k),), *values)
    return out


def _moves(m: mujoco.MjModel, b: int) -> bool:
    while b:
        if m.body_dofnum[b]:
            return True
        b = int(m.body_parentid[b])
    return False


def _contacts(
    at: str,
    kind: str,
    index: tuple[int, ...],
    friction: float,
    stiffness: float,
    damping: float,
) -> list[Place]:
    """Friction and softness of all contacts, or of those of a pair of geoms, which
    have these values in the model as given."""
    slip, give = ("slip", "give") if index else ("friction", "softness")
    rubs = Column(slip, index, "friction", "1", 1.0, 0.05, 10.0, 0.05, friction)
    soft = (
        Column(
            *(give, (*index, 0), "stiffness", "1/s2"),
            *(1.0, 1e-3, 50.0, 0.05, stiffness),
        ),
        Column(
            *(give, (*index, 1), "damping", "1/s"),
            *(1.0, 1e-2, 50.0, 0.05, damping),
        ),
    )
    return [
        Place("contact_friction", at, kind, (rubs,), ((0.6,), (1.6,))),
        Place("contact_softness", at, kind, soft, ((0.3, 0.5), (0.1, 0.3))),
    ]


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
                -float(m.dof_armature[d]),
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
                -1.5 * position,
                1.5 * position,
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


def _shared(s: Scales) -> list[Place]:
    """What all drives have alike, as one bus or one controller makes it: a number of
    each drive would be one of dozens, and hardly help alone."""
    return _late("", "model", (), s)


def _late(at: str, kind: str, index: tuple[int, ...], s: Scales) -> list[Place]:
    """Delay and lag of a command, or of all."""
    dt = s.dt
    delay = Column("delay", index, "delay", "s", 0.0, 0.0, s.longest, 0.25 * dt)
    lag = Column("lag", index, "time_constant", "s", 0.0, 0.0, 0.5, 0.25 * dt)
    delays = (0.5 * dt,), (2.0 * dt,), (0.3 * s.longest,)
    return [
        Place("actuator_delay", at, kind, (delay,), delays),
        Place("actuator_lag", at, kind, (lag,), ((dt,), (0.03,), (0.1,))),
    ]


def _at_actuator(m: mujoco.MjModel, a: int, s: Scales) -> list[Place]:
    at = name_of(m, "actuator", a)
    command, force = max(float(s.command[a]), 1e-9), max(float(s.force[a]), 1e-9)
    peak = float(s.peak[a])

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
        *_late(at, "actuator", (a,), s),
        place(
            "actuator_saturation",
            Column(
                "limit",
                (a,),
                "limit",
                "N m" if linear_drive(m, a) is False else "N",
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
