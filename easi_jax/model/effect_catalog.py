"""Effects in the address language: ``effect.FIELD.NAME``, such as
``effect.coulomb.hinge``, ``effect.com.torso.0`` or ``effect.tilt.0``.

One row for each field of `easi_jax.model.effects.Effects` (one for each entry of a
vector), of the same kind as those of `easi_jax.model.quantities`.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from easi_jax.model.backlash import geared
from easi_jax.model.quantities import (
    SEED,
    Entry,
    Inert,
    Quantity,
    actuation,
    direct_solref,
    is_scalar,
    joint_unit,
    linear_drive,
    open_force_limit,
    scalar_only,
)

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
    "viscous_damping": ("joint", "damping"),
    "coulomb_friction": ("joint", "frictionloss"),
    "joint_stiffness": ("joint", "stiffness"),
    "armature": ("joint", "armature"),
    "actuator_gain": ("actuator", "gain"),
    "actuator_saturation": ("actuator", "force_limit"),
    "actuator_lag": ("actuator", "time_constant"),
    "payload_mass": ("body", "mass"),
}

_INF = float("inf")


@dataclass(frozen=True)
class EffectQuantity(Quantity):
    """A row of the table.

    Attributes:
        on: what it sits at: joint, actuator, body, geom (a pair of them) or model.
        word: what people call it.
        neutral: its value without the effect.
    """

    on: str = "joint"
    word: str = ""
    neutral: float = 0.0


def _unit(text: str) -> Callable[[Any, int], str]:
    return lambda m, i: text


def _dof(field: str) -> Callable[[Any, int], tuple[Entry, ...]]:
    return lambda m, j: (Entry(f"effects.{field}", (int(m.jnt_dofadr[j]),)),)


def _at(field: str, *rest: int) -> Callable[[Any, int], tuple[Entry, ...]]:
    return lambda m, i: (Entry(f"effects.{field}", (i, *rest)),)


def _whole(field: str, *index: int) -> Callable[[Any, int], tuple[Entry, ...]]:
    return lambda m, i: (Entry(f"effects.{field}", index),)


def _seed_dry(m: Any, j: int) -> None:
    d = int(m.jnt_dofadr[j])
    m.dof_frictionloss[d] = max(m.dof_frictionloss[d], SEED)


def _moving(m: Any, b: int) -> str | None:
    return Inert("it cannot move") if m.body_weldid[b] == 0 else None


def _heavy(m: Any, b: int) -> str | None:
    if m.body_mass[b] <= 0:
        return Inert("it has no mass in the model")
    return _moving(m, b)


def _with_gravity(m: Any, _: int) -> str | None:
    return None if np.any(m.opt.gravity) else "the model has no gravity"


def _stepwise(m: Any, _: int) -> str | None:
    if m.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4:
        return "contacts of single pairs do not go with RK4"
    return None


def _direct_contacts(m: Any, _: int) -> None:
    if _stepwise(m, 0) is None:
        return  # done in the step
    for solref in (*m.geom_solref, *m.pair_solref):
        if solref[0] > 0:
            solref[:] = -np.asarray(direct_solref(m, solref))


def _joint(
    field: str,
    word: str,
    units: tuple[str, str],
    low: Callable[[Any, int], float] | float = 0.0,
    neutral: float = 0.0,
    open: Callable[[Any, int], None] = lambda m, j: None,
    refuse: Callable[[Any, int], str | None] = scalar_only,
) -> EffectQuantity:
    return EffectQuantity(
        _dof(field),
        joint_unit(*units),
        low,
        refuse=refuse,
        open=open,
        on="joint",
        word=word,
        neutral=neutral,
    )


def _geared(m: Any, j: int) -> str | None:
    if is_scalar(m, j) and int(m.jnt_dofadr[j]) in geared(m):
        return None
    return "only joints that an actuator turns directly have play"


def _actuator(
    field: str,
    word: str,
    unit: Callable[[Any, int], str],
    low: float = 0.0,
    high: float = _INF,
    neutral: float = 0.0,
    open: Callable[[Any, int], None] = lambda m, a: None,
) -> EffectQuantity:
    return EffectQuantity(
        _at(field),
        unit,
        low,
        high,
        refuse=actuation,
        open=open,
        on="actuator",
        word=word,
        neutral=neutral,
    )


def _force_unit(m: Any, a: int) -> str:
    return "N m" if linear_drive(m, a) is False else "N"


_TORQUE = ("N", "N m")
_LONG = 0.5  # s, the longest delay or time constant

EFFECT_TABLE: dict[str, EffectQuantity] = {
    # What the model has too much of is an effect of negative strength.
    "coulomb": _joint(
        "coulomb",
        "torque",
        _TORQUE,
        lambda m, j: -float(m.dof_frictionloss[m.jnt_dofadr[j]]),
        open=_seed_dry,
    ),
    "static": _joint("static", "static_beyond_kinetic", _TORQUE, open=_seed_dry),
    "stribeck": _joint("stribeck", "velocity", ("m/s", "rad/s"), 1e-6, 1.0),
    "damping": _joint(
        "damping",
        "damping",
        ("N s/m", "N m s/rad"),
        lambda m, j: -float(m.dof_damping[m.jnt_dofadr[j]]),
    ),
    "drag": _joint("drag", "coefficient", ("N s2/m2", "N m s2/rad2")),
    "stiffness": _joint("stiffness", "stiffness", ("N/m", "N m/rad")),
    "spring": _joint("spring", "torque_at_zero", _TORQUE, -_INF),
    "constant": _joint("constant", "torque", _TORQUE, -_INF),
    "ripple": _joint("ripple", "amplitude", _TORQUE),
    "cycles": _joint("cycles", "cycles_per_rev", ("1", "1"), 1e-6, 1.0),
    "phase": _joint("phase", "phase", ("rad", "rad"), -_INF),
    "armature": _joint(
        "armature",
        "armature",
        ("kg", "kg m2"),
        lambda m, j: -float(m.dof_armature[m.jnt_dofadr[j]]),
    ),
    "width": _joint("width", "width", ("m", "rad"), refuse=_geared),
    "rotor": _joint("rotor", "rotor_inertia", ("kg", "kg m2"), 1e-9, refuse=_geared),
    "gain": _actuator("gain", "gain", _unit("1"), 1e-3, neutral=1.0),
    "delay": _actuator("delay", "delay", _unit("s"), high=_LONG),
    "lag": _actuator("lag", "time_constant", _unit("s"), high=_LONG),
    "limit": _actuator(
        "limit", "limit", _force_unit, 1e-6, neutral=_INF, open=open_force_limit
    ),
    "deadband": _actuator("deadband", "width", _unit("ctrl")),
    "jump": _actuator("jump", "jump", _unit("1"), high=1.0),
    "mass": EffectQuantity(
        _at("mass"),
        _unit("kg"),
        lambda m, b: -0.99 * float(m.body_mass[b]),
        refuse=_moving,
        on="body",
        word="mass",
    ),
    "spread": EffectQuantity(
        _at("spread"), _unit("1"), high=1.0, refuse=_moving, on="body", word="spread"
    ),
    "resistance": EffectQuantity(
        _at("resistance"),
        _unit("N s2/m2"),
        0.0,
        refuse=_moving,
        on="body",
        word="coefficient",
    ),
    **{
        f"com.{i}": EffectQuantity(
            _at("com", i), _unit("m"), -_INF, refuse=_heavy, on="body", word=axis
        )
        for i, axis in enumerate("xyz")
    },
    **{
        f"force.{i}": EffectQuantity(
            _at("force", i), _unit("N"), -_INF, refuse=_moving, on="body", word=axis
        )
        for i, axis in enumerate("xyz")
    },
    **{
        f"tilt.{i}": EffectQuantity(
            _whole("tilt", i),
            _unit("rad"),
            -np.pi / 2,
            np.pi / 2,
            refuse=_with_gravity,
            on="model",
            word=word,
        )
        for i, word in enumerate(("roll", "pitch"))
    },
    "friction": EffectQuantity(
        _whole("friction"),
        _unit("1"),
        1e-3,
        on="model",
        word="friction_factor",
        neutral=1.0,
    ),
    **{
        f"softness.{i}": EffectQuantity(
            _whole("softness", i),
            _unit("1"),
            1e-6,
            open=_direct_contacts,
            on="model",
            word=f"{word}_factor",
            neutral=1.0,
        )
        for i, word in enumerate(("stiffness", "damping"))
    },
    "slip": EffectQuantity(
        *(_at("slip"), _unit("1"), 1e-3),
        refuse=_stepwise,
        on="geom",
        word="friction_factor",
        neutral=1.0,
    ),
    **{
        f"give.{i}": EffectQuantity(
            *(_at("give", i), _unit("1"), 1e-6),
            refuse=_stepwise,
            on="geom",
            word=f"{word}_factor",
            neutral=1.0,
        )
        for i, word in enumerate(("stiffness", "damping"))
    },
}
# Effects of an actuator that all may have alike, as one bus or one controller makes
# them.
SHARED = ("actuator_delay", "actuator_lag")
VECTORS = ("com", "force", "tilt", "softness", "give")
# In the readings, not in the physics.
READINGS = ("bias", "late")
