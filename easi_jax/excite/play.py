"""Plays commands in MuJoCo C, in the model as given and wrong ones, within limits."""

import copy
from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from easi_jax.data.recording import physics_steps
from easi_jax.excite.drives import Feedback, Limits, driven
from easi_jax.model.joint_space import scalar_dofs
from easi_jax.model.mujoco_warnings import warnings_to
from easi_jax.model.quantities import FILTERS

_WRONG = 0.2  # by how much mass and friction may be wrong
_ROUNDS = 30
_NOTHING = 1e-3  # share of the largest amplitude that is not worth playing
_AIM = 0.97  # of the limits
_LOST = 3.0  # times the allowed travel: no use in going on


@dataclass(frozen=True)
class Motion:
    """What a machine does, a row per control step.

    Attributes:
        qpos: ``(T, nq)``.
        qvel: ``(T, nv)``.
        ctrl: sent from this row to the next, ``(T, nu)``.
        force: of each actuator at the end of that, ``(T, nu)``.
    """

    qpos: np.ndarray
    qvel: np.ndarray
    ctrl: np.ndarray
    force: np.ndarray


def variations(m: mujoco.MjModel) -> list[mujoco.MjModel]:
    """The model as given, then with mass and friction wrong by 20 % either way.

    Force limits are off, so that a force beyond one is seen.
    """
    out = []
    for mass, friction in (
        (1.0, 1.0),
        (1 - _WRONG, 1 - _WRONG),
        (1 + _WRONG, 1 - _WRONG),
        (1 - _WRONG, 1 + _WRONG),
        (1 + _WRONG, 1 + _WRONG),
    ):
        w = copy.deepcopy(m)
        w.body_mass *= mass
        w.body_inertia *= mass
        w.dof_damping *= friction
        w.dof_frictionloss *= friction
        w.actuator_forcelimited[:] = 0
        if mass != 1.0:
            mujoco.mj_setConst(w, mujoco.MjData(w))
        out.append(w)
    return out


def _settle(m: mujoco.MjModel, d: mujoco.MjData, ctrl: np.ndarray) -> None:
    """Drives with a filter have followed the first command, as at rest."""
    for a in np.flatnonzero(np.isin(m.actuator_dyntype, FILTERS)).tolist():
        d.act[m.actuator_actadr[a]] = ctrl[a]


def play(
    m: mujoco.MjModel,
    start: np.ndarray,
    ctrl: np.ndarray,
    dt: float,
    feedback: Feedback | None = None,
    far: np.ndarray | None = None,
) -> Motion:
    """Plays commands ``(T, nu)`` from rest; shorter than T where it gets lost.

    Args:
        start: ``(nq,)``.
        dt: control step [s].
        feedback: what is added to the commands, if anything.
        far: travel of scalar joints from the start beyond which it stops, ``(nv,)``.
    """
    d = mujoco.MjData(m)
    substeps = physics_steps(dt, m.opt.timestep)
    old = float(m.opt.timestep)
    m.opt.timestep = dt / substeps
    rows = len(ctrl)
    qpos, qvel = np.zeros((rows, m.nq)), np.zeros((rows, m.nv))
    sent, force = np.zeros((rows, m.nu)), np.zeros((rows, m.nu))
    at = list(scalar_dofs(m).values())
    q_at, v_at = (np.array(x, int) for x in zip(*at, strict=True)) if at else ([], [])
    reach = None if far is None else far[v_at]
    d.qpos[:] = start
    _settle(m, d, ctrl[0])
    end = rows
    # One that goes astray is found below; MuJoCo need not tell of it.
    with warnings_to():
        for t in range(rows):
            qpos[t], qvel[t] = d.qpos, d.qvel
            lost = reach is not None and bool(
                (np.abs(d.qpos[q_at] - start[q_at]) > reach).any()
            )
            if lost or d.warning[mujoco.mjtWarning.mjWARN_BADQACC].number:
                end = t
                break
            u = ctrl[t]
            if feedback is not None:
                u = u + feedback.command(d.qpos, d.qvel)
            sent[t] = u
            d.ctrl[:] = u
            mujoco.mj_step(m, d, substeps)
            force[t] = d.actuator_force
    m.opt.timestep = old
    return Motion(qpos[:end], qvel[:end], sent[:end], force[:end])


@dataclass(frozen=True)
class Usage:
    """How much of each limit a motion takes; 1 is all of it.

    Attributes:
        joint: of travel and speed, ``(nv,)``.
        actuator: of command range and force, ``(nu,)``.
        whole: whether it came to its end.
    """

    joint: np.ndarray
    actuator: np.ndarray
    whole: bool

    @property
    def most(self) -> float:
        """The largest; infinite for a motion that got lost."""
        if not self.whole:
            return np.inf
        return float(max(self.joint.max(initial=0), self.actuator.max(initial=0)))


