"""Recordings that lead elsewhere than the others do."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import jax.numpy as jnp
import numpy as np

from easi_jax.data.cleaning import trusted_velocities
from easi_jax.data.recording import Run
from easi_jax.data.segments import Segments, to_device
from easi_jax.data.sensor_channels import Sensors
from easi_jax.estimation.identifiability import identifiability
from easi_jax.estimation.least_squares import raised_to_range
from easi_jax.estimation.pieces import segments_from_runs
from easi_jax.estimation.posterior import Estimate, diverged, widened
from easi_jax.model.parameters import ParameterSpace
from easi_jax.simulation.simulator import Simulator

_COMPARED = 8  # runs at most that are fitted by themselves, and as many held-out ones
_FAR, _DIFFERENT = 5.0, 0.1  # standard deviations, and log ratio, that contradict


@dataclass(frozen=True)
class Recording:
    """Pieces of one recording, for a fit to them and nothing else.

    Attributes:
        name: of the recording.
        pieces: those that count, among others of no weight.
        held: whether it was held out of the fit that it is compared with.
    """

    name: str
    pieces: Segments
    held: bool = False


def compared(
    whole: Segments,
    owner: np.ndarray,
    weight: np.ndarray,
    apart: Sequence[Recording],
    few: bool,
) -> Iterator[Recording]:
    """Recordings that can contradict others, as many pieces of each.

    Args:
        whole: the pieces of the fit, ``M``; ``owner (M,)`` whose they are, and
            ``weight (M,)`` how well they fit.
        apart: held-out recordings (`held_apart`).
        few: no more pieces than the largest of them has; else as many as ``whole``.
    """
    names = worst(owner, weight)
    if len(names) == 1:  # it is the fit
        names = []
    sizes = [int((owner == name).sum()) for name in names]
    sizes += [r.pieces.count for r in apart]
    most = min(max(sizes, default=0), whole.count) if few else whole.count
    for name in names:
        mine = np.asarray(whole.weight * weight) * (owner == name)
        if np.any(mine > 0):
            pieces = replace(whole, weight=jnp.asarray(mine))
            pieces = alone(pieces, owner == name, most) if few else pieces
            yield Recording(name, pieces)
    for r in apart:
        own = np.ones(r.pieces.count, bool)
        yield Recording(r.name, alone(r.pieces, own, most), held=True)


def held_apart(
    whole: Segments,
    simulator: Simulator,
    runs: tuple[Sequence[Run], Sequence[Run]],
    steps: int,
    every: int,
    sensors: Sensors,
) -> list[Recording]:
    """Held-out recordings of which no fit has a row, cut as the pieces ``whole`` are;
    without those that lack what all that were fitted have measured.

    Args:
        runs: to fit, and held out.
        steps, every, sensors: of `easi_jax.estimation.pieces.segments_from_runs`.
    """
    fit, held = runs
    fitted = {(run.source, run.recording) for run in fit}
    trusted, found = trusted_velocities(fit), []
    apart: dict[tuple[str, str], list[Run]] = {}
    for run in held:
        key = run.source, run.recording
        if key not in fitted and len(run) > steps:
            apart.setdefault(key, []).append(run)
    every_one = list(apart.values())
    for i in _evenly(len(every_one), _COMPARED):
        mine = every_one[i]
        if (trusted & ~trusted_velocities(mine)).any():
            continue
        if not all(n.sensor in run.sensors for n in sensors for run in mine):
            continue
        pieces = segments_from_runs(simulator, mine, steps, every, trusted, sensors)
        if isinstance(whole.read, tuple) != isinstance(pieces.read, tuple):
            if isinstance(whole.read, tuple):
                continue
            pieces = replace(pieces, read=np.ones_like(pieces.sensed))
        pieces = to_device(replace(pieces, weight=0.5 * pieces.weight))
        found.append(Recording(mine[0].recording, pieces, held=True))
    return found


def _evenly(count: int, most: int) -> list[int]:
    """Places of ``most`` of ``count`` things at most, at even distances."""
    return np.linspace(0, count - 1, min(count, most)).round().astype(int).tolist()


def worst(owner: np.ndarray, weight: np.ndarray) -> list[str]:
    """Recordings, in order: of many those whose pieces fit worst.

    Args:
        owner: recording of each piece, ``(M,)``.
        weight: of each piece by how well it fits, ``(M,)``.
    """
    names = list(dict.fromkeys(owner.tolist()))
    chosen = sorted(names, key=lambda n: weight[owner == n].mean())[:_COMPARED]
    return [n for n in names if n in chosen]


def alone(pieces: Segments, own: np.ndarray, count: int) -> Segments:
    """``count`` pieces: those that are ``own (M,)``, at even distances where there are
    more, then others of no weight."""
    first = np.flatnonzero(own)
    first = first[_evenly(len(first), count)]
    some = pieces.take(np.append(first, np.full(count - len(first), first[0])))
    return replace(some, weight=some.weight * (np.arange(count) < len(first)))


def contradictions(
    space: ParameterSpace,
    recordings: Iterable[Recording],
    found: Estimate,
    by_itself: Callable[[Recording], Estimate],
) -> list[str]:
    """A note on each recording that, fitted ``by_itself``, leads far from where all
    that were fitted lead, ``found``."""
    notes = []
    for recording in recordings:
        notes += contradiction(space, recording, by_itself(recording), found)
    return notes


def contradiction(
    space: ParameterSpace, recording: Recording, alone: Estimate, found: Estimate
) -> list[str]:
    """A note where the fit ``alone`` leads far from ``found``; none where it is none,
    or determines nothing."""
    if diverged(alone, space.names):
        return []
    known = identifiability(space, np.asarray(alone.hessian))
    fits = [np.asarray(raised_to_range(space, e.fit), float) for e in (alone, found)]
    off = (fits[0] - fits[1]) * known.scale
    std = known.std * float(widened(alone.excess))
    far = known.determined & (np.abs(off) > np.maximum(_FAR * std, _DIFFERENT))
    if not far.any():
        return []
    i = int(np.argmax(np.where(far, np.abs(off) / np.maximum(std, 1e-12), 0.0)))
    one, all_ = (float(space.to_si(e.fit)[i]) for e in (alone, found))
    others = "those that were fitted" if recording.held else "all together"
    return [
        f"{recording.name} contradicts the other runs: alone it says "
        f"{space.names[i]} {one:.3g} {space.units[i]}, {others} {all_:.3g} (something "
        "was changed between them, or it moves the robot in a way that shows what the "
        "model lacks)"
    ]
