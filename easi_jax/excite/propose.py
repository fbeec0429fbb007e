"""What to record next, so that two effects can be told apart."""

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np

from easi_jax.data.recording import Run
from easi_jax.data.scales import scales_of
from easi_jax.errors import UserError
from easi_jax.excite import candidates, drives
from easi_jax.excite import evaluate as ev
from easi_jax.excite.separation import Design, alike, separation
from easi_jax.gap.batched_least_squares import Bounds
from easi_jax.gap.predictor import Predictor
from easi_jax.gap.table import Place
from easi_jax.gap.window_set import WindowSet, join
from easi_jax.model.joint_space import scalar_dofs
from easi_jax.progress import Tell

_WINDOWS = 32  # of each run
_MARGIN = 0.05
_WORTH = 1.5  # times as far apart as in the data given
_SEEN = 3.0  # times the noise that a test has to tell two names apart by
_TRAVEL = 0.5  # m or rad, of a joint without a range that the data hardly move


@dataclass(frozen=True)
class Proposal:
    """A test that would tell one effect from another.

    Attributes:
        effect, rival: ``effect@at``.
        test: what to play; None where no test keeps to the limits.
        apart: expected distance in the test's data, in units of noise.
        given: in the data given.
        twins: whether the rival does all that the effect does, in all that was tried.
        way: ``open-loop`` or ``feed-forward``.
        names: of the actuators.
    """

    effect: str
    rival: str
    test: candidates.Test | None
    apart: float
    given: float
    twins: bool
    way: str
    names: tuple[str, ...]

    def text(self) -> str:
        """A sentence for a report."""
        pair = f"{self.effect} from {self.rival}"
        if not self.names:
            return (
                "The model has no actuator that a test could be played on: to tell "
                f"{pair}, record it from other starts, in larger and smaller motion."
            )
        if self.test is None:
            return f"No test inside the joints' ranges was found to tell {pair}."
        if self.twins:
            return (
                f"In this model {self.rival} does all that {self.effect} does: no test "
                "that was tried tells them apart."
            )
        gain = self.apart / max(self.given, 1e-9)
        if gain < _WORTH or self.apart < _SEEN:
            return (
                f"No test that was tried tells {pair} much better than the data given."
            )
        size = ", ".join(
            f'{a:.2g} at "{n}"'
            for a, n in zip(self.test.amplitude, self.names, strict=True)
        )
        seconds = self.test.run.time[-1]
        added = ", added to your controller," if self.way == "feed-forward" else ""
        return (
            f"{seconds:.0f} s of {self.test.recipe.text()} (commands of {size}){added} "
            f"would tell {pair} {gain:.2g} times as well as the data given."
        )


def propose(
    m: mujoco.MjModel,
    predictor: Predictor,
    bounds: Bounds,
    x: np.ndarray,
    nuisance: Sequence[int],
    place: Place,
    rivals: Sequence[Place],
    runs: Sequence[Run],
    noise: np.ndarray,
    horizon: float,
    plan: tuple[Sequence[candidates.Test], str],
    tell: Tell = lambda _: None,
) -> list[Proposal]:
    """For each rival of an effect, the best of a few tests.

    The compiled program of ``predictor`` is used again, so this takes seconds.

    Args:
        m: the model as given; tests are simulated in it.
        predictor: with all places in its layout.
        bounds: of whole vectors.
        x: the fitted vector, the effect in it at its strength, ``(n,)``.
        nuisance: entries that a fit moves as well; those of ``place`` are left out.
        rivals: what the data cannot tell it from.
        runs: the data given.
        noise: of measured positions, ``(nv,)``.
        horizon: of the predictor's windows [s].
        plan: `quick_tests`.
    """
    scales, predictor = scales_of(m, runs), predictor.of_positions()
    mine = predictor.layout.where(place) + predictor.own
    base = np.array(x, np.float64)
    base[mine] = predictor.layout.neutral[mine - predictor.own]
    names = tuple(m.actuator(a).name for a in range(m.nu))
    tests, way = plan
    if not tests:
        return [
            Proposal(place.key, r.key, None, 0.0, 0.0, False, way, names)
            for r in rivals
        ]
    design = Design(
        predictor, bounds, base, [i for i in nuisance if i not in mine.tolist()]
    )
    share = _small(place, (np.asarray(x) - base)[mine] / bounds.size[mine])
    design.add(place, base + share * (x - base))
    for rival in rivals:
        design.add(rival)
    given_runs = [r for r in runs if len(r) > predictor.steps]
    every = [*given_runs, *(t.run for t in tests)]
    most = min(_WINDOWS, predictor.capacity)
    parts = ev.windows_of(m, every, horizon, scales.longest, most)
    found = []
    for group in _groups(parts, predictor.capacity):
        chosen = [_of_run(parts[k], i) for i, k in enumerate(group)]
        on = copy.copy(design)
        on.predictor = predictor.on(join(chosen))
        found += ev.products_of(
            m, on, chosen, [every[k] for k in group], noise, scales, tell
        )
    given = separation(design, np.sum(found[: len(given_runs)], 0))
    tried = [separation(design, p) for p in found[len(given_runs) :]]
    known = alike([given, *tried])
    out = []
    for rival in rivals:
        j = given.keys.index(rival.key)
        best = int(np.argmax([s.apart[0, j] for s in tried]))
        out.append(
            Proposal(
                place.key,
                rival.key,
                tests[best],
                float(tried[best].apart[0, j]) / share,
                float(given.apart[0, j]) / share,
                bool(known.same[0, j]),
                way,
                names,
            )
        )
    return out


