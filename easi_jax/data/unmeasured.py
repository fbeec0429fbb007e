"""Joints that nobody measured: which of them the model places, and a guess of where.

What is here is where an estimate of a start begins, and how far from it the truth may
be. The estimate itself is made with the model's own dynamics.
"""

import copy
from collections.abc import Collection, Sequence
from dataclasses import replace

import mujoco
import numpy as np

from easi_jax.data.recording import Run
from easi_jax.data.windows import fitted_velocity
from easi_jax.errors import UserError
from easi_jax.model.joint_space import (
    dofs,
    driven_joint,
    given_name,
    is_hinge,
    is_scalar,
    scalar_dofs,
    tangent_names,
    tangent_units,
    widths,
)

_JOINT_EQUALITY = int(mujoco.mjtEq.mjEQ_JOINT)
_TENDON_EQUALITY = int(mujoco.mjtEq.mjEQ_TENDON)
# Half the travel of a joint, by its range or by its spring under twice the weight, up
# to which it is play or compliance of the joint beside it and no joint of its own.
_PLAY = {"rad": 0.15, "m": 0.01}
# Least half travel: what lies on a joint's axis has no weight there, but inertia.
_LEAST = {"rad": 0.02, "m": 0.002}
_GRAVITY = 9.81  # m/s^2, for models without, whose springs are soft or stiff as well
# How far a joint may be [rad, m] of which the model says nothing.
_NOTHING_KNOWN = {"rad": 1.0, "m": 0.1}
_ROUNDS = 20  # of Newton's method on a row's equalities; 2 or 3 do
_CLOSED = 1e-10  # rad or m of a step that ends it
_BALANCING = 3  # rounds of spring against gravity, a contraction for stiff springs


def joint_dofs(m: mujoco.MjModel, joints: Collection[int]) -> np.ndarray:
    """Degrees of freedom of ``joints``, ``(nv,)`` bool."""
    out = np.zeros(m.nv, bool)
    for j in joints:
        out[list(dofs(m, j))] = True
    return out


def placed_by_model(m: mujoco.MjModel, measured: Collection[int]) -> dict[int, str]:
    """Hinges and slides that the model itself places, given the ``measured`` joints.

    Those are joints that an active equality couples to measured ones, also by fixed
    tendons, or holds at a number, and play: a joint without an actuator beside a
    measured one (same body, next body up or down the chain), with a small range or a
    stiff spring. A joint that was placed places others.

    Returns:
        What places each, in words.
    """
    out: dict[int, str] = {}
    while True:
        known = {*measured, *out}
        found = {j: _placed(m, j, known) for j in scalar_dofs(m) if j not in known}
        found = {j: how for j, how in found.items() if how}
        if not found:
            return out
        out |= found


def _placed(m: mujoco.MjModel, j: int, known: Collection[int]) -> str:
    """What places joint ``j`` where ``known`` joints are given, or ``""``."""
    for e in range(m.neq):
        if not m.eq_active0[e]:
            continue
        if int(m.eq_type[e]) == _TENDON_EQUALITY:
            others = _beside_in_tendons(m, e, j)
            if others is not None and others <= {*known}:
                names = ", ".join(given_name(m, k) for k in sorted(others))
                return f"coupled to {names}" if names else "held by an equality"
        if int(m.eq_type[e]) != _JOINT_EQUALITY:
            continue
        first, second = int(m.eq_obj1id[e]), int(m.eq_obj2id[e])
        if j == first and second < 0:
            return "held by an equality"
        other = second if j == first else first
        # A polynomial in the joint without a linear term tells nothing of it.
        if j not in (first, second) or (j == second and not m.eq_data[e, 1]):
            continue
        if other in known:
            return f"coupled to {given_name(m, other)}"
    if not is_play(m, j):
        return ""
    beside = next((k for k in known if _beside(m, j, k)), None)
    return "" if beside is None else f"play beside {given_name(m, beside)}"


def _beside_in_tendons(m: mujoco.MjModel, e: int, j: int) -> set[int] | None:
    """Other joints of the fixed tendons that equality ``e`` couples, or holds; None
    where it says nothing of joint ``j``."""
    told: dict[int, bool] = {}  # joints, and whether the equality tells where they are
    for at, t in enumerate((int(m.eq_obj1id[e]), int(m.eq_obj2id[e]))):
        first = m.tendon_adr[t]
        for w in range(first, first + m.tendon_num[t]) if t >= 0 else ():
            if m.wrap_type[w] != mujoco.mjtWrap.mjWRAP_JOINT:
                return None
            # A polynomial in the second without a linear term tells nothing of it.
            tells = m.wrap_prm[w] != 0 and (at == 0 or m.eq_data[e, 1] != 0)
            told[int(m.wrap_objid[w])] = bool(tells)
    return {*told} - {j} if told.get(j) else None


