"""How far a body reaches, by its geoms and its inertia."""

import itertools

import mujoco
import numpy as np

_ASIDE = (
    0.5  # of the longest half length: what sits beside a slender body, as drives do
)


def room_for_mass(m: mujoco.MjModel, b: int) -> tuple[np.ndarray, np.ndarray]:
    """How far the center of mass of a body can be from where it is, and still in it.

    The body reaches as far as its geoms and as the box of its inertia; across a slender
    one there is room for half of its half length.

    Returns:
        Lowest and highest shift along each axis of the body's frame, ``(3,)`` [m].
    """
    center = m.body_ipos[b]
    corners = [np.zeros((1, 3)), _box(m, b)]
    for g in np.flatnonzero(m.geom_bodyid == b):
        if m.geom_type[g] != mujoco.mjtGeom.mjGEOM_PLANE:
            middle, half = m.geom_aabb[g, :3], m.geom_aabb[g, 3:]
            at = _turned(middle + _SIGNS * half, m.geom_quat[g]) + m.geom_pos[g]
            corners.append(at - center)
    every = np.concatenate(corners)
    low, high = every.min(0), every.max(0)
    aside = _ASIDE * 0.5 * float((high - low).max())
    return np.minimum(low, -aside), np.maximum(high, aside)


_SIGNS = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))


def _box(m: mujoco.MjModel, b: int) -> np.ndarray:
    """Corners of the even box that has the body's mass and inertia, about its center of
    mass, ``(8, 3)``."""
    mass, inertia = float(m.body_mass[b]), m.body_inertia[b]
    if mass <= 0:
        return np.zeros((1, 3))
    half = np.sqrt(np.maximum(1.5 * (inertia.sum() - 2 * inertia) / mass, 0.0))
    return _turned(_SIGNS * half, m.body_iquat[b])


def _turned(points: np.ndarray, quat: np.ndarray) -> np.ndarray:
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, quat)
    return points @ matrix.reshape(3, 3).T
