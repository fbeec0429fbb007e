"""The effects that the workflow knows: names, and what one at a place consists of.

A `Place` is one effect at one joint, actuator, body or at the whole model. Its numbers
are columns of a long vector that holds every place (`easi_jax.gap.effect_vector`); at
their neutral values the model is as given. Names and units: the log format's table of
effects.
"""

from dataclasses import dataclass, field

import mujoco
import numpy as np

from easi_jax.errors import UserError
from easi_jax.model import addresses as language
from easi_jax.model.effect_catalog import _UNUSUAL, RARE, REFITTED, SHARED
from easi_jax.model.parameters import ParameterSpace


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
        at: the joint, actuator, body or pair of geoms; "" for the whole model, or for
            what all actuators have alike (`shared`).
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

    @property
    def shared(self) -> bool:
        """Whether it is one of single actuators that all have alike."""
        return not self.at and self.effect in SHARED

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


def covered(place: Place, space: ParameterSpace, m: mujoco.MjModel) -> bool:
    """Whether the refit of the model's own parameters does what an effect does."""
    own = [a for p in space.parameters for a in p.addresses]
    return any(does(place, a, m) for a in own)


def does(place: Place, address: str, m: mujoco.MjModel) -> bool:
    """Whether an address of the model's own parameters is what an effect changes."""
    kind, quantity = REFITTED.get(place.effect, ("", ""))
    found = language.places(m, address)
    return any(
        (kind, quantity) == (k, q)
        and (not place.at or object_id(m, kind, place.at) == i)
        for k, q, i in found
    )
