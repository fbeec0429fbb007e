"""Pairs of geoms that may touch, and what MuJoCo makes of their contact numbers."""

from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from mujoco.mjx._src.collision_driver import geom_pairs

from easi_jax.model.quantities import direct_solref

_LEAST = mujoco.mjMINVAL


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
    geoms: tuple[int, int]
    dim: int
    friction: np.ndarray
    solref: np.ndarray
    solimp: np.ndarray
    margin: float
    stiffness: float
    damping: float


def pair_ids(m: Any) -> list[tuple[int, int]]:
    """Geoms of every pair that may touch; a pair's place in it is its number."""
    return [(int(a), int(b)) for a, b, _ in geom_pairs(m)]


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


def touching(pairs: list[tuple[int, int]], data: mujoco.MjData) -> list[bool]:
    """Which of some pairs of geoms touch in a state after `mj_fwdPosition`."""
    met = {frozenset(g) for g in data.contact.geom[data.contact.dist < 0].tolist()}
    return [frozenset(pair) in met for pair in pairs]
