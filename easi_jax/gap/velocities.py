"""Whether measured velocities come later than the positions that they belong to."""

from collections.abc import Sequence

import numpy as np

from easi_jax.recording import Run
from easi_jax.windows import fitted_velocity

_LONGEST = 0.1  # s
_LATE = 0.003  # s; less is the velocity fit's own doing
_ALIKE = 0.5  # share of the squared difference that the shift has to explain


def velocity_lags(runs: Sequence[Run]) -> dict[int, float]:
    """Lag [s] of each measured velocity (place in qvel) behind the positions.

    A filtered velocity is the derivative of the positions of some time ago. The lag is
    the shift at which both agree best; only where it explains most of the difference.
    """
    measured = [r for r in runs if r.qvel_measured]
    if not measured:
        return {}
    dt = measured[0].dt
    found = {}
    shifts = np.arange(round(_LONGEST / dt) + 1)
    for dof in range(measured[0].qvel.shape[1]):
        cost = np.zeros(len(shifts))
        for run in measured:
            fitted = fitted_velocity(run.qpos, run.dt, run.configuration)[:, dof]
            told = run.qvel[:, dof]
            n = len(told) - len(shifts)
            if n < len(shifts):
                continue
            for i, s in enumerate(shifts):
                cost[i] += np.sum(
                    (told[len(shifts) :] - fitted[len(shifts) - s : -s or None][:n])
                    ** 2
                )
        best = int(np.argmin(cost))
        if 0 < best < len(shifts) - 1:
            a, b, c = cost[best - 1 : best + 2]
            lag = (best + 0.5 * (a - c) / max(a - 2 * b + c, 1e-300)) * dt
        else:
            lag = best * dt
        if lag > max(_LATE, 0.5 * dt) and cost[best] < _ALIKE * cost[0]:
            found[dof] = float(lag)
    return found
