"""Where each effect of the catalog can sit in a model, with its numbers there."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import mujoco
import numpy as np

from easi_jax.gap.decisions import DECIDE
from easi_jax.gap.table import Column, Place, name_of
from easi_jax.model.contact_pairs import contact_pairs
from easi_jax.model.effect_catalog import CATALOG, Effect, Part, Scales, Spot
from easi_jax.model.effect_numbers import (
    NO_FORCE_LIMIT,
    OWN_LAWS,
    field_of,
    own_row,
)
from easi_jax.model.joint_space import scalar_dofs
from easi_jax.model.parameter_proposal import like_places

_PAIRS = 12  # at most, that are looked at one by one


class _Object(NamedTuple):
    """Something of the model that effects sit at.

    Attributes:
        name: "" for the whole model and for all actuators alike.
        index: where its numbers are in fields of `Effects`.
        spot: the same for the catalog.
        is_all: it stands for all of its kind.
        tied: names of the like places that it stands for, and ``among`` where their
            numbers are.
        range: where a spring at it may rest: at a joint, or at each of like joints.
    """

    name: str
    index: tuple[int, ...]
    spot: Spot
    is_all: bool = False
    tied: tuple[str, ...] = ()
    among: tuple[tuple[int, ...], ...] = ()
    range: tuple[float, float] = (-np.inf, np.inf)


def places(m: mujoco.MjModel, s: Scales) -> list[Place]:
    """Every effect at every place of a model where it can sit, but those whose starts
    come from a grid (`ripples`)."""
    rows = [row for row in CATALOG.values() if not row.is_sine]
    return [p for o in _objects(m, s) for row in rows for p in _at(row, o)]


def ripples(
    m: mujoco.MjModel, j: int, s: Scales, cycles: Sequence[float]
) -> list[Place]:
    """A torque ripple at a joint, for each of some numbers of cycles."""
    o = _joint(m, j, s)
    rows = [row for row in CATALOG.values() if row.is_sine]
    return [p for c in cycles for row in rows for p in _at(row, o, float(c))]


def _joint(m: mujoco.MjModel, j: int, s: Scales) -> _Object:
    dof = int(m.jnt_dofadr[j])
    spot = Spot(m, "joint", j, s)
    return _Object(name_of(m, "joint", j), (dof,), spot, range=spot.range)


def _objects(m: mujoco.MjModel, s: Scales) -> Iterator[_Object]:
    for j in scalar_dofs(m):
        yield _joint(m, j, s)
    for a in range(m.nu):
        yield _Object(name_of(m, "actuator", a), (a,), Spot(m, "actuator", a, s))
    if m.nu > 1:
        # A number of each drive would be one of dozens, and hardly help alone.
        yield _Object("", (), Spot(m, "actuator", 0, s), is_all=True)
    for kind in ("joint", "actuator", "body"):
        yield from _like(m, kind, s)
    for b in range(1, m.nbody):
        if m.body_mass[b] > 0:
            yield _Object(name_of(m, "body", b), (b,), Spot(m, "body", b, s))
    pairs = tuple(contact_pairs(m))
    yield _Object("", (), Spot(m, "model", 0, s, pairs))
    often = [int(k) for k in np.argsort(-s.touching) if s.touching[k] > DECIDE.touches]
    if len(often) > 1:
        for k in sorted(often[:_PAIRS]):
            yield _Object(pairs[k].name, (k,), Spot(m, "geom", k, s, (pairs[k],)))


def _like(m: mujoco.MjModel, kind: str, s: Scales) -> Iterator[_Object]:
    """Groups of like joints, actuators or bodies."""
    id_of = {"joint": m.joint, "actuator": m.actuator, "body": m.body}[kind]
    for pattern, names in like_places(m, kind).items():
        ids = [int(id_of(name).id) for name in names]
        at = m.jnt_dofadr[ids].tolist() if kind == "joint" else ids
        among = tuple((k,) for k in at)
        rests = [Spot(m, kind, i, s).range for i in ids] if kind == "joint" else []
        low, high = zip(*rests, (-np.inf, np.inf), strict=True)
        yield _Object(
            pattern,
            (),
            Spot(m, kind, ids[0], s),
            tied=names,
            among=among,
            range=(max(low), min(high)),
        )


def _at(row: Effect, o: _Object, cycles: float = np.nan) -> Iterator[Place]:
    """An effect at an object, if it can be there: a place for each of its shapes."""
    kind = o.spot.kind
    site = row.sites.get(kind)
    if site is None or not site.offered(o.spot) or (o.is_all and not row.is_shared):
        return
    parts = site.parts
    if o.tied and kind == "body":
        # A mass acts where theirs is; directions are mirror images, left and right.
        parts = tuple(p for p in parts if not p.number.is_shape)
        if len(parts) != 1:
            return
    columns = tuple(_column(part, o) for part in parts)
    if o.tied and not all(map(_adds, parts, columns)):
        return
    if row.is_shared and len(o.tied) == o.spot.m.nu:
        return  # offered as that of all actuators already
    starts = tuple(
        tuple(cycles if np.isnan(x) else float(x) for x in start)
        for start in site.starts_at(o.spot)
    )
    what = (row.name, o.name, "model" if o.is_all else kind, columns)
    if row.rests:
        yield Place(*what, starts, rests=o.range, tied=o.tied)
        return
    if not parts[-1].number.is_shape:
        yield Place(*what, starts, tied=o.tied)
        return
    fitted = (True,) * (len(columns) - 1) + (False,)
    for shape in (columns[-1].low, columns[-1].high):
        shaped = tuple((*start, shape) for start in starts)
        yield Place(*what, shaped, fitted, tied=o.tied)


def _adds(part: Part, c: Column) -> bool:
    """Whether a number can be given to several places on top of their own."""
    return not part.number.is_shape and abs(c.neutral) < NO_FORCE_LIMIT


def _column(part: Part, o: _Object) -> Column:
    spot = o.spot
    return Column(
        field_of(part.column),
        _index(part, o.index) if not o.tied else (),
        part.name,
        part.unit or part.number.unit(spot.m, spot.i),
        part.neutral(spot),
        *part.bounds(spot),
        part.size * spot.sizes[part.scale],
        spot.sizes[part.of],
        tuple(_index(part, index) for index in o.among),
        part.column,
    )


def _index(part: Part, at: tuple[int, ...]) -> tuple[int, ...]:
    """Where a number is in its field, for something that is there at ``at``."""
    first, _, entry = part.column.partition(".")
    if first in OWN_LAWS:
        return own_row(part.column), *(at or (0,))
    return (*at, int(entry)) if entry else at
