"""Chooses the test that tells most effects apart."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np

from easi_jax.data.recording import physics_steps
from easi_jax.data.scales import scales_of
from easi_jax.errors import UserError, nearest
from easi_jax.excite import evaluate as ev
from easi_jax.excite.candidates import Test
from easi_jax.excite.separation import (
    Alike,
    Separation,
    alike,
    nearest_rival,
    separation,
    soft_minimum,
)
from easi_jax.gap.batched_least_squares import bounds_of
from easi_jax.gap.candidates import places, ripples
from easi_jax.gap.table import Place, covered, does
from easi_jax.model.effect_catalog import CATALOG, Scales
from easi_jax.model.joint_space import scalar_dofs
from easi_jax.model.parameters import ParameterSpace
from easi_jax.progress import Tell
from easi_jax.simulation.step import WRITTEN_OUT

_WORK = 4e6  # physics steps of all simulations together
_WORK_WIDE = 1e6
_RIPPLE = 6.0  # cycles over the range of a joint


@dataclass(frozen=True)
class Choice:
    """The test that was chosen, and why.

    Attributes:
        best: index of the chosen test.
        scores: of each test.
        found: what each test would say.
        known: what no test can tell.
        wanted: pairs (i, j) of ``keys`` that count; empty: every effect against its
            nearest rival.
        numbers: name, unit and size of each effect's numbers, by key.
        windows: of each test that were simulated.
        vectors: changes of the model that were simulated.
    """

    best: int
    scores: np.ndarray
    found: Sequence[Separation]
    known: Alike
    wanted: Sequence[tuple[int, int]]
    numbers: Mapping[str, list[tuple[str, str, float]]]
    windows: int
    vectors: int


def check_excitable(m: mujoco.MjModel) -> None:
    """Raises `UserError` for a model that no test moves."""
    if not scalar_dofs(m):
        raise UserError("the model has no hinge or slide joint: nothing to excite")


def check_names(names: Sequence[str]) -> None:
    """Raises `UserError` for a name that is no effect's."""
    for name in names:
        if name not in CATALOG:
            raise UserError(
                f'unknown effect "{name}"{nearest(name, CATALOG)} (known: '
                f"{', '.join(CATALOG)})"
            )


def effects_wanted(
    m: mujoco.MjModel, space: ParameterSpace, scales: Scales, names: Sequence[str]
) -> list[Place]:
    """Places of the effects with some names (none: all), less those that the model's
    own refit covers, and less what all actuators have alike: what tells single ones
    apart tells that.

    Raises:
        UserError: an unknown name, or none that fits the model.
    """
    check_names(names)
    found = places(m, scales)
    for j, (_, d) in scalar_dofs(m).items():
        found += ripples(m, j, scales, [_RIPPLE * 2 * np.pi / float(scales.span[d])])
    kept = [
        p
        for p in found
        if (not names or p.effect in names)
        and not (p.shared or p.tied or covered(p, space, m))
    ]
    if not kept:
        raise UserError(
            f"{', '.join(names)}: this model has no place for it, or its own "
            "parameters already cover it"
        )
    return kept


def choose(
    m: mujoco.MjModel,
    space: ParameterSpace,
    tests: Sequence[Test],
    noise: np.ndarray,
    horizon: float,
    names: Sequence[str] = (),
    pairs: Sequence[tuple[str, str]] = (),
    strengths: Mapping[str, Mapping[str, float]] | None = None,
    scales: Scales | None = None,
    tell: Tell = lambda _: None,
) -> Choice:
    """The test whose data tell most.

    Args:
        m: the model as given.
        space: its own parameters, which a refit may move.
        tests: to choose from.
        noise: of measured positions, ``(nv,)``.
        horizon: length of the predictions that the gap workflow makes [s].
        names: effects that count; all where empty.
        pairs: ``(effect@at, effect@at)`` that are to be told apart; all where empty.
        strengths: of effects by key, then by a column's name; by default
            a few percent of what moves the machine.
        scales: how large motion is; by default that of all tests together.

    Raises:
        UserError: an effect that the model has no place for.
    """
    check_excitable(m)
    runs = [t.run for t in tests]
    scales = scales_of(m, runs) if scales is None else replace(scales, dt=runs[0].dt)
    keys = {k for pair in pairs for k in pair}
    space = less_named(space, [p for p in places(m, scales) if p.key in keys], m)
    found = effects_wanted(m, space, scales, names)
    if pairs:
        found = _only(found, keys)
    dt = runs[0].dt
    physics = max(10, round(horizon / dt)) * physics_steps(dt, m.opt.timestep)
    guess = (
        1
        + 4 * m.nv
        + space.size
        + sum((1 + len(p.columns)) * len(p.starts) for p in found)
    )
    work = _WORK_WIDE if m.nv > WRITTEN_OUT else _WORK
    most = int(np.clip(work / (physics * guess * len(tests)) // 16 * 16, 16, 48))
    parts = ev.windows_of(m, runs, horizon, scales.longest, most)
    predictor = ev.make_predictor(m, space, found, parts, dt)
    bounds = bounds_of(space, predictor.layout)
    truths = _truths(predictor, found, strengths or {})
    design = ev.make_design(predictor, bounds, found, truths)
    tell("compiling the predictions ...")
    products = ev.products_of(m, design, parts, runs, noise, scales, tell)
    seen = [separation(design, p) for p in products]
    known = alike(seen)
    keys = list(design.truths)
    wanted = [
        (keys.index(a), keys.index(b)) for a, b in pairs if a in keys and b in keys
    ]
    if wanted and all(known.same[i, j] or known.unseen[i] for i, j in wanted):
        tell("no test tells any of these pairs apart: chosen for all effects instead")
    scores = np.array([score(s, known, wanted) for s in seen])
    return Choice(
        int(scores.argmax()),
        scores,
        seen,
        known,
        wanted,
        design.numbers,
        most,
        len(design.vectors),
    )


def score(s: Separation, known: Alike, wanted: Sequence[tuple[int, int]]) -> float:
    """Soft minimum of the distances that count; what no data tell is left out."""
    able = [
        s.apart[i, j] for i, j in wanted if not known.same[i, j] and not known.unseen[i]
    ]
    if able:
        return soft_minimum(np.array(able))
    distance, _ = nearest_rival(s, known)
    return soft_minimum(distance[~known.unseen])


def less_named(
    space: ParameterSpace, named: Sequence[Place], m: mujoco.MjModel
) -> ParameterSpace:
    """The model's own parameters without those that the gap workflow names as effects:
    what lies beyond a refit's bounds is one."""
    return space.select(
        p.name
        for p in space.parameters
        if not any(does(place, a, m) for place in named for a in p.addresses)
    )


def _only(found: Sequence[Place], keys: set[str]) -> list[Place]:
    kept = [p for p in found if p.key in keys]
    missing = sorted(keys - {p.key for p in kept})
    if missing:
        raise UserError(
            f"{', '.join(missing)}: no such effect in this model; is --gap a result "
            "for the same model?"
        )
    return kept


def _truths(
    predictor: ev.Predictor,
    found: Sequence[Place],
    strengths: Mapping[str, Mapping[str, float]],
) -> dict[str, np.ndarray]:
    """Whole vectors with an effect at a known strength."""
    out = {}
    for place in found:
        values = strengths.get(place.key)
        if values is None:
            continue
        x = predictor.neutral.copy()
        index = predictor.layout.where(place) + predictor.own
        for i, c in zip(index, place.columns, strict=True):
            x[i] = values.get(c.name, x[i])
        out[place.key] = x
    return out
