"""The table of physical quantities that an address can name.

One entry says where MuJoCo keeps a quantity, its unit, what physics allows, why it
may not vary at some place, and what must be set in the model before `mjx.put_model`
so that MJX does not compile it out. `addresses` turns text into places of this table.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from easi_jax.model.joint_space import dofs, driven_joint, is_scalar

# Added to what MJX would compile out if it were zero: small against any real value,
# and a normal number in float32.
SEED = 1e-9
# Stands for "no limit" where MuJoCo needs a finite range.
NO_LIMIT = 1e10

_Joint = mujoco.mjtJoint
_Disable = mujoco.mjtDisableBit
_SOLID = {
    int(mujoco.mjtGeom.mjGEOM_BOX),
    int(mujoco.mjtGeom.mjGEOM_CAPSULE),
    int(mujoco.mjtGeom.mjGEOM_CYLINDER),
}
_INF = math.inf
# Activations that follow the command, and are it at rest.
FILTERS = int(mujoco.mjtDyn.mjDYN_FILTER), int(mujoco.mjtDyn.mjDYN_FILTEREXACT)

Index = tuple[int, ...]


@dataclass(frozen=True)
class Entry:
    """One number of the model: ``field[index] = sign * value``.

    ``field`` is a leaf of `mjx.Model` (dots allowed), or ``speed_limit``.
    """

    field: str
    index: Index
    sign: int = 1


class Inert(str):
    """Why a value changes nothing at a place; a pattern passes such places over."""

    __slots__ = ()


@dataclass(frozen=True)
class Quantity:
    """A row of the table.

    Attributes:
        entries: numbers that hold the value at object ``i`` of a model.
        unit: SI unit, from the model and object.
        low, high: what physics allows.
        refuse: why the value may not vary there, or None.
        open: sets types, flags and seeds in a model that is about to be put.
        read: the value in a model; None: the first entry of the model.
        derived: MuJoCo derives constants from it, to be computed again.
        moves_center: it moves a body's center of mass away from where it was.
        extra: further numbers that writing it sets, so that no other may set them.
    """

    entries: Callable[[Any, int], tuple[Entry, ...]]
    unit: Callable[[Any, int], str]
    low: Callable[[Any, int], float] | float = 0.0
    high: float = _INF
    refuse: Callable[[Any, int], str | None] = lambda m, i: None
    open: Callable[[Any, int], None] = lambda m, i: None
    read: Callable[[Any, int], float] | None = None
    derived: bool = False
    moves_center: bool = False
    extra: Callable[[Any, int], tuple[Entry, ...]] = lambda m, i: ()

    def lower(self, m: Any, i: int) -> float:
        """The smallest value that physics allows at object ``i``."""
        return self.low(m, i) if callable(self.low) else self.low


def value_of(m: Any, entry: Entry) -> float:
    """The value that an `MjModel` holds in an entry; infinite if it has no such."""
    if entry.field == "speed_limit":
        return _INF
    target = m
    for part in entry.field.split("."):
        target = getattr(target, part)
    return float(entry.sign * np.asarray(target)[entry.index])


def _disabled(m: Any, *flags: tuple[Any, str]) -> Inert | None:
    for flag, name in flags:
        if m.opt.disableflags & flag:
            return Inert(f'the model has <flag {name}="disable"/>')
    return None


# Joints ----------------------------------------------------------------------


def _dof_entries(field: str) -> Callable[[Any, int], tuple[Entry, ...]]:
    return lambda m, j: tuple(Entry(field, (d,)) for d in dofs(m, j))


def actuator_name(m: Any, a: int) -> str:
    """An actuator's name, or its number."""
    return m.actuator(a).name or f"actuator{a}"


def body_name(m: Any, b: int) -> str:
    """A body's name, or its number."""
    return m.body(b).name or f"body{b}"


def joint_unit(linear: str, angular: str) -> Callable[[Any, int], str]:
    """The unit of a quantity of slides and of other joints."""

    def unit(m: Any, j: int) -> str:
        return linear if m.jnt_type[j] == _Joint.mjJNT_SLIDE else angular

    return unit


def scalar_only(m: Any, j: int) -> str | None:
    """Why a joint that is no hinge or slide has no such value, or None."""
    return None if is_scalar(m, j) else "only hinge and slide joints have one"


