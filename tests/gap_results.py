"""A result of the gap workflow, made by hand."""

import dataclasses
from typing import Any

from easi_jax.model.results import (
    ErrorPlace,
    GapFigures,
    GapResult,
    NamedEffect,
    Refitted,
    Site,
)


def effect(
    name: str = "coulomb_friction",
    at: str = "hinge",
    kind: str = "joint",
    unit: str = "N m",
    gaps: tuple[float, float] = (0.2, 0.1),
    rival: str = "viscous_damping@hinge",
) -> NamedEffect:
    """One effect, held-out gap before and after it."""
    values = {
        "coulomb_friction": {"torque": (0.1, 0.01, unit)},
        "armature": {"armature": (0.002, 0.0001, unit)},
        "sensor_delay": {"delay": (0.01, 0.001, "s")},
        "sensor_bias": {"bias": (0.1, 0.01, "m")},
    }[name]
    column = {"sensor_delay": "late", "sensor_bias": "bias"}.get(name, "coulomb")
    return NamedEffect(
        name,
        kind,
        (Site(at, gaps[1]),),
        values,
        0.9,
        (rival,) if rival else (),
        gaps[0],
        {column: 0.01},
        {column: 0.001},
        cost=0.7,
    )


def result(text: str = "hinge", unit: str = "rad", **changed: Any) -> GapResult:
    """One effect at a joint, a run that disagrees, a channel left out."""
    figures = GapFigures(0.2, (0.1, 0.3), (1.0,), ((0.8, 1.3),))
    found = GapResult(
        model=text,
        verdict="unexplained",
        effects=(effect(at=text, unit=unit, rival=f"viscous_damping@{unit}"),),
        readings=(),
        refitted=(Refitted(f"joint.{text}.damping", 1.0, 2.0, 1.0),),
        before=figures,
        refit=figures,
        after=figures,
        floor=0.1,
        floor_si=(1.0,),
        channels=(text,),
        units=(unit,),
        ignored={unit: text},
        held_out=(text,),
        held_name=text,
        horizon=0.200009,
        disagreeing={text: 3.0},
        seconds=1.0,
        start=0.05,
        open=(text,),
        undecided=("cart", ""),
        notes=(text, unit),
        where=(ErrorPlace(text, 0.5, unit),),
        record_next=(text,),
    )
    return dataclasses.replace(found, **changed)
