"""Free play between a drive and the joint that it turns.

The drive's inertia is taken out of the joint's armature and turns on its own; teeth
that touch push and do not pull. The joint's own motion is MuJoCo's: it gets the mean
push of a physics step, found in a few shorter parts in which the joint is taken to be
as heavy as a torque there meets it.
"""

from typing import TYPE_CHECKING, Any

import flax.struct
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import numpy.typing as npt

from easi_jax.model.joint_space import is_scalar

_PARTS = 6  # of a physics step
_STIFF = 0.4  # phase of the teeth's own oscillation in a part [rad]

_JOINT = int(mujoco.mjtTrn.mjTRN_JOINT)
_GAINS = (int(mujoco.mjtGain.mjGAIN_FIXED), int(mujoco.mjtGain.mjGAIN_AFFINE))
_BIASES = (int(mujoco.mjtBias.mjBIAS_NONE), int(mujoco.mjtBias.mjBIAS_AFFINE))


@flax.struct.dataclass
class MotorState:
    """A drive at every degree of freedom, at the joint's side of the gear.

    Attributes:
        angle: ``(nv,)`` [m, rad].
        speed: ``(nv,)``.
        push: mean torque on the joint in the last physics step, ``(nv,)``.
        joint: speed of the joint before that step, ``(nv,)``.
    """

    angle: jax.Array
    speed: jax.Array
    push: jax.Array
    joint: jax.Array

    if TYPE_CHECKING:  # made by flax

        def replace(self, **changes: Any) -> "MotorState": ...


def geared(m: Any) -> dict[int, list[int]]:
    """Actuators of every hinge or slide whose drive may have play, by its place in
    ``qvel``: those that push on it directly, by a law of its position and speed."""
    found: dict[int, list[int]] = {}
    out = set()
    for a in range(m.nu):
        if int(m.actuator_trntype[a]) != _JOINT:
            continue
        j = int(m.actuator_trnid[a, 0])
        dof = int(m.jnt_dofadr[j])
        plain = int(m.actuator_gaintype[a]) in _GAINS
        plain &= int(m.actuator_biastype[a]) in _BIASES
        if not is_scalar(m, j) or not plain:
            out.add(dof)
        found.setdefault(dof, []).append(a)
    return {dof: acts for dof, acts in found.items() if dof not in out}


def felt_inertia(m: mujoco.MjModel) -> np.ndarray:
    """Inertia that a torque at each degree of freedom alone meets at ``qpos0``,
    ``(nv,)``."""
    d = mujoco.MjData(m)
    mujoco.mj_forward(m, d)
    full = np.zeros((m.nv, m.nv))
    mujoco.mj_fullM(m, d, full)
    return 1.0 / np.diag(np.linalg.pinv(full))


def first_rotor(scalar: npt.ArrayLike, qpos: jax.Array, qvel: jax.Array) -> MotorState:
    """Drives in the middle of their play, at the joints' speeds.

    ``scalar``: places in ``qpos`` and ``qvel`` of the hinges and slides, ``(k, 2)``.
    """
    at, dof = np.array(scalar, int).reshape(-1, 2).T
    zero = jnp.zeros_like(qvel)
    return MotorState(zero.at[dof].set(qpos[at]), qvel, zero, qvel)


def _torque(
    m: Any, drives: dict[int, list[int]], q: jax.Array, v: jax.Array, u: jax.Array
) -> jax.Array:
    """Of the actuators at each drive's joint, at positions and speeds ``(k,)``."""
    acts = np.array([a for mine in drives.values() for a in mine])
    place = np.array([i for i, mine in enumerate(drives.values()) for _ in mine])
    gear = jnp.asarray(m.actuator_gear)[acts, 0]
    state = jnp.stack([jnp.ones(len(acts)), gear * q[place], gear * v[place]], 1)
    gain, bias = m.actuator_gainprm[acts, :3], m.actuator_biasprm[acts, :3]
    plain = np.array([int(m.actuator_gaintype[a]) == _GAINS[0] for a in acts])
    free = np.array([int(m.actuator_biastype[a]) == _BIASES[0] for a in acts])
    force = jnp.where(plain, gain[:, 0], jnp.sum(gain * state, 1)) * u[acts]
    force += jnp.where(free, 0.0, jnp.sum(bias * state, 1))
    limited = np.asarray(m.actuator_forcelimited)[acts].astype(bool)
    edge = jnp.asarray(m.actuator_forcerange)[acts]
    force = jnp.where(limited, jnp.clip(force, edge[:, 0], edge[:, 1]), force)
    return jnp.zeros(len(drives)).at[place].add(gear * force)


