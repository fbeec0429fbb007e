"""Parts of a machine that have nothing to do with each other: legs in a stand, say."""

import mujoco
import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from easi_jax.model.contact_pairs import pair_ids
from easi_jax.model.joint_space import driven_joint


def separate_trees(m: mujoco.MjModel) -> np.ndarray:
    """Number of the part that each degree of freedom belongs to, ``(nv,)``.

    A part is one or more kinematic trees. Trees whose geoms may touch are one part;
    where an equality, a tendon, a flex or an actuator that is not at a joint may couple
    trees, all of them are.
    """
    others = any(driven_joint(m, a) is None for a in range(m.nu))
    if m.neq or m.ntendon or m.nflex or others:
        return np.zeros(m.nv, int)
    pairs = np.array(pair_ids(m), int).reshape(-1, 2)
    trees = m.body_treeid[m.geom_bodyid[pairs]]
    trees = trees[(trees >= 0).all(1)]
    shape = m.ntree, m.ntree
    touching = coo_array((np.ones(len(trees)), (trees[:, 0], trees[:, 1])), shape)
    return connected_components(touching, directed=False)[1][m.dof_treeid]


def start_parts(m: mujoco.MjModel) -> np.ndarray:
    """The part of each number of a start: positions, velocities and activations,
    ``(2 nv + na,)``."""
    parts = separate_trees(m)
    driven = np.zeros(m.na, int)
    for i in np.flatnonzero(m.actuator_actadr >= 0):
        first = int(m.actuator_actadr[i])
        joint = int(m.actuator_trnid[i, 0])
        # Where an actuator is at something else, all is one part.
        part = parts[m.jnt_dofadr[joint]] if parts.any() else 0
        driven[first : first + int(m.actuator_actnum[i])] = part
    return np.concatenate([parts, parts, driven])


def turns(parts: np.ndarray) -> np.ndarray:
    """Place of each number among those of its part, ``(s,)``: numbers of one place can
    be moved at once, and every channel tells of its own part's."""
    return np.array([np.sum(parts[:i] == k) for i, k in enumerate(parts)], int)
