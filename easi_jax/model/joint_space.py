"""Joint geometry: where joints lie in ``qpos`` and ``qvel``, and differences and steps
between positions, in numpy or jax.

A hinge or slide coordinate is a plain number; the orientation of a ball or free
joint is a unit quaternion (w x y z), whose differences are rotation vectors in
the joint's own frame, as MuJoCo's angular velocities are.
"""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

_Joint = mujoco.mjtJoint
_AT_JOINT = {
    int(mujoco.mjtTrn.mjTRN_JOINT),
    int(mujoco.mjtTrn.mjTRN_JOINTINPARENT),
}
# Widths of a joint's positions, of which a free joint has the most, and velocities.
FREE_WIDTH = 7
_WIDTHS = {_Joint.mjJNT_FREE: (FREE_WIDTH, 6), _Joint.mjJNT_BALL: (4, 3)}
_TANGENT_UNITS = {
    _Joint.mjJNT_FREE: ("m", "m", "m", "rad", "rad", "rad"),
    _Joint.mjJNT_BALL: ("rad", "rad", "rad"),
    _Joint.mjJNT_SLIDE: ("m",),
    _Joint.mjJNT_HINGE: ("rad",),
}
# Square of a rotation [rad^2] below which sines and angles are their first order,
# which then is exact in float64 and has a slope.
_TINY = 1e-16
# Range of a hinge [rad] in which a full turn fits: limits are written with few digits.
_FULL_TURN = 2 * math.pi - 1e-3


def _kind(m: Any, j: int) -> mujoco.mjtJoint:
    return _Joint(int(m.jnt_type[j]))


def given_name(m: Any, j: int) -> str:
    """A joint's name, for a free joint without one its body's, or ``""``."""
    name = m.joint(j).name
    if not name and _kind(m, j) == _Joint.mjJNT_FREE:
        name = m.body(int(m.jnt_bodyid[j])).name
    return name


def carrying_joints(m: Any) -> list[int]:
    """Free joints of bodies that carry all other joints of their tree."""
    root = [int(m.body_rootid[b]) for b in m.jnt_bodyid]
    return [
        j
        for j in range(m.njnt)
        if _kind(m, j) == _Joint.mjJNT_FREE and root.count(root[j]) > 1
    ]


def joint_name(m: Any, j: int) -> str:
    """A joint's name as in `given_name`, or its number."""
    return given_name(m, j) or f"joint{j}"


def widths(m: Any, j: int) -> tuple[int, int]:
    """How many positions and how many velocities joint ``j`` has."""
    return _WIDTHS.get(_kind(m, j), (1, 1))


def dofs(m: Any, j: int) -> range:
    """Degrees of freedom of joint ``j``."""
    start = int(m.jnt_dofadr[j])
    return range(start, start + widths(m, j)[1])


def numbered(name: str, width: int) -> tuple[str, ...]:
    """``name`` alone, or ``name.0``, ``name.1`` ... where a joint or sensor has more
    than one number."""
    return (name,) if width == 1 else tuple(f"{name}.{i}" for i in range(width))


def one_sign(q: np.ndarray) -> np.ndarray:
    """Quaternions ``(T, 4)`` of one path, each of the sign that is nearer to the one
    before: q and -q are the same orientation."""
    turned = np.sum(q[1:] * q[:-1], axis=1) < 0
    sign = np.cumprod(np.append(1.0, np.where(turned, -1.0, 1.0)))
    return q * sign[: len(q), None]


def tangent_names(m: Any) -> tuple[str, ...]:
    """Names of the ``nv`` entries of a tangent vector or velocity."""
    return tuple(
        name
        for j in range(m.njnt)
        for name in numbered(joint_name(m, j), widths(m, j)[1])
    )


def tangent_units(m: Any) -> tuple[str, ...]:
    """Units of the ``nv`` entries of a tangent vector: m or rad."""
    return tuple(u for j in range(m.njnt) for u in _TANGENT_UNITS[_kind(m, j)])


def is_scalar(m: Any, j: int) -> bool:
    """Whether joint ``j`` is a hinge or a slide."""
    return _kind(m, j) in (_Joint.mjJNT_HINGE, _Joint.mjJNT_SLIDE)


def is_free(m: Any, j: int) -> bool:
    """Whether joint ``j`` is a free joint."""
    return _kind(m, j) == _Joint.mjJNT_FREE


def is_hinge(m: Any, j: int) -> bool:
    """Whether joint ``j`` is a hinge."""
    return _kind(m, j) == _Joint.mjJNT_HINGE


def turns_fully(m: Any, j: int) -> bool:
    """Whether joint ``j`` is a hinge in whose range a full turn fits, so that a reading
    may jump by a turn without a motion."""
    low, high = m.jnt_range[j]
    return is_hinge(m, j) and bool(not m.jnt_limited[j] or high - low >= _FULL_TURN)


def driven_joint(m: Any, a: int) -> int | None:
    """The joint that actuator ``a`` is at; None where it is at something else."""
    at = int(m.actuator_trntype[a]) in _AT_JOINT
    return int(m.actuator_trnid[a, 0]) if at else None


def scalar_dofs(m: Any) -> dict[int, tuple[int, int]]:
    """(place in qpos, place in qvel) of hinges and slides, by joint."""
    return {
        j: (int(m.jnt_qposadr[j]), int(m.jnt_dofadr[j]))
        for j in range(m.njnt)
        if is_scalar(m, j)
    }


def scalar_places(m: Any) -> np.ndarray:
    """Places in ``qpos`` and in ``qvel`` of hinges and slides, ``(k, 2)``."""
    return np.array([*scalar_dofs(m).values()], int).reshape(-1, 2)