def is_play(m: mujoco.MjModel, j: int) -> bool:
    """Whether joint ``j`` has no drive and can hardly move."""
    if _is_driven(m, j):
        return False
    return _travel(m, j) <= _PLAY[_unit(m, j)]


def _is_driven(m: mujoco.MjModel, j: int) -> bool:
    for a in range(m.nu):
        kind, at = int(m.actuator_trntype[a]), int(m.actuator_trnid[a, 0])
        if driven_joint(m, a) == j:
            return True
        if kind == int(mujoco.mjtTrn.mjTRN_TENDON):
            wraps = range(m.tendon_adr[at], m.tendon_adr[at] + m.tendon_num[at])
            if any(
                m.wrap_type[w] == mujoco.mjtWrap.mjWRAP_JOINT and m.wrap_objid[w] == j
                for w in wraps
            ):
                return True
    return False


def _unit(m: mujoco.MjModel, j: int) -> str:
    return "rad" if is_hinge(m, j) else "m"


def _travel(m: mujoco.MjModel, j: int) -> float:
    """How far joint ``j`` may be from the middle [rad, m]: half its range, or what
    twice the weight behind it makes of its spring; infinite where it has neither."""
    half = 0.5 * float(np.ptp(m.jnt_range[j])) if m.jnt_limited[j] else np.inf
    stiffness = float(m.jnt_stiffness[j])
    if stiffness <= 0:
        return half
    d = mujoco.MjData(m)
    mujoco.mj_forward(m, d)
    b = int(m.jnt_bodyid[j])
    force = m.body_subtreemass[b] * max(np.linalg.norm(m.opt.gravity), _GRAVITY)
    if is_hinge(m, j):
        force *= np.linalg.norm(d.subtree_com[b] - d.xanchor[j])
    return min(half, max(2 * float(force) / stiffness, _LEAST[_unit(m, j)]))


def _beside(m: mujoco.MjModel, j: int, k: int) -> bool:
    """Whether no joint lies between joints ``j`` and ``k`` of a chain."""
    a, b = int(m.jnt_bodyid[j]), int(m.jnt_bodyid[k])
    return a == b or _jointed_above(m, a) == b or _jointed_above(m, b) == a


def _jointed_above(m: mujoco.MjModel, b: int) -> int:
    """The nearest body above ``b`` that has a joint, or the world."""
    b = int(m.body_parentid[b])
    while b and not m.body_jntnum[b]:
        b = int(m.body_parentid[b])
    return b


def apart_from(m: mujoco.MjModel, hidden: np.ndarray) -> list[int]:
    """Joints of trees in which nothing is measured, by ``hidden (nv,)``: only contacts
    and couplings tie them to what is."""
    seen = {int(t) for t in m.dof_treeid[~hidden]}
    trees = [int(m.dof_treeid[m.jnt_dofadr[j]]) for j in range(m.njnt)]
    return [j for j, tree in enumerate(trees) if tree not in seen]


def with_guess(m: mujoco.MjModel, run: Run) -> Run:
    """``run`` with a guess at each hidden joint that obeys the model.

    A joint with a spring is where the spring is at rest, or, where that is stiff, where
    it carries the weight; any other one as in the model's reference configuration; both
    within their range. Then hidden joints move until the active equalities of the model
    hold, as far as hidden joints can make them hold. Velocities are the derivative of
    the guessed positions. Nothing that is measured is changed.
    """
    if not run.hidden.any():
        return run
    qpos = run.qpos.copy()
    stiff = []
    for j in range(m.njnt):
        if not run.hidden[m.jnt_dofadr[j]]:
            continue
        at = slice(int(m.jnt_qposadr[j]), int(m.jnt_qposadr[j]) + widths(m, j)[0])
        sprung = m.jnt_stiffness[j] > 0
        rest = np.array(m.qpos_spring if sprung else m.qpos0)[at]
        if is_scalar(m, j):
            rest = _within_range(m, j, rest)
            if sprung and is_play(m, j):
                stiff.append(j)
        qpos[:, at] = rest
    _close(m, run.hidden, stiff, qpos)
    fitted = fitted_velocity(qpos, run.dt, run.configuration)
    return replace(run, qpos=qpos, qvel=np.where(run.hidden, fitted, run.qvel))


def _within_range(m: mujoco.MjModel, j: int, value: np.ndarray) -> np.ndarray:
    return np.clip(value, *m.jnt_range[j]) if m.jnt_limited[j] else value


