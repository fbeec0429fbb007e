"""Where a test starts, what holds the machine there, and how far commands may go."""

from dataclasses import dataclass

import mujoco
import numpy as np

from easi_jax.data.unmeasured import is_play
from easi_jax.errors import UserError
from easi_jax.model.joint_space import driven_joint, is_scalar, joint_name, scalar_dofs
from easi_jax.model.quantities import (
    FILTERS,
    actuator_name,
    is_position_servo,
    is_velocity_servo,
)

_NONE = int(mujoco.mjtDyn.mjDYN_NONE)
_ROOM = 0.15  # of a joint's range that a start needs on both sides
_SLOWEST = 0.3  # Hz, what a velocity drive has to be able to sweep its travel with
_BRISK = 1.5  # Hz, natural torque: what moves a joint by its travel at this
_STIFF = 1.0  # Hz, of the controller that a feed-forward test is simulated with


@dataclass(frozen=True)
class Limits:
    """What a test must keep to.

    Attributes:
        low, high: positions of hinges and slides, infinite where free, ``(nv,)``.
        speed: largest, ``(nv,)``.
        ctrl_low, ctrl_high: commands, ``(nu,)``.
        force: largest of each actuator, ``(nu,)``.
        assumed: joints whose range is not the model's but ``travel``.
    """

    low: np.ndarray
    high: np.ndarray
    speed: np.ndarray
    ctrl_low: np.ndarray
    ctrl_high: np.ndarray
    force: np.ndarray
    assumed: tuple[str, ...] = ()


def driven(m: mujoco.MjModel) -> dict[int, tuple[int, ...]]:
    """Actuators at each hinge or slide joint."""
    out: dict[int, tuple[int, ...]] = {}
    for a in range(m.nu):
        j = driven_joint(m, a)
        if j is not None and is_scalar(m, j):
            out[j] = (*out.get(j, ()), a)
    return out


def limits_of(
    m: mujoco.MjModel,
    margin: float,
    travel: np.ndarray,
    speed: np.ndarray,
) -> Limits:
    """Limits of a model; play (`easi_jax.data.unmeasured.is_play`) has none, for it
    is made to reach its ends.

    Args:
        margin: share of a joint's range that is left free at both ends.
        travel: how far a driven joint without a range may go from where it stands
            in ``qpos0``, ``(nv,)``.
        speed: ``(nv,)``.
    """
    low, high = np.full((2, m.nv), np.inf)
    low = -low
    assumed = []
    moved_by = driven(m)
    for j, (q, d) in scalar_dofs(m).items():
        if is_play(m, j):
            continue
        if m.jnt_limited[j]:
            a, b = m.jnt_range[j]
            low[d], high[d] = a + margin * (b - a), b - margin * (b - a)
        elif j in moved_by:
            low[d], high[d] = m.qpos0[q] - travel[d], m.qpos0[q] + travel[d]
            assumed.append(joint_name(m, j))
    free = m.actuator_ctrllimited == 0
    ctrl = np.where(free[:, None], [-np.inf, np.inf], m.actuator_ctrlrange)
    bound = np.where(
        m.actuator_forcelimited == 1, np.abs(m.actuator_forcerange).min(1), np.inf
    )
    return Limits(low, high, speed, ctrl[:, 0], ctrl[:, 1], bound, tuple(assumed))


def start_pose(m: mujoco.MjModel, limits: Limits) -> tuple[np.ndarray, list[str]]:
    """Where the test starts ``(nq,)``, and notes.

    The model's own reference pose; a joint that has little room there starts in the
    middle of its range.
    """
    q0, notes = m.qpos0.copy(), []
    for j, (q, d) in scalar_dofs(m).items():
        span = limits.high[d] - limits.low[d]
        if not np.isfinite(span):
            continue
        room = min(q0[q] - limits.low[d], limits.high[d] - q0[q])
        if room < _ROOM * span:
            middle = 0.5 * (limits.low[d] + limits.high[d])
            notes.append(
                f'joint "{joint_name(m, j)}" starts at {middle:.3g}, the middle of its '
                f"range: at {q0[q]:.3g} it has no room to move"
            )
            q0[q] = middle
    return q0, notes


def hold_command(m: mujoco.MjModel, start: np.ndarray, limits: Limits) -> np.ndarray:
    """Commands that balance gravity and springs at rest in a pose, ``(nu,)``.

    Least squares where actuators are fewer than joints; inside the command range.
    """
    d = mujoco.MjData(m)
    d.qpos[:] = start
    mujoco.mj_forward(m, d)
    moment = np.zeros((m.nu, m.nv))
    mujoco.mju_sparse2dense(
        moment, d.actuator_moment, d.moment_rownnz, d.moment_rowadr, d.moment_colind
    )
    wanted = d.qfrc_bias - d.qfrc_passive
    force = np.linalg.lstsq(moment.T, wanted, rcond=None)[0]
    out = np.zeros(m.nu)
    for a in range(m.nu):
        gain = m.actuator_gainprm[a, 0]
        plain = m.actuator_gaintype[a] == mujoco.mjtGain.mjGAIN_FIXED and gain != 0
        if not plain or m.actuator_dyntype[a] not in (_NONE, *FILTERS):
            continue
        bias = m.actuator_biasprm[a]
        affine = m.actuator_biastype[a] == mujoco.mjtBias.mjBIAS_AFFINE
        offset = bias[0] + bias[1] * d.actuator_length[a] if affine else 0.0
        out[a] = (force[a] - offset) / gain
    return np.clip(out, limits.ctrl_low, limits.ctrl_high)


