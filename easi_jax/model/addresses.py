"""The address language: text that names a quantity at one or more places of a model.

    joint.NAME.damping     actuator.leg_*.kp     body.torso.mass     option.gravity
    effect.coulomb.NAME    effect.com.torso.0    effect.tilt.0    effect.slip.FLOOR/FOOT

``*`` matches any run of characters, so that one parameter can be tied to many places.
Names may contain dots. What ``effect.`` names lies beyond the model
(`easi_jax.model.effects`): its FIELD, its place, and the entry of a vector. `resolve`
checks addresses against a model and returns what `easi_jax.model.mjx_model` writes;
`open_gates` prepares an `MjModel` so that MJX obeys.
"""

import copy
import math
import re
from collections import ChainMap
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import mujoco
from mujoco.mjx._src.collision_driver import geom_pairs

from easi_jax.errors import UserError, nearest
from easi_jax.model.contact_pairs import pair_names
from easi_jax.model.effect_numbers import (
    EFFECT_TABLE,
    READING_TABLE,
    EffectNumber,
    is_vector,
)
from easi_jax.model.quantities import TABLE as MODEL_TABLE
from easi_jax.model.quantities import Entry, Inert, Quantity, direct_solref, value_of

# A constant offset of a joint's readings is the one number of what is read that a fit
# to logs may vary (`easi_jax.simulation.open_loop`); `declare` refuses it to others.
TABLE: Mapping[str, Mapping[str, Quantity]] = {
    **MODEL_TABLE,
    "effect": ChainMap(EFFECT_TABLE, {"bias": READING_TABLE["bias"]}),
}

# Of what sensors read, not of a model: a search has such numbers beside a model's.
READING = "reading"

_OBJECTS = {
    "joint": (mujoco.mjtObj.mjOBJ_JOINT, "njnt"),
    "actuator": (mujoco.mjtObj.mjOBJ_ACTUATOR, "nu"),
    "body": (mujoco.mjtObj.mjOBJ_BODY, "nbody"),
    "geom": (mujoco.mjtObj.mjOBJ_GEOM, "ngeom"),
}


@dataclass(frozen=True)
class Writer:
    """One place of the model that follows one parameter; static and hashable.

    Attributes:
        parameter: index into theta.
        kind, quantity: the row of `TABLE`.
        id: joint, actuator, body or geom; 0 for options and whole models.
        entries: the numbers to set.
    """

    parameter: int
    kind: str
    quantity: str
    id: int
    entries: tuple[Entry, ...]

    @property
    def row(self) -> Quantity:
        """Its row of the table."""
        return TABLE[self.kind][self.quantity]

    def body(self, m: mujoco.MjModel) -> int:
        """The body whose center of mass it moves, where ``row.moves_center``."""
        return int(m.geom_bodyid[self.id]) if self.kind == "geom" else self.id


def names(m: mujoco.MjModel, kind: str) -> dict[str, int]:
    """Named objects of a kind: name -> id. The world body is not among them."""
    obj, count = _OBJECTS[kind]
    found = {}
    for i in range(kind == "body", getattr(m, count)):
        name = mujoco.mj_id2name(m, obj, i)
        if name:
            found[name] = i
    return found


def matching(pattern: str, known: Iterable[str]) -> list[str]:
    """Those of some names that a pattern with ``*`` fits."""
    regex = re.compile(".*".join(re.escape(part) for part in pattern.split("*")))
    return [name for name in known if regex.fullmatch(name)]


def split(address: str) -> tuple[str, str, str]:
    """Returns (kind, name, quantity); the name of an option is empty, the quantity of
    an effect is its field, with the entry of a vector (``com.0``).

    Raises:
        UserError: not of the form ``kind.NAME.quantity``, unknown kind or quantity.
    """
    kind, _, rest = address.partition(".")
    if kind == READING:
        name, _, quantity = rest.rpartition(".")
        return kind, name, quantity
    if kind not in TABLE:
        raise UserError(
            f'address "{address}": unknown kind "{kind}" (known: '
            f"{', '.join(TABLE)}){nearest(kind, TABLE)}"
        )
    if kind == "option":
        name, quantity = "", rest
    elif kind == "effect":
        quantity, _, name = rest.partition(".")
        if is_vector(quantity):
            name, _, part = name.rpartition(".")
            quantity = f"{quantity}.{part}"
    else:
        name, dot, quantity = rest.rpartition(".")
        if not dot or not name:
            raise UserError(
                f'address "{address}": write {kind}.NAME.QUANTITY, '
                f"such as {kind}.NAME.{next(iter(TABLE[kind]))}"
            )
    if quantity not in TABLE[kind]:
        known = EFFECT_TABLE if kind == "effect" else TABLE[kind]
        raise UserError(
            f'address "{address}": {kind} has no quantity "{quantity}" (known: '
            f"{', '.join(known)}){nearest(quantity, known)}"
        )
    return kind, name, quantity


