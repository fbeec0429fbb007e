"""The gap: open-loop prediction error in units of the motion, and its noise floor."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import mujoco
import numpy as np

from easi_jax.data.recording import Run
from easi_jax.data.sensor_channels import NO_SENSORS, Sensors
from easi_jax.gap.decisions import DECIDE
from easi_jax.model.joint_space import (
    FREE_WIDTH,
    dofs,
    is_hinge,
    joint_name,
    tangent_names,
    tangent_units,
    widths,
)
from easi_jax.model.results import UNMEASURED

_DRAWS = 2000


@dataclass(frozen=True)
class Channels:
    """Positions and readings of sensors that are compared, c of them.

    Attributes:
        names: of each degree of freedom, then of each number of a sensor.
        joints: the joint that each belongs to, or ``sensor.NAME``.
        units: SI.
        scale: errors are divided by it; infinite where left out, ``(c,)``.
        ignored: reason for each that is left out.
        still: what the scale of a channel that moves too little would be, ``(c,)``.
        change: RMS of what is measured over a horizon, ``(c,)``.
    """

    names: tuple[str, ...]
    joints: tuple[str, ...]
    units: tuple[str, ...]
    scale: np.ndarray
    ignored: dict[str, str]
    still: np.ndarray = field(default_factory=lambda: np.zeros(0))
    change: np.ndarray = field(default_factory=lambda: np.zeros(0))


def channels(
    m: mujoco.MjModel,
    runs: Sequence[Run],
    noise: np.ndarray,
    steps: int,
    sensors: Sensors = NO_SENSORS,
) -> Channels:
    """What the gap of these runs is made of.

    ``noise (c,)`` is of all channels. A channel's scale is its standard deviation over
    all rows, or for one without bounds (a free base's x and y, a hinge that turns on)
    the RMS of its change over ``steps`` control steps.
    """
    parts, changes = [], []
    for run in runs:
        origin = np.broadcast_to(runs[0].qpos[0], run.qpos.shape)
        difference, read = run.configuration.difference, sensors.readings(run)
        parts.append(np.c_[difference(origin, run.qpos), sensors.read(run)])
        if len(run) > steps:
            moved = difference(run.qpos[:-steps], run.qpos[steps:])
            changes.append(np.c_[moved, read[steps:] - read[:-steps]])
    everything = np.concatenate(parts)
    change = np.sqrt(np.mean(np.concatenate(changes) ** 2, 0))
    spread = np.nanstd(everything, 0)
    names = [*tangent_names(m), *(n.channel for n in sensors)]
    joints = [joint_name(m, j) for j in m.dof_jntid]
    joints += [f"sensor.{n.sensor}" for n in sensors]
    units = [*tangent_units(m), *(n.unit for n in sensors)]
    unbounded = np.zeros(len(names), bool)
    for j in range(m.njnt):
        if is_hinge(m, j) and not m.jnt_limited[j]:
            d = int(m.jnt_dofadr[j])
            unbounded[d] = np.ptp(everything[:, d]) > 2 * np.pi
        elif widths(m, j)[0] == FREE_WIDTH:
            unbounded[list(dofs(m, j)[:2])] = True
    scale = np.where(unbounded, change, spread)
    quiet = change < DECIDE.visible * noise
    ignored = {
        names[d]: UNMEASURED
        if np.isinf(noise[d])
        else (
            f"moves by {_size(change[d], units[d])} over a horizon, less than "
            f"{DECIDE.visible:g} times its noise of {_size(noise[d], units[d])}"
        )
        for d in np.flatnonzero(quiet).tolist()
    }
    still = np.maximum(scale, noise)
    scale = np.where(quiet | (scale <= 0), np.inf, scale)
    known = tuple(names), tuple(joints), tuple(units), scale, ignored
    return Channels(*known, still, change)


def _size(x: float, unit: str) -> str:
    return f"{x:.2g} {unit}".rstrip()


def with_moving(found: Channels, moved: np.ndarray, noise: np.ndarray) -> Channels:
    """The channels with those of no motion in the log that move in the model: a stuck
    joint is not left out; nor is one that was left out for a noise that is less.

    Args:
        moved: predicted changes over a horizon, ``(W, c)``; NaN where there was no
            reading.
        noise: of readings, ``(c,)``; infinite where not measured.
    """
    each = [np.abs(m[np.isfinite(m)]) for m in moved.T]
    usual = np.array([np.median(m) if len(m) else 0.0 for m in each])
    size = np.maximum(usual, found.change)
    stuck = (
        ~np.isfinite(found.scale) & np.isfinite(noise) & (size > DECIDE.visible * noise)
    )
    if not stuck.any():
        return found
    names = {found.names[d] for d in np.flatnonzero(stuck).tolist()}
    ignored = {k: v for k, v in found.ignored.items() if k not in names}
    scale = np.where(stuck, found.still, found.scale)
    return replace(found, scale=scale, ignored=ignored)


def gap(square: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """The gap from mean squares ``(..., c)`` of each channel."""
    used = np.isfinite(scale)
    return np.sqrt(np.mean(square[..., used] / scale[used] ** 2, -1))


def squares(errors: np.ndarray) -> np.ndarray:
    """Mean squares of each window and channel, ``(W, c)``, of ``(W, H, c)``."""
    return np.mean(errors.astype(np.float64) ** 2, 1)


def finite(errors: np.ndarray, largest: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Errors in which a window whose prediction is not finite counts as the largest
    motion, and which windows those are.

    Args:
        errors: ``(..., W, H, c)``.
        largest: motion seen in a window, ``(c,)``; more are left out.

    Returns:
        Errors of the same shape, and ``(..., W)`` bool.
    """
    lost = np.asarray(~np.isfinite(errors).all((-2, -1)))
    if lost.any():
        most = np.asarray(largest, errors.dtype)[: errors.shape[-1]]
        errors = np.where(lost[..., None, None], most, errors)
    return errors, lost


def odd_runs(
    square: np.ndarray, scale: np.ndarray, run: np.ndarray, floor: float
) -> dict[int, float]:
    """Runs whose windows are predicted far worse than those of the other runs.

    Of two runs it is the one that the other's model does not predict: whichever is odd,
    the model follows the other one down to its noise, and misses this one by far.

    Args:
        square: mean squares of each window, ``(W, c)``.
        run: which run each window is of, ``(W,)``.
        floor: gap of a perfect model.

    Returns:
        For each such run its median error over that of the others.
    """
    error = gap(square, scale)
    typical = {int(r): float(np.median(error[run == r])) for r in np.unique(run)}
    out = {}
    for r, mine in typical.items():
        rest = [x for k, x in typical.items() if k != r]
        others = float(np.median(rest)) if rest else np.inf
        least = others
        if len(rest) == 1:
            if others >= DECIDE.followed * floor:
                continue
            least = DECIDE.followed * max(others, floor)
        if mine > DECIDE.odd_run * least:
            out[r] = mine / max(others, 1e-30)
    return out


def resampled(count: int, seed: int) -> np.ndarray:
    """Bootstrap weights of windows, ``(draws, W)``; neighbors overlap, so in pairs."""
    rng = np.random.default_rng(seed)
    pairs = -(-count // 2)
    picks = rng.integers(0, pairs, (_DRAWS, pairs))
    out = np.zeros((_DRAWS, 2 * pairs))
    for k in range(2):
        np.add.at(out, (np.arange(_DRAWS)[:, None], 2 * picks + k), 1.0)
    return out[:, :count] / np.maximum(out[:, :count].sum(1, keepdims=True), 1.0)


def interval(
    square: np.ndarray, scale: np.ndarray, seed: int = 0
) -> tuple[float, float]:
    """95 % interval of the gap of windows with mean squares ``(W, c)``."""
    drawn = gap(resampled(len(square), seed) @ square, scale)
    low, high = np.quantile(drawn, (0.025, 0.975))
    return float(low), float(high)
