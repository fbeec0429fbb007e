"""A candidate effect, and a set of effects with its fit."""

from dataclasses import dataclass, field, replace

import numpy as np

from easi_jax.gap.batched_least_squares import Fitted
from easi_jax.gap.table import Place


@dataclass(frozen=True)
class Candidate:
    """A place with the values that its fit starts from.

    Attributes:
        ends: the whole vector one Gauss-Newton step later; empty where not known.
    """

    place: Place
    start: tuple[float, ...]
    ends: tuple[float, ...] = ()


@dataclass
class Model:
    """A set of effects with its fit.

    Attributes:
        places: effects, in the order of selection.
        fit: parameters and derivatives.
        loss: cross-validated squared error of each block, per window, ``(blocks,)``.
        gap: the same in units of the gap; squared, ``(blocks,)``.
        own: indices of the model's own fitted parameters.
        unlikely: for how many reasons few machines have these effects.
        windows: loss and gap of each window, weighted, ``(2, W)``.
        felt: fitted numbers of each effect that the predictions depend on, by key; all
            of them where not given. A planar arm does not feel one of two tilts.
    """

    places: list[Place]
    fit: Fitted
    loss: np.ndarray
    gap: np.ndarray
    own: tuple[int, ...] = field(default=())
    unlikely: int = 0
    windows: np.ndarray = field(default_factory=lambda: np.zeros((2, 0)))
    felt: dict[str, int] = field(default_factory=dict)


def keys(model: Model) -> frozenset[str]:
    """Of its effects, in whatever order."""
    return frozenset(p.key for p in model.places)


def last(model: Model, place: Place) -> Model:
    """The model with one of its effects as the last."""
    return replace(model, places=[*[p for p in model.places if p is not place], place])