def places(m: mujoco.MjModel, address: str) -> tuple[tuple[str, str, int], ...]:
    """Every (kind, quantity, id) that an address names in a model.

    A pattern passes over places where the value would change nothing (a body
    without mass, a geom without contact).

    Raises:
        UserError: unknown name, kind or quantity; or the quantity cannot vary there,
            with the reason.
    """
    kind, name, quantity = split(address)
    if kind == READING:
        raise UserError(
            f'address "{address}": it is in what sensors read, not in the model '
            f"(known: {', '.join(TABLE)})"
        )
    row = TABLE[kind][quantity]
    at = row.on if isinstance(row, EffectNumber) else kind
    if at in ("option", "model"):
        if name:
            raise UserError(f'address "{address}": it is of the whole model, no name')
        _may_vary(address, "the model", row.refuse(m, 0))
        return ((kind, quantity, 0),)
    if (kind, at) == ("effect", "geom"):  # one on geoms is on a pair of them
        known, at = pair_names(m), "pair of geoms"
    else:
        known = names(m, at)
    if name in known:
        ids, pattern = [known[name]], False
    else:
        pattern = "*" in name
        ids = [known[n] for n in matching(name, known)] if pattern else []
    if not ids:
        what = "matches no" if pattern else "names no"
        raise UserError(
            f'address "{address}" {what} {at} of the model (known: '
            f"{', '.join(known) or 'none has a name'}){nearest(name, known)}"
        )
    found = []
    reason = None
    where = {i: n for n, i in known.items()}
    for i in ids:
        reason = row.refuse(m, i) or _contact_reason(m, kind, quantity, i)
        if reason is None:
            found.append((kind, quantity, i))
        elif not (pattern and isinstance(reason, Inert)):
            _may_vary(address, f'{at} "{where[i]}"', reason)
    if not found:
        raise UserError(f'address "{address}" has no effect at any place: {reason}')
    return tuple(found)


def _may_vary(address: str, where: str, reason: str | None) -> None:
    if reason is not None:
        raise UserError(f'address "{address}": cannot vary at {where}: {reason}')


def _name(m: mujoco.MjModel, kind: str, i: int) -> str:
    return mujoco.mj_id2name(m, _OBJECTS[kind][0], i) or f"number {i}"


def _partners(m: mujoco.MjModel, g: int, friction: bool) -> list[int] | None:
    """Geoms whose contact with ``g`` reads g's parameters; None: it meets nothing."""
    met, heard = False, []
    for pair in geom_pairs(m):
        g1, g2, explicit = (int(x) for x in pair)
        if g not in (g1, g2):
            continue
        met = True
        other = g2 if g == g1 else g1
        mine, theirs = int(m.geom_priority[g]), int(m.geom_priority[other])
        dim = m.geom_condim[[g, other]]
        condim = max(dim) if mine == theirs else dim[0 if mine > theirs else 1]
        if explicit < 0 and mine >= theirs and not (friction and condim == 1):
            heard.append(other)
    return heard if met else None


_CONTACT = ("friction", "contact_stiffness", "contact_damping")


def _contact_reason(m: mujoco.MjModel, kind: str, quantity: str, g: int) -> str | None:
    if kind != "geom" or quantity not in _CONTACT:
        return None
    heard = _partners(m, g, quantity == "friction")
    if heard is None:
        return Inert("it touches nothing (contype and conaffinity)")
    if not heard:
        return Inert(
            "all its contacts take their parameters elsewhere (a <pair>, the other "
            "geom's priority, or condim 1)"
        )
    return None


def _contact_value(m: mujoco.MjModel, quantity: str, g: int) -> float:
    if quantity == "friction":
        return float(m.geom_friction[g, 0])
    if m.geom_solref[g, 0] > 0:  # gives way to a direct one
        return -math.inf
    return direct_solref(m, m.geom_solref[g])[quantity == "contact_damping"]


def _check_dominated(m: mujoco.MjModel, writers: Sequence[Writer]) -> None:
    """MuJoCo takes the larger value of two geoms: one alone may do nothing."""
    for w in writers:
        if w.kind != "geom" or w.quantity not in _CONTACT:
            continue
        varied = {v.id for v in writers if v.quantity == w.quantity}
        value = w.row.read(m, w.id) if w.row.read else value_of(m, w.entries[0])
        rivals = []
        for other in _partners(m, w.id, w.quantity == "friction") or []:
            free = m.geom_priority[other] < m.geom_priority[w.id] or other in varied
            if free or _contact_value(m, w.quantity, other) < value:
                rivals = []
                break
            rivals.append(other)
        if rivals:
            mine, other = (_name(m, "geom", g) for g in (w.id, rivals[0]))
            raise UserError(
                f"address geom.{mine}.{w.quantity}: MuJoCo takes the larger value of "
                f'the two geoms in contact, and that of geom "{other}" is not smaller; '
                f'give geom "{mine}" priority="1" in the model, or vary "{other}"'
            )


