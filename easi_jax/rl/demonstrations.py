"""What a policy is to imitate: windows of recorded motion, a few of them labelled."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from brax import math

from easi_jax.errors import UserError, nearest

LABELLED = ":"  # between the skill and the rest of a run's name
_FEWEST = 200  # windows; fewer hold next to no motion
_SAME_STEP = 0.01  # share that control steps may differ by
_LIVELY = 1e-5  # of an input's own size; what varies by less is rounding

Style = Callable[[jax.Array, jax.Array], jax.Array]


@dataclass(frozen=True, eq=False)
class Demonstrations:
    """Windows of motion that is imitated.

    Attributes:
        windows: what the discriminator sees of each, ``(N, features)``.
        labels: index of the skill of each in `skills`, -1 where it has no label,
            ``(N,)``.
        episodes: which recording each is of, ``(N,)``.
        skills: names of the skills that are labelled; may be empty.
        source: the file, for messages and records.
        digest: SHA-256 of the file; empty without one.
        notes: what a user should know of the reading, one line each.
    """

    windows: np.ndarray
    labels: np.ndarray
    episodes: np.ndarray
    skills: tuple[str, ...] = ()
    source: str = ""
    digest: str = ""
    notes: tuple[str, ...] = ()
    mean: np.ndarray = field(init=False)
    std: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        """Mean and standard deviation of each feature; 1 where it never varies."""
        std = self.windows.std(0)
        lively = std > _LIVELY * np.abs(self.windows).max(0, initial=0.0)
        object.__setattr__(self, "mean", self.windows.mean(0))
        object.__setattr__(self, "std", np.where(lively, std, 1.0))

    def scaled(self, windows: Any) -> Any:
        """Windows ``(..., features)`` in standard deviations of the demonstrations."""
        return (windows - self.mean) / self.std

    def labelled(self, share: float, seed: int = 0) -> "Demonstrations":
        """The same with labels on only ``share`` of the windows that have one, at
        least one of each skill.

        Raises:
            UserError: a share outside 0 and 1.
        """
        if not 0 <= share <= 1:
            raise UserError(f"labelled is {share}: give a share from 0 to 1")
        labels = np.full(len(self.labels), -1)
        rng = np.random.default_rng(seed)
        for skill in range(len(self.skills) if share else 0):
            own = np.flatnonzero(self.labels == skill)
            count = max(1, round(share * len(own)))
            labels[rng.choice(own, min(count, len(own)), replace=False)] = skill
        return replace(self, labels=labels)

    def some(self, count: int, seed: int = 0) -> "Demonstrations":
        """At most ``count`` of the windows, drawn at random."""
        if count >= len(self.windows):
            return self
        rng = np.random.default_rng(seed)
        kept = np.sort(rng.choice(len(self.windows), count, replace=False))
        return replace(
            self,
            windows=self.windows[kept],
            labels=self.labels[kept],
            episodes=self.episodes[kept],
        )

    def skill(self, name: str) -> int:
        """Index of a skill.

        Raises:
            UserError: no window has such a label.
        """
        if name not in self.skills:
            known = ", ".join(self.skills) or "none: no run is named SKILL:…"
            raise UserError(
                f'{self.source}: no demonstration is labelled "{name}" (labels: '
                f"{known}){nearest(name, self.skills)}"
            )
        return self.skills.index(name)


def style_of(env: Any) -> Style:
    """What of an environment's motion is imitated: its own ``style(qpos, qvel)``, or
    else all positions and speeds but where a free body is and heads."""
    own = getattr(env, "style", None)
    return own if own is not None else partial(_plain_style, _layout(env.mj_model))


def read_demonstrations(path: Path, env: Any, frames: int = 2) -> Demonstrations:
    """Demonstrations in a log (docs/your_own_robot.md) of the robot of ``env``.

    A run is an episode. Its label is what stands before the colon in its name, as in
    ``trot:12``. A run without a colon has none, nor has one whose name begins with a
    number, such as a time of day.

    Args:
        path: ``.csv``, ``.npz`` or ``.parquet``.
        env: with ``mj_model`` and ``dt``.
        frames: see `windows_of`.

    Raises:
        UserError: not a log of this robot or control step, or too little motion.
    """
    from easi_jax.io.files import digest_of
    from easi_jax.io.logs.columns import log_columns
    from easi_jax.io.logs.reader import read_logs
    from easi_jax.io.logs.tables import read_table

    there = read_table(path).columns
    lacks = [c for c in ("time", *log_columns(env.mj_model).qpos) if c not in there]
    if lacks:
        more = f" (and {len(lacks) - 1} more)" * (len(lacks) > 1)
        raise UserError(
            f"{path} has no column {lacks[0]}{more}: {env.name} is imitated where the "
            "position of every joint was measured, a base included (python -m "
            "train.import_logs makes logs of other tables)"
        )
    log = read_logs(path, env.mj_model)
    for run in log.runs:
        if abs(run.dt / env.dt - 1) > _SAME_STEP:
            raise UserError(
                f"{path}: {run.name} has a control step of {1e3 * run.dt:.4g} ms, "
                f"{env.name} one of {1e3 * env.dt:.4g} ms: record demonstrations at "
                f"{1 / env.dt:.4g} Hz"
            )
    named = [_label(run.name) for run in log.runs]
    skills = tuple(sorted({name for name in named if name}))
    found = demonstrations_of(
        env,
        [(r.qpos, r.qvel, r.ctrl) for r in log.runs],
        [skills.index(name) if name else -1 for name in named],
        skills,
        frames,
        str(path),
    )
    return replace(found, digest=digest_of(path), notes=log.notes)


def demonstrations_of(
    env: Any,
    episodes: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray]],
    labels: Sequence[int],
    skills: tuple[str, ...] = (),
    frames: int = 2,
    source: str = "demonstrations",
) -> Demonstrations:
    """Demonstrations of episodes.

    Args:
        env: the environment.
        episodes: positions, speeds and commands of each, ``(T, ...)``.
        labels: index of each one's skill; -1: without.
        skills: their names.
        frames: see `windows_of`.
        source: what messages call them.

    Raises:
        UserError: too few windows; all motion is one single cycle.
    """
    style = jax.jit(jax.vmap(style_of(env)))
    windows: list[np.ndarray] = []
    at: list[int] = []
    for k, (qpos, qvel, ctrl) in enumerate(episodes):
        if len(qpos) < 2:
            continue
        motion = np.asarray(style(jnp.asarray(qpos), jnp.asarray(qvel)))
        windows.append(windows_of(motion, ctrl, frames))
        at += [k] * len(windows[-1])
    total = len(at)
    if total < _FEWEST:
        raise UserError(
            f"{source} has {total} steps: imitation needs at least {_FEWEST}, from "
            "more than one stride (python -m train.demonstrate makes some thousands)"
        )
    found = np.concatenate(windows)
    if not np.isfinite(found).all():
        raise UserError(f"{source}: numbers that are not finite")
    where = np.array(at)
    _check_variety(found, source)
    return Demonstrations(found, np.array(labels)[where], where, skills, source)


def windows_of(motion: Any, ctrl: Any, frames: int) -> Any:
    """What the discriminator sees of the steps of an episode.

    Args:
        motion: style of each row, ``(T, features)``.
        ctrl: commands sent from each row on, ``(T, nu)``.
        frames: 2: rows before and after a step; 1: the row before it and its command.

    Returns:
        ``(T - 1, 2 features)`` or ``(T - 1, features + nu)``.
    """
    join = np.concatenate if isinstance(motion, np.ndarray) else jnp.concatenate
    second = motion[1:] if frames == 2 else ctrl[:-1]
    return join([motion[:-1], second], axis=-1)


def _check_variety(windows: np.ndarray, source: str) -> None:
    """Refuses motion that repeats one cycle exactly: there is nothing to learn from it
    but its rows."""
    rounded = np.round(windows / np.maximum(windows.std(0), 1e-9), 3)
    if len(np.unique(rounded, axis=0)) < _FEWEST:
        raise UserError(
            f"{source} repeats a single cycle: {len(np.unique(rounded, axis=0))} "
            f"different steps of {len(windows)}; imitation needs motion that varies: "
            "several speeds, starts, or noise on the actions"
        )


def _label(name: str) -> str:
    """The skill in a run's name; empty where it has none."""
    label, colon, _ = name.partition("/")[2].partition(LABELLED)
    return label if colon and not label[:1].isdigit() else ""