@dataclass(frozen=True)
class Configuration:
    """Where numbers and quaternions lie in ``qpos`` and ``qvel``.

    Attributes:
        nq: size of ``qpos``.
        nv: size of ``qvel``.
        scalar_qpos: places in ``qpos`` of the plain coordinates.
        scalar_qvel: their places in ``qvel``, in the same order.
        quaternions: (first place in ``qpos``, first place in ``qvel``) of each
            quaternion (4 and 3 wide).
    """

    nq: int
    nv: int
    scalar_qpos: tuple[int, ...]
    scalar_qvel: tuple[int, ...]
    quaternions: tuple[tuple[int, int], ...]

    @classmethod
    def of(cls, model: Any) -> "Configuration":
        """The layout of ``model``, of MuJoCo or of MJX."""
        scalars: list[tuple[int, int]] = []
        quaternions: list[tuple[int, int]] = []
        for j in range(model.njnt):
            qpos, dof = int(model.jnt_qposadr[j]), int(model.jnt_dofadr[j])
            if is_scalar(model, j):
                scalars.append((qpos, dof))
                continue
            before = widths(model, j)[0] - 4  # a free joint's position
            scalars += [(qpos + i, dof + i) for i in range(before)]
            quaternions.append((qpos + before, dof + before))
        return cls(
            nq=model.nq,
            nv=model.nv,
            scalar_qpos=tuple(q for q, _ in scalars),
            scalar_qvel=tuple(v for _, v in scalars),
            quaternions=tuple(quaternions),
        )

    @cached_property
    def _stretches(self) -> tuple[tuple[slice, slice, bool], ...]:
        """Places in ``qpos`` and ``qvel``, in order: plain numbers as far as they
        follow each other, or a quaternion (True)."""
        out: list[tuple[slice, slice, bool]] = []
        first = 0
        for q, v in (*self.quaternions, (self.nq, self.nv)):
            if q > first:
                plain = slice(v - (q - first), v)
                out.append((slice(first, q), plain, False))
            if q < self.nq:
                out.append((slice(q, q + 4), slice(v, v + 3), True))
            first = q + 4
        return tuple(out)

    def difference(self, start: Any, end: Any) -> Any:
        """The tangent vector that leads from ``start`` to ``end`` in unit time.

        Equals ``mujoco.mj_differentiatePos`` with ``dt = 1``; the shorter way
        round is taken, whatever the sign of a quaternion. Plain numbers are
        subtracted: angles do not wrap.

        Args:
            start: ``(..., nq)``, quaternions of unit length.
            end: ``(..., nq)``, broadcast against ``start``.

        Returns:
            ``(..., nv)``, m and rad; of jax where an argument is.
        """
        if not self.quaternions:
            return end - start
        xp = _module(start, end)
        parts = [
            _rotation_vector(xp, start[..., q], end[..., q])
            if turns
            else end[..., q] - start[..., q]
            for q, _, turns in self._stretches
        ]
        return xp.concatenate(parts, -1)

    def integrate(self, start: Any, tangent: Any) -> Any:
        """The configuration reached from ``start`` along ``tangent``.

        Equals ``mujoco.mj_integratePos`` with ``dt = 1`` and undoes
        :meth:`difference`.

        Args:
            start: ``(..., nq)``.
            tangent: ``(..., nv)``, m and rad.

        Returns:
            ``(..., nq)``, quaternions of unit length; of jax where an argument is.
        """
        if not self.quaternions:
            return start + tangent
        xp = _module(start, tangent)
        parts = [
            _turned(xp, start[..., q], tangent[..., v])
            if turns
            else start[..., q] + tangent[..., v]
            for q, v, turns in self._stretches
        ]
        return xp.concatenate(parts, -1)


def _module(*arrays: Any) -> Any:
    return jnp if any(isinstance(x, jax.Array) for x in arrays) else np


def _product(xp: Any, a: Any, b: Any) -> Any:
    """Of quaternions ``(..., 4)``."""
    aw, av = a[..., :1], a[..., 1:]
    bw, bv = b[..., :1], b[..., 1:]
    w = aw * bw - xp.sum(av * bv, -1, keepdims=True)
    return xp.concatenate([w, aw * bv + bw * av + xp.cross(av, bv)], -1)


def _size(xp: Any, vector: Any) -> tuple[Any, Any]:
    """Whether ``vector (..., 3)`` is more than tiny, and its length, else one: the root
    has no slope at zero."""
    square = xp.sum(vector * vector, -1, keepdims=True)
    large = square > _TINY
    return large, xp.sqrt(xp.where(large, square, 1.0))


def _rotation_vector(xp: Any, start: Any, end: Any) -> Any:
    """From unit quaternion ``start`` to ``end``, in the frame of ``start`` [rad]."""
    inverse = xp.concatenate([start[..., :1], -start[..., 1:]], -1)
    turn = _product(xp, inverse, end)
    vector = xp.where(turn[..., :1] < 0, -turn[..., 1:], turn[..., 1:])
    large, sine = _size(xp, vector)
    angle = 2.0 * xp.arctan2(sine, xp.abs(turn[..., :1]))
    return vector * xp.where(large, angle / sine, 2.0)


def _turned(xp: Any, quaternion: Any, vector: Any) -> Any:
    """``quaternion`` turned by a rotation vector in its own frame, of unit length."""
    large, angle = _size(xp, vector)
    real = xp.where(large, xp.cos(angle / 2.0), 1.0)
    scale = xp.where(large, xp.sin(angle / 2.0) / angle, 0.5)
    moved = _product(xp, quaternion, xp.concatenate([real, scale * vector], -1))
    return moved / xp.sqrt(xp.sum(moved * moved, -1, keepdims=True))