def _check_springs(m: mujoco.MjModel, writers: Sequence[Writer]) -> None:
    stiff = {w.id for w in writers if (w.kind, w.quantity) == ("joint", "stiffness")}
    for w in writers:
        if (
            w.quantity == "springref"
            and w.id not in stiff
            and not m.jnt_stiffness[w.id]
        ):
            name = _name(m, "joint", w.id)
            raise UserError(
                f"address joint.{name}.springref: the joint has no stiffness, so it "
                f"would do nothing; vary joint.{name}.stiffness too or set it"
            )


def _check_conflicts(
    m: mujoco.MjModel, writers: Sequence[Writer], texts: dict[Writer, str]
) -> None:
    owner: dict[tuple[str, tuple[int, ...]], Writer] = {}
    for w in writers:
        for entry in (*w.entries, *w.row.extra(m, w.id)):
            first = owner.setdefault((entry.field, entry.index), w)
            if first is not w:
                raise UserError(
                    f'addresses "{texts[first]}" and "{texts[w]}" set the same number '
                    f"of the model; let one parameter hold both, or drop one"
                )


def resolve(
    m: mujoco.MjModel, addresses_per_parameter: Iterable[Iterable[str]]
) -> tuple[Writer, ...]:
    """What each parameter writes in a model.

    Args:
        m: the model as given, before `open_gates`.
        addresses_per_parameter: for each parameter its addresses, all set to its value.

    Raises:
        UserError: unknown address; a quantity that MJX cannot vary or would ignore
            there; two parameters that set the same number.
    """
    texts: dict[Writer, str] = {}
    for p, addresses in enumerate(addresses_per_parameter):
        for address in addresses:
            for kind, quantity, i in places(m, address):
                entries = TABLE[kind][quantity].entries(m, i)
                texts.setdefault(Writer(p, kind, quantity, i, entries), address)
    writers = tuple(texts)
    _check_conflicts(m, writers, texts)
    _check_springs(m, writers)
    _check_dominated(m, writers)
    return writers


def open_gates(m: mujoco.MjModel, addresses: Iterable[str]) -> mujoco.MjModel:
    """A copy of a model in which every address can be varied after `mjx.put_model`.

    MJX compiles out what is zero or switched off. The copy has seeds of 1e-9 where a
    zero would be compiled out, force limits that are on but very wide, an affine bias
    where a motor gets kv, and contact parameters in their direct form; its motion is
    that of the original to within the seeds.

    Raises:
        UserError: as `resolve`.
    """
    opened = copy.deepcopy(m)
    for w in resolve(m, (addresses,)):
        w.row.open(opened, w.id)
    return opened


def nominal(m: mujoco.MjModel, addresses: Iterable[str]) -> float:
    """The value that a model holds at addresses that are tied together, SI units.

    Raises:
        UserError: as `resolve`; the places differ; the model states no value (a limit
            that is off).
    """
    addresses = tuple(addresses)
    values = []
    for w in resolve(m, (addresses,)):
        read = w.row.read
        if isinstance(w.row, EffectNumber):
            values.append(w.row.neutral)
        else:
            values += [read(m, w.id)] if read else [value_of(m, e) for e in w.entries]
    shown = ", ".join(addresses)
    if any(math.isnan(v) for v in values):
        raise UserError(f"{shown}: the model's force range is not symmetric")
    if not all(math.isfinite(v) for v in values):
        raise UserError(f"{shown}: the model states no value; give a nominal")
    if max(values) - min(values) > 1e-9 * max(map(abs, values)):
        raise UserError(
            f"{shown}: the model has different values there ({min(values):g} to "
            f"{max(values):g}); give a nominal"
        )
    return values[0]


def describe(
    m: mujoco.MjModel, addresses: Iterable[str]
) -> tuple[str, tuple[float, float]]:
    """Unit and physical bounds (low, high) of tied addresses, SI units.

    Raises:
        UserError: as `resolve`; the units differ.
    """
    addresses = tuple(addresses)
    writers = resolve(m, (addresses,))
    units = {w.row.unit(m, w.id) for w in writers}
    if len(units) > 1:
        raise UserError(
            f"{', '.join(addresses)}: units differ ({', '.join(sorted(units))})"
        )
    low = max(w.row.lower(m, w.id) for w in writers)
    return units.pop(), (low, min(w.row.high for w in writers))
