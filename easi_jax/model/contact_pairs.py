"""Pairs of geoms that may touch, and what MuJoCo makes of their contact numbers."""

import copy
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from mujoco.mjx._src.collision_driver import _COLLISION_FUNC, geom_pairs

from easi_jax.model.quantities import direct_solref

_LEAST = mujoco.mjMINVAL
# Of the model's extent: geoms within it count as near. Predictions start at measured
# poses, and stay within it unless they are wrong anyway.
_NEAR = 0.05
_POSES = 20_000  # looked at, evenly, at most
_TOGETHER = 500  # poses
_BITS = 31  # of a geom's contype, the sign left out
_ALWAYS = (mujoco.mjtGeom.mjGEOM_HFIELD, mujoco.mjtGeom.mjGEOM_SDF)  # no distance

Pair = tuple[int, int]


@dataclass(frozen=True)
class ContactPair:
    """Two geoms that may touch, and the numbers of their contacts.

    Attributes:
        name: ``GEOM/GEOM``.
        geoms: the two, in MJX's order.
        dim: condim.
        friction: two sliding, one torsional, two rolling, ``(5,)``.
        solref: as MuJoCo writes it, ``(2,)``.
        solimp: ``(5,)``.
        margin: [m].
        stiffness, damping: what ``solref`` means [1/s^2, 1/s].
    """

    name: str
    geoms: Pair
    dim: int
    friction: np.ndarray
    solref: np.ndarray
    solimp: np.ndarray
    margin: float
    stiffness: float
    damping: float


def pair_ids(m: Any) -> list[Pair]:
    """Geoms of every pair that may touch; a pair's place in it is its number."""
    return [(int(a), int(b)) for a, b, _ in geom_pairs(m)]


def contacts(m: Any) -> tuple[int, int]:
    """How many contacts MJX computes at every step, touching or not: with planes, and
    between other geoms. A pair that MJX lacks counts once."""
    counts = [0, 0]
    if m.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CONTACT:
        return 0, 0
    for pair in pair_ids(m):
        types: Any = tuple(int(m.geom_type[g]) for g in pair)
        other = mujoco.mjtGeom.mjGEOM_PLANE not in types
        counts[other] += getattr(_COLLISION_FUNC.get(types), "ncon", 1)
    return counts[0], counts[1]


def geom_name(m: Any, g: int) -> str:
    """A geom's name, or its number."""
    return m.geom(g).name or f"geom{g}"


def pair_names(m: Any) -> dict[str, int]:
    """``GEOM/GEOM`` of every pair that may touch -> its number."""
    names = ("/".join(geom_name(m, g) for g in pair) for pair in pair_ids(m))
    return {name: k for k, name in enumerate(names)}


def contact_pairs(m: mujoco.MjModel) -> list[ContactPair]:
    """Every pair that may touch.

    MuJoCo documentation, "Contact": the geom of higher priority decides; between equal
    ones the larger friction and condim, and means weighed by solmix, count.
    """
    return [_pair(m, int(a), int(b), int(p)) for a, b, p in geom_pairs(m)]


def _pair(m: mujoco.MjModel, a: int, b: int, explicit: int) -> ContactPair:
    if explicit >= 0:
        dim, margin = m.pair_dim[explicit], m.pair_margin[explicit]
        friction, solref = m.pair_friction[explicit], m.pair_solref[explicit]
        solimp = m.pair_solimp[explicit]
    else:
        both = [a, b]
        if m.geom_priority[a] != m.geom_priority[b]:
            both = 2 * [a if m.geom_priority[a] > m.geom_priority[b] else b]
        dim, margin = m.geom_condim[both].max(), m.geom_margin[[a, b]].sum()
        friction = m.geom_friction[both].max(0)[[0, 0, 1, 2, 2]]
        refs, share = m.geom_solref[both], _share(m.geom_solmix[both])
        solref = share @ refs if (refs[:, 0] > 0).all() else refs.min(0)
        solimp = share @ m.geom_solimp[both]
    return ContactPair(
        "/".join(geom_name(m, g) for g in (a, b)),
        (a, b),
        int(dim),
        np.array(friction),
        np.array(solref),
        np.array(solimp),
        float(margin),
        *direct_solref(m, solref),
    )


def _share(mix: np.ndarray) -> np.ndarray:
    """Weights of two geoms by their solmix."""
    enough = mix >= _LEAST
    if enough.all():
        return mix / mix.sum()
    return np.array([0.5, 0.5]) if not enough.any() else enough.astype(float)


def _between(m: mujoco.MjModel, a: int, b: int) -> set[int]:
    """Degrees of freedom that move geoms ``a`` and ``b`` against each other."""
    return _moving(m, a) ^ _moving(m, b)