def usage(
    m: mujoco.MjModel,
    motion: Motion,
    start: np.ndarray,
    hold: np.ndarray,
    limits: Limits,
    rows: int,
) -> Usage:
    """What a motion takes of the limits, counted from the start and the hold."""
    joint = np.abs(motion.qvel).max(0, initial=0) / limits.speed
    for q, d in scalar_dofs(m).values():
        off = motion.qpos[:, q] - start[q]
        up, down = limits.high[d] - start[q], start[q] - limits.low[d]
        joint[d] = max(
            joint[d],
            off.max(initial=0) / max(up, 1e-12),
            -off.min(initial=0) / max(down, 1e-12),
        )
    off = motion.ctrl - hold
    room_up = np.maximum(limits.ctrl_high - hold, 1e-12)
    room_down = np.maximum(hold - limits.ctrl_low, 1e-12)
    actuator = np.maximum(
        off.max(0, initial=0) / room_up, -off.min(0, initial=0) / room_down
    )
    # A command at the very end of its range is in it.
    actuator = np.where(actuator <= 1 + 1e-9, np.minimum(actuator, _AIM), actuator)
    actuator = np.maximum(actuator, np.abs(motion.force).max(0) / limits.force)
    whole = len(motion.qpos) == rows and bool(np.isfinite(motion.qpos).all())
    return Usage(joint, actuator, whole)


@dataclass(frozen=True)
class Bench:
    """A machine with its limits, on which tests are tried.

    Attributes:
        models: as given first, then wrong ones.
        start: pose, ``(nq,)``.
        hold: commands there, ``(nu,)``.
        limits: to keep to.
        dt: control step [s].
        feedback: the controller that feed-forward tests are simulated with.
    """

    models: Sequence[mujoco.MjModel]
    start: np.ndarray
    hold: np.ndarray
    limits: Limits
    dt: float
    feedback: Feedback | None = None

    @property
    def far(self) -> np.ndarray:
        """Travel beyond which a motion counts as lost, ``(nv,)``."""
        out = np.full(self.models[0].nv, np.inf)
        for q, d in scalar_dofs(self.models[0]).values():
            up, down = self.limits.high[d], self.limits.low[d]
            out[d] = _LOST * max(up - self.start[q], self.start[q] - down)
        return out

    def played(self, test: np.ndarray) -> tuple[list[Motion], list[Usage]]:
        """Motions of all models under hold plus test ``(T, nu)``; none after the
        first that leaves the limits."""
        motions, used = [], []
        for m in self.models:
            motion = play(
                m, self.start, self.hold + test, self.dt, self.feedback, self.far
            )
            motions.append(motion)
            used.append(usage(m, motion, self.start, self.hold, self.limits, len(test)))
            if used[-1].most > 1.0:
                break
        return motions, used

    def fitted(
        self, test: np.ndarray, scale: np.ndarray
    ) -> tuple[np.ndarray, list[Motion]] | None:
        """Scales ``(nu,)`` of a test's columns that keep all models inside the limits,
        with their motions; None where none are found.

        A joint that goes too far has its own command made smaller; where that helps
        little, other joints swing it, and all commands are.

        Args:
            test: ``(T, nu)``.
            scale: the largest that are tried, ``(nu,)``.
        """
        m = self.models[0]
        dofs = {a: int(m.jnt_dofadr[j]) for j, many in driven(m).items() for a in many}
        swung, before, shrunk = np.zeros(m.nv, bool), np.zeros(m.nv), np.ones(m.nu)
        for k in range(_ROUNDS):
            motions, used = self.played(scale * test)
            last = used[-1]
            if last.most <= 1.0:
                return scale, motions
            if scale.max() < _NOTHING:
                break
            for a, dof in dofs.items():
                helped = last.joint[dof] <= before[dof] * 0.5 * (1 + shrunk[a])
                swung[dof] |= shrunk[a] < 1 and not helped
            before = last.joint
            over, others = last.actuator.copy(), last.joint.copy()
            for a, dof in dofs.items():
                over[a] = max(over[a], last.joint[dof])
                if not swung[dof]:
                    others[dof] = 0.0
            # What no actuator of its own moves, all of them move.
            over = np.maximum(over, others.max(initial=0))
            if k >= _ROUNDS // 2:
                over[:] = over.max()
            shrink = np.clip(_AIM / np.maximum(over, 1e-9), 0.4, 0.9)
            if not last.whole:
                shrink = np.minimum(shrink, 0.7)
            shrunk = np.where((over > 1.0) | (not last.whole), shrink, 1.0)
            scale = scale * shrunk
        return None
