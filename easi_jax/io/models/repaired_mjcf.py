"""``model.xml``: a model with the effects that MJCF can express added to it."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from easi_jax.io.models.mjcf import ways
from easi_jax.model.contact_pairs import contact_pairs, geom_name, pair_names
from easi_jax.model.found_effects import EffectEntry

_ASSETS = "assets"  # folder beside the model
_ROUNDING = 1e-9  # rad
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


@dataclass(frozen=True)
class Repaired:
    """A model that loads in plain MuJoCo.

    Attributes:
        xml: its text.
        assets: files that it names (meshes, textures, height fields), by the names
            that it has for them; they belong beside it.
        left: what MJCF has no word for (a constant torque at a joint, torque ripple,
            late sensors ...).
    """

    xml: str
    assets: dict[str, Path]
    left: list[str]


def repaired_model(
    path: Path, entries: Sequence[EffectEntry], text: str | None = None
) -> Repaired:
    """A model with effects.

    Args:
        path: the model as given.
        entries: effects.
        text: taken in place of what ``path`` holds; its files are still looked for
            from there.
    """
    if text is None:
        spec = mujoco.MjSpec.from_file(str(path))
        spec.compile()  # says where files named by included ones are
    else:
        spec = mujoco.MjSpec.from_string(text)
    assets = _gathered(spec, path.parent)
    left = []
    for e in entries:
        # Compiled anew each time: two effects may sit at one body.
        if e.effect not in _SAID or not _add(spec, spec.compile(), e):
            left.append(f"{e.effect}@{e.at}" if e.at else e.effect)
    spec.compile()
    return Repaired(spec.to_xml(), assets, left)


def _gathered(spec: mujoco.MjSpec, folder: Path) -> dict[str, Path]:
    """Files of a model, which is changed to name them beside it."""
    out: dict[str, Path] = {}

    def renamed(file: str, below: str) -> str:
        place = _found(file, folder, below) if file else None
        if place is None:
            return file
        count, name = 1, f"{_ASSETS}/{place.name}"
        while out.setdefault(name, place) != place:
            count += 1
            name = f"{_ASSETS}/{place.stem}_{count}{place.suffix}"
        return name

    for item in (*spec.meshes, *spec.hfields, *spec.skins):
        item.file = renamed(item.file, spec.meshdir)
    for texture in spec.textures:
        texture.file = renamed(texture.file, spec.texturedir)
        for i, file in enumerate(texture.cubefiles):
            texture.cubefiles[i] = renamed(file, spec.texturedir)
    spec.meshdir = spec.texturedir = ""
    spec.assets = {name: place.read_bytes() for name, place in out.items()}
    return out


def _found(file: str, folder: Path, below: str) -> Path | None:
    """The file that MuJoCo read; of an attached model its name alone is left."""
    tried = [
        folder / part / way
        for way in sorted(ways(file), key=len, reverse=True)
        for part in (below, "")
    ]
    tried += [folder / below / Path(file).name]
    tried += sorted(folder.rglob(Path(file).name))
    return next((place.resolve() for place in tried if place.is_file()), None)


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
            return _spring(spec, m, e)
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

        from easi_jax.model.effects import tilted

        spec.option.gravity = np.asarray(
            tilted(
                jnp.asarray(spec.option.gravity),
                jnp.array([c["tilt.0"], c["tilt.1"]]),
            )
        )
        return True
    _contacts(spec, m, e)
    return True


def _spring(spec: mujoco.MjSpec, m: mujoco.MjModel, e: EffectEntry) -> bool:
    """Another spring at a joint that may have one: stiffnesses and torques add up."""
    joint, there = spec.joint(e.at), m.joint(e.at)
    q = int(there.qposadr[0])
    old = float(np.ravel(there.stiffness)[0])
    stiffness = old + e.columns["stiffness"]
    if stiffness <= 0:
        return False
    torque = old * float(m.qpos_spring[q]) + e.columns["spring"]
    _set(joint, "stiffness", stiffness)
    joint.springref = torque / stiffness
    # Angles of a text are in degrees unless it says otherwise.
    if abs(spec.compile().qpos_spring[q] - torque / stiffness) > _ROUNDING:
        joint.springref = math.degrees(torque / stiffness)
    return True


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


def _contacts(spec: mujoco.MjSpec, m: mujoco.MjModel, e: EffectEntry) -> None:
    """Contacts of one pair of geoms, or all: pairs hold their own numbers, geoms those
    of the others."""
    one, c = e.kind == "geom", e.columns
    items = [_pair(spec, m, e.at)] if one else [*spec.geoms, *spec.pairs]
    slip, give = ("slip", "give") if one else ("friction", "softness")
    for item in items:
        if e.effect == "contact_friction":
            friction = np.array(item.friction)
            # A geom has one sliding friction, a pair two.
            friction[: 1 if len(friction) == 3 else 2] *= c[slip]
            item.friction = friction
        else:
            factors = np.array([c[f"{give}.0"], c[f"{give}.1"]])
            item.solref = _softer(np.array(item.solref), factors)


def _softer(solref: np.ndarray, factors: np.ndarray) -> np.ndarray:
    """Contacts whose stiffness and damping are multiplied by ``factors (2,)``."""
    if (solref <= 0).any():
        return solref * factors
    # Stiffness goes with the inverse square of the time constant, damping with its
    # inverse.
    time, ratio = solref
    time /= factors[1]
    return np.array([time, ratio * factors[1] / np.sqrt(factors[0])])


def _pair(spec: mujoco.MjSpec, m: mujoco.MjModel, at: str) -> mujoco.MjsPair:
    """The ``<pair>`` of two geoms, made from their numbers where there is none."""
    p = contact_pairs(m)[pair_names(m)[at]]
    names = [geom_name(m, g) for g in p.geoms]
    for g, name in zip(p.geoms, names, strict=True):
        spec.geoms[g].name = name
    # Compiled pairs are in another order.
    there = [q for q in spec.pairs if {q.geomname1, q.geomname2} == set(names)]
    if there:
        return there[-1]
    pair = spec.add_pair(geomname1=names[0], geomname2=names[1])
    pair.condim, pair.margin, pair.solimp = p.dim, p.margin, p.solimp
    pair.friction, pair.solref = p.friction, p.solref
    return pair
