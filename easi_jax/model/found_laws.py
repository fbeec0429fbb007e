"""Laws that nobody listed: sums of terms, found in data, as rows of the catalog.

A law is a generalized force along a joint, or along a sum of joints, that is linear in
its numbers ``c1``, ``c2``, ...: one for each term (`easi_jax.model.law_terms`). Its
name is ``found_law`` to people and files; within the catalog each has one of its own.
"""

import ast
import math
import re
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import mujoco
import numpy as np

from easi_jax.errors import UserError, nearest
from easi_jax.model.effect_catalog import CATALOG, Effect, Part, Site, Spot
from easi_jax.model.effect_mjcf import InMjcf, tendon
from easi_jax.model.effect_numbers import (
    EFFECT_TABLE,
    NUMBERS,
    OWN,
    OWN_LAWS,
    EffectNumber,
    OwnLaw,
    own_row,
)
from easi_jax.model.joint_space import tangent_units
from easi_jax.model.law_terms import Known, Term
from easi_jax.model.own_laws import Now
from easi_jax.model.quantities import Entry, Inert, joint_unit, scalar_only

FOUND_LAW = "found_law"
_INTERNAL = re.compile(rf"\b{FOUND_LAW}_\d+\b")
_FAR = 20.0  # times the size that a number starts with, that a fit may go
_SMALL = 0.05  # of it, that differences are taken over
_INF = float("inf")


@dataclass(frozen=True)
class FoundLaw:
    """A law, without its numbers.

    Attributes:
        acts: joints that it pushes, with the share of each: 1 or -1. The first is where
            it is said to sit.
        terms: whose weighted sum the force is.
    """

    acts: tuple[tuple[str, float], ...]
    terms: tuple[Term, ...]

    @property
    def at(self) -> str:
        """The joint that it is said to sit at."""
        return self.acts[0][0]

    @property
    def numbers(self) -> tuple[str, ...]:
        """Names of its numbers."""
        return tuple(f"c{k}" for k in range(1, len(self.terms) + 1))

    @property
    def name(self) -> str:
        """In the catalog, and in addresses of its numbers."""
        return f"{FOUND_LAW}_{_number_of(self)}"

    def force(self, now: Now, p: Any) -> dict[str, Any]:
        """Generalized forces by joint."""
        known = Known(now.position, now.speed, now.command, now.time)
        total, first = 0.0, 0
        for name, term in zip(self.numbers, self.terms, strict=True):
            count = len(term.memories)
            memory = now.memory[first : first + count]
            total = total + getattr(p, name) * term.value(known, memory)
            first += count
        return {joint: share * jnp.asarray(total) for joint, share in self.acts}

    @property
    def sentence(self) -> str:
        """For reports, with its numbers in braces."""
        where = " and ".join(f'"{_braced(joint)}"' for joint, _ in self.acts)
        how = "" if all(x > 0 for _, x in self.acts) else ", against each other,"
        parts = zip(self.numbers, self.terms, strict=True)
        what = " and ".join(f"{{{k}}} times {_braced(t.shown)}" for k, t in parts)
        feel = f"joint {where} feels" if len(self.acts) == 1 else f"joints {where} feel"
        return f"{feel}{how} {what} (a law that is none of the known effects)"

    def shown(self, values: Sequence[float], unit: str) -> str:
        """Such as ``-1.9*sign(qvel.a + qvel.b) N m``."""
        text = ""
        for value, term in zip(values, self.terms, strict=True):
            sign = "-" if value < 0 else "+" if text else ""
            space = " " if text else ""
            text += f"{space}{sign}{space}{abs(value):.4g}*{_factor(term)}"
        return f"{text} {unit}"

    def unit_of_force(self, m: mujoco.MjModel) -> str:
        """Of the law: N m at a hinge, N at a slide."""
        return joint_unit("N", "N m")(m, m.joint(self.at).id)

    def unit(self, m: mujoco.MjModel, k: int) -> str:
        """Of a number: that of the force by that of the term."""
        lengths = {
            m.joint(j).name: tangent_units(m)[int(m.jnt_dofadr[j])]
            for j in range(m.njnt)
        }
        powers = self.terms[k].unit(
            lambda kind, name: "ctrl" if kind == "ctrl" else lengths[name]
        )
        over = [f"{u}^{-p:g}".replace("^1", "") for u, p in powers.items() if p < 0]
        under = [f"{u}^{p:g}".removesuffix("^1") for u, p in powers.items() if p > 0]
        whole = " ".join([self.unit_of_force(m), *over])
        return f"{whole}/{' '.join(under)}" if under else whole


def _braced(text: str) -> str:
    return text.replace("{", "{{").replace("}", "}}")


def _factor(term: Term) -> str:
    return f"({term.shown})" if term.is_sum else term.shown


def _number_of(law: FoundLaw) -> int:
    """The same for the same law, in every process."""
    text = repr((law.acts, [term.text for term in law.terms]))
    return zlib.crc32(text.encode())


