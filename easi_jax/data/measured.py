"""From logs as they were read to runs that are fitted and runs that are held out."""

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from easi_jax.data.cleaning import split_at_resets, to_common_step, without_odd_ends
from easi_jax.data.holdout import split_held_out
from easi_jax.data.noise import pooled_noise, without_held
from easi_jax.data.recording import Log, Run, check_run
from easi_jax.data.unmeasured import measured_alike

_FEW_ROWS = 30  # of a run say little of its noise


@dataclass(frozen=True, eq=False)
class MeasuredRuns:
    """Recordings of a machine at one control step.

    Attributes:
        recorded: those to fit, as they were recorded.
        noise: standard deviations of positions and velocities [m, rad, m/s, rad/s],
            ``(2 nv,)``; infinite where hidden, which is the same in all runs.
        fit, held: runs, cleaned.
        held_name: which data are held out.
        notes: what a user should know of the data, one line each.
    """

    recorded: tuple[Run, ...]
    noise: np.ndarray
    fit: list[Run]
    held: list[Run]
    held_name: str
    notes: list[str]


def measured_runs(
    mj_model: mujoco.MjModel, log: Log, held_out: Log | None, horizon: float
) -> MeasuredRuns:
    """Cleans runs and splits them.

    Args:
        mj_model: of the machine.
        log: to fit.
        held_out: kept out of every fit; None: a quarter of ``log``
            (`easi_jax.data.holdout.split_held_out`).
        horizon: of predictions [s].

    Raises:
        UserError: runs that do not fit the model; too few rows to hold some out.
    """
    everything = (*log.runs, *(held_out.runs if held_out else ()))
    for run in everything:
        check_run(run, mj_model)
    notes = [*log.notes, *(held_out.notes if held_out else ()), *_states(mj_model)]
    alike, unused = measured_alike(mj_model, everything)
    notes += unused
    alike, held = _without_held(alike)
    notes += held
    recorded, kept_out = alike[: len(log.runs)], alike[len(log.runs) :]
    # Before interpolation, which would smooth the noise.
    noise = pooled_noise(recorded)
    parts: list[Sequence[Run]] = []
    for given in (recorded, kept_out):
        cut, leaps = split_at_resets(given, noise)
        notes += leaps
        parts.append(cut)
    if parts[0] != recorded:
        # Bad readings have no part in the noise, where there are rows enough.
        noise = pooled_noise([r for r in parts[0] if len(r) > _FEW_ROWS] or recorded)
    runs, changed = to_common_step([*parts[0], *parts[1]])
    notes += changed
    runs, odd = without_odd_ends(runs, noise)
    notes += odd
    fit, held = runs[: len(parts[0])], runs[len(parts[0]) :]
    if held_out is None:
        fit, held, name = split_held_out(mj_model, fit, horizon)
    else:
        name = ", ".join(run.name for run in held)
    return MeasuredRuns(tuple(recorded), noise, fit, held, name, notes)


def _without_held(runs: Sequence[Run]) -> tuple[list[Run], list[str]]:
    """Runs whose slow sensors have readings where these are new, and a note."""
    out = [without_held(run) for run in runs]
    names = {
        name
        for run, before in zip(out, runs, strict=True)
        for name in run.sensors
        if run.sensors[name] is not before.sensors[name]
    }
    if not names:
        return out, []
    return out, [
        f"sensors that are slower than the rows and held between their readings: "
        f"{', '.join(sorted(names))}; only rows with a new reading count"
    ]


def _states(m: mujoco.MjModel) -> list[str]:
    """A note on drives whose state (activation) no log holds."""
    names = [m.actuator(a).name for a in range(m.nu) if m.actuator_actnum[a]]
    if not names:
        return []
    return [
        f"drives with a state of their own (activation): {', '.join(names)}; logs do "
        "not hold it, so it is unknown where a prediction begins"
    ]