def _close(
    m: mujoco.MjModel, hidden: np.ndarray, stiff: Sequence[int], qpos: np.ndarray
) -> None:
    """Moves hidden degrees of freedom of each row of ``qpos (T, nq)`` to balance their
    ``stiff`` springs, and to where the equalities hold."""
    if not (m.neq or stiff):
        return
    m = copy.copy(m)
    off = mujoco.mjtDisableBit
    m.opt.disableflags |= int(
        off.mjDSBL_CONTACT | off.mjDSBL_LIMIT | off.mjDSBL_FRICTIONLOSS
    )
    m.opt.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    d, free = mujoco.MjData(m), np.flatnonzero(hidden)
    before = np.zeros(m.nv)  # how far the row before was moved
    for row in qpos:
        d.qpos[:], d.qvel[:] = row, 0.0
        for _ in range(_BALANCING if stiff else 0):
            _balance(m, d, stiff)
        if m.neq:
            balanced = d.qpos.copy()
            mujoco.mj_integratePos(m, d.qpos, before, 1.0)
            _satisfy_equalities(m, d, free)
            mujoco.mj_differentiatePos(m, before, 1.0, balanced, d.qpos)
        row[:] = d.qpos


def _balance(m: mujoco.MjModel, d: mujoco.MjData, stiff: Sequence[int]) -> None:
    """Moves joints to where their springs carry what gravity does at ``d``."""
    mujoco.mj_fwdPosition(m, d)
    mujoco.mj_fwdVelocity(m, d)
    for j in stiff:
        q, v = int(m.jnt_qposadr[j]), int(m.jnt_dofadr[j])
        load = d.qfrc_gravcomp[v] - d.qfrc_bias[v]
        at = m.qpos_spring[q] + load / m.jnt_stiffness[j]
        d.qpos[q] = _within_range(m, j, at)


def _satisfy_equalities(m: mujoco.MjModel, d: mujoco.MjData, free: np.ndarray) -> None:
    """Newton's method on the ``free`` degrees of freedom."""
    step = np.zeros(m.nv)
    for _ in range(_ROUNDS):
        mujoco.mj_fwdPosition(m, d)
        rows = d.efc_type[: d.nefc] == mujoco.mjtConstraint.mjCNSTR_EQUALITY
        slope = d.efc_J[: d.nefc * m.nv].reshape(-1, m.nv)[rows][:, free]
        step[free] = -np.linalg.lstsq(slope, d.efc_pos[: d.nefc][rows])[0]
        mujoco.mj_integratePos(m, d.qpos, step, 1.0)
        if np.abs(step).max() < _CLOSED:
            return


def hidden_in_any(runs: Sequence[Run]) -> np.ndarray:
    """Degrees of freedom that some run lacks, ``(nv,)`` bool."""
    return np.any([run.hidden for run in runs], axis=0)


def measured_alike(
    m: mujoco.MjModel, runs: Sequence[Run]
) -> tuple[list[Run], list[str]]:
    """Runs in which the same joints are hidden: those that one of them lacks, and notes
    on readings that are not used for it.

    Raises:
        UserError: nothing is measured in all of them.
    """
    hidden = hidden_in_any(runs)
    if hidden.all():
        raise UserError(
            "no joint is measured in all logs: leave some out, or log the same joints"
        )
    out, dropped = [], dict[str, None]()
    for run in runs:
        more = hidden & ~run.hidden
        if more.any():
            dropped |= dict.fromkeys(np.array(tangent_names(m))[more].tolist())
            run = with_guess(m, replace(run, hidden=hidden))
        out.append(run)
    if not dropped:
        return out, []
    return out, [
        f"readings of {', '.join(dropped)} are not used, for some of the logs lack them"
    ]


def start_spread(
    m: mujoco.MjModel, runs: Sequence[Run], hidden: np.ndarray | None = None
) -> np.ndarray:
    """How far a hidden start may be from its guess, standard deviations ``(2 nv,)``
    [m, rad, m/s, rad/s]: wide, so that the rows of a log decide.

    Positions: half the joint's range, or what twice the weight behind it makes of its
    spring, whichever is less; 1 rad or 0.1 m where the model says nothing, and for what
    an equality couples as much, for it may be soft. Velocities: as fast as the fastest
    measured joint of the same unit is in RMS, and no slower than the spread of the
    position in a second.

    Args:
        hidden: degrees of freedom that are asked for, ``(nv,)`` bool; not given: those
            that one of ``runs`` lacks.

    Returns:
        Finite at hidden degrees of freedom, infinite at measured ones, of which the
        caller knows the noise.
    """
    hidden, units = hidden_in_any(runs) if hidden is None else hidden, tangent_units(m)
    out = np.full(2 * m.nv, np.inf)
    square = np.mean(np.concatenate([run.qvel for run in runs]) ** 2, 0)
    scalar = {d: j for j, (_, d) in scalar_dofs(m).items()}
    for v in np.flatnonzero(hidden):
        spread = _NOTHING_KNOWN[units[v]]
        j = scalar.get(int(v))
        if j is not None:
            spread = min(spread, _travel(m, j))
        like = [square[k] for k in np.flatnonzero(~hidden) if units[k] == units[v]]
        out[v] = spread
        out[m.nv + v] = max(spread, float(np.sqrt(max(like, default=0.0))))
    return out
