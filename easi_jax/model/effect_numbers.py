"""The numbers that effects consist of, and their addresses: ``effect.FIELD.NAME``, such
as ``effect.coulomb.hinge``, ``effect.com.torso.0`` or ``effect.tilt.0``.

One row for each field of `easi_jax.model.effects.Effects` (one for each entry of a
vector), of the same kind as those of `easi_jax.model.quantities`. Which effects they
make up: `easi_jax.model.effect_catalog`.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import mujoco
import numpy as np

from easi_jax.model.backlash import geared
from easi_jax.model.joint_space import is_scalar
from easi_jax.model.law_terms import Memory
from easi_jax.model.own_laws import Function
from easi_jax.model.quantities import (
    SEED,
    Entry,
    Inert,
    Quantity,
    actuation,
    affine_bias,
    direct_solref,
    fixed_gain,
    joint_unit,
    linear_drive,
    open_force_limit,
    scalar_only,
)

_INF = float("inf")
# Stands for "no limit" in a simulation (N or N m).
NO_FORCE_LIMIT = 1e9

Acts = Literal["model", "step", "drive", "command", "contacts", "readings"]


@dataclass(frozen=True)
class EffectNumber(Quantity):
    """A row of the table.

    Attributes:
        on: what it sits at: joint, actuator, body, geom (a pair of them) or model.
        word: what people call it.
        neutral: its value without the effect.
        acts: where: in the ``model``, written once; in each ``step``; in a ``drive``
            with play; on the way of a ``command``; in ``contacts`` as they are made; in
            ``readings``, not in the physics.
        is_shift: whether it is a shift in time [s].
        is_shape: whether it says which kind an effect is of, not how much.
    """

    on: str = "joint"
    word: str = ""
    neutral: float = 0.0
    acts: Acts = "step"
    is_shift: bool = False
    is_shape: bool = False


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
    # What it is welded to has no joint: the world, or a mocap body.
    fixed = m.body_dofnum[m.body_weldid[b]] == 0
    return Inert("it cannot move") if fixed else None


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
    direct_contacts(m)


def direct_contacts(m: mujoco.MjModel) -> None:
    """Writes stiffness and damping of contacts in their direct form, which has no least
    time constant; unless geoms differ: MuJoCo takes the smaller of two geoms' direct
    numbers, but means of their time constants and damping ratios."""
    touch = (m.geom_contype | m.geom_conaffinity) > 0
    alike = len(np.unique(m.geom_solref[touch], axis=0)) <= 1
    for solref in (*(m.geom_solref if alike else ()), *m.pair_solref):
        if solref[0] > 0:
            solref[:] = -np.asarray(direct_solref(m, solref))


def _joint(
    field: str,
    word: str,
    units: tuple[str, str],
    low: Callable[[Any, int], float] | float = 0.0,
    refuse: Callable[[Any, int], str | None] = scalar_only,
    **more: Any,
) -> EffectNumber:
    unit = joint_unit(*units)
    return EffectNumber(_dof(field), unit, low, refuse=refuse, word=word, **more)


def _geared(m: Any, j: int) -> str | None:
    if is_scalar(m, j) and int(m.jnt_dofadr[j]) in geared(m):
        return None
    return "only joints that an actuator turns directly have play"


def _feedback(term: int, name: str) -> Callable[[Any, int], str | None]:
    """Refuses what has no feedback of the position (1) or of the speed (2)."""

    def refuse(m: Any, a: int) -> str | None:
        if not fixed_gain(m, a) or not affine_bias(m, a):
            return "it is no drive: its force is not a fixed gain with an affine bias"
        if m.actuator_gainprm[a, 0] == 0:
            return "it is no drive: no command moves it"
        if m.actuator_biasprm[a, term] >= 0:
            return Inert(f"its {name} is 0, and so is a multiple of it")
        return actuation(m, a)

    return refuse


def _linear(m: Any, a: int) -> str | None:
    affine_gain = m.actuator_gaintype[a] == mujoco.mjtGain.mjGAIN_AFFINE
    no_bias = m.actuator_biastype[a] == mujoco.mjtBias.mjBIAS_NONE
    if (fixed_gain(m, a) or affine_gain) and (no_bias or affine_bias(m, a)):
        return actuation(m, a)
    return "its gain and bias are not constant or affine"


def _actuator(
    field: str,
    word: str,
    unit: Callable[[Any, int], str],
    low: float = 0.0,
    refuse: Callable[[Any, int], str | None] = actuation,
    **more: Any,
) -> EffectNumber:
    return EffectNumber(
        _at(field), unit, low, refuse=refuse, on="actuator", word=word, **more
    )


def _factor(
    field: str, refuse: Callable[[Any, int], str | None], low: float = 1e-3
) -> EffectNumber:
    """A factor on numbers of an actuator."""
    return _actuator(
        *(field, "factor", _unit("1"), low), refuse, neutral=1.0, acts="model"
    )


def _body(
    field: str,
    word: str,
    unit: str,
    *part: int,
    low: Callable[[Any, int], float] | float = -_INF,
    refuse: Callable[[Any, int], str | None] = _moving,
    **more: Any,
) -> EffectNumber:
    entries = _at(field, *part)
    return EffectNumber(
        entries, _unit(unit), low, refuse=refuse, on="body", word=word, **more
    )


def _contact(
    field: str, word: str, *part: int, low: float = 1e-6, **more: Any
) -> EffectNumber:
    """A factor on a number of all contacts."""
    more = {"on": "model", "acts": "contacts", **more}
    entries = _whole(field, *part)
    return EffectNumber(
        entries, _unit("1"), low, word=f"{word}_factor", neutral=1.0, **more
    )


def _pair(field: str, word: str, *part: int, low: float = 1e-6) -> EffectNumber:
    """A factor on a number of the contacts of a pair of geoms."""
    return EffectNumber(
        *(_at(field, *part), _unit("1"), low),
        refuse=_stepwise,
        on="geom",
        word=f"{word}_factor",
        neutral=1.0,
        acts="contacts",
    )


def _force_unit(m: Any, a: int) -> str:
    return "N m" if linear_drive(m, a) is False else "N"


# Units at a slide and at a hinge.
_TORQUE = ("N", "N m")
_POSITION = ("m", "rad")
_INERTIA = ("kg", "kg m^2")
_SOFTNESS = ("stiffness", "damping")
_LONG = 0.5  # s, the longest delay or time constant

EFFECT_TABLE: dict[str, EffectNumber] = {
    # What the model has too much of is an effect of negative strength.
    "coulomb": _joint(
        "coulomb",
        "torque",
        _TORQUE,
        lambda m, j: -float(m.dof_frictionloss[m.jnt_dofadr[j]]),
        open=_seed_dry,
    ),
    "static": _joint("static", "static_beyond_kinetic", _TORQUE, open=_seed_dry),
    "stribeck": _joint("stribeck", "velocity", ("m/s", "rad/s"), 1e-6, neutral=1.0),
    "damping": _joint(
        "damping",
        "damping",
        ("N s/m", "N m s/rad"),
        lambda m, j: -float(m.dof_damping[m.jnt_dofadr[j]]),
    ),
    "drag": _joint("drag", "coefficient", ("N s^2/m^2", "N m s^2/rad^2")),
    "stiffness": _joint("stiffness", "stiffness", ("N/m", "N m/rad")),
    "spring": _joint("spring", "torque_at_zero", _TORQUE, -_INF),
    "constant": _joint("constant", "torque", _TORQUE, -_INF),
    "ripple": _joint("ripple", "amplitude", _TORQUE),
    "cycles": _joint("cycles", "cycles_per_rev", ("1", "1"), 1e-6, neutral=1.0),
    "phase": _joint("phase", "phase", ("rad", "rad"), -_INF),
    "armature": _joint(
        "armature",
        "armature",
        _INERTIA,
        lambda m, j: -float(m.dof_armature[m.jnt_dofadr[j]]),
        acts="model",
    ),
    "width": _joint("width", "width", _POSITION, refuse=_geared, acts="drive"),
    "rotor": _joint(
        "rotor", "rotor_inertia", _INERTIA, 1e-9, refuse=_geared, acts="drive"
    ),
    "gain": _actuator("gain", "gain", _unit("1"), 1e-3, neutral=1.0, acts="model"),
    "kp": _factor("kp", _feedback(1, "kp")),
    "kv": _factor("kv", _feedback(2, "kv"), 0.0),
    "strength": _factor("strength", _linear),
    "delay": _actuator(
        "delay", "delay", _unit("s"), high=_LONG, acts="command", is_shift=True
    ),
    "lag": _actuator(
        "lag", "time_constant", _unit("s"), high=_LONG, acts="command", is_shift=True
    ),
    "limit": _actuator(
        *("limit", "limit", _force_unit, 1e-6),
        neutral=_INF,
        open=open_force_limit,
        acts="model",
    ),
    "deadband": _actuator("deadband", "width", _unit("ctrl"), acts="command"),
    "jump": _actuator(
        "jump", "jump", _unit("1"), high=1.0, acts="command", is_shape=True
    ),
    "mass": _body(
        *("mass", "mass", "kg"),
        low=lambda m, b: -0.99 * float(m.body_mass[b]),
        acts="model",
    ),
    "spread": _body(
        "spread", "spread", "1", low=0.0, high=1.0, acts="model", is_shape=True
    ),
    "resistance": _body("resistance", "coefficient", "N s^2/m^2", low=0.0),
    **{
        f"com.{i}": _body(
            "com", axis, "m", i, refuse=_heavy, acts="model", moves_center=True
        )
        for i, axis in enumerate("xyz")
    },
    **{f"force.{i}": _body("force", axis, "N", i) for i, axis in enumerate("xyz")},
    **{
        f"tilt.{i}": EffectNumber(
            *(_whole("tilt", i), _unit("rad"), -np.pi / 2, np.pi / 2),
            refuse=_with_gravity,
            on="model",
            word=word,
            acts="model",
        )
        for i, word in enumerate(("roll", "pitch"))
    },
    "friction": _contact("friction", "friction", low=1e-3, acts="model"),
    **{
        f"softness.{i}": _contact("softness", word, i, open=_direct_contacts)
        for i, word in enumerate(_SOFTNESS)
    },
    "slip": _pair("slip", "friction", low=1e-3),
    **{f"give.{i}": _pair("give", word, i) for i, word in enumerate(_SOFTNESS)},
}
# In the readings, which no parameter of a machine reaches.
READING_TABLE: dict[str, EffectNumber] = {
    "bias": _joint("bias", "bias", _POSITION, -_INF, acts="readings"),
    "late": _joint("late", "delay", ("s", "s"), acts="readings", is_shift=True),
}
NUMBERS = {**EFFECT_TABLE, **READING_TABLE}

OWN = "own"  # the field that holds the numbers of all effects that owners wrote


class OwnLaw(NamedTuple):
    """What an owner's effect does (`easi_jax.model.own_effects`).

    Attributes:
        name: of the effect.
        numbers: their names; columns are called ``EFFECT.NUMBER``.
        on: what it sits at: joint, actuator or model.
        fits: whether it may sit at a joint or actuator of this name.
        force, command, reading: its functions.
        memories: what it remembers.
        names: of joints and actuators that it is about: a model without them has no
            such effect. Empty where that is not known.
    """

    name: str
    numbers: tuple[str, ...]
    on: str
    fits: Callable[[str], bool]
    force: Function | None
    command: Function | None
    reading: Function | None
    memories: tuple[Memory, ...] = ()
    names: frozenset[str] = frozenset()


# Those that are registered, in the order of the rows of their numbers.
OWN_LAWS: dict[str, OwnLaw] = {}


def own_row(column: str) -> int:
    """The row of a number of an owner's effect."""
    name, _, number = column.partition(".")
    before = list(OWN_LAWS).index(name)
    rows = [len(law.numbers) for law in OWN_LAWS.values()]
    return sum(rows[:before]) + OWN_LAWS[name].numbers.index(number)