def is_motor(m: mujoco.MjModel, a: int) -> bool:
    """Whether a command is a force, up to a constant factor."""
    return bool(
        m.actuator_gaintype[a] == mujoco.mjtGain.mjGAIN_FIXED
        and m.actuator_biastype[a] == mujoco.mjtBias.mjBIAS_NONE
        and m.actuator_dyntype[a] == mujoco.mjtDyn.mjDYN_NONE
        and m.actuator_gainprm[a, 0] != 0
    )


def amplitudes(
    m: mujoco.MjModel,
    start: np.ndarray,
    hold: np.ndarray,
    limits: Limits,
    most: np.ndarray,
) -> np.ndarray:
    """Largest change of each command that is worth trying, ``(nu,)``.

    Args:
        most: what the user allows, infinite where nothing is said, ``(nu,)``.

    Raises:
        UserError: an actuator without limits whose commands mean nothing known.
    """
    room = np.minimum(limits.ctrl_high - hold, hold - limits.ctrl_low)
    out = np.minimum(room, most)
    joint = {a: j for j, many in driven(m).items() for a in many}
    d = mujoco.MjData(m)
    d.qpos[:] = start
    mujoco.mj_forward(m, d)
    inertia = np.zeros((m.nv, m.nv))
    mujoco.mj_fullM(m, d, inertia)
    for a in range(m.nu):
        natural = np.inf
        if a in joint:
            q, dof = scalar_dofs(m)[joint[a]]
            gear = abs(m.actuator_gear[a, 0])
            reach = min(limits.high[dof] - start[q], start[q] - limits.low[dof])
            if is_position_servo(m, a):
                natural = gear * reach
            elif is_velocity_servo(m, a):
                fast = 2 * np.pi * _SLOWEST * reach
                natural = gear * min(4 * fast, limits.speed[dof])
            elif is_motor(m, a):
                weight = abs(d.qfrc_bias[dof])
                torque = inertia[dof, dof] * (2 * np.pi * _BRISK) ** 2 * reach + weight
                per_ctrl = gear * abs(m.actuator_gainprm[a, 0])
                natural = torque / max(per_ctrl, 1e-12)
                own = limits.force[a] / abs(m.actuator_gainprm[a, 0])
                natural = min(natural, own - abs(hold[a]))
        out[a] = min(out[a], natural)
        if not np.isfinite(out[a]):
            name = actuator_name(m, a)
            raise UserError(
                f'actuator "{name}" has no ctrlrange, and what moves a joint safely '
                f"cannot be told from the model: give --amplitude {name}=NUMBER"
            )
    return np.maximum(out, 0.0)


@dataclass(frozen=True)
class Feedback:
    """The controller that a feed-forward test is simulated with.

    ``ctrl = hold + test - kp (q - start) - kd v``, at the control rate.

    Attributes:
        kp, kd: in units of ctrl per rad or m, and per rad/s or m/s, ``(nu,)``.
        qpos, dof: place of each actuator's joint, ``(nu,)``.
        start: pose that it holds, ``(nq,)``.
    """

    kp: np.ndarray
    kd: np.ndarray
    qpos: np.ndarray
    dof: np.ndarray
    start: np.ndarray

    def command(self, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
        """``(nu,)`` that is added to the test."""
        off = qpos[self.qpos] - self.start[self.qpos]
        return -self.kp * off - self.kd * qvel[self.dof]


def feedback_of(m: mujoco.MjModel, start: np.ndarray) -> Feedback | None:
    """A soft PD controller about a pose; None where no motor sits at a joint.

    About 1 Hz above what gravity's own stiffness asks for.
    """
    d = mujoco.MjData(m)
    inertia = np.zeros((m.nv, m.nv))
    d.qpos[:] = start
    mujoco.mj_forward(m, d)
    mujoco.mj_fullM(m, d, inertia)
    bias = d.qfrc_bias.copy()
    kp, kd = np.zeros((2, m.nu))
    at, dof = np.zeros((2, m.nu), int)
    omega = 2 * np.pi * _STIFF
    for j, many in driven(m).items():
        q, v = scalar_dofs(m)[j]
        d.qpos[:] = start
        d.qpos[q] += 0.05
        mujoco.mj_forward(m, d)
        weight = abs(d.qfrc_bias[v] - bias[v]) / 0.05
        # A loaded arm's gravity couples its joints: twice what is seen at one.
        stiff = inertia[v, v] * omega**2 + 2 * weight
        damped = 1.4 * np.sqrt(stiff * inertia[v, v])
        motors = [a for a in many if is_motor(m, a)]
        for a in motors:
            force = m.actuator_gear[a, 0] * m.actuator_gainprm[a, 0] * len(motors)
            kp[a], kd[a], at[a], dof[a] = stiff / force, damped / force, q, v
    return Feedback(kp, kd, at, dof, start) if kp.any() else None
