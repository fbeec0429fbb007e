"""What the gap workflow found, as values."""

import math
from dataclasses import dataclass, field

import numpy as np

from easi_jax.gap.measure import Channels
from easi_jax.gap.table import Place
from easi_jax.gap.where import Conditions
from easi_jax.gap.window_set import WindowSet


@dataclass(frozen=True)
class Part:
    """One actuator of an effect that all have.

    Attributes:
        place: the same effect there.
        gap_after: held-out gap with the effect at it and those before it.
    """

    place: Place
    gap_after: float


@dataclass(frozen=True)
class Found:
    """One effect that the model lacks.

    Attributes:
        place: which, and where.
        values: of its parameters, with their standard deviations.
        confidence: probability of this name against its rivals, an unknown effect
            among them.
        indistinguishable: rivals that predict the held-out data as well.
        gap_after: held-out gap with it and those before it.
        deviations: standard deviation of each of the place's columns that the fit
            moved, by its number among them.
        parts: of a shared effect (`Place.shared`), the actuators that it is seen at.
    """

    place: Place
    values: dict[str, tuple[float, float, str]]
    confidence: float
    indistinguishable: list[str]
    gap_after: float
    deviations: dict[int, float] = field(default_factory=dict)
    parts: tuple[Part, ...] = ()


@dataclass(frozen=True)
class Figures:
    """Held-out gap of one model.

    Attributes:
        gap: in units of the motion.
        interval: its 95 % interval, by bootstrap over windows.
        si: RMS error of each degree of freedom, ``(nv,)``.
        square: mean squares of each window, ``(W, nv)``.
        errors: of every step, ``(W, H, nv)``.
        conditions: what was going on in the rows that the errors belong to.
    """

    gap: float
    interval: tuple[float, float]
    si: np.ndarray
    square: np.ndarray
    errors: np.ndarray
    conditions: Conditions


@dataclass
class Outcome:
    """What the workflow found; see the log format's ``gap.json``.

    Attributes:
        x: the whole vector at the end, and ``active`` its entries that the last fit
            moved.
        disagreeing: runs that the model predicts far worse than the others, with how
            many times.
        horizon: of the predictions [s].
        record_next: what to record to tell names apart, a sentence for each pair.
    """

    verdict: str
    found: list[Found]
    refitted: list[dict]
    before: Figures
    refit: Figures
    after: Figures
    floor: float
    floor_si: np.ndarray
    channels: Channels
    held: WindowSet
    x: np.ndarray
    active: list[int]
    notes: list[str] = field(default_factory=list)
    disagreeing: dict[str, float] = field(default_factory=dict)
    record_next: list[str] = field(default_factory=list)
    seconds: float = 0.0
    horizon: float = 0.0


def for_people(
    place: Place, got: dict[str, tuple[float, float, str]]
) -> dict[str, tuple[float, float, str]]:
    """Parameters as the table states them, from those that are fitted."""
    out = dict(got)
    if place.effect == "joint_stiffness":
        (k, dk, unit), (s, ds, _) = got["stiffness"], got["rest"]
        rest = s / k if k > 0 else 0.0
        relative = math.hypot(ds / s if s else 0.0, dk / k if k > 0 else 0.0)
        length = "rad" if "rad" in unit else "m"
        out["rest"] = (rest, abs(rest) * relative, length)
    if place.effect == "stribeck_friction":
        (kinetic, dk, unit), (extra, de, _) = got["kinetic"], got["static"]
        out["static"] = (kinetic + extra, math.hypot(dk, de), unit)
    if place.effect == "torque_ripple":
        phase, dp, unit = got["phase"]
        out["phase"] = (math.remainder(phase, 2 * math.pi), dp, unit)
    return out
