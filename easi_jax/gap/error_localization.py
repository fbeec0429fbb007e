"""Where and when a prediction error sits: which joint, and what was going on."""

from collections.abc import Sequence
from functools import cached_property

import mujoco
import numpy as np

from easi_jax.data.recording import Run
from easi_jax.data.windows import fitted_velocity
from easi_jax.gap.decisions import DECIDE
from easi_jax.gap.gap_metric import Channels
from easi_jax.gap.window_set import Rows, WindowSet
from easi_jax.model.joint_space import scalar_dofs
from easi_jax.model.quantities import actuator_name, body_name
from easi_jax.model.results import ErrorPlace


class Conditions:
    """What was going on in windows: masks ``(W,)`` of bool by a condition in words.

    Args:
        m: the model that was recorded.
        windows: of ``runs``.
        rows: what their predictions are about.
    """

    def __init__(
        self,
        m: mujoco.MjModel,
        windows: WindowSet,
        runs: Sequence[Run],
        rows: Rows,
    ) -> None:
        self._m = m
        self._windows = windows
        self._runs = runs
        self._of_joint: dict[int, dict[str, np.ndarray]] = {}
        self.rows = rows
        first = np.zeros(m.nq, int)  # of each position's joint, among velocities
        for at, dof in zip(m.jnt_qposadr, m.jnt_dofadr, strict=True):
            first[at:] = dof
        self._position_rows = rows.readings[..., first]

    @cached_property
    def positions(self) -> np.ndarray:
        """Measured positions that predictions are compared with, ``(W, H + 1, nq)``."""
        return self._taken([r.qpos for r in self._runs], self._position_rows)

    @cached_property
    def _qvel(self) -> np.ndarray:
        speed = [fitted_velocity(r.qpos, r.dt, r.configuration) for r in self._runs]
        return self._taken(speed, self.rows.readings)

    @cached_property
    def _ctrl(self) -> np.ndarray:
        rows = np.repeat(self.rows.commands[..., None], self._m.nu, -1)
        return self._taken([r.ctrl for r in self._runs], rows)

    def _taken(self, of_runs: Sequence[np.ndarray], rows: np.ndarray) -> np.ndarray:
        column = np.arange(rows.shape[-1])
        return np.array(
            [
                of_runs[r][np.clip(row, 0, len(of_runs[r]) - 1), column]
                for r, row in zip(self._windows.run, rows, strict=True)
            ]
        )

    @cached_property
    def general(self) -> dict[str, np.ndarray]:
        """Those that hold for the whole machine."""
        w = self._windows
        row = w.row + np.array([len(self._runs[r].before) for r in w.run])
        length: dict[str, int] = {}
        for run in self._runs:
            known = max(length.get(run.recording, 0), len(run.before) + len(run))
            length[run.recording] = known
        whole = np.array([length[self._runs[r].recording] for r in w.run])
        out = {
            "late in the recordings": row > whole * (2 / 3),
        }
        if self._m.nu:
            out["when the command jumps"] = _largest(self._jumps.max(1))
        if self._touching:
            out["in contact"] = np.any([*self._touching.values()], axis=0)
        return out

    @cached_property
    def named(self) -> dict[str, np.ndarray]:
        """Those of one actuator or body."""
        size = np.abs(self._ctrl).mean(1)
        out = {}
        for a in range(self._m.nu):
            name = actuator_name(self._m, a)
            out[f"when the command of {name} jumps"] = _largest(self._jumps[:, a])
            out[f"at large commands of {name}"] = _largest(size[:, a])
        for b, mask in self._touching.items():
            out[f"with {body_name(self._m, b)} in contact"] = mask
        return out

    def of_joint(self, j: int) -> dict[str, np.ndarray]:
        """Those of a hinge or slide."""
        if j not in self._of_joint:
            self._of_joint[j] = self._made_of_joint(j)
        return self._of_joint[j]

    def _made_of_joint(self, j: int) -> dict[str, np.ndarray]:
        m = self._m
        q = self.positions[..., m.jnt_qposadr[j]]
        v = self._qvel[..., m.jnt_dofadr[j]]
        typical = np.sqrt(np.mean(v**2)) + 1e-12
        up, down = v.max(1) > 0.1 * typical, v.min(1) < -0.1 * typical
        speed, middle = np.abs(v).mean(1), q.mean(1)
        out = {
            "speed changes sign": up & down,
            "at high speed": _largest(speed),
            "at low speed": _largest(-speed),
            "moving up": up & ~down,
            "moving down": down & ~up,
            "at large positions": _largest(middle),
            "at small positions": _largest(-middle),
        }
        if m.jnt_limited[j]:
            low, high = m.jnt_range[j]
            near = np.minimum(q - low, high - q).min(1) < DECIDE.near_end * (high - low)
            out["near a limit"] = near
        return out

    @cached_property
    def _jumps(self) -> np.ndarray:
        """Largest change of each command, ``(W, nu)``."""
        ctrl = self._ctrl
        if ctrl.shape[1] < 2:
            return np.zeros((len(ctrl), ctrl.shape[2]))
        return np.abs(np.diff(ctrl, axis=1)).max(1)

    @cached_property
    def _touching(self) -> dict[int, np.ndarray]:
        """Windows in which a body touches something, by body."""
        m, data = self._m, mujoco.MjData(self._m)
        steps = self.positions.shape[1] - 1
        out: dict[int, np.ndarray] = {}
        for w, positions in enumerate(self.positions):
            for k in sorted({0, steps // 2, steps}):
                data.qpos[:] = positions[k]
                mujoco.mj_fwdPosition(m, data)
                geoms = data.contact.geom[data.contact.dist < 0]
                for body in np.unique(m.geom_bodyid[geoms]).tolist():
                    if m.body_weldid[body]:  # not the world
                        mask = out.setdefault(body, np.zeros(len(self.positions), bool))
                        mask[w] = True
        return dict(sorted(out.items()))


def _largest(values: np.ndarray) -> np.ndarray:
    """The largest quarter."""
    return values > np.quantile(values, 0.75)


def where(
    errors: np.ndarray, found: Conditions, m: mujoco.MjModel, channels: Channels
) -> list[ErrorPlace]:
    """Joints with a share of the squared gap, largest first.

    Of the conditions under which a joint's error is much larger, the one is told that
    is least likely chance (Welch's t).

    Args:
        errors: ``(W, H, nv)``.
        found: conditions of these windows.
    """
    used = np.isfinite(channels.scale)
    square = np.mean(errors.astype(float) ** 2, 1)
    square[:, used] /= channels.scale[used] ** 2
    square[:, ~used] = 0.0
    total = max(square.sum(), 1e-300)
    out = []
    scalar = {d: j for j, (_, d) in scalar_dofs(m).items()}
    for joint in dict.fromkeys(channels.joints):
        dofs = [d for d, name in enumerate(channels.joints) if name == joint]
        mine = square[:, dofs].sum(1)
        when, surest = "throughout", 0.0
        masks = {**found.general, **found.named}
        if dofs[0] in scalar:
            masks = {**found.of_joint(scalar[dofs[0]]), **masks}
        for text, mask in masks.items():
            if min(mask.sum(), (~mask).sum()) < DECIDE.when_windows:
                continue
            there, elsewhere = mine[mask], mine[~mask]
            times = there.mean() / max(elsewhere.mean(), 1e-300)
            sure = _welch(there, elsewhere)
            if times > DECIDE.when_ratio and sure > surest:
                when, surest = text, sure
        out.append(ErrorPlace(joint, float(mine.sum() / total), when))
    return sorted((w for w in out if w.share > 0), key=lambda w: -w.share)


def _welch(a: np.ndarray, b: np.ndarray) -> float:
    spread = a.var() / len(a) + b.var() / len(b)
    return float((a.mean() - b.mean()) / np.sqrt(max(spread, 1e-300)))


def condition_errors(
    errors: np.ndarray, found: Conditions, m: mujoco.MjModel, channels: Channels
) -> tuple[list[str], list[str], np.ndarray]:
    """RMS errors of hinges and slides by condition, as shares of their motion.

    Args:
        errors: ``(W, H, nv)``.
        found: conditions of these windows.

    Returns:
        Joints, conditions, and errors ``(joints, conditions)``, NaN where a condition
        holds in too few windows.
    """
    square = np.mean(errors.astype(float) ** 2, 1)
    joints: list[str] = []
    rows: list[dict[str, float]] = []
    for j, (_, dof) in scalar_dofs(m).items():
        if not np.isfinite(channels.scale[dof]):
            continue
        mine = square[:, dof] / channels.scale[dof] ** 2
        everywhere = {"throughout": np.ones(len(mine), bool)}
        masks = {**everywhere, **found.of_joint(j), **found.general}
        joints.append(channels.joints[dof])
        rows.append(
            {
                t: float(mine[k].mean())
                for t, k in masks.items()
                if k.sum() >= DECIDE.when_windows
            }
        )
    names = list(dict.fromkeys(name for row in rows for name in row))
    table = np.array([[row.get(name, np.nan) for name in names] for row in rows])
    return joints, names, np.sqrt(table.reshape(len(joints), len(names)))
