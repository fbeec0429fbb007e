"""Whether measured velocities come later than the positions that they belong to."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import sqrt

import numpy as np

from easi_jax.recording import Run
from easi_jax.windows import fitted_velocity

_LONGEST = 0.1  # s
_LATE = 0.003  # s; less is the velocity fit's own doing
_ALIKE = 0.5  # share of the squared difference that the shift has to explain
PIECES = 10


@dataclass(frozen=True)
class Lag:
    """How late a measured velocity is.

    Attributes:
        seconds: of all data.
        std: standard error, from pieces of the data.
        confidence: share of the pieces that are late by themselves, one more of either
            kind counted (Laplace).
    """

    seconds: float
    std: float
    confidence: float


def velocity_lags(runs: Sequence[Run]) -> dict[int, Lag]:
    """Lag of each measured velocity (place in qvel) behind the positions.

    A filtered velocity is the derivative of the positions of some time ago. The lag is
    the shift at which both agree best; only where it explains most of the difference.
    """
    measured = [r for r in runs if r.qvel_measured]
    if not measured:
        return {}
    dt = measured[0].dt
    shifts = round(_LONGEST / dt) + 1
    found = {}
    for dof in range(measured[0].qvel.shape[1]):
        costs = _costs(measured, dof, shifts)
        lag = shift_of(costs.sum(0), dt)
        if lag is not None:
            found[dof] = Lag(lag, *alike([shift_of(c, dt) for c in costs], dt))
    return found


def alike(alone: Sequence[float | None], dt: float) -> tuple[float, float]:
    """Standard error and confidence of a lag, from those of single pieces."""
    late = [x for x in alone if x is not None]
    spread = float(np.std(late, ddof=1)) if len(late) > 1 else dt
    std = max(spread, 0.1 * dt) / sqrt(max(len(late), 1))
    return std, (len(late) + 1) / (len(alone) + 2)


def _costs(runs: Sequence[Run], dof: int, shifts: int) -> np.ndarray:
    """Squared differences by pieces of the data and shifts, ``(pieces, shifts)``."""
    rows = []
    for run in runs:
        fitted = fitted_velocity(run.qpos, run.dt, run.configuration)[:, dof]
        told = run.qvel[shifts:, dof]
        n = len(told)
        if n < shifts:
            continue
        rows.append(
            [(told - fitted[shifts - s : shifts - s + n]) ** 2 for s in range(shifts)]
        )
    if not rows:
        return np.zeros((1, shifts))
    pieces = np.array_split(np.concatenate(rows, 1), PIECES, axis=1)
    return np.array([p.sum(1) for p in pieces])


def shift_of(cost: np.ndarray, dt: float, least: float = 0.0) -> float | None:
    """The shift of least cost [s]; None where it is no better than none.

    Args:
        cost: squared differences by shift, ``(shifts,)``.
        least: what is no news [s].
    """
    best = int(np.argmin(cost))
    lag = float(best)
    if 0 < best < len(cost) - 1:
        a, b, c = cost[best - 1 : best + 2]
        lag += 0.5 * (a - c) / max(a - 2 * b + c, 1e-300)
    enough = lag * dt > max(_LATE, 0.5 * dt, least)
    return float(lag * dt) if enough and cost[best] < _ALIKE * cost[0] else None
