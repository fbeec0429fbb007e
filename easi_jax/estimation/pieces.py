"""From runs to the pieces that an estimate is made of."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from easi_jax.data.activations import activation_guess
from easi_jax.data.cleaning import _STEPS_AGREE, trusted_velocities, velocities
from easi_jax.data.law_states import law_states, times
from easi_jax.data.recording import Run
from easi_jax.data.segments import Segments, cut, join, windows
from easi_jax.data.sensor_channels import NO_SENSORS, Sensors
from easi_jax.errors import UserError
from easi_jax.simulation.open_loop import motion
from easi_jax.simulation.simulator import Simulator

_STEPS = 25  # control steps of a piece in the finish
_WIDE_SECONDS = 0.25  # of a piece there for larger robots, whose motion is stiffer
_WIDE_PIECES = 64  # and how many of them
_REST = 10  # times as many that the finish ends on
FLOOR = 1e-3  # of the motion: what a model is never trusted to be better than


def visible_steps(
    runs: Sequence[Run], noise: np.ndarray, most: int, ratio: float
) -> int:
    """Fewest steps over which motion stands out of the noise, at most ``most``.

    RMS change of every measured position and velocity, at least ``ratio``
    times its noise ``(2 nv,)``: in shorter pieces a search would see mostly noise.
    """
    trusted = trusted_velocities(runs)
    states = [(run, velocities(run, trusted)) for run in runs]
    known = np.isfinite(noise)
    for steps in range(1, most):
        square, rows = np.zeros(len(noise)), 0
        for run, qvel in states:
            if len(run) <= steps:
                continue
            moved = run.configuration.difference(run.qpos[:-steps], run.qpos[steps:])
            change = np.concatenate([moved, qvel[steps:] - qvel[:-steps]], 1)
            square += (change**2).sum(0)
            rows += len(change)
        rms = np.sqrt(square / max(rows, 1))
        if np.all(rms[known] >= ratio * noise[known]):
            return steps
    return most


def segments_from_runs(
    simulator: Simulator,
    runs: Sequence[Run],
    horizon: int,
    every: int,
    trusted: np.ndarray | None = None,
    sensors: Sensors = NO_SENSORS,
) -> Segments:
    """Segments of ``horizon`` control steps, none across two runs.

    Args:
        simulator: its control step is that of the runs.
        every: steps from one start to the next.
        trusted: measured velocities that are taken, ``(nv,)`` bool; all others follow
            from the positions. `easi_jax.data.cleaning.trusted_velocities` where None.
        sensors: whose readings they have.

    Raises:
        UserError: no run is longer than ``horizon`` steps.
        ValueError: a run of another control step.
    """
    parts = []
    whole = all(sensors.known(run).all() for run in runs)
    trusted = trusted_velocities(runs) if trusted is None else trusted
    for run in runs:
        if abs(run.dt / simulator.dt - 1) > _STEPS_AGREE:
            raise ValueError(f"{run.name}: control step {run.dt}, not {simulator.dt}")
        qvel = velocities(run, trusted)
        act = activation_guess(simulator.mj_model, run)
        given = run.qpos, qvel, run.ctrl, horizon, every, simulator.past_steps
        known = None if whole else _in_steps(sensors, 1.0 * sensors.known(run))
        more = act, run.before, _in_steps(sensors, sensors.readings(run)), known
        timed = None
        if simulator.is_timed:
            timed = times(run), law_states(simulator.mj_model, run)
        parts.append(cut(*given, *more, timed))
    found = [p for p in parts if p is not None]
    if not found:
        longest = max(runs, key=len)
        raise UserError(
            f"no run is longer than {horizon} steps ({horizon * simulator.dt:g} s); "
            f"the longest, {longest.name}, has {len(longest)} rows: record more, or "
            "shorten --horizon"
        )
    return join(found)


def _in_steps(sensors: Sensors, read: np.ndarray) -> np.ndarray:
    """Of rows ``(T, N)`` what belongs to each step, ``(T - 1, N)``."""
    return np.where(sensors.at_end, read[1:], read[:-1])


def finish_pieces(
    simulator: Simulator,
    trajectories: Segments,
    steps: int | None = None,
    most: int | None = None,
) -> Segments:
    """Pieces for the least-squares finish, from trajectories ``(B, T, 1, ...)``.

    Args:
        steps: control steps of a piece, cut to those of a trajectory; not given: 25,
            or a quarter of a second for larger robots.
        most: pieces at most; not given: as `few` has it.
    """
    usual = _usual(simulator) if simulator.wide else _STEPS
    steps = max(1, min(steps or usual, trajectories.weight.shape[1]))
    found = windows(trajectories, steps, steps + 1, simulator.past_steps)
    if most is None:
        return few(simulator, found)
    return found.spread(most) if most < found.count else found


def few(simulator: Simulator, pieces: Segments, count: int = _WIDE_PIECES) -> Segments:
    """Some of ``pieces``, with which the many trials of a fit do not take hours: all,
    or of a larger robot's as many control steps as ``count`` of a quarter of a second
    have."""
    most = max(1, count * _usual(simulator) // pieces.horizon)
    return pieces.spread(most) if simulator.wide and most < pieces.count else pieces


def _usual(simulator: Simulator) -> int:
    """Control steps of a larger robot's piece."""
    return max(1, round(_WIDE_SECONDS / simulator.dt))


def finish_rest(
    simulator: Simulator,
    trajectories: Segments,
    noisy: bool,
    steps: int | None = None,
    most: int | None = None,
) -> Segments | None:
    """What the finish ends on (`estimate`): ten times as much as `finish_pieces` gives
    of a larger robot's recording. None for clean data, where ``most`` is given, and
    where there is no more."""
    if not (noisy and simulator.wide) or most is not None:
        return None
    part = finish_pieces(simulator, trajectories, steps)
    most = _REST * part.count
    whole = finish_pieces(simulator, trajectories, steps, most)
    return whole if whole.count > part.count else None


def effective_noise(
    simulator: Simulator, segments: Segments, noise: jax.Array
) -> jax.Array:
    """Noise ``(2 nv,)``, and of sensors, not below a thousandth of the motion's RMS per
    channel."""
    moved = motion(simulator, segments)
    w = segments.weight[:, None, None]
    square = (moved**2 * w).sum((0, 1)) / jnp.maximum(w.sum() * moved.shape[1], 1.0)
    return jnp.maximum(noise, jnp.maximum(FLOOR * jnp.sqrt(square), 1e-9))
