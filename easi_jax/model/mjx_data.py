"""`mjx.Data` of a model, also where frictionless contacts go with elliptic cones."""

import copy

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx
from mujoco.mjx._src import constraint
from mujoco.mjx._src.collision_driver import make_condim
from mujoco.mjx._src.types import ConeType

from easi_jax.devices.mesh import own_device

# What a row of constraints has.
_ROW = ("J", "pos", "margin", "frictionloss", "D", "aref", "force")


def make_data(m: mjx.Model) -> mjx.Data:
    """Data at ``qpos0``, at rest, on this process's device.

    `mjx.make_data` refuses frictionless contacts (condim 1) beside an elliptic cone,
    although MJX's constraints and solver treat them. Such data are made with friction
    at all contacts, and then given the rows that the model has.
    """
    dim = make_condim(m)
    if m.opt.cone != ConeType.ELLIPTIC or not (dim == 1).any():
        return mjx.make_data(m, own_device())
    rubbed = {k: np.maximum(getattr(m, k), 3) for k in ("geom_condim", "pair_dim")}
    d = mjx.make_data(m.replace(**rubbed), own_device())
    kind = constraint.make_efc_type(m, dim)
    counts = constraint.counts(kind)
    contact = jax.tree.map(lambda x: jnp.repeat(x[:1], dim.size, 0), d._impl.contact)
    address = constraint.make_efc_address(m, dim, kind)
    changes = {
        **dict(zip(("ne", "nf", "nl"), counts[:3], strict=True)),
        "nefc": sum(counts),
        "ncon": dim.size,
        "efc_type": kind,
        "contact": contact.replace(dim=dim, efc_address=address),
    }
    for name in _ROW:
        row = getattr(d._impl, f"efc_{name}")
        changes[f"efc_{name}"] = jnp.zeros((sum(counts), *row.shape[1:]), row.dtype)
    return d.replace(_impl=d._impl.replace(**changes))


def without_idle_cone(m: mujoco.MjModel) -> mujoco.MjModel:
    """The model, with pyramidal cones where all its contacts are frictionless: the
    same motion, for which this package has a faster solver."""
    if m.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC and not (make_condim(m) > 1).any():
        m = copy.copy(m)
        m.opt.cone = mujoco.mjtCone.mjCONE_PYRAMIDAL
    return m
