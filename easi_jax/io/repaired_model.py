"""``model.xml``: a model with the effects that MJCF can express added to it."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import mujoco
import numpy as np

from easi_jax.found_effects import EffectEntry

_SAID = {
    "coulomb_friction",
    "viscous_damping",
    "joint_stiffness",
    "armature",
    "actuator_gain",
    "actuator_delay",
    "actuator_lag",
    "actuator_saturation",
    "payload_mass",
    "com_offset",
    "gravity_tilt",
    "contact_friction",
    "contact_softness",
}


def repaired_xml(
    path: Path, entries: Sequence[EffectEntry], own: Mapping[str, float]
) -> tuple[str, list[str]]:
    """The model's XML with effects and refitted values, and names of what it lacks.

    The text loads in plain MuJoCo. What MJCF cannot say (a constant torque at a joint,
    torque ripple, late sensors ...) is only in ``effects.yaml``.

    Args:
        path: the model as given.
        entries: effects.
        own: values of the model's own parameters, by address.
    """
    spec = mujoco.MjSpec.from_file(str(path))
    compiled = spec.compile()
    for address, value in own.items():
        kind, rest = address.split(".", 1)
        name, quantity = rest.rsplit(".", 1)
        if kind == "joint":
            _set(spec.joint(name), quantity, value)
    left = []
    for e in entries:
        if e.effect not in _SAID or not _add(spec, compiled, e):
            left.append(f"{e.effect}@{e.at}" if e.at else e.effect)
    spec.compile()
    return spec.to_xml(), left


def _set(joint: mujoco.MjsJoint, quantity: str, value: float) -> None:
    old = getattr(joint, quantity)
    if np.ndim(old):
        old = np.array(old)
        old[0] = value
        setattr(joint, quantity, old)
    else:
        setattr(joint, quantity, value)


def _get(joint: mujoco.MjsJoint, quantity: str) -> float:
    return float(np.ravel(getattr(joint, quantity))[0])


def _add(spec: mujoco.MjSpec, m: mujoco.MjModel, e: EffectEntry) -> bool:
    """Whether it could be added."""
    c = e.columns
    if e.kind == "joint":
        joint = spec.joint(e.at)
        if e.effect == "joint_stiffness":
            if _get(joint, "stiffness") or c["stiffness"] <= 0:
                return False
            _set(joint, "stiffness", c["stiffness"])
            joint.springref = c["spring"] / c["stiffness"]
            return True
        quantity = {
            "coulomb_friction": ("frictionloss", "coulomb"),
            "viscous_damping": ("damping", "damping"),
            "armature": ("armature", "armature"),
        }[e.effect]
        _set(joint, quantity[0], _get(joint, quantity[0]) + c[quantity[1]])
        return True
    if e.kind == "actuator":
        return _actuator(spec.actuator(e.at), e, float(m.opt.timestep))
    if e.kind == "body":
        _body(spec.body(e.at), m, e)
        return True
    if e.effect == "gravity_tilt":
        import jax.numpy as jnp

        from easi_jax.effects import tilted

        spec.option.gravity = np.asarray(
            tilted(
                jnp.asarray(spec.option.gravity),
                jnp.array([c["tilt.0"], c["tilt.1"]]),
            )
        )
        return True
    return _contacts(spec, e)


def _actuator(actuator: mujoco.MjsActuator, e: EffectEntry, timestep: float) -> bool:
    c = e.columns
    if e.effect == "actuator_gain":
        gain = np.array(actuator.gainprm)
        gain[0] *= c["gain"]
        actuator.gainprm = gain
        return True
    if e.effect == "actuator_saturation":
        actuator.forcelimited = True
        actuator.forcerange = [-c["limit"], c["limit"]]
        return True
    if e.effect == "actuator_lag":
        if actuator.dyntype != mujoco.mjtDyn.mjDYN_NONE:
            return False
        actuator.dyntype = mujoco.mjtDyn.mjDYN_FILTEREXACT
        prm = np.array(actuator.dynprm)
        prm[0] = c["lag"]
        actuator.dynprm = prm
        return True
    # MuJoCo C keeps a history of commands; MJX does not.
    actuator.delay = c["delay"]
    actuator.nsample = math.ceil(c["delay"] / timestep) + 2
    return True


def _body(body: mujoco.MjsBody, m: mujoco.MjModel, e: EffectEntry) -> None:
    b = m.body(body.name).id
    mass = float(m.body_mass[b])
    c = e.columns
    extra = c.get("mass", 0.0)
    shift = np.array([c.get(f"com.{i}", 0.0) for i in range(3)])
    body.explicitinertial = True
    body.mass = mass + extra
    body.ipos = m.body_ipos[b] + shift
    body.iquat = m.body_iquat[b]
    body.inertia = m.body_inertia[b] * (1 + c.get("spread", 0.0) * extra / mass)


def _contacts(spec: mujoco.MjSpec, e: EffectEntry) -> bool:
    c = e.columns
    for g in spec.geoms:
        if e.effect == "contact_friction":
            friction = np.array(g.friction)
            friction[0] *= c["friction"]
            g.friction = friction
        else:
            factors = np.array([c["softness.0"], c["softness.1"]])
            solref = np.array(g.solref)
            if (solref > 0).all():
                # Stiffness goes with the inverse square of the time constant, damping
                # with its inverse.
                time, ratio = solref
                time /= factors[1]
                ratio *= factors[1] / np.sqrt(factors[0])
                g.solref = np.array([time, ratio])
            else:
                g.solref = solref * factors
    return not list(spec.pairs)
