"""Measured velocities that come late, or from a filter, set right by the positions.

A drive's velocity is often the derivative of its encoder some milliseconds ago, or
behind a first-order filter. How much so shows beside the positions: their steps,
delayed or filtered likewise, are what was read.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import mujoco
import numpy as np
from scipy.optimize import minimize_scalar
from scipy.signal import lfilter

from easi_jax.data.cleaning import rows_of, trusted_velocities
from easi_jax.data.recording import Run

_LONGEST = 0.1  # s, of a delay or a time constant
_GRID = 40  # of them that are looked at, before the best is refined
_SETTLES = 5.0  # time constants of a run, until a filter has forgotten its start
_MEAN = 0.01  # s, over which velocities are compared
_EXPLAINS = 0.8  # share of the squared difference that is left, at most
_CERTAIN = 0.5  # of it with as long an advance, that a delay leaves at most
# Time constants to either side of a row, that slopes are taken over: short ones bend
# least, and half of one makes 1.7 times the noise of it.
_REACHES = 0.0, 0.5
_FEWEST = 30  # rows of a run that say something of it

# Of each run, steps of the positions as velocities ``(T - 1,)`` [m/s, rad/s] and what
# was read between the same rows.
_Parts = Sequence[tuple[np.ndarray, np.ndarray]]
# Such steps, a time [s] and the control step [s] to what would be read.
_Seen = Callable[[np.ndarray, float, float], np.ndarray]


def set_right(
    given: Sequence[Run], names: Sequence[str], simulated: float = 0.0
) -> tuple[list[Run], list[str], np.ndarray]:
    """Runs whose late or filtered velocities are as if they were neither.

    Only where that explains some of how they differ from the steps of the positions,
    and they are to be trusted afterwards (`easi_jax.data.cleaning.trusted_velocities`).

    Args:
        names: of all degrees of freedom, ``(nv,)``.
        simulated: how late velocities of the model are beside its own positions [s];
            so late they are to be (`of_model`).

    Returns:
        The runs, a note for each degree of freedom that was changed, and which these
        are, ``(nv,)`` bool.
    """
    runs, changed = list(given), np.zeros(len(names), bool)
    if not all(run.qvel_measured for run in runs):
        return runs, [], changed
    notes, seen = [], ~np.any([run.hidden for run in runs], 0)
    dt, each = runs[0].dt, [_steps(run) for run in runs if len(run) > _FEWEST]
    for d in np.flatnonzero(seen).tolist() if each else []:
        tried = []
        parts = [(moved[:, d], read[:, d]) for moved, read in each]
        for way in (_delayed, _filtered):
            share, late = _best(parts, dt, way, simulated)
            seconds = late - simulated if way is _delayed else late
            if share > _EXPLAINS or seconds <= simulated:
                continue
            for reach in _REACHES if way is _filtered else _REACHES[:1]:
                right = [_undone(run, d, seconds, way, reach) for run in runs]
                # With the noise that undoing makes more of.
                left = [_steps(run) for run in right if len(run) > _FEWEST]
                left = [(moved[:, d], read[:, d]) for moved, read in left]
                off = _off(left, dt, _delayed, simulated).sum() if left else np.inf
                tried.append((off, seconds, way, right))
        for _, seconds, way, right in sorted(tried, key=lambda t: t[0]):
            if trusted_velocities(right)[d]:
                runs, changed[d] = right, True
                kind = "late by" if way is _delayed else "filtered, time constant"
                notes.append(
                    f"velocity of {names[d]}: {kind} {1000 * seconds:.3g} ms, by the "
                    "positions beside it; that is taken out"
                )
                break
    return runs, notes, changed


def of_model(m: mujoco.MjModel) -> float:
    """How late velocities of a simulation are beside its positions [s]: half a physics
    step, since all of MuJoCo's integrators but one move with the new velocity."""
    rk4 = int(mujoco.mjtIntegrator.mjINT_RK4)
    return 0.0 if m.opt.integrator == rk4 else 0.5 * float(m.opt.timestep)


def _delayed(moved: np.ndarray, seconds: float, dt: float) -> np.ndarray:
    row = np.arange(len(moved))
    return np.interp(row - seconds / dt, row, moved)


def _filtered(moved: np.ndarray, seconds: float, dt: float) -> np.ndarray:
    """At either end of each step, and of these the mean."""
    keeps = np.exp(-dt / max(seconds, 1e-9))
    after, _ = lfilter([1.0 - keeps], [1.0, -keeps], moved, zi=[keeps * moved[0]])
    return 0.5 * (after + np.concatenate([moved[:1], after[:-1]]))


def _steps(run: Run) -> tuple[np.ndarray, np.ndarray]:
    """Velocities by the steps of the positions, and as read on either side of each,
    ``(T - 1, nv)``."""
    moved = run.configuration.difference(run.qpos[:-1], run.qpos[1:]) / run.dt
    return moved, 0.5 * (run.qvel[:-1] + run.qvel[1:])


def _best(
    parts: _Parts, dt: float, way: _Seen, simulated: float
) -> tuple[float, float]:
    """How much the best time leaves of the mean square of velocities less steps of the
    positions, beside none and one that is ``simulated``, and that time [s]. Infinite
    where a run is the worse for it, or an advance would do as well: shifts by parts of
    a row smooth the noise."""

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
    ahead = rows @ _off(parts, dt, _delayed, -best)
    if (here > now).any() or rows @ here > _CERTAIN * ahead:
        return np.inf, best
    return float(rows @ here / max(rows @ now, 1e-300)), best


def _off(parts: _Parts, dt: float, way: _Seen, seconds: float) -> np.ndarray:
    """Mean squares of velocities less steps of the positions as they would be read, of
    each run."""
    over, out = max(1, round(_MEAN / dt)), []
    shortest = min(len(moved) for moved, _ in parts)
    first = min(round(_SETTLES * _LONGEST / dt), max(0, shortest - over - _FEWEST))
    for moved, read in parts:
        off = (read - way(moved, seconds, dt))[first:]
        # Noise of single steps is as large as motion at a fast rate.
        some = np.full(min(over, len(off)), 1.0 / over)
        out.append(np.mean(np.convolve(off, some, "valid") ** 2))
    return np.array(out)


def _undone(run: Run, d: int, seconds: float, way: _Seen, reach: float) -> Run:
    """A run with one velocity read as much earlier, without the last rows, of which
    nothing was read later; or unfiltered, by slopes over ``reach`` time constants to
    either side, a row at least."""
    read, qvel, row = run.qvel[:, d], run.qvel.copy(), np.arange(len(run))
    if way is _filtered:
        rows = max(1, round(reach * seconds / run.dt))
        low, high = np.maximum(row - rows, 0), np.minimum(row + rows, row[-1])
        slope = (read[high] - read[low]) / ((high - low) * run.dt)
        qvel[:, d] = read + seconds * slope
        return replace(run, qvel=qvel)
    at = row + seconds / run.dt
    qvel[:, d] = np.interp(at, row, read)
    return rows_of(replace(run, qvel=qvel), 0, int((at <= row[-1]).sum()))