def _small(place: Place, sizes: np.ndarray) -> float:
    """Share of an effect, of ``sizes`` in units of a small change, that is small.

    A rival is counted by its slope, and twins are alike only to first order. What has
    no slope at zero counts as a whole.
    """
    smooth = any(
        all(
            s == c.neutral
            for s, c, fitted in zip(start, place.columns, place.fitted, strict=True)
            if fitted
        )
        for start in place.starts
    )
    return min(1.0, 0.5 / max(float(np.abs(sizes).max()), 1e-9)) if smooth else 1.0


def _of_run(windows: WindowSet, index: int) -> WindowSet:
    """The windows as those of the run ``index``."""
    return replace(windows, run=np.full(len(windows), index))


def _groups(parts: Sequence[WindowSet], most: int) -> list[list[int]]:
    """Parts in order, together at most ``most`` windows each time."""
    out: list[list[int]] = []
    room = 0
    for k, part in enumerate(parts):
        if not out or len(part) > room:
            out.append([])
            room = most
        out[-1].append(k)
        room -= len(part)
    return out


def quick_tests(
    m: mujoco.MjModel, runs: Sequence[Run], seconds: float = 20.0, seed: int = 0
) -> tuple[list[candidates.Test], str]:
    """A few tests inside the model's limits; where it has none, inside the data's.

    And whether they are ``open-loop`` or ``feed-forward``. They take the longest of a
    proposal, and serve all effects.
    """
    if not m.nu:
        return [], "open-loop"
    dt = runs[0].dt
    travel = np.full(m.nv, _TRAVEL)
    for q, d in scalar_dofs(m).values():
        seen = max(float(np.abs(r.qpos[:, q] - m.qpos0[q]).max()) for r in runs)
        travel[d] = max(_TRAVEL, seen)
    limits = drives.limits_of(m, _MARGIN, travel, np.full(m.nv, np.inf))
    rows = round(seconds / dt) + 1
    bench, _ = candidates.make_bench(m, limits, dt, rows)
    sent = np.max([np.abs(r.ctrl - bench.hold).max(0) for r in runs], 0)
    most = np.where(m.actuator_ctrllimited == 1, np.inf, np.maximum(sent, 1e-9))
    recipes = [
        r for r in candidates.recipes(1.0 / dt, seconds) if r.level == 1 and _quick(r)
    ]
    try:
        tests = candidates.make_tests(bench, recipes, most, seconds, seed)
    except UserError:
        tests = []  # an actuator of a kind that commands are not known for
    return tests, "open-loop" if bench.feedback is None else "feed-forward"


def _quick(recipe: candidates.Recipe) -> bool:
    """Whether a recipe is one of the few."""
    fast = recipe.high > 1.0
    return fast if recipe.kind in ("multisine", "mixed") else recipe.kind != "chirp"
