"""Effects that an owner of a machine adds to the catalog.

    from easi_jax import Number, OwnEffect

    def pull(now, p):
        twist = now.position["elbow"] - now.position["shoulder"]
        return {"shoulder": p.stiffness * twist, "elbow": -p.stiffness * twist}

    COUPLING = OwnEffect(
        "coupling_spring",
        "a spring of {stiffness} couples shoulder and elbow",
        (Number("stiffness", "N m/rad", 0.0, 20.0),),
        force=pull,
    )

While `registered`, they are rows of the catalog like all others: fits, files, reports
and simulations find them there. What their functions do in a step:
`easi_jax.model.own_laws`.
"""

import contextlib
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import mujoco

from easi_jax.errors import UserError
from easi_jax.model.addresses import matching
from easi_jax.model.effect_catalog import CATALOG, Effect, Part, Site, Spot
from easi_jax.model.effect_numbers import (
    EFFECT_TABLE,
    NUMBERS,
    OWN,
    OWN_LAWS,
    EffectNumber,
    OwnLaw,
    own_row,
)
from easi_jax.model.own_laws import Function
from easi_jax.model.quantities import Entry, Inert, scalar_only

_NAME = re.compile(r"[a-z][a-z0-9_]*")
_SMALL = 0.02  # of a typical value: a difference that fits take
_TYPICAL = 0.1  # of the range, where nothing is said


@dataclass(frozen=True)
class Number:
    """One number of an owner's effect.

    Attributes:
        name: lower case, with ``_``; an attribute of what functions get.
        unit: SI, such as ``N m/rad``.
        low, high: bounds of a fit.
        neutral: its value in a model without the effect. With all numbers at these the
            functions must change nothing.
        starts: values that fits start from, in turn; ``neutral`` where empty, which
            serves wherever a small change of the number shows at once.
        step: a small but visible change; not given: 2 % of a start, or of a tenth of
            the range.
    """

    name: str
    unit: str
    low: float
    high: float
    neutral: float = 0.0
    starts: tuple[float, ...] = ()
    step: float | None = None

    @property
    def size(self) -> float:
        """Of a difference."""
        if self.step is not None:
            return self.step
        typical = max((abs(x) for x in self.starts), default=0.0)
        return _SMALL * (typical or _TYPICAL * (self.high - self.low))


@dataclass(frozen=True)
class OwnEffect:
    """An effect that its owner wrote; see the module.

    Attributes:
        name: lower case, with ``_``; none of the catalog's.
        sentence: for reports; names of numbers and ``at`` in braces.
        numbers: what a fit looks for.
        force: of `Now` and the numbers, generalized forces [N, N m] by the names of
            joints, or one at the joint that it sits at.
        command: likewise, commands in place of those that arrive, by the names of
            actuators.
        reading: likewise, readings in place of positions, by the names of joints.
        on: what it sits at: every ``joint`` or ``actuator`` in turn, or the ``model``.
        at: names or patterns of the joints or actuators; all where empty.
    """

    name: str
    sentence: str
    numbers: tuple[Number, ...]
    force: Function | None = None
    command: Function | None = None
    reading: Function | None = None
    on: Literal["joint", "actuator", "model"] = "model"
    at: tuple[str, ...] = ()

    def fits(self, name: str) -> bool:
        """Whether it may sit at a joint or actuator; "" is the whole model."""
        return (
            not self.at
            or not name
            or any(matching(pattern, [name]) for pattern in self.at)
        )

    def check(self) -> None:
        """Whether it can be told of and fitted.

        Raises:
            UserError: what is wrong with it.
        """
        what = f"effect {self.name!r}"
        if not (isinstance(self.name, str) and _NAME.fullmatch(self.name)):
            raise UserError(f"{what}: a name is lower-case letters, digits and _")
        if not isinstance(self.sentence, str):
            raise UserError(f"{what}: its sentence is no text")
        # A comma that is missing makes no tuple of one.
        for name, kind in (("numbers", Number), ("at", str)):
            given = getattr(self, name)
            if not (
                isinstance(given, list | tuple)
                and all(isinstance(x, kind) for x in given)
            ):
                raise UserError(
                    f"{what}: {name}= holds a tuple, of one with a comma: "
                    f"({kind.__name__.lower()},)"
                )
        if self.name in CATALOG:
            raise UserError(f"{what}: there is one of this name; give it another")
        acts = [self.force, self.command, self.reading]
        if not any(acts) or not all(f is None or callable(f) for f in acts):
            raise UserError(f"{what}: give it force=, command= or reading=, a function")
        if self.reading is not None and (self.force or self.command):
            raise UserError(
                f"{what}: a reading is no physics: make two effects of the two"
            )
        if self.on not in ("joint", "actuator", "model"):
            raise UserError(f'{what}: on="{self.on}" (joint, actuator or model)')
        if not self.numbers:
            raise UserError(f"{what}: numbers= is empty, so that nothing can be found")
        for n in self.numbers:
            self._check_number(n)
        if len({n.name for n in self.numbers}) < len(self.numbers):
            raise UserError(f"{what}: two of its numbers have one name")
        try:
            self.sentence.format(at="", kind="", **{n.name: "" for n in self.numbers})
        except (KeyError, IndexError) as error:
            raise UserError(
                f"{what}: its sentence names {error}, which is no number of it"
            ) from error
        except (ValueError, AttributeError, TypeError) as error:
            raise UserError(
                f"{what}: its sentence has names of numbers in braces, and nothing "
                f"more there, for these come with their units ({error})"
            ) from error

    def _check_number(self, n: Number) -> None:
        what = f"effect {self.name!r}, number {n.name!r}"
        values = (n.low, n.high, n.neutral, *_listed(n.starts), n.step or 0.0)
        if not all(isinstance(x, int | float) for x in values):
            raise UserError(f"{what}: low, high, neutral, starts and step hold numbers")
        plain = isinstance(n.name, str) and _NAME.fullmatch(n.name)
        if not plain or n.name in ("at", "kind", "pair"):
            raise UserError(
                f"{what}: a name is lower-case letters, digits and _, and not at, kind "
                "or pair"
            )
        if not n.low < n.high or not math.isfinite(n.high - n.low):
            raise UserError(f"{what}: low {n.low:g} and high {n.high:g} are no range")
        for x in (n.neutral, *n.starts):
            if not n.low <= x <= n.high:
                raise UserError(f"{what}: {x:g} is not within {n.low:g} to {n.high:g}")
        if not n.size > 0:
            raise UserError(f"{what}: step is {n.size:g}: give one above 0")


