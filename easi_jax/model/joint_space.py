"""Differences and steps on a model's configuration space, in numpy.

A hinge or slide coordinate is a plain number; the orientation of a ball or free
joint is a unit quaternion (w x y z), whose differences are rotation vectors in
the joint's own frame, as MuJoCo's angular velocities are.
"""

from dataclasses import dataclass

import mujoco
import numpy as np

_TINY = 1e-12


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
    def of(cls, model: mujoco.MjModel) -> "Configuration":
        """The layout of ``model``."""
        scalars: list[tuple[int, int]] = []
        quaternions: list[tuple[int, int]] = []
        for kind, qpos, dof in zip(
            model.jnt_type, model.jnt_qposadr, model.jnt_dofadr, strict=True
        ):
            qpos, dof = int(qpos), int(dof)
            if kind == mujoco.mjtJoint.mjJNT_FREE:
                scalars += [(qpos + i, dof + i) for i in range(3)]
                quaternions.append((qpos + 3, dof + 3))
            elif kind == mujoco.mjtJoint.mjJNT_BALL:
                quaternions.append((qpos, dof))
            else:
                scalars.append((qpos, dof))
        return cls(
            nq=model.nq,
            nv=model.nv,
            scalar_qpos=tuple(q for q, _ in scalars),
            scalar_qvel=tuple(v for _, v in scalars),
            quaternions=tuple(quaternions),
        )

    def difference(self, start: np.ndarray, end: np.ndarray) -> np.ndarray:
        """The tangent vector that leads from ``start`` to ``end`` in unit time.

        Equals ``mujoco.mj_differentiatePos`` with ``dt = 1``; the shorter way
        round is taken, whatever the sign of a quaternion.

        Args:
            start: ``(..., nq)``, quaternions of unit length.
            end: ``(..., nq)``, broadcast against ``start``.

        Returns:
            ``(..., nv)``, m and rad.
        """
        shape = np.broadcast_shapes(start.shape, end.shape)[:-1]
        out = np.empty((*shape, self.nv))
        qpos, qvel = list(self.scalar_qpos), list(self.scalar_qvel)
        out[..., qvel] = end[..., qpos] - start[..., qpos]
        for q, v in self.quaternions:
            inverse = start[..., q : q + 4] * np.array([1.0, -1.0, -1.0, -1.0])
            turn = _product(inverse, end[..., q : q + 4])
            out[..., v : v + 3] = _rotation_vector(turn)
        return out

    def integrate(self, start: np.ndarray, tangent: np.ndarray) -> np.ndarray:
        """The configuration reached from ``start`` along ``tangent``.

        Equals ``mujoco.mj_integratePos`` with ``dt = 1`` and undoes
        :meth:`difference`.

        Args:
            start: ``(..., nq)``.
            tangent: ``(..., nv)``, m and rad.

        Returns:
            ``(..., nq)``, quaternions of unit length.
        """
        shape = np.broadcast_shapes(start.shape[:-1], tangent.shape[:-1])
        out = np.empty((*shape, self.nq))
        qpos, qvel = list(self.scalar_qpos), list(self.scalar_qvel)
        out[..., qpos] = start[..., qpos] + tangent[..., qvel]
        for q, v in self.quaternions:
            turn = _quaternion(tangent[..., v : v + 3])
            moved = _product(start[..., q : q + 4], turn)
            norm = np.linalg.norm(moved, axis=-1, keepdims=True)
            out[..., q : q + 4] = moved / norm
        return out


def _product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    aw, av = a[..., :1], a[..., 1:]
    bw, bv = b[..., :1], b[..., 1:]
    w = aw * bw - np.sum(av * bv, axis=-1, keepdims=True)
    return np.concatenate([w, aw * bv + bw * av + np.cross(av, bv)], axis=-1)


def _rotation_vector(quaternion: np.ndarray) -> np.ndarray:
    near = np.where(quaternion[..., :1] < 0, -quaternion, quaternion)
    sine = np.linalg.norm(near[..., 1:], axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(sine, near[..., :1])
    ratio = np.where(sine < _TINY, 2.0, angle / np.maximum(sine, _TINY))
    return near[..., 1:] * ratio


def _quaternion(rotation_vector: np.ndarray) -> np.ndarray:
    angle = np.linalg.norm(rotation_vector, axis=-1, keepdims=True)
    # numpy's sinc is sin(pi x) / (pi x)
    half = 0.5 * np.sinc(angle / (2.0 * np.pi))
    return np.concatenate([np.cos(angle / 2.0), rotation_vector * half], axis=-1)
