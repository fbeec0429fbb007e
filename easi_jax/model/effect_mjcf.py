"""How MJCF says an effect: numbers of a compiled model, and what must be there first.

MuJoCo writes the numbers back into a model's text; see
`easi_jax.io.models.repaired_mjcf`.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from easi_jax.model.contact_pairs import contact_pairs, geom_name, pair_names
from easi_jax.model.effect_numbers import EffectEntry
from easi_jax.model.effects import drive_factors, tilted
from easi_jax.model.joint_space import joint_name
from easi_jax.model.quantities import actuator_name, body_name, direct_solref

_LINEAR = 1  # MuJoCo's ``interp`` of commands that are kept: between two of them


@dataclass(frozen=True)
class InMjcf:
    """An effect in MJCF.

    Attributes:
        write: sets its numbers in a compiled model.
        build: makes what must be there before, in the model's text and from that
            compiled; whether it can.
    """

    write: Callable[[mujoco.MjModel, EffectEntry], None]
    build: Callable[[mujoco.MjSpec, mujoco.MjModel, EffectEntry], bool] = (
        lambda spec, m, e: True
    )


def _index(m: mujoco.MjModel, e: EffectEntry) -> int:
    """The joint, actuator or body that an effect is at; ValueError without it."""
    count, name = {
        "joint": (m.njnt, joint_name),
        "actuator": (m.nu, actuator_name),
        "body": (m.nbody, body_name),
    }[e.kind]
    return [name(m, i) for i in range(count)].index(e.at)


def _of_joint(field: str, column: str) -> Callable[[mujoco.MjModel, EffectEntry], None]:
    def write(m: mujoco.MjModel, e: EffectEntry) -> None:
        getattr(m, field)[m.jnt_dofadr[_index(m, e)]] += e.columns[column]

    return write


def _springy(spec: mujoco.MjSpec, m: mujoco.MjModel, e: EffectEntry) -> bool:
    return m.jnt_stiffness[_index(m, e)] + e.columns["stiffness"] > 0


def _spring(m: mujoco.MjModel, e: EffectEntry) -> None:
    """Another spring at a joint that may have one: stiffnesses and torques add up."""
    j = _index(m, e)
    q, old = m.jnt_qposadr[j], float(m.jnt_stiffness[j])
    torque = old * float(m.qpos_spring[q]) + e.columns["spring"]
    m.jnt_stiffness[j] = old + e.columns["stiffness"]
    m.qpos_spring[q] = torque / m.jnt_stiffness[j]


def _drive(m: mujoco.MjModel, e: EffectEntry) -> None:
    at = [_index(m, e)]
    names = "gain", "kp", "kv", "strength"
    gain, kp, kv, strength = (np.array([e.columns.get(n, 1.0)]) for n in names)
    factors = gain, kp, kv, strength
    gains, biases = drive_factors(m.actuator_biasprm[at], *factors, np)
    m.actuator_gainprm[at, :3] *= gains
    m.actuator_biasprm[at, :3] *= biases


def _saturation(m: mujoco.MjModel, e: EffectEntry) -> None:
    a, limit = _index(m, e), e.columns["limit"]
    edges = -limit, limit
    if m.actuator_forcelimited[a]:
        low, high = m.actuator_forcerange[a]
        edges = max(low, -limit), min(high, limit)
    m.actuator_forcelimited[a] = True
    m.actuator_forcerange[a] = edges


def _filtered(spec: mujoco.MjSpec, m: mujoco.MjModel, e: EffectEntry) -> bool:
    a = _index(m, e)
    actuator = spec.actuators[a]
    if actuator.dyntype != mujoco.mjtDyn.mjDYN_NONE:
        return False
    actuator.dyntype = mujoco.mjtDyn.mjDYN_FILTEREXACT
    # A key frame is at rest: its command has arrived. The other activations move on.
    range_ = m.actuator_ctrlrange[a] if m.actuator_ctrllimited[a] else (None, None)
    for key, act, ctrl in zip(spec.keys, m.key_act, m.key_ctrl[:, a], strict=True):
        at = int(m.actuator_actnum[:a].sum())
        key.act = np.insert(act, at, np.clip(ctrl, *range_))
    return True


def _lag(m: mujoco.MjModel, e: EffectEntry) -> None:
    m.actuator_dynprm[_index(m, e), 0] = e.columns["lag"]


def _delayed(spec: mujoco.MjSpec, m: mujoco.MjModel, e: EffectEntry) -> bool:
    # MuJoCo C keeps a history of commands; MJX does not.
    # It acts between two steps by interpolation, and after one at least.
    actuator = spec.actuators[_index(m, e)]
    delay = actuator.delay + e.columns["delay"]
    if delay < m.opt.timestep:
        return False
    actuator.delay, actuator.interp = delay, _LINEAR
    actuator.nsample = math.ceil(delay / m.opt.timestep) + 2
    return True


def tendon(acts: Sequence[tuple[str, float]], words: Mapping[str, str]) -> InMjcf:
    """A fixed tendon along a sum of joints with shares, whose numbers an effect's are.

    Args:
        acts: joints with the share of each.
        words: for each number of the effect stiffness, damping or frictionloss: the
            tendon has as much of it as the number is below zero.
    """

    def build(spec: mujoco.MjSpec, m: mujoco.MjModel, e: EffectEntry) -> bool:
        if any(e.columns[column] > 0 for column in words):
            return False
        added = spec.add_tendon(name=f"{e.effect}@{e.at}")
        for joint, share in acts:
            added.wrap_joint(joint, share)
        added.springlength = [0.0, 0.0]  # not that of the model's first pose
        for column, word in words.items():
            value = getattr(added, word)
            size = -e.columns[column]
            if np.ndim(value):
                value[0] = size  # of a polynomial
            else:
                setattr(added, word, size)
        return True

    return InMjcf(lambda m, e: None, build)


def _body(m: mujoco.MjModel, e: EffectEntry) -> None:
    b, c = _index(m, e), e.columns
    extra, mass = c.get("mass", 0.0), float(m.body_mass[b])
    m.body_mass[b] = mass + extra
    m.body_ipos[b] += [c.get(f"com.{i}", 0.0) for i in range(3)]
    if mass > 0:
        m.body_inertia[b] *= 1 + c.get("spread", 0.0) * extra / mass


def _gravity(m: mujoco.MjModel, e: EffectEntry) -> None:
    with jax.enable_x64(True):
        tilt = jnp.array([e.columns["tilt.0"], e.columns["tilt.1"]])
        m.opt.gravity = np.asarray(tilted(jnp.asarray(m.opt.gravity), tilt))


def _pair_made(spec: mujoco.MjSpec, m: mujoco.MjModel, e: EffectEntry) -> bool:
    """Makes the ``<pair>`` of two geoms from their numbers where there is none."""
    if e.kind != "geom":
        return True
    p = contact_pairs(m)[pair_names(m)[e.at]]
    names = [geom_name(m, g) for g in p.geoms]
    for g, name in zip(p.geoms, names, strict=True):
        spec.geoms[g].name = name
    if _pair_of(m, e.at) is None:
        pair = spec.add_pair(geomname1=names[0], geomname2=names[1])
        pair.condim, pair.margin, pair.solimp = p.dim, p.margin, p.solimp
        pair.friction, pair.solref = p.friction, p.solref
    return True


def _pair_of(m: mujoco.MjModel, at: str) -> int | None:
    """The stated pair of two geoms."""
    geoms = {*contact_pairs(m)[pair_names(m)[at]].geoms}
    stated = zip(m.pair_geom1.tolist(), m.pair_geom2.tolist(), strict=True)
    return next((k for k, pair in enumerate(stated) if {*pair} == geoms), None)


def _slip(m: mujoco.MjModel, e: EffectEntry) -> None:
    """Pairs hold their own numbers, geoms those of the other contacts."""
    if e.kind == "geom":
        m.pair_friction[_pair_of(m, e.at), :2] *= e.columns["slip"]
    else:
        m.geom_friction[:, 0] *= e.columns["friction"]
        m.pair_friction[:, :2] *= e.columns["friction"]


def _soft(m: mujoco.MjModel, e: EffectEntry) -> None:
    name = "give" if e.kind == "geom" else "softness"
    factors = np.array([e.columns[f"{name}.{i}"] for i in range(2)])
    if e.kind == "geom":
        k = _pair_of(m, e.at)
        m.pair_solref[k] = _softer(m, m.pair_solref[[k]], factors)[0]
    else:
        m.geom_solref[:] = _softer(m, m.geom_solref, factors)
        m.pair_solref[:] = _softer(m, m.pair_solref, factors)


def _softer(m: mujoco.MjModel, solref: np.ndarray, factors: np.ndarray) -> np.ndarray:
    """Contacts ``(n, 2)`` whose stiffness and damping are multiplied by ``factors``."""
    safe = not m.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_REFSAFE
    least = 2 * m.opt.timestep if safe else 0.0
    # Stiffness goes with the inverse square of the time constant, damping with its
    # inverse. MuJoCo takes weighed means of both numbers of two geoms.
    out = solref * np.array([1, factors[1] / np.sqrt(factors[0])])
    out[:, 0] = np.maximum(solref[:, 0], least) / factors[1]
    if (solref > 0).all() and (out[:, 0] >= least).all():
        return out
    direct = -np.array([direct_solref(m, row) for row in solref]) * factors
    if len(np.unique(direct[solref[:, 0] > 0], axis=0)) > 1:
        raise ValueError("contacts of unequal time constants at the least that is safe")
    return direct


COULOMB = InMjcf(_of_joint("dof_frictionloss", "coulomb"))
DAMPING = InMjcf(_of_joint("dof_damping", "damping"))
ARMATURE = InMjcf(_of_joint("dof_armature", "armature"))
SPRING = InMjcf(_spring, _springy)
DRIVE = InMjcf(_drive)
LIMIT = InMjcf(_saturation)
LAG = InMjcf(_lag, _filtered)
DELAY = InMjcf(lambda m, e: None, _delayed)
BODY = InMjcf(_body)
TILT = InMjcf(_gravity)
FRICTION = InMjcf(_slip, _pair_made)
SOFTNESS = InMjcf(_soft, _pair_made)
