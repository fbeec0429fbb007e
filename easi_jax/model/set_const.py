"""What MuJoCo derives from a model at ``qpos0``, in JAX.

MJX has no ``mj_setConst``: replacing a mass leaves these constants at their old
values, and dry friction, limits and contacts are then wrong in silence. Definitions:
MuJoCo's documentation of `mjModel` (``*_invweight0``: mean diagonal of the inverse
inertia in the coordinates of a joint, body or tendon).
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from mujoco import mjx
from mujoco.mjx._src import smooth, support

from easi_jax.model.mjx_data import make_data
from easi_jax.model.native_model import NativeModel

_ELIMINATE_UP_TO = 24


def spd_inverse(a: jax.Array) -> jax.Array:
    """Inverse of a symmetric positive definite ``(n, n)``.

    Up to 24 rows by Gauss-Jordan elimination written out: a batch of it vectorizes,
    which a batched LAPACK call on a CPU does not.
    """
    n = a.shape[-1]
    if n > _ELIMINATE_UP_TO:
        return jnp.linalg.inv(a)
    for k in range(n):
        row = (a[k] / a[k, k]).at[k].set(1 / a[k, k])
        column = a[:, k]
        a = (a.at[:, k].set(0.0) - column[:, None] * row).at[k].set(row)
    return a


def _ancestry(m: mjx.Model) -> np.ndarray:
    """``(nbody, nbody)``: 1 where the column's body is in the subtree of the row's."""
    out = np.eye(m.nbody)
    for b in range(m.nbody - 1, 0, -1):
        out[m.body_parentid[b]] += out[b]
    return out


def _body_dofs(m: mjx.Model) -> np.ndarray:
    """``(nbody, nv)``: True where the degree of freedom moves the body."""
    return _ancestry(m).T[:, m.dof_bodyid] > 0


def _joint_means(m: mjx.Model, diag: jax.Array) -> jax.Array:
    """The mean over each joint's translations and over its rotations, ``(nv,)``."""
    average = np.eye(m.nv)
    width = {0: (3, 3), 1: (3,)}
    for kind, start in zip(m.jnt_type, m.jnt_dofadr, strict=True):
        for n in width.get(int(kind), (1,)):
            average[start : start + n, start : start + n] = 1 / n
            start += n
    return jnp.asarray(average, diag.dtype) @ diag


def set_const(m: mjx.Model) -> mjx.Model:
    """Recomputes what follows from masses, inertias, armature, centers and gears.

    Sets body_subtreemass, body_invweight0, dof_invweight0, dof_M0,
    tendon_invweight0, actuator_acc0, cam_poscom0 and stat.meaninertia, as
    `mujoco.mj_setConst` does. Lengths and poses at ``qpos0`` do not follow from masses
    and stay. Pure; works under jit, vmap and forward derivatives. For the engine
    ``mujoco`` nothing is done here: MuJoCo C does it where the model is simulated.
    """
    if isinstance(m, NativeModel):
        return m
    mass = m.body_mass
    subtree = jnp.asarray(_ancestry(m), mass.dtype)
    m = m.replace(body_subtreemass=subtree @ mass)
    if m.nv == 0:
        return m
    d = make_data(m).replace(qpos=m.qpos0)
    d = smooth.com_pos(m, smooth.kinematics(m, d))
    d = smooth.tendon(m, d)
    d = smooth.transmission(m, smooth.tendon_armature(m, smooth.crb(m, d)))
    full = support.full_m(m, d)
    impl: Any = d._impl
    inverse = spd_inverse(full)

    def inverse_weight(jac: Any) -> jax.Array:
        """Diagonal of J M^-1 J', ``(..., rows)``, from ``(..., rows, nv)``."""
        return ((jac @ inverse) * jac).sum(-1)

    # cdof: rotation, then translation of the point at the root's center of mass.
    turn, move = d.cdof[:, :3], d.cdof[:, 3:]
    arm = d.xipos - d.subtree_com[m.body_rootid]
    moves = jnp.asarray(_body_dofs(m), mass.dtype)[:, :, None]
    jac_turn = moves * turn
    jac_move = moves * (move + jnp.cross(turn, arm[:, None]))
    jac = jnp.stack([jac_move, jac_turn], 1)  # (nbody, 2, nv, 3)
    body = inverse_weight(jnp.swapaxes(jac, -1, -2)).mean(-1)
    dofs = _joint_means(m, jnp.diagonal(inverse))
    # MuJoCo takes the mass alone for a body that slides along its own axes.
    slides = np.asarray(m.body_simple) == 2
    body = body.at[slides].set(jnp.stack([1 / mass, 0 * mass], 1)[slides])
    dofs = jnp.where(slides[m.dof_bodyid], 1 / mass[m.dof_bodyid], dofs)
    changes: dict[str, Any] = {
        "body_invweight0": body,
        "dof_invweight0": dofs,
        "dof_M0": jnp.diagonal(full),
        "stat.meaninertia": jnp.diagonal(full).mean(),
    }
    if m.ntendon:
        changes["tendon_invweight0"] = inverse_weight(impl.ten_J)
    if m.nu:
        changes["actuator_acc0"] = jnp.linalg.norm(
            impl.actuator_moment @ inverse, axis=-1
        )
    if m.ncam:
        b = m.cam_bodyid
        place = d.xpos[b] + jnp.einsum("cij,cj->ci", d.xmat[b], m.cam_pos)
        changes["cam_poscom0"] = place - d.subtree_com[b]
    return m.tree_replace(changes)  # type: ignore[return-value]