def field_of(column: str) -> str:
    """The field of `easi_jax.model.effects.Effects` that a number is in."""
    first = column.partition(".")[0]
    return OWN if first in OWN_LAWS else first


_VECTORS = tuple(dict.fromkeys(field_of(c) for c in NUMBERS if "." in c))


def is_vector(first: str) -> bool:
    """Whether columns of this first part have a second one: ``com.0``."""
    return first in _VECTORS or first in OWN_LAWS


def fields_that_act(where: Acts) -> tuple[str, ...]:
    """Fields whose numbers act there; what owners write acts in steps."""
    named = dict.fromkeys(field_of(c) for c, n in NUMBERS.items() if n.acts == where)
    return (*named, OWN) if where == "step" else tuple(named)


_READINGS = fields_that_act("readings")


def _is_read(column: str) -> bool:
    """Whether a number is in the readings, not in the physics."""
    if column in NUMBERS:
        return NUMBERS[column].acts == "readings"
    return field_of(column) in _READINGS  # of a sensor of several numbers


def is_column(name: str) -> bool:
    """Whether an effects file may have a number of this name. A sensor of several
    numbers has one for each: ``bias.2``."""
    field, _, entry = name.partition(".")
    of_sensor = field in _READINGS and entry.isascii() and entry.isdecimal()
    return name in NUMBERS or of_sensor


@dataclass(frozen=True)
class EffectEntry:
    """One effect.

    Attributes:
        effect: name.
        at: joint, actuator or body; "" for the whole model.
        kind: what ``at`` is.
        columns: values of fields of `easi_jax.model.effects.Effects`, by name; vectors
            have a name for each entry, such as ``com.0``.
        std: their standard deviations, where known.
    """

    effect: str
    at: str
    kind: str
    columns: Mapping[str, float]
    std: Mapping[str, float]

    @property
    def of_readings(self) -> bool:
        """Whether it is in the readings of a sensor, not in the physics."""
        return all(_is_read(column) for column in self.columns)

    def address(self, column: str) -> str:
        """The address of one of its numbers."""
        field, *part = column.split(".")
        return ".".join(["effect", field, *([self.at] if self.at else []), *part])
