"""Effects of the catalog at places of one model.

A `Place` is one effect at one joint, actuator, body or at the whole model. Its numbers
are columns of a long vector that holds every place (`easi_jax.gap.effect_vector`); at
their neutral values the model is as given.
"""

from dataclasses import dataclass, field

import mujoco
import numpy as np

from easi_jax.model import addresses as language
from easi_jax.model.effect_catalog import CATALOG, Effect
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
        among: places in the field that all have it on top of their own; the empty
            ``index`` of a column without them means all places.
        name: in an effects file: ``com.0`` for one entry of a vector.
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
    among: tuple[tuple[int, ...], ...] = ()
    name: str = ""


@dataclass(frozen=True)
class Place:
    """One effect at one place.

    Attributes:
        effect: its name.
        at: the joint, actuator, body or pair of geoms; "" for the whole model, or for
            what all actuators have alike (`shared`); a pattern of like places.
        kind: what ``at`` is.
        columns: its numbers.
        starts: values of the columns that a fit starts from, in turn.
        fitted: which columns a fit moves.
        rests: within what the second number over the first has to be.
        tied: names of like places that have it alike; empty where it is at one place.
    """

    effect: str
    at: str
    kind: str
    columns: tuple[Column, ...]
    starts: tuple[tuple[float, ...], ...]
    fitted: tuple[bool, ...] = field(default=())
    rests: tuple[float, float] = (-np.inf, np.inf)
    tied: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not self.fitted:
            object.__setattr__(self, "fitted", (True,) * len(self.columns))

    @property
    def row(self) -> Effect:
        """What is known of its effect."""
        return CATALOG[self.effect]

    @property
    def rarity(self) -> int:
        """Of its effect at such a place: above zero where few machines have it."""
        site = self.row.sites.get(self.kind)
        return self.row.rarity + (site.rarity if site else 0)

    @property
    def key(self) -> str:
        """``effect@at``."""
        return f"{self.effect}@{self.at}"

    @property
    def shared(self) -> bool:
        """Whether it is one of single actuators that all have alike."""
        return not self.at and self.row.is_shared

    def possible(self, values: np.ndarray) -> bool:
        """Whether a machine can have it with these values of its columns. A spring that
        does not stiffen is a constant force, which has a name of its own."""
        low, high = self.rests
        if not self.row.rests or not np.any(values):
            return True
        return bool(values[0] > 0 and low <= values[1] / values[0] <= high)

    def unlikely(self, values: np.ndarray) -> int:
        """For how many reasons few machines have it with these values of its columns: a
        rare effect, an unusual size; one less where nearly all machines have it."""
        low, high = self.row.usual
        usual = np.all((values >= low) & (values <= high))
        return self.rarity + (not usual)


def name_of(m: mujoco.MjModel, kind: str, i: int) -> str:
    """Name of a joint, actuator or body."""
    obj = {"joint": m.joint, "actuator": m.actuator, "body": m.body}[kind]
    return str(obj(i).name)


def covered(place: Place, space: ParameterSpace, m: mujoco.MjModel) -> bool:
    """Whether the refit of the model's own parameters does what an effect does."""
    own = [a for p in space.parameters for a in p.addresses]
    return any(does(place, a, m) for a in own)


def does(place: Place, address: str, m: mujoco.MjModel) -> bool:
    """Whether an address of the model's own parameters is what an effect changes."""
    return any(
        place.row.refits == (kind, quantity)
        and (not place.at or name_of(m, kind, i) in (place.at, *place.tied))
        for kind, quantity, i in language.places(m, address)
    )