def _passive(m: Any, j: int) -> str | None:
    # MJX leaves out all passive forces where either flag is set.
    return _disabled(
        m, (_Disable.mjDSBL_SPRING, "spring"), (_Disable.mjDSBL_DAMPER, "damper")
    )


def _dry(m: Any, j: int) -> str | None:
    return _disabled(
        m,
        (_Disable.mjDSBL_FRICTIONLOSS, "frictionloss"),
        (_Disable.mjDSBL_CONSTRAINT, "constraint"),
    )


def _seed_dofs(m: Any, j: int) -> None:
    for d in dofs(m, j):
        m.dof_frictionloss[d] = max(m.dof_frictionloss[d], SEED)


# Actuators -------------------------------------------------------------------


def fixed_gain(m: Any, a: int) -> bool:
    """Whether a command is multiplied by a constant."""
    return m.actuator_gaintype[a] == mujoco.mjtGain.mjGAIN_FIXED


def affine_bias(m: Any, a: int) -> bool:
    """Whether the force has a part linear in position and speed."""
    return m.actuator_biastype[a] == mujoco.mjtBias.mjBIAS_AFFINE


def is_position_servo(m: Any, a: int) -> bool:
    """Force is ``kp (ctrl - length) - kv velocity`` with kp not zero."""
    kp = m.actuator_gainprm[a, 0]
    servo = fixed_gain(m, a) and affine_bias(m, a)
    return bool(servo and kp != 0 and m.actuator_biasprm[a, 1] == -kp)


def is_velocity_servo(m: Any, a: int) -> bool:
    """Force is ``kv (ctrl - velocity)`` with kv not zero."""
    kv = m.actuator_gainprm[a, 0]
    bias = m.actuator_biasprm[a]
    servo = fixed_gain(m, a) and affine_bias(m, a) and kv != 0
    return bool(servo and bias[1] == 0 and bias[2] == -kv)


def actuation(m: Any, a: int) -> str | None:
    """Why nothing of an actuator may vary, or None."""
    return _disabled(m, (_Disable.mjDSBL_ACTUATION, "actuation"))


def _refuse_kp(m: Any, a: int) -> str | None:
    if not is_position_servo(m, a):
        return "it is no position servo, or its kp is 0 (vary its gain instead)"
    return actuation(m, a)


def _refuse_kv(m: Any, a: int) -> str | None:
    none = m.actuator_biastype[a] == mujoco.mjtBias.mjBIAS_NONE
    if not fixed_gain(m, a) or not (none or affine_bias(m, a)):
        return "its force is not a fixed gain with an affine bias"
    return actuation(m, a)


def _refuse_gain(m: Any, a: int) -> str | None:
    if not fixed_gain(m, a):
        return "its gain is not fixed"
    if is_position_servo(m, a):
        return "it is a position servo: vary its kp"
    if is_velocity_servo(m, a):
        return "it is a velocity servo: vary its kv"
    return actuation(m, a)


def _refuse_gear(m: Any, a: int) -> str | None:
    if np.any(m.actuator_gear[a, 1:]):
        return "its gear is a vector: vary its gain instead"
    return actuation(m, a)


def _refuse_time_constant(m: Any, a: int) -> str | None:
    if int(m.actuator_dyntype[a]) not in FILTERS:
        return (
            'it has no filter: write timeconst="..." (position) or '
            'dyntype="filterexact" dynprm="..." (general) in the model file'
        )
    return actuation(m, a)


def _kp_entries(m: Any, a: int) -> tuple[Entry, ...]:
    gain, bias = "actuator_gainprm", "actuator_biasprm"
    return Entry(gain, (a, 0)), Entry(bias, (a, 1), -1)


def _kv_entries(m: Any, a: int) -> tuple[Entry, ...]:
    bias = Entry("actuator_biasprm", (a, 2), -1)
    if is_velocity_servo(m, a):
        return bias, Entry("actuator_gainprm", (a, 0))
    return (bias,)


def _open_kv(m: Any, a: int) -> None:
    if not affine_bias(m, a):
        m.actuator_biastype[a] = mujoco.mjtBias.mjBIAS_AFFINE
        m.actuator_biasprm[a] = 0.0


