"""How a Go2 walks, read off its positions: rhythm, duty, phases, speed."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from envs.frames import matrix
from envs.go2 import FOOT, LEGS, TOUCH, feet_in_world

_SETTLE = 1.0  # s at the start of an episode, in which the robot sets off
_SHORTEST = 0.12  # s between touchdowns of one foot; sooner, it bounced


@dataclass(frozen=True)
class Gait:
    """A gait; NaN where a foot never steps.

    Attributes:
        rate: strides a second.
        duty: share of a stride that each foot stands, ``(4,)``.
        phase: of each foot's touchdown after that of FL, in strides, ``(4,)``.
        speed: forward [m/s].
        height: of the base [m].
    """

    rate: float
    duty: np.ndarray
    phase: np.ndarray
    speed: float
    height: float


def gait_of(qpos: np.ndarray, dt: float, settle: float = _SETTLE) -> Gait:
    """The gait of an episode ``(T, 19)`` at control steps of ``dt`` [s], its first
    ``settle`` seconds aside.

    Phases are circular means over the strides of FL.
    """
    qpos = qpos[round(settle / dt) :]
    feet = np.asarray(jax.vmap(feet_in_world)(jnp.asarray(qpos)))
    touching = feet[..., 2] < FOOT + TOUCH
    landed = [_touchdowns(touching[:, k], dt) for k in range(len(LEGS))]
    forward = np.asarray(jax.vmap(lambda q: matrix(q[3:7])[:, 0])(jnp.asarray(qpos)))
    moved = np.diff(qpos[:, :3], axis=0) / dt
    nothing = np.full(len(LEGS), np.nan)
    rate, phase = np.nan, nothing
    if all(len(times) >= 2 for times in landed):
        strides = [np.diff(times) for times in landed]
        rate = 1.0 / (dt * float(np.mean(np.concatenate(strides))))
        phase = np.array([_phase(landed[0], times) for times in landed])
    return Gait(
        rate=rate,
        duty=touching.mean(0),
        phase=phase,
        speed=float(np.sum(moved * forward[:-1], 1).mean()),
        height=float(qpos[:, 2].mean()),
    )


def mean_gait(gaits: list[Gait]) -> Gait:
    """The mean of several, phases around the circle; those without strides left out of
    rhythm and phases."""
    walking = [g for g in gaits if np.isfinite(g.rate)]
    nothing = np.full(len(LEGS), np.nan)
    turns = [np.exp(2j * np.pi * g.phase) for g in walking]
    return Gait(
        rate=float(np.mean([g.rate for g in walking])) if walking else np.nan,
        duty=np.mean([g.duty for g in gaits], 0),
        phase=np.angle(np.mean(turns, 0)) / (2 * np.pi) % 1.0 if walking else nothing,
        speed=float(np.mean([g.speed for g in gaits])),
        height=float(np.mean([g.height for g in gaits])),
    )


def phase_distance(first: np.ndarray, second: np.ndarray) -> float:
    """Largest difference of the phases of two gaits, in strides, around the circle."""
    return float(np.abs((first - second + 0.5) % 1.0 - 0.5).max())


def _touchdowns(touching: np.ndarray, dt: float) -> np.ndarray:
    """Rows in which a foot comes down."""
    rows = np.flatnonzero(touching[1:] & ~touching[:-1]) + 1
    kept: list[int] = []
    for row in rows:
        if not kept or (row - kept[-1]) * dt >= _SHORTEST:
            kept.append(int(row))
    return np.array(kept, int)


def _phase(first: np.ndarray, times: np.ndarray) -> float:
    """Mean phase of touchdowns inside the strides between those of the first foot."""
    at = np.searchsorted(first, times, side="right") - 1
    inside = (at >= 0) & (at < len(first) - 1)
    at, times = at[inside], times[inside]
    if not len(times):
        return np.nan
    share = (times - first[at]) / (first[at + 1] - first[at])
    return float(np.angle(np.mean(np.exp(2j * np.pi * share))) / (2 * np.pi) % 1.0)