def law_of(effect: str) -> FoundLaw | None:
    """The law of a name of the catalog; None where it is another effect."""
    return _LAWS.get(effect)


_LAWS: dict[str, FoundLaw] = {}


def public_name(text: str) -> str:
    """What people and files read in place of names of the catalog."""
    return _INTERNAL.sub(FOUND_LAW, text)


def add_law(law: FoundLaw, sizes: Sequence[float] = ()) -> str:
    """Makes a law a row of the catalog, as long as `own_effects.registered` lasts.

    Args:
        sizes: what a fit of its numbers starts with, SI units; 1 where not known.

    Returns:
        Its name there.
    """
    name, sizes = law.name, tuple(sizes) or (1.0,) * len(law.terms)
    _LAWS[name] = law
    about = {joint for joint, _ in law.acts}
    about |= {n for term in law.terms for _, n in term.names}
    memories = tuple(x for term in law.terms for x in term.memories)
    OWN_LAWS[name] = OwnLaw(
        *(name, law.numbers, "joint", lambda at: at == law.at),
        *(law.force, None, None, memories, frozenset(about)),
    )
    parts = []
    for k, (number, size) in enumerate(zip(law.numbers, sizes, strict=True)):
        column = f"{name}.{number}"
        NUMBERS[column] = EFFECT_TABLE[column] = _row(law, k, own_row(column))
        far = _FAR * abs(size)
        parts.append(Part(column, number, "1", -far, far, _SMALL * abs(size)))
    site = Site(tuple(parts), (sizes,), able=lambda o: _fits(law, o))
    CATALOG[name] = Effect(name, law.sentence, {"joint": site}, mjcf=_in_mjcf(law))
    return name


def _in_mjcf(law: FoundLaw) -> InMjcf | None:
    """How MJCF says it: what depends on a sum of joints alone, and acts along that, may
    be a tendon. None where it has no word for a term."""
    if len(law.acts) < 2:
        return None
    words = [_word(law, term) for term in law.terms]
    columns = [f"{law.name}.{number}" for number in law.numbers]
    known = dict(zip(columns, words, strict=True))
    return tendon(law.acts, known) if all(words) else None


def _word(law: FoundLaw, term: Term) -> str:
    """What a tendon along a law's joints calls a term, by its value at a state."""
    tree, inside, turns = term.tree, term, False
    if isinstance(tree, ast.Call) and ast.unparse(tree.func) == "sign":
        inside, turns = Term(ast.unparse(tree.args[0])), True
    if inside.memories:
        return ""
    rng = np.random.default_rng(0)
    names = sorted({name for _, name in inside.names} | {j for j, _ in law.acts})
    q, v, u = (
        dict(zip(names, x, strict=True)) for x in rng.normal(size=(3, len(names)))
    )
    value = inside.value(Known(q, v, u, rng.normal()))
    along = [sum(share * x[joint] for joint, share in law.acts) for x in (q, v)]
    position, speed = np.isclose(value, along, rtol=1e-5)
    if turns:
        return "frictionloss" if speed else ""
    return "stiffness" if position else "damping" if speed else ""


def _fits(law: FoundLaw, o: Spot) -> bool:
    return o.m.joint(o.i).name == law.at


def _row(law: FoundLaw, k: int, row: int) -> EffectNumber:
    def refuse(m: Any, j: int) -> str | None:
        if m.joint(j).name != law.at:
            return Inert("the law is of another joint")
        return scalar_only(m, j)

    return EffectNumber(
        lambda m, j: (Entry(f"effects.{OWN}", (row, int(m.jnt_dofadr[j]))),),
        lambda m, j: law.unit(m, k),
        -_INF,
        refuse=refuse,
        word=law.numbers[k],
    )


def check_law(m: mujoco.MjModel, law: FoundLaw) -> None:
    """Refuses a law that a model has no place for.

    Raises:
        UserError: a joint or actuator that the model lacks.
    """
    known = {
        "joint": {m.joint(j).name for j in range(m.njnt)},
        "actuator": {m.actuator(a).name for a in range(m.nu)},
    }
    named = [("joint", joint) for joint, _ in law.acts]
    for term in law.terms:
        for kind, name in sorted(term.names):
            named.append(("actuator" if kind == "ctrl" else "joint", name))
    for kind, name in named:
        if name not in known[kind]:
            raise UserError(
                f'{FOUND_LAW}: the model has no {kind} "{name}"'
                f"{nearest(name, known[kind])}"
            )


def read_law(acts: Mapping[str, float], terms: Sequence[str]) -> FoundLaw:
    """A law from what a file says.

    Raises:
        UserError: a term that is none; no joint, or a share that is not finite.
    """
    if not acts or not terms:
        raise UserError(f"{FOUND_LAW}: acts: names joints, and terms: holds terms")
    if not all(math.isfinite(x) for x in acts.values()):
        raise UserError(f"{FOUND_LAW}: acts: holds numbers")
    return FoundLaw(tuple(acts.items()), tuple(Term(text) for text in terms))