def open_force_limit(m: Any, a: int) -> None:
    """Puts a force limit on that is very wide, where there is none."""
    if not m.actuator_forcelimited[a]:
        m.actuator_forcelimited[a] = 1
        m.actuator_forcerange[a] = -NO_LIMIT, NO_LIMIT


def _read_force_limit(m: Any, a: int) -> float:
    low, high = m.actuator_forcerange[a]
    if not m.actuator_forcelimited[a]:
        return _INF
    return float(high) if -low == high else math.nan


def linear_drive(m: Any, a: int) -> bool | None:
    """True for forces along a line, False for torques, None where it is mixed."""
    kind, target = int(m.actuator_trntype[a]), m.actuator_trnid[a, 0]
    if kind == int(mujoco.mjtTrn.mjTRN_TENDON):
        at = int(m.tendon_adr[target]) + np.arange(int(m.tendon_num[target]))
        if (m.wrap_type[at] != int(mujoco.mjtWrap.mjWRAP_JOINT)).any():
            return True
        slides = m.jnt_type[m.wrap_objid[at]] == _Joint.mjJNT_SLIDE
        return bool(slides[0]) if (slides == slides[0]).all() else None
    joint = driven_joint(m, a)
    if joint is not None and m.jnt_type[joint] != _Joint.mjJNT_FREE:
        return bool(m.jnt_type[joint] == _Joint.mjJNT_SLIDE)
    return None


def _drive_unit(linear: str, angular: str) -> Callable[[Any, int], str]:
    def unit(m: Any, a: int) -> str:
        return angular if linear_drive(m, a) is False else linear

    return unit


# Bodies ----------------------------------------------------------------------


def _refuse_mass(m: Any, b: int) -> str | None:
    if m.body_weldid[b] == 0:
        return Inert("it cannot move, so its mass changes nothing")
    if m.body_mass[b] <= 0:
        return Inert("it has no mass in the model, so its inertia cannot be scaled")
    return None


def _com_entries(axis: int) -> Callable[[Any, int], tuple[Entry, ...]]:
    return lambda m, b: (Entry("body_ipos", (b, axis)),)


# Geoms -----------------------------------------------------------------------


def unit_inertia(kind: int, size: Any, xp: Any) -> Any:
    """Inertia of a uniform solid of 1 kg about its axes, ``(3,)`` [m^2].

    Box, capsule or cylinder of MuJoCo ``size (3,)``; a capsule is a cylinder with a
    half ball at each end, weighted by volume. ``xp`` is numpy or jax.numpy.
    """
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        x, y, z = size[0] ** 2, size[1] ** 2, size[2] ** 2
        return xp.stack([y + z, x + z, x + y]) / 3
    r, half = size[0], size[1]
    height = 2 * half
    axial, radial = r**2 / 2, r**2 / 4 + height**2 / 12
    if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        # Half ball: center of mass 3r/8 from its flat side (Spong et al., tables).
        ball = 4 * r / (4 * r + 3 * height)  # share of the mass
        axial = (1 - ball) * axial + ball * 0.4 * r**2
        ends = 0.4 * r**2 + 0.375 * r * height + half**2
        radial = (1 - ball) * radial + ball * ends
    return xp.stack([radial, radial, axial])


def long_axis(m: Any, g: int) -> int:
    """The axis of a solid geom along which its length is measured: 0, 1 or 2."""
    if m.geom_type[g] == mujoco.mjtGeom.mjGEOM_BOX:
        return int(np.argmax(m.geom_size[g]))
    return 2


def length_of(kind: int, axis: int, size: Any) -> Any:
    """Full length [m] of a solid geom, end to end."""
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        return 2 * size[axis]
    if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        return 2 * (size[0] + size[1])
    return 2 * size[1]


def _matrix(quat: Any) -> np.ndarray:
    out = np.zeros(9)
    mujoco.mju_quat2Mat(out, np.asarray(quat, float))
    return out.reshape(3, 3)


