"""What MuJoCo C adds to point constraints and MJX leaves out."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from mujoco.mjx._src.types import DisableBit, EqType, ObjType


def with_velocity_products(m: Any, d: Any) -> Any:
    """The data with ``-dJ/dt qvel`` in the reference acceleration of `connect` rows.

    MuJoCo C (4.0) takes the velocity products of point constraints into account, MJX
    3.17 does not, and a closed chain in fast motion is then off by several percent of
    its acceleration. For the data after the velocity stage.
    """
    ids = np.flatnonzero(m.eq_type == EqType.CONNECT)
    off = DisableBit.EQUALITY | DisableBit.CONSTRAINT
    if not ids.size or m.opt.disableflags & off:
        return d
    rows = jnp.concatenate([_connect(m, d, int(i)) for i in ids])
    aref = d._impl.efc_aref
    return d.tree_replace({"_impl.efc_aref": aref.at[: len(rows)].add(-rows)})


def _connect(m: Any, d: Any, i: int) -> jax.Array:
    """Acceleration of point 1 against point 2 at zero ``qacc``, ``(3,)``."""
    ends = []
    for k, obj in enumerate((int(m.eq_obj1id[i]), int(m.eq_obj2id[i]))):
        if m.eq_objtype[i] == ObjType.SITE:
            body, point = int(m.site_bodyid[obj]), d.site_xpos[obj]
        else:
            anchor = m.eq_data[i, 3 * k : 3 * k + 3]
            body, point = obj, d.xmat[obj].reshape(3, 3) @ anchor + d.xpos[obj]
        ends.append(_acceleration(m, d, body, point))
    return (ends[0] - ends[1]) * d.eq_active[i]


def _acceleration(m: Any, d: Any, body: int, point: jax.Array) -> jax.Array:
    """Of a point of a body at zero ``qacc`` and without gravity, ``(3,)``."""
    if body == 0:
        return jnp.zeros(3)
    arm = point - d.subtree_com[int(m.body_rootid[body])]
    spatial = jnp.zeros(6)  # angular, linear, about the center of mass of the tree
    b = body
    while b:
        first, count = int(m.body_dofadr[b]), int(m.body_dofnum[b])
        for j in range(first, first + count):
            spatial = spatial + d.cdof_dot[j] * d.qvel[j]
        b = int(m.body_parentid[b])
    turn = d.cvel[body, :3]
    speed = d.cvel[body, 3:] + jnp.cross(turn, arm)
    return spatial[3:] + jnp.cross(spatial[:3], arm) + jnp.cross(turn, speed)
