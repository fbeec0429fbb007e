"""Short pieces of measured motion: where they start, what was sent, what came."""

from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np


@flax.struct.dataclass
class Segments:
    """Pieces of ``H`` control steps each, none across a reset or a run's end.

    Attributes:
        qpos, qvel: measured start, ``(M, nq)``, ``(M, nv)``.
        ctrl: commands, ``(M, H, nu)``; row h is held from row h to h + 1.
        next_qpos, next_qvel: measured states after each step, ``(M, H, nq)``,
            ``(M, H, nv)``.
    """

    qpos: Any
    qvel: Any
    ctrl: Any
    next_qpos: Any
    next_qvel: Any

    @property
    def count(self) -> int:
        return int(self.qpos.shape[0])

    @property
    def horizon(self) -> int:
        return int(self.ctrl.shape[1])

    def take(self, index: Any) -> "Segments":
        """The segments at ``index`` (an array of integers or a slice)."""
        return jax.tree.map(lambda x: x[index], self)


def cut(
    qpos: np.ndarray,
    qvel: np.ndarray,
    ctrl: np.ndarray,
    horizon: int,
    every: int,
) -> Segments | None:
    """Segments of one uninterrupted recording ``(T, ...)``, None if too short."""
    starts = np.arange(0, len(qpos) - horizon, every)
    if not len(starts):
        return None
    steps = starts[:, None] + np.arange(horizon)
    return Segments(
        qpos=qpos[starts],
        qvel=qvel[starts],
        ctrl=ctrl[steps],
        next_qpos=qpos[steps + 1],
        next_qvel=qvel[steps + 1],
    )


def join(parts: list[Segments]) -> Segments:
    """All segments of ``parts`` (one horizon) as one."""
    return jax.tree.map(lambda *x: np.concatenate(x), *parts)


def to_device(segments: Segments) -> Segments:
    """As jax arrays in the default float type."""
    return jax.tree.map(lambda x: jnp.asarray(x, jnp.result_type(float)), segments)