# -- motion without place and heading --------------------------------------------------


def _layout(m: mujoco.MjModel) -> tuple[np.ndarray, np.ndarray, tuple[int, ...]]:
    """Entries of ``qpos`` and ``qvel`` that are of no free joint, and where in both the
    free ones begin."""
    q, v = np.ones(m.nq, bool), np.ones(m.nv, bool)
    free: list[int] = []
    for j in np.flatnonzero(m.jnt_type == mujoco.mjtJoint.mjJNT_FREE):
        at, dof = int(m.jnt_qposadr[j]), int(m.jnt_dofadr[j])
        q[at : at + 7], v[dof : dof + 6] = False, False
        free += [at, dof]
    return np.flatnonzero(q), np.flatnonzero(v), tuple(free)


def _plain_style(layout: Any, qpos: jax.Array, qvel: jax.Array) -> jax.Array:
    """Positions and speeds; of a free body its height, the direction of gravity and
    its velocities, all in its own frame."""
    q, v, free = layout
    parts = [qpos[q], qvel[v]]
    for at, dof in zip(free[::2], free[1::2], strict=True):
        quaternion = qpos[at + 3 : at + 7]
        up = math.inv_rotate(jnp.array([0.0, 0.0, 1.0]), quaternion)
        forward = math.rotate(jnp.array([1.0, 0.0, 0.0]), quaternion)[:2]
        forward = forward / jnp.maximum(jnp.linalg.norm(forward), 1e-6)
        speed = qvel[dof : dof + 3]
        level = jnp.stack(
            [
                forward @ speed[:2],
                forward[0] * speed[1] - forward[1] * speed[0],
                speed[2],
            ]
        )
        parts += [qpos[at + 2 : at + 3], up, level, qvel[dof + 3 : dof + 6]]
    return jnp.concatenate(parts)