def _listed(x: Any) -> tuple[Any, ...]:
    return tuple(x) if isinstance(x, list | tuple) else (x,)


@contextlib.contextmanager
def registered(own: Sequence[OwnEffect]) -> Iterator[None]:
    """The catalog has these effects as well, inside; what is added there goes, too.

    Raises:
        UserError: what is wrong with one of them.
    """
    tables: list[dict[str, Any]] = [OWN_LAWS, NUMBERS, EFFECT_TABLE]
    tables += [CATALOG]
    before = [dict(table) for table in tables]
    try:
        for effect in own:
            effect.check()
            _add(effect)
        yield
    finally:
        for table, kept in zip(tables, before, strict=True):
            table.clear()
            table.update(kept)


def _add(effect: OwnEffect) -> None:
    names = tuple(n.name for n in effect.numbers)
    functions = effect.force, effect.command, effect.reading
    law = OwnLaw(effect.name, names, effect.on, effect.fits, *functions)
    OWN_LAWS[effect.name] = law
    parts = []
    for n in effect.numbers:
        column = f"{effect.name}.{n.name}"
        number = _number(effect, n, own_row(column))
        NUMBERS[column] = number
        if not effect.reading:  # no address reaches readings
            EFFECT_TABLE[column] = number
        parts.append(Part(column, n.name, "1", n.low, n.high, n.size))

    def able(o: Spot) -> bool:
        return effect.fits(_name(o.m, effect.on, o.i))

    site = Site(tuple(parts), _starts(effect), able=able)
    CATALOG[effect.name] = Effect(effect.name, effect.sentence, {effect.on: site})


def _starts(effect: OwnEffect) -> tuple[tuple[float, ...], ...]:
    """As many as the number with most of them has; the others go round."""
    each = [n.starts or (n.neutral,) for n in effect.numbers]
    count = max(map(len, each))
    return tuple(tuple(s[k % len(s)] for s in each) for k in range(count))


def _name(m: mujoco.MjModel, kind: str, i: int) -> str:
    """Of a joint or an actuator; "" for the whole model."""
    if kind == "model":
        return ""
    return str((m.joint(i) if kind == "joint" else m.actuator(i)).name)


def _number(effect: OwnEffect, n: Number, row: int) -> EffectNumber:
    def column(m: Any, i: int) -> int:
        return int(m.jnt_dofadr[i]) if effect.on == "joint" else i

    def refuse(m: Any, i: int) -> str | None:
        if effect.on == "joint" and (reason := scalar_only(m, i)):
            return reason
        if not effect.fits(_name(m, effect.on, i)):
            return Inert(f"{effect.name} is not for it")
        return None

    return EffectNumber(
        lambda m, i: (Entry(f"effects.{OWN}", (row, column(m, i))),),
        lambda m, i: n.unit,
        n.low,
        n.high,
        refuse=refuse,
        on=effect.on,
        word=n.name,
        neutral=n.neutral,
        acts="readings" if effect.reading else "step",
    )