def _refuse_length(m: Any, g: int) -> str | None:
    kind, b = int(m.geom_type[g]), int(m.geom_bodyid[g])
    if kind not in _SOLID:
        return "only a box, a capsule or a cylinder has a length"
    if m.body_weldid[b] == 0:
        return Inert("its body cannot move, so its length changes no motion")
    size = m.geom_size[g]
    if kind == mujoco.mjtGeom.mjGEOM_BOX and np.ptp(np.sort(size)[-2:]) == 0:
        return "its two longest sides are equal, so its length is ambiguous"
    inertia = m.body_mass[b] * unit_inertia(kind, size, np)
    same_axes = np.abs(_matrix(m.body_iquat[b]).T @ _matrix(m.geom_quat[g]))
    alone = (
        m.body_mass[b] > 0
        and np.allclose(m.body_ipos[b], m.geom_pos[g], atol=1e-9)
        and np.allclose(m.body_inertia[b], inertia, rtol=1e-5, atol=0)
        and np.allclose(same_axes, np.eye(3), atol=1e-6)
    )
    if not alone:
        name = m.body(b).name
        return f'the inertia of body "{name}" is not that of this geom alone'
    return None


def _length_entries(m: Any, g: int) -> tuple[Entry, ...]:
    kind = m.geom_type[g]
    axis = long_axis(m, g) if kind == mujoco.mjtGeom.mjGEOM_BOX else 1
    return (Entry("geom_size", (g, axis)),)


def _length_extra(m: Any, g: int) -> tuple[Entry, ...]:
    b = int(m.geom_bodyid[g])
    return tuple(Entry("body_ipos", (b, k)) for k in range(3))


def _read_length(m: Any, g: int) -> float:
    return float(length_of(int(m.geom_type[g]), long_axis(m, g), m.geom_size[g]))


def _lowest_length(m: Any, g: int) -> float:
    capsule = m.geom_type[g] == mujoco.mjtGeom.mjGEOM_CAPSULE
    return float(2 * m.geom_size[g, 0]) if capsule else 1e-6


def direct_solref(m: Any, solref: Any) -> tuple[float, float]:
    """``(stiffness [1/s^2], damping [1/s])`` that mean what ``solref (2,)`` means.

    MuJoCo documentation, "Solver parameters": timeconst and dampratio (t, z) give
    stiffness 1/(t z)^2 and damping 2/t, up to powers of dmax that both forms share.
    """
    time, ratio = float(solref[0]), float(solref[1])
    if time <= 0:
        return -time, -ratio
    if not m.opt.disableflags & _Disable.mjDSBL_REFSAFE:
        time = max(time, 2 * m.opt.timestep)
    # MuJoCo's least number: a ratio of zero means as stiff as can be said.
    return 1 / max((time * ratio) ** 2, float(mujoco.mjMINVAL)), 2 / time


def _open_contact(m: Any, g: int) -> None:
    stiffness, damping = direct_solref(m, m.geom_solref[g])
    m.geom_solref[g] = -stiffness, -damping


def _contact_enabled(m: Any, g: int) -> str | None:
    return _disabled(
        m,
        (_Disable.mjDSBL_CONTACT, "contact"),
        (_Disable.mjDSBL_CONSTRAINT, "constraint"),
    )


# Options ---------------------------------------------------------------------


def _refuse_gravity(m: Any, _: int) -> str | None:
    if not np.any(m.opt.gravity):
        return "the model has no gravity, so its direction is not known"
    return _disabled(m, (_Disable.mjDSBL_GRAVITY, "gravity"))


def _refuse_fluid(m: Any, i: int) -> str | None:
    if m.opt.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST:
        return 'MJX has no fluid forces with integrator="implicitfast" (use "Euler")'
    return _passive(m, i)


def _open_option(name: str) -> Callable[[Any, int], None]:
    def seed(m: Any, _: int) -> None:
        setattr(m.opt, name, max(getattr(m.opt, name), SEED))

    return seed


def _option(name: str) -> Callable[[Any, int], tuple[Entry, ...]]:
    return lambda m, i: (Entry(f"opt.{name}", ()),)


def _one(field: str, *rest: int) -> Callable[[Any, int], tuple[Entry, ...]]:
    return lambda m, i: (Entry(field, (i, *rest)),)


def _unit(text: str) -> Callable[[Any, int], str]:
    return lambda m, i: text


_com = {
    f"com_{name}": Quantity(
        entries=_com_entries(axis),
        unit=_unit("m"),
        low=-_INF,
        refuse=_refuse_mass,
        derived=True,
        moves_center=True,
    )
    for axis, name in enumerate("xyz")
}

