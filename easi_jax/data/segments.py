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
        weight: ``(M,)``, 1 where the piece counts, 0 beyond an episode's end.
        past: commands before the start, oldest first, ``(M, D, nu)``; what comes before
            the first known command of a run or an episode is that command. () where no
            simulation has use for them.
        act: activations of the start, ``(M, na)``, of a log a guess; () where the model
            has none. Zero where they are left out.
        sensed: readings of N numbers of sensors where each step begins, or where it
            ends (`easi_jax.data.sensor_channels.SensorNumber.at_end`), ``(M, H, N)``;
            () where none are compared.
        read: which of these there are, 1 or 0, ``(M, H, N)``; () where all.
        time: of the start since that of its run or episode, ``(M,)`` [s]; () where no
            simulation has use for it.
        hidden: what laws remember there (`easi_jax.data.law_states`), ``(M, S)``;
            likewise.
        seen: what the controller saw and did, ``[s, a, s']`` of one step,
            ``(M, obs_size + action_size + obs_size)``; () where nobody asks for it.
    """

    qpos: Any
    qvel: Any
    ctrl: Any
    next_qpos: Any
    next_qvel: Any
    weight: Any
    past: Any = ()
    act: Any = ()
    sensed: Any = ()
    read: Any = ()
    time: Any = ()
    hidden: Any = ()
    seen: Any = ()

    @property
    def count(self) -> int:
        return int(self.qpos.shape[0])

    @property
    def horizon(self) -> int:
        return int(self.ctrl.shape[1])

    def take(self, index: Any) -> "Segments":
        """The segments at ``index`` (an array of integers or a slice)."""
        return jax.tree.map(lambda x: x[index], self)

    def spread(self, count: int) -> "Segments":
        """``count`` segments at even distances among those that count; jit-friendly.

        Where fewer count, all of them, and the others weigh nothing.
        """
        order = jnp.argsort(self.weight <= 0, stable=True)
        found = jnp.sum(self.weight > 0)
        each = jnp.arange(count)
        index = jnp.where(found >= count, each * found // count, each)
        return self.take(order[index])


def cut(
    qpos: np.ndarray,
    qvel: np.ndarray,
    ctrl: np.ndarray,
    horizon: int,
    every: int,
    past: int = 0,
    act: np.ndarray | None = None,
    before: np.ndarray | None = None,
    sensed: np.ndarray | None = None,
    read: np.ndarray | None = None,
    timed: tuple[np.ndarray, np.ndarray] | None = None,
) -> Segments | None:
    """Segments of one uninterrupted recording ``(T, ...)``, None if too short.

    Args:
        past: how many commands before each start they hold.
        act: activations at each row, ``(T, na)``.
        before: commands before the first row, ``(D, nu)``.
        sensed: what sensors read where the step of a row begins, or ends,
            ``(T - 1, N)``; ``read`` which of these there are, 1 or 0; all where None.
        timed: time of each row ``(T,)`` and what laws remember there ``(T, S)``, where
            the pieces hold them.
    """
    starts = np.arange(0, len(qpos) - horizon, every)
    if not len(starts):
        return None
    steps = starts[:, None] + np.arange(horizon)
    sent = ctrl if before is None else np.concatenate([before, ctrl])
    earlier = len(sent) - len(ctrl) + starts[:, None] + np.arange(-past, 0)
    return Segments(
        qpos=qpos[starts],
        qvel=qvel[starts],
        ctrl=ctrl[steps],
        next_qpos=qpos[steps + 1],
        next_qvel=qvel[steps + 1],
        weight=np.ones(len(starts)),
        past=sent[np.maximum(earlier, 0)] if past else (),
        act=act[starts] if act is not None and act.shape[1] else (),
        sensed=sensed[steps] if sensed is not None and sensed.shape[1] else (),
        read=read[steps] if read is not None else (),
        time=timed[0][starts] if timed is not None else (),
        hidden=timed[1][starts] if timed is not None else (),
    )


def join(parts: list[Segments]) -> Segments:
    """All segments of ``parts`` (one horizon) as one."""
    return jax.tree.map(lambda *x: np.concatenate(x), *parts)


def windows(
    trajectories: Segments, horizon: int, every: int, past: int = 0
) -> Segments:
    """Pieces of ``horizon`` steps from trajectories of single steps; jit-friendly.

    Args:
        trajectories: leaves ``(B, T, 1, ...)``, weights ``(B, T)``, as from
            `rollout.collect`.
        past: how many commands before each start the pieces hold, where the
            trajectories hold none before each step.

    Returns:
        Segments with leaves ``(B * starts, ...)``; a piece counts where all its
        steps do.
    """
    t = trajectories
    steps = t.weight.shape[1]
    starts = np.arange(0, steps - horizon + 1, every)
    rows = starts[:, None] + np.arange(horizon)

    def flat(x: jax.Array) -> jax.Array:
        return x.reshape(-1, *x.shape[2:])

    before = jax.tree.map(lambda x: x[:, starts], t.past)
    if past and not jax.tree.leaves(before):
        earlier = np.maximum(starts[:, None] + np.arange(-past, 0), 0)
        before = t.ctrl[:, earlier, 0]
    return Segments(
        qpos=flat(t.qpos[:, starts]),
        qvel=flat(t.qvel[:, starts]),
        ctrl=flat(t.ctrl[:, rows, 0]),
        next_qpos=flat(t.next_qpos[:, rows, 0]),
        next_qvel=flat(t.next_qvel[:, rows, 0]),
        weight=flat(t.weight[:, rows].min(-1)),
        past=jax.tree.map(flat, before),
        act=jax.tree.map(lambda x: flat(x[:, starts]), t.act),
        time=jax.tree.map(lambda x: flat(x[:, starts]), t.time),
        hidden=jax.tree.map(lambda x: flat(x[:, starts]), t.hidden),
        seen=jax.tree.map(lambda x: flat(x[:, starts]), t.seen),
    )


def to_device(segments: Segments) -> Segments:
    """As jax arrays in the default float type."""
    return jax.tree.map(lambda x: jnp.asarray(x, jnp.result_type(float)), segments)
