"""Draws a case of a kind: mechanism, effects and places, visible ones only."""

import itertools
from collections.abc import Sequence
from fnmatch import fnmatchcase
from pathlib import Path

import numpy as np

from tests.gap_cases.cases import Case, build_machine, make_case
from tests.gap_cases.effects import (
    KINDS,
    LOSSES,
    ON_REQUEST,
    OUTSIDE,
    UNLISTED,
    CaseError,
    Effect,
)
from tests.gap_cases.mechanisms import LEGS, ON_GROUND, Mechanism, Stated
from tests.gap_cases.places import places, twins
from tests.gap_cases.robots import MECHANISMS, WIDE
from tests.gap_cases.search import MOST

CASE_KINDS = (
    *("single", "pair", "none", "wrong_own", "outside", "mixed", "several"),
    "real",
)
"""One effect of the table, two, none, none but the model's own numbers, one that no
table has, one of each, three to five of the table; what real machines have: two to four
of the table, a loss of the drives among them, beside one or two that no table has."""
LOUDEST = 100.0
"""Gap in floors that several effects may have together."""
REAL = 1e4
"""The same, of wide cases."""
TIED = 0.6
"""Share of effects of like joints or drives that all of these have."""
CHEAP = ("slide", "pendulum", "cartpole", "arm2")
FRICTIONS = {"coulomb_friction", "stribeck_friction"}
TRIES = 25


def _stated(rng: np.random.Generator, kind: str, effect: str) -> Stated:
    return Stated(
        damping=bool(rng.random() < 0.5) or kind == "wrong_own",
        armature=bool(rng.random() < 0.5) or effect == "backlash",
        stiffness=bool(rng.random() < 0.12),
        frictionloss=bool(rng.random() < 0.12),
    )


def _effects(
    rng: np.random.Generator, machine: Mechanism, names: Sequence[str]
) -> list[Effect]:
    """Each effect at a place of its own; CaseError where there is none."""
    drawn = []
    for name in names:
        where = places(machine, name)
        if not where:
            raise CaseError(f"{name} cannot be seen on {machine.name}")
        at = str(rng.choice(where))
        leg, _, part = at.partition("_")
        is_body = part.endswith("_link")
        if leg in LEGS and not is_body and KINDS.get(name) and rng.random() < TIED:
            at = f"*_{part}"
        drawn.append(Effect(name, at))
    for first, second in itertools.combinations(drawn, 2):
        alike = f"{second.name}@{second.at}" in twins(machine, first)
        if first.name == second.name and _overlap(first, second):
            alike = True
        frictions = {first.name, second.name} <= FRICTIONS and _overlap(first, second)
        if alike or frictions or is_one_spring(machine, first, second):
            raise CaseError("the two are one")
    return drawn


def _overlap(first: Effect, second: Effect) -> bool:
    """Whether some place has both."""
    return fnmatchcase(first.at, second.at) or fnmatchcase(second.at, first.at)


def is_one_spring(machine: Mechanism, first: Effect, second: Effect) -> bool:
    """Whether one is a spring and the other moves where it rests."""
    for spring, force in ((first, second), (second, first)):
        names = {f"{force.name}@{force.at}", *twins(machine, force)}
        if spring.name == "joint_stiffness" and f"constant_force@{spring.at}" in names:
            return True
    return False


def _recipe(
    rng: np.random.Generator,
    kind: str,
    mechanisms: Sequence[str],
    effect: str,
    unknown: Sequence[str],
) -> tuple[str, list[str]]:
    """Mechanism and names of effects; `effect` fixes the first."""
    names: list[str] = []
    known = [name for name in KINDS if name not in ON_REQUEST]
    if kind in ("single", "pair", "mixed"):
        names.append(effect or str(rng.choice(known)))
    if kind == "pair":
        names.append(str(rng.choice([name for name in known if name != names[0]])))
    if kind == "outside":
        names.append(effect or str(rng.choice(unknown)))
    if kind == "mixed":
        names.append(str(rng.choice(unknown)))
    if kind == "real":
        names.append(effect or str(rng.choice(LOSSES)))
        names += rng.choice(known, int(rng.integers(1, 4)), replace=False).tolist()
        names += rng.choice(unknown, int(rng.integers(1, 3)), replace=False).tolist()
    if kind == "several":
        names += rng.choice(known, int(rng.integers(3, 6)), replace=False).tolist()
    return str(rng.choice(list(mechanisms))), names


def draw_case(
    seed: int,
    kind: str,
    out_dir: Path,
    *,
    cheap: bool = False,
    effect: str = "",
    mechanism: str = "",
    coarse: bool = False,
    wide: bool = False,
) -> Case:
    """Write a random case of `kind` into `out_dir`, the same for the same arguments.

    `cheap` keeps to one or two joints; `effect` and `mechanism` fix what is drawn;
    `coarse`, `wide`: see `make_case`.
    """
    if kind not in CASE_KINDS:
        raise ValueError(f"unknown kind {kind!r}; choose from {CASE_KINDS}")
    every = WIDE if wide else MECHANISMS
    mechanisms = (mechanism,) if mechanism else CHEAP if cheap else every
    if effect.startswith("contact_") and not mechanism:
        mechanisms = ON_GROUND
    rng = np.random.default_rng([seed, CASE_KINDS.index(kind)])
    unknown, most = UNLISTED if wide else OUTSIDE, MOST
    if kind in ("mixed", "several", "real"):
        most = LOUDEST
    reason = ""
    for _ in range(TRIES):
        name, names = _recipe(rng, kind, mechanisms, effect, unknown)
        stated = _stated(rng, kind, "backlash" if "backlash" in names else "")
        case_seed = int(rng.integers(2**31))
        try:
            machine = build_machine(case_seed, name, stated, wide)
            effects = _effects(rng, machine, names)
            return make_case(
                case_seed,
                name,
                effects,
                out_dir,
                stated=stated,
                wrong_own=kind == "wrong_own",
                kind=kind,
                coarse=coarse,
                most=REAL if wide else most,
                wide=wide,
            )
        except CaseError as error:
            reason = f"{name} with {names}: {error}"
    raise CaseError(f"{TRIES} draws failed; the last: {reason}")
