"""Measured velocities that are late, filtered or off, set right by the positions.

A drive's velocity is often the derivative of its encoder some milliseconds ago, or
behind a first-order filter. How much so shows beside the positions: their steps,
delayed or filtered likewise, are what was read. A constant offset (a gyroscope's, an
amplifier's) shows as well.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import mujoco
import numpy as np
from scipy.optimize import minimize_scalar
from scipy.signal import lfilter

from easi_jax.data.cleaning import rows_of, trusted_velocities
from easi_jax.data.recording import Run, physics_steps
from easi_jax.data.windows import fitted_velocity, start_rows

_LONGEST = 0.1  # s, of a delay or a time constant
_GRID = 40  # of them that are looked at, before the best is refined
_SETTLES = 5.0  # time constants of a run, until a filter has forgotten its start
_MEAN, _ROWS = 0.02, 5  # s and rows at least, over which velocities are compared
_EXPLAINS = 0.8  # share of the squared difference that is left, at most
_CERTAIN = 0.5  # of it the other way in time, that lateness leaves at most
# Time constants to either side of a row, that slopes are taken over: short ones bend
# least, and half of one makes 1.7 times the noise of it.
_REACHES = 0.0, 0.5
_FEWEST = 30  # rows of a run that say something of it
_BLOCKS = 10  # of all rows, whose means say how sure an offset is
_SURE = 4.0  # standard errors that an offset is at least
_MATTERS = 0.2  # of the noise of single readings: what a start would notice

# Of each run, steps of the positions as velocities ``(T - 1,)`` [m/s, rad/s] and what
# was read between the same rows.
_Parts = Sequence[tuple[np.ndarray, np.ndarray]]
# Such steps, a time [s] and the control step [s] to what would be read.
_Seen = Callable[[np.ndarray, float, float], np.ndarray]


@dataclass(frozen=True)
class SetRight:
    """Runs whose late, filtered or offset velocities are as if they were none of it.

    Attributes:
        runs: as many as were given.
        notes: one for each degree of freedom that was changed.
        noisier: how much more noise velocities have for it, 1 where nothing was
            changed, ``(nv,)``.
    """

    runs: list[Run]
    notes: list[str]
    noisier: np.ndarray


def set_right(
    given: Sequence[Run], names: Sequence[str], simulated: float = 0.0
) -> SetRight:
    """Sets velocities right that are off by a constant, come late, or from a filter.

    Lateness and filters only where they explain some of how velocities differ from the
    steps of the positions, and these are to be trusted afterwards
    (`easi_jax.data.cleaning.trusted_velocities`). The last rows of a run, of which
    nothing was read later, are left out.

    Args:
        names: of all degrees of freedom, ``(nv,)``.
        simulated: how late velocities of the model are beside its own positions [s];
            so late they are to be (`of_model`).
    """
    runs, noisier, notes = list(given), np.ones(len(names)), []
    each = [_steps(run) for run in runs if len(run) > _FEWEST]
    if not (each and all(run.qvel_measured for run in runs)):
        return SetRight(runs, notes, noisier)
    dt, latest = runs[0].dt, 0.0
    left, chosen = {}, {}
    seen = ~np.any([run.hidden for run in runs], 0)
    for d in np.flatnonzero(seen).tolist():
        parts = [(moved[:, d], read[:, d]) for moved, read in each]
        left[d] = _tried(runs, d, parts, simulated)
    # The best of each at once, then the next of those that are not to be trusted.
    while left := {d: found for d, found in left.items() if found}:
        right = runs
        for d, found in left.items():
            right = [found[0].undone(run, d) for run in right]
        trusted = trusted_velocities(_centered(right, seen, simulated)[0])
        chosen |= {d: found[0] for d, found in left.items() if trusted[d]}
        left = {d: found[1:] for d, found in left.items() if not trusted[d]}
    for d, found in sorted(chosen.items()):
        runs, noisier[d] = [found.undone(run, d) for run in runs], found.noisier(dt)
        late = found.way is _delayed
        latest = max(latest, found.seconds if late else 0.0)
        kind = "late by" if late else "filtered, time constant"
        notes.append(
            f"velocity of {names[d]}: {kind} {1000 * found.seconds:.3g} ms, by the "
            "positions beside it; that is taken out"
        )
    lost = math.ceil(latest / dt - 1e-9)
    runs = [
        rows_of(r, 0, len(r) - lost) if lost and len(r) > lost + _FEWEST else r
        for r in runs
    ]
    runs, offset = _centered(runs, seen, simulated)
    notes += [
        f"velocity of {names[d]}: off by {offset[d]:.3g}, by the positions beside it; "
        "that is taken out"
        for d in np.flatnonzero(offset).tolist()
    ]
    return SetRight(runs, notes, noisier)


def _centered(
    runs: list[Run], seen: np.ndarray, simulated: float
) -> tuple[list[Run], np.ndarray]:
    """Runs without what velocities read beyond the steps of the positions, which a
    simulation reads a little later, and that, ``(nv,)`` [m/s, rad/s]: 0 where blocks of
    the runs do not agree, or where it is small beside the noise or what such lateness
    makes."""
    each = [_steps(run) for run in runs if len(run) > _FEWEST]
    off = np.concatenate([read - moved for moved, read in each])
    total = sum(len(run) * run.dt for run in runs)
    pull = sum(np.abs(run.qvel[-1] - run.qvel[0]) for run in runs) / total
    means = np.array([part.mean(0) for part in np.array_split(off, _BLOCKS)])
    offset, error = means.mean(0), means.std(0, ddof=1) / math.sqrt(_BLOCKS)
    read = np.concatenate([read for _, read in each])
    noise = np.diff(read, 2, axis=0).std(0) / math.sqrt(6.0)  # of white noise
    least = np.maximum(_MATTERS * noise, 2.0 * simulated * pull)
    sure = np.abs(offset) > np.maximum(_SURE * error, least)
    offset = np.where(sure & seen, offset, 0.0)
    if offset.any():
        runs = [replace(run, qvel=run.qvel - offset) for run in runs]
    return runs, offset


def _tried(
    runs: Sequence[Run], d: int, parts: _Parts, simulated: float
) -> list["_Found"]:
    """What may have been done to a velocity; what leaves least once undone first."""
    dt, out = runs[0].dt, []
    for way in (_delayed, _filtered):
        share, late = _best(parts, dt, way, simulated)
        seconds = late - simulated if way is _delayed else late
        if share > _EXPLAINS or seconds <= simulated:
            continue
        for reach in _REACHES if way is _filtered else _REACHES[:1]:
            found = _Found(way, seconds, reach)
            right = [found.undone(run, d).qvel for run in runs if len(run) > _FEWEST]
            left = [
                (moved, _between(qvel[:, d]))
                for (moved, _), qvel in zip(parts, right, strict=True)
            ]
            # With the noise that undoing makes more of.
            out.append((float(_off(left, dt, _delayed, simulated).sum()), found))
    return [found for _, found in sorted(out, key=lambda t: t[0])]


@dataclass(frozen=True)
class _Found:
    """What was done to a velocity.

    Attributes:
        way: what it was; ``seconds`` how much.
        reach: time constants of a filter to either side of a row, that slopes are taken
            over.
    """

    way: _Seen
    seconds: float
    reach: float

    def _rows(self, dt: float) -> int:
        return max(1, round(self.reach * self.seconds / dt))

    def noisier(self, dt: float) -> float:
        """Noise once it is undone, over that before."""
        if self.way is _delayed:
            return 1.0
        return math.hypot(1.0, self.seconds / dt / self._rows(dt) / math.sqrt(2.0))

    def undone(self, run: Run, d: int) -> Run:
        """A run with one velocity as if nothing was done to it."""
        read, qvel, row = run.qvel[:, d], run.qvel.copy(), np.arange(len(run))
        if self.way is _filtered:
            rows = self._rows(run.dt)
            low, high = np.maximum(row - rows, 0), np.minimum(row + rows, row[-1])
            slope = (read[high] - read[low]) / (np.maximum(high - low, 1) * run.dt)
            qvel[:, d] = read + self.seconds * slope
            return replace(run, qvel=qvel)
        # The nearest reading, whose noise stays white; what it is off in time is made
        # up for by the positions, and where nothing was read they take its place.
        fitted = fitted_velocity(run.qpos, run.dt, run.configuration)[:, d]
        later = np.round(row + self.seconds / run.dt).astype(int)
        at = np.minimum(later, row[-1])
        then = np.interp(at - self.seconds / run.dt, row, fitted)
        qvel[:, d] = np.where(later <= row[-1], read[at] + fitted - then, fitted)
        return replace(run, qvel=qvel)


def noise_in_starts(
    m: mujoco.MjModel, runs: Sequence[Run], noise: np.ndarray
) -> np.ndarray:
    """Noise ``(nv,)`` of measured velocities [m/s, rad/s], as large as lets the rows of
    a start say no more than they know: all of them share `error_of_means`.

    Args:
        noise: of positions, then of velocities, ``(2 nv,)``.
    """
    dt = runs[0].dt
    rows = start_rows(dt)
    off = error_of_means(runs, noise, rows, of_model(m, dt))
    return np.hypot(noise[len(off) :], math.sqrt(rows) * off)


def error_of_means(
    runs: Sequence[Run], noise: np.ndarray, rows: int, simulated: float
) -> np.ndarray:
    """What measured velocities are off by over ``rows`` rows beyond noise, ``(nv,)``
    [m/s, rad/s]: of their means over so many rows, beside the way of the positions.

    The integral of the velocities is by the trapezoidal rule with Gregory's first
    correction; what is left of that rule's own error counts as theirs.

    Args:
        noise: of positions, then of velocities, ``(2 nv,)``.
        simulated: as for `set_right`.
    """
    nv, found = len(noise) // 2, []
    for run in runs:
        if len(run) < rows + 3:
            continue
        moved, read = _steps(run)
        moved = np.stack([_delayed(x, simulated, run.dt) for x in moved.T], 1)
        whole = np.cumsum(np.pad(read - moved, [(1, 0), (0, 0)]), 0)
        mean = (whole[rows - 1 :] - whole[: 1 - rows]) / (rows - 1)
        turn = np.gradient(run.qvel, axis=0) / 12.0
        mean -= (turn[rows - 1 :] - turn[: 1 - rows]) / (rows - 1)
        found.append(mean[1:-1])
    if not found:
        return np.full(nv, np.inf)
    # A shift by part of a row averages the readings at either end.
    part = simulated / runs[0].dt % 1.0
    made = 2.0 * ((1.0 - part) ** 2 + part**2)
    made = made * (noise[:nv] / (rows - 1) / runs[0].dt) ** 2
    made += noise[nv:] ** 2 / (rows - 1)
    square = np.mean(np.concatenate(found) ** 2, 0)
    return np.sqrt(np.maximum(square - made, 0.0))


def of_model(m: mujoco.MjModel, dt: float) -> float:
    """How late velocities of a simulation at a control step ``dt`` are beside its
    positions [s]: half a physics step, since all of MuJoCo's integrators but one move
    with the new velocity."""
    rk4 = int(mujoco.mjtIntegrator.mjINT_RK4)
    step = dt / physics_steps(dt, float(m.opt.timestep))
    return 0.0 if m.opt.integrator == rk4 else 0.5 * step


def _delayed(moved: np.ndarray, seconds: float, dt: float) -> np.ndarray:
    row = np.arange(len(moved))
    return np.interp(row - seconds / dt, row, moved)


def _filtered(moved: np.ndarray, seconds: float, dt: float) -> np.ndarray:
    """At either end of each step, and of these the mean; of a time below zero, by what
    comes instead of what was."""
    if seconds < 0.0:
        return _filtered(moved[::-1], -seconds, dt)[::-1]
    keeps = np.exp(-dt / max(seconds, 1e-9))
    after, _ = lfilter([1.0 - keeps], [1.0, -keeps], moved, zi=[keeps * moved[0]])
    return 0.5 * (after + np.concatenate([moved[:1], after[:-1]]))


def _steps(run: Run) -> tuple[np.ndarray, np.ndarray]:
    """Velocities by the steps of the positions, and as read on either side of each,
    ``(T - 1, nv)``."""
    moved = run.configuration.difference(run.qpos[:-1], run.qpos[1:]) / run.dt
    return moved, _between(run.qvel)


def _between(qvel: np.ndarray) -> np.ndarray:
    """Means of velocities on either side of each step, ``(T - 1, ...)``."""
    return 0.5 * (qvel[:-1] + qvel[1:])


def _best(
    parts: _Parts, dt: float, way: _Seen, simulated: float
) -> tuple[float, float]:
    """How much the best time leaves of the mean square of velocities less steps of the
    positions, beside none and one that is ``simulated``, and that time [s]. Infinite
    where a run is the worse for it, or as much the other way in time would do as well:
    filters, and shifts by parts of a row, smooth the noise of the steps."""

    def cost(seconds: float) -> float:
        return float(rows @ _off(parts, dt, way, seconds))

    rows = np.array([len(moved) for moved, _ in parts], float)
    grid = np.linspace(0.0, _LONGEST, _GRID + 1)
    k = int(np.argmin([cost(seconds) for seconds in grid]))
    edges = grid[max(k - 1, 0)], grid[min(k + 1, _GRID)]
    least: Any = minimize_scalar(cost, bounds=edges, method="bounded")
    best = float(least.x)
    here, *now = (
        _off(parts, dt, *x)
        for x in ((way, best), (_delayed, 0.0), (_delayed, simulated))
    )
    now = np.minimum(*now)
    # A delay beside that of a simulation, a filter beside none.
    middle = simulated if way is _delayed else 0.0
    ahead = rows @ _off(parts, dt, way, 2.0 * middle - best)
    if (here > now).any() or rows @ here > _CERTAIN * ahead:
        return np.inf, best
    return float(rows @ here / max(rows @ now, 1e-300)), best


def _off(parts: _Parts, dt: float, way: _Seen, seconds: float) -> np.ndarray:
    """Mean squares of velocities less steps of the positions as they would be read, of
    each run."""
    over, out = max(_ROWS, round(_MEAN / dt)), []
    shortest = min(len(moved) for moved, _ in parts)
    # A filter forgets where it began, at either end.
    first = round(_SETTLES * _LONGEST / dt)
    first = min(first, max(0, shortest - over - _FEWEST) // 2)
    for moved, read in parts:
        off = (read - way(moved, seconds, dt))[first : len(read) - first]
        # Noise of single steps is as large as motion at a fast rate. Without ends that
        # are sharp, or a shift by half a row would be the one that averages most of it.
        some = np.hanning(min(over, len(off)) + 2)[1:-1]
        out.append(np.mean(np.convolve(off, some / some.sum(), "valid") ** 2))
    return np.array(out)