TABLE: dict[str, dict[str, Quantity]] = {
    "joint": {
        "damping": Quantity(
            _dof_entries("dof_damping"),
            joint_unit("N s/m", "N m s/rad"),
            refuse=_passive,
        ),
        "frictionloss": Quantity(
            _dof_entries("dof_frictionloss"),
            joint_unit("N", "N m"),
            refuse=_dry,
            open=_seed_dofs,
        ),
        "armature": Quantity(
            _dof_entries("dof_armature"),
            joint_unit("kg", "kg m^2"),
            derived=True,
        ),
        "stiffness": Quantity(
            _one("jnt_stiffness"), joint_unit("N/m", "N m/rad"), refuse=_passive
        ),
        "springref": Quantity(
            lambda m, j: (Entry("qpos_spring", (int(m.jnt_qposadr[j]),)),),
            joint_unit("m", "rad"),
            low=-_INF,
            refuse=lambda m, j: scalar_only(m, j) or _passive(m, j),
        ),
        "speed_limit": Quantity(
            _dof_entries("speed_limit"),
            joint_unit("m/s", "rad/s"),
            refuse=scalar_only,
        ),
    },
    "actuator": {
        "kp": Quantity(_kp_entries, _drive_unit("N/m", "N m/rad"), refuse=_refuse_kp),
        "kv": Quantity(
            _kv_entries,
            _drive_unit("N s/m", "N m s/rad"),
            refuse=_refuse_kv,
            open=_open_kv,
        ),
        "gain": Quantity(
            _one("actuator_gainprm", 0),
            _drive_unit("N/ctrl", "N m/ctrl"),
            low=-_INF,
            refuse=_refuse_gain,
        ),
        "gear": Quantity(
            _one("actuator_gear", 0),
            _unit("1"),
            low=-_INF,
            refuse=_refuse_gear,
            derived=True,
        ),
        "force_limit": Quantity(
            lambda m, a: (
                Entry("actuator_forcerange", (a, 1)),
                Entry("actuator_forcerange", (a, 0), -1),
            ),
            _drive_unit("N", "N m"),
            refuse=actuation,
            open=open_force_limit,
            read=_read_force_limit,
        ),
        "time_constant": Quantity(
            _one("actuator_dynprm", 0),
            _unit("s"),
            low=1e-6,
            refuse=_refuse_time_constant,
        ),
    },
    "body": {
        "mass": Quantity(
            _one("body_mass"),
            _unit("kg"),
            low=1e-6,
            refuse=_refuse_mass,
            derived=True,
        ),
        **_com,
    },
    "geom": {
        "friction": Quantity(
            _one("geom_friction", 0), _unit("1"), refuse=_contact_enabled
        ),
        "contact_stiffness": Quantity(
            lambda m, g: (Entry("geom_solref", (g, 0), -1),),
            _unit("1/s^2"),
            low=1e-6,
            refuse=_contact_enabled,
            open=_open_contact,
            read=lambda m, g: direct_solref(m, m.geom_solref[g])[0],
        ),
        "contact_damping": Quantity(
            lambda m, g: (Entry("geom_solref", (g, 1), -1),),
            _unit("1/s"),
            refuse=_contact_enabled,
            open=_open_contact,
            read=lambda m, g: direct_solref(m, m.geom_solref[g])[1],
        ),
        "length": Quantity(
            _length_entries,
            _unit("m"),
            low=_lowest_length,
            refuse=_refuse_length,
            read=_read_length,
            derived=True,
            moves_center=True,
            extra=_length_extra,
        ),
    },
    "option": {
        "gravity": Quantity(
            lambda m, i: tuple(Entry("opt.gravity", (k,)) for k in range(3)),
            _unit("m/s^2"),
            refuse=_refuse_gravity,
            read=lambda m, i: float(np.linalg.norm(m.opt.gravity)),
        ),
        "viscosity": Quantity(
            _option("viscosity"),
            _unit("Pa s"),
            refuse=_refuse_fluid,
            open=_open_option("viscosity"),
        ),
        "density": Quantity(
            _option("density"),
            _unit("kg/m^3"),
            refuse=_refuse_fluid,
            open=_open_option("density"),
        ),
    },
}
