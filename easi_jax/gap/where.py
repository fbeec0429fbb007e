"""Where and when a prediction error sits: which joint, and what it was doing."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from easi_jax.gap.measure import Channels
from easi_jax.gap.predictor import WindowSet
from easi_jax.recording import Run
from easi_jax.windows import fitted_velocity

_TELLING = 1.3  # times as much error as elsewhere
_FEW = 8  # windows that a condition needs


@dataclass(frozen=True)
class Where:
    """Share of the squared gap at one joint, and when it is largest.

    Attributes:
        at: joint.
        share: of the squared gap.
        when: a condition in words.
        ratio: squared error there over that elsewhere.
    """

    at: str
    share: float
    when: str
    ratio: float


def conditions(
    windows: WindowSet, runs: Sequence[Run], dof: int, qpos: int
) -> dict[str, np.ndarray]:
    """Windows in which something holds at a hinge or slide, ``(W,)`` bool each."""
    speed = [fitted_velocity(r.qpos, r.dt, r.configuration)[:, dof] for r in runs]
    steps = windows.ctrl.shape[1]
    span = np.arange(steps + 1)
    v = np.array(
        [speed[r][row + span] for r, row in zip(windows.run, windows.row, strict=True)]
    )
    q = np.array(
        [
            runs[r].qpos[row + span, qpos]
            for r, row in zip(windows.run, windows.row, strict=True)
        ]
    )
    typical = np.sqrt(np.mean(v**2)) + 1e-12
    fast, slow = v.max(1) > 0.1 * typical, v.min(1) < -0.1 * typical
    mean = np.abs(v).mean(1)
    middle = q.mean(1)
    jump = np.abs(np.diff(windows.ctrl, axis=1)).max((1, 2))
    return {
        "speed changes sign": fast & slow,
        "at high speed": mean > np.quantile(mean, 0.75),
        "at low speed": mean < np.quantile(mean, 0.25),
        "moving up": ~slow & fast,
        "moving down": slow & ~fast,
        "at large positions": middle > np.quantile(middle, 0.75),
        "at small positions": middle < np.quantile(middle, 0.25),
        "when the command jumps": jump > np.quantile(jump, 0.75),
    }


def where(
    errors: np.ndarray,
    windows: WindowSet,
    runs: Sequence[Run],
    channels: Channels,
    scalar: Sequence[tuple[int, int]],
) -> list[Where]:
    """Joints by their share of the squared gap, largest first.

    Args:
        errors: ``(W, H, nv)``.
        scalar: places in qpos and qvel of hinges and slides.
    """
    used = np.isfinite(channels.scale)
    square = np.mean(errors.astype(float) ** 2, 1)
    square[:, used] /= channels.scale[used] ** 2
    square[:, ~used] = 0.0
    total = max(square.sum(), 1e-300)
    out = []
    place = {dof: q for q, dof in scalar}
    for joint in dict.fromkeys(channels.joints):
        dofs = [d for d, name in enumerate(channels.joints) if name == joint]
        mine = square[:, dofs].sum(1)
        when, ratio = "throughout", 1.0
        if len(dofs) == 1 and dofs[0] in place and mine.sum() > 0:
            found = conditions(windows, runs, dofs[0], place[dofs[0]])
            best = []
            for text, mask in found.items():
                if min(mask.sum(), (~mask).sum()) >= _FEW:
                    best.append(
                        (mine[mask].mean() / max(mine[~mask].mean(), 1e-300), text)
                    )
            if best and max(best)[0] > _TELLING:
                ratio, when = max(best)
        out.append(Where(joint, float(mine.sum() / total), when, float(ratio)))
    return sorted(out, key=lambda w: -w.share)


def condition_errors(
    errors: np.ndarray,
    windows: WindowSet,
    runs: Sequence[Run],
    channels: Channels,
    scalar: Sequence[tuple[int, int]],
) -> tuple[list[str], list[str], np.ndarray]:
    """RMS errors of joints under each condition, as shares of their motion.

    Args:
        errors: ``(W, H, nv)``.
        scalar: places in qpos and qvel of hinges and slides.

    Returns:
        Joints, conditions, and errors ``(joints, conditions)``, NaN where a condition
        holds in too few windows.
    """
    square = np.mean(errors.astype(float) ** 2, 1)
    joints, rows = [], []
    names = ["throughout"]
    for q, dof in scalar:
        if not np.isfinite(channels.scale[dof]):
            continue
        mine = square[:, dof] / channels.scale[dof] ** 2
        found = conditions(windows, runs, dof, q)
        names = ["throughout", *found]
        means = [mine.mean()]
        for mask in found.values():
            means.append(mine[mask].mean() if mask.sum() >= _FEW else np.nan)
        joints.append(channels.joints[dof])
        rows.append(np.sqrt(means))
    return joints, names, np.array(rows).reshape(len(joints), -1)