def _moving(m: mujoco.MjModel, g: int) -> set[int]:
    """Degrees of freedom that move geom ``g`` in the world."""
    out, b = set[int](), int(m.geom_bodyid[g])
    while b:
        first = int(m.body_dofadr[b])
        out.update(range(first, first + int(m.body_dofnum[b])))
        b = int(m.body_parentid[b])
    return out


def never_near(
    m: mujoco.MjModel,
    qpos: np.ndarray,
    lengthened: Mapping[int, float] | None = None,
    hidden: np.ndarray | None = None,
) -> frozenset[Pair]:
    """Pairs of `pair_ids` that stay apart in all of some poses.

    Near are geoms within their margin and 5 % of the model's extent. Pairs that the
    model names (``<pair>``), with height fields or signed distance fields, those of
    a free body with what cannot move, and those between which nobody measured a joint
    are never apart.

    Args:
        m: the model.
        qpos: poses, ``(K, nq)`` [m, rad].
        lengthened: geoms whose surface may move by so much [m], in their body.
        hidden: degrees of freedom that nobody measured, ``(nv,)`` bool.
    """
    more = dict(lengthened or {})
    unknown = set() if hidden is None else set(np.flatnonzero(hidden).tolist())
    left = {
        (int(a), int(b)): _NEAR * m.stat.extent
        + float(m.geom_margin[[a, b]].sum())
        + more.get(int(a), 0.0)
        + more.get(int(b), 0.0)
        for a, b, named in geom_pairs(m)
        if named < 0
        and not _always(m, int(a), int(b))
        and not (_between(m, int(a), int(b)) & unknown)
    }
    d = mujoco.MjData(m)
    looked_at = np.linspace(0, len(qpos) - 1, min(len(qpos), _POSES)).astype(int)
    for first in range(0, len(looked_at), _TOGETHER):
        rows = qpos[looked_at[first : first + _TOGETHER]]
        centers = np.empty((len(rows), m.ngeom, 3))
        for i, row in enumerate(rows):
            d.qpos[:] = row
            mujoco.mj_kinematics(m, d)
            centers[i] = d.geom_xpos
        for (a, b), within in list(left.items()):
            reach = within + m.geom_rbound[a] + m.geom_rbound[b]
            off = np.linalg.norm(centers[:, a] - centers[:, b], axis=1)
            flat = m.geom_rbound[[a, b]].min() == 0  # a plane has no bound
            for i in np.flatnonzero((off < reach) | flat):
                d.qpos[:] = rows[i]
                mujoco.mj_kinematics(m, d)
                if mujoco.mj_geomDistance(m, d, a, b, within, None) < within:
                    del left[a, b]
                    break
    return frozenset(left)


def _always(m: mujoco.MjModel, a: int, b: int) -> bool:
    if m.geom_type[a] in _ALWAYS or m.geom_type[b] in _ALWAYS:
        return True
    bodies = m.geom_bodyid[[a, b]]
    fixed = m.body_weldid[bodies] == 0
    first = m.body_dofadr[m.body_rootid[bodies]]
    types = m.jnt_type[m.dof_jntid[np.maximum(first, 0)]] if m.nv else first
    free = (first >= 0) & (types == mujoco.mjtJoint.mjJNT_FREE)
    return bool(fixed.any() and free.any())


def without_pairs(m: mujoco.MjModel, apart: Collection[Pair]) -> mujoco.MjModel:
    """A copy in which some pairs of `pair_ids` cannot touch, all others as before.

    The pairs that are left are parted into stars, a bit of contype and conaffinity
    each; where these bits do not suffice, no pair is taken out.
    """
    edges = {(int(a), int(b)) for a, b, named in geom_pairs(m) if named < 0}
    edges -= set(apart)
    contype, conaffinity = np.zeros((2, m.ngeom), m.geom_contype.dtype)
    for bit in range(_BITS):
        if not edges:
            break
        ends = [g for pair in edges for g in pair]
        center = max(sorted(set(ends)), key=ends.count)
        star = {pair for pair in edges if center in pair}
        contype[center] |= 1 << bit
        for a, b in star:
            conaffinity[b if a == center else a] |= 1 << bit
        edges -= star
    if edges:
        return m
    out = copy.copy(m)
    out.geom_contype[:], out.geom_conaffinity[:] = contype, conaffinity
    return out


def touching(pairs: list[Pair], data: mujoco.MjData) -> list[bool]:
    """Which of some pairs of geoms touch in a state after `mj_fwdPosition`."""
    met = {frozenset(g) for g in data.contact.geom[data.contact.dist < 0].tolist()}
    return [frozenset(pair) in met for pair in pairs]
