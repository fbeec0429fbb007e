"""What several runs would say of every effect: simulated once, in one program."""

from collections.abc import Sequence

import mujoco
import numpy as np

from easi_jax.data.recording import Run
from easi_jax.data.windows import lead_rows, window_rows
from easi_jax.estimation.starts import Starts, known_noise
from easi_jax.excite.separation import Design
from easi_jax.gap import gap_metric as measure
from easi_jax.gap.batched_least_squares import Bounds
from easi_jax.gap.effect_vector import Layout
from easi_jax.gap.predictor import Predictor
from easi_jax.gap.table import Place
from easi_jax.gap.whitening import make_residuals
from easi_jax.gap.window_set import WindowSet, join, window_set
from easi_jax.gap.window_starts import window_starts
from easi_jax.model.effect_catalog import Scales
from easi_jax.model.parameters import ParameterSpace
from easi_jax.progress import Tell

_TOGETHER = 16  # vectors in one call, between two lines of progress
_FLOOR = 0.05  # of the error that the start velocity's own fit makes


def windows_of(
    m: mujoco.MjModel, runs: Sequence[Run], horizon: float, longest: float, most: int
) -> list[WindowSet]:
    """At most ``most`` windows of each run, at even distances.

    Args:
        horizon: length of a window [s].
        longest: delay that predictions have to allow for [s].

    Raises:
        ValueError: a run that is shorter than a window.
    """
    out = []
    for i, run in enumerate(runs):
        rows = window_rows(run, horizon, lead=lead_rows(run.dt))
        count = len(rows)
        pick = np.linspace(0, count - 1, min(most, count)).round().astype(int)
        found = window_set(m, [run], horizon, longest, i, rows=[rows[pick]])
        if found is None:
            raise ValueError(f"{run.name} is shorter than a window")
        out.append(found)
    return out


def make_design(
    predictor: Predictor,
    bounds: Bounds,
    found: Sequence[Place],
    truths: dict[str, np.ndarray] | None = None,
) -> Design:
    """A design of some effects about the model as given."""
    own = range(predictor.own)
    design = Design(predictor, bounds, predictor.neutral.copy(), list(own))
    for place in found:
        design.add(place, (truths or {}).get(place.key))
    return design


def products_of(
    m: mujoco.MjModel,
    design: Design,
    parts: Sequence[WindowSet],
    runs: Sequence[Run],
    noise: np.ndarray,
    scales: Scales,
    tell: Tell = lambda _: None,
) -> list[np.ndarray]:
    """Products of all signatures in each run, in units of noise, ``(P, P)`` each.

    Args:
        design: its predictor predicts all ``parts``, one after another.
        parts: windows of each run; ``run`` counts ``runs``.
        noise: of measured positions, ``(nv,)``.
        scales: how large motion is.
    """
    p = design.predictor
    windows, lead = join(list(parts)), lead_rows(runs[0].dt)
    starts = window_starts(m, p, runs, scales, known_noise(noise, scales.position))
    still = np.zeros((len(windows), p.size))
    moved, _ = starts.solve(design.base, still)
    groups: list[np.ndarray] = []
    for first in range(0, len(design.vectors), _TOGETHER):
        x = np.array(design.vectors[first : first + _TOGETHER])
        at = np.broadcast_to(moved, (len(x), *still.shape))
        groups.append(p.errors(x, None, at))
        tell(f"simulated {first + len(x)} of {len(design.vectors)} changes")
    errors = np.concatenate(groups)
    out, at = [], 0
    for part, run in zip(parts, runs, strict=True):
        here = slice(at, at + len(part))
        at += len(part)
        scale = measure.channels(m, [run], noise, p.steps - lead).scale
        found = np.zeros((len(design.pairs),) * 2)
        if np.isfinite(scale).any():
            found = _products(design, starts.part(here), lead, errors[:, here], scale)
            # Windows overlap by half, and not all were simulated.
            found *= len(run) / (p.steps - lead) / len(part)
        out.append(found)
    return out


def _products(
    design: Design, starts: Starts, lead: int, errors: np.ndarray, scale: np.ndarray
) -> np.ndarray:
    """Products of all signatures in some windows, in units of noise, ``(P, P)``."""
    first, _ = measure.finite(errors[0], design.predictor.largest)
    rms = np.sqrt(np.mean(first.astype(float) ** 2, (0, 1)))
    residuals = make_residuals(starts, lead, _FLOOR * rms, scale)
    # Differences first: they are small beside what single precision carries.
    a, b = (np.array(x) for x in zip(*design.pairs, strict=True))
    change = residuals.grouped(errors[a].astype(np.float64) - errors[b])
    flat = residuals.whitened(change).reshape(len(a), -1)
    flat = np.where(np.isfinite(flat), flat, 0.0)
    return flat @ flat.T


def make_predictor(
    m: mujoco.MjModel,
    space: ParameterSpace,
    found: Sequence[Place],
    parts: Sequence[WindowSet],
    dt: float,
) -> Predictor:
    """A predictor of all parts, one after another."""
    return Predictor(m, space, Layout(m, found), join(list(parts)), dt)
