"""Which data are kept out of a fit."""

import math
from collections.abc import Sequence

import mujoco
import numpy as np

from easi_jax.data.cleaning import rows_of
from easi_jax.data.drive_forces import exertion
from easi_jax.data.recording import Run
from easi_jax.errors import UserError

HELD_OUT = 0.25  # of the rows, where whole runs are held out
LAST = 0.3  # of a single run
_REACHED = 99.8  # percentile
_FURTHER = 4.0  # times as bad as not as far: what fits never see cannot be found


def split_held_out(
    m: mujoco.MjModel, runs: Sequence[Run], gap_s: float
) -> tuple[list[Run], list[Run], str]:
    """Runs to fit, runs held out, and a sentence that says which.

    Of two runs or more, whole runs with a quarter of the rows, and hardly more, whose
    speeds and drive forces reach about as far as those of the runs left to fit, and
    rather less far than further; of equals the last. Of a single run its last 30 %
    behind a gap of ``gap_s`` seconds.

    Raises:
        UserError: a single run too short to be split.
    """
    if len(runs) == 1:
        run = runs[0]
        first = round((1 - LAST) * len(run))
        last = first - math.ceil(gap_s / run.dt)
        if last < 2 or len(run) - first < 2:
            raise UserError(
                f"{run.source}: {len(run)} rows are too few to hold some out behind a "
                f"gap of {gap_s:g} s: record more, or shorten --horizon"
            )
        return (
            [rows_of(run, 0, last)],
            [rows_of(run, first, len(run))],
            f"the last {100 * LAST:.0f} % of {run.name}",
        )
    total = sum(len(run) for run in runs)
    reach = np.array([_reach(m, run) for run in runs])

    def cost(held: set[int]) -> tuple[float, int]:
        rows = sum(len(runs[i]) for i in held)
        more = max(rows / total - HELD_OUT, 0.0)
        return round(_unlike(reach, held) + 2 * more, 2), -sum(held)

    sets = []
    for first in range(len(runs)):
        chosen = {first}
        while sum(len(runs[i]) for i in chosen) < HELD_OUT * total:
            left = [i for i in range(len(runs)) if i not in chosen]
            if len(left) == 1:
                break
            chosen.add(min(left, key=lambda i: cost({*chosen, i})))
        sets.append(chosen)
    chosen = min(sets, key=cost)
    held = [run for i, run in enumerate(runs) if i in chosen]
    return (
        [run for i, run in enumerate(runs) if i not in chosen],
        held,
        ", ".join(run.name for run in held),
    )


def _reach(m: mujoco.MjModel, run: Run) -> np.ndarray:
    """Largest drive forces and measured speeds but for two rows in 1,000."""
    measured = np.concatenate([np.ones(m.nu, bool), ~run.hidden])
    return np.percentile(exertion(m, run)[:, measured], _REACHED, axis=0)


def _unlike(reach: np.ndarray, held: set[int]) -> float:
    """How differently far the runs held out reach; where further, it counts more."""
    out = np.isin(np.arange(len(reach)), list(held))
    least = 1e-3 * reach.max(0) + 1e-12
    d = np.log((reach[out].max(0) + least) / (reach[~out].max(0) + least))
    return float(np.mean(np.where(d > 0, _FURTHER * d, -d)))
