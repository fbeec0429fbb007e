"""Draws a case of a kind: mechanism, effects and places, visible ones only."""

import itertools
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from tests.gap_cases.cases import Case, build_machine, make_case
from tests.gap_cases.effects import KINDS, ON_REQUEST, OUTSIDE, CaseError, Effect
from tests.gap_cases.mechanisms import ON_GROUND, Mechanism, Stated
from tests.gap_cases.places import places, twins
from tests.gap_cases.robots import MECHANISMS
from tests.gap_cases.search import MOST

CASE_KINDS = ("single", "pair", "none", "wrong_own", "outside", "mixed", "several")
"""One effect of the table, two, none, none but the model's own numbers, one that no
table has, one of each, three to five of the table."""
LOUDEST = 100.0
"""Gap in floors that several effects may have together."""
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
        drawn.append(Effect(name, str(rng.choice(where))))
    for first, second in itertools.combinations(drawn, 2):
        alike = f"{second.name}@{second.at}" in twins(machine, first)
        frictions = {first.name, second.name} <= FRICTIONS and first.at == second.at
        if alike or frictions or is_one_spring(machine, first, second):
            raise CaseError("the two are one")
    return drawn


def is_one_spring(machine: Mechanism, first: Effect, second: Effect) -> bool:
    """Whether one is a spring and the other moves where it rests."""
    for spring, force in ((first, second), (second, first)):
        names = {f"{force.name}@{force.at}", *twins(machine, force)}
        if spring.name == "joint_stiffness" and f"constant_force@{spring.at}" in names:
            return True
    return False


def _recipe(
    rng: np.random.Generator, kind: str, mechanisms: Sequence[str], effect: str
) -> tuple[str, list[str]]:
    """Mechanism and names of effects; `effect` fixes the first."""
    names: list[str] = []
    known = [name for name in KINDS if name not in ON_REQUEST]
    if kind in ("single", "pair", "mixed"):
        names.append(effect or str(rng.choice(known)))
    if kind == "pair":
        names.append(str(rng.choice([name for name in known if name != names[0]])))
    if kind == "outside":
        names.append(effect or str(rng.choice(OUTSIDE)))
    if kind == "mixed":
        names.append(str(rng.choice(OUTSIDE)))
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
) -> Case:
    """Write a random case of `kind` into `out_dir`, the same for the same arguments.

    `cheap` keeps to one or two joints; `effect` and `mechanism` fix what is drawn;
    `coarse`: see `make_case`.
    """
    if kind not in CASE_KINDS:
        raise ValueError(f"unknown kind {kind!r}; choose from {CASE_KINDS}")
    mechanisms = (mechanism,) if mechanism else CHEAP if cheap else MECHANISMS
    if effect.startswith("contact_") and not mechanism:
        mechanisms = ON_GROUND
    rng = np.random.default_rng([seed, CASE_KINDS.index(kind)])
    reason = ""
    for _ in range(TRIES):
        name, names = _recipe(rng, kind, mechanisms, effect)
        stated = _stated(rng, kind, "backlash" if "backlash" in names else "")
        case_seed = int(rng.integers(2**31))
        try:
            machine = build_machine(case_seed, name, stated)
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
                most=LOUDEST if kind in ("mixed", "several") else MOST,
            )
        except CaseError as error:
            reason = f"{name} with {names}: {error}"
    raise CaseError(f"{TRIES} draws failed; the last: {reason}")