def sent(m: Any, ctrl: jax.Array, act: jax.Array) -> jax.Array:
    """What each actuator's gain multiplies: its command in range, or its state."""
    edge = jnp.asarray(m.actuator_ctrlrange)
    u = jnp.where(m.actuator_ctrllimited, jnp.clip(ctrl, edge[:, 0], edge[:, 1]), ctrl)
    for a in range(m.nu):
        if int(m.actuator_dyntype[a]) != int(mujoco.mjtDyn.mjDYN_NONE):
            u = u.at[a].set(act[int(m.actuator_actadr[a])])
    return u


def pushes(
    m: Any,
    drives: dict[int, list[int]],
    rotor: MotorState,
    width: jax.Array,
    inertia: jax.Array,
    load: jax.Array,
    motion: tuple[jax.Array, jax.Array],
    u: jax.Array,
    h: jax.Array,
) -> MotorState:
    """Drives a physics step later, and how they push meanwhile.

    Args:
        m: MJX model whose actuators drive the rotors.
        drives: see `geared`.
        rotor: at the start of the step.
        width: total play, ``(nv,)``; 0 for none.
        inertia: of the rotors, ``(nv,)``.
        load: of the joints without them, ``(nv,)``.
        motion: positions and speeds of the joints, ``(nv,)`` each.
        u: see `sent`, ``(nu,)``.
        h: length of the step [s].
    """
    part = h / _PARTS
    at = np.array(list(drives))
    on = (width[at] > 0) & (inertia[at] > 0)
    j = jnp.where(on, inertia[at], 1.0)
    mass = load[at]
    lesser = j * mass / (j + mass)
    k = lesser * (_STIFF / part) ** 2
    c = 2.0 * jnp.sqrt(k * lesser) + k * part  # critical, and a part ahead
    q, v = motion[0][at], motion[1][at]
    # What moved the joint besides the push goes on.
    other = (v - rotor.joint[at]) / h - rotor.push[at] / mass
    # A semi-implicit step's positions are half a step ahead of its speeds.
    ahead = 0.5 * (h - part)
    x, w = rotor.angle[at], rotor.speed[at]

    def go(state: tuple, _: None) -> tuple:
        x, w, q, v, total = state
        torque = _torque(m, drives, q, v, u)
        side = jnp.sign(x - q)
        depth = jnp.abs(x - q) - 0.5 * width[at]
        closing = (w - v + part * (torque / j - other)) * side
        f = (k * depth + c * closing) / (1.0 + c * part / lesser)
        f = jnp.where(depth > 0, side * jnp.maximum(f, 0.0), 0.0)
        w = w + part * (torque - f) / j
        v = v + part * (other + f / mass)
        return (x + part * w, w, q + part * v, v, total + f), None

    begin = (x - ahead * w, w, q - ahead * v, v, jnp.zeros_like(q))
    (x, w, _, _, total), _ = jax.lax.scan(go, begin, None, length=_PARTS)
    return MotorState(
        rotor.angle.at[at].set(jnp.where(on, x + ahead * w, rotor.angle[at])),
        rotor.speed.at[at].set(jnp.where(on, w, rotor.speed[at])),
        jnp.zeros_like(rotor.push).at[at].set(jnp.where(on, total / _PARTS, 0.0)),
        motion[1],
    )
