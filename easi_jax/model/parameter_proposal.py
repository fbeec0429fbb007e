"""A first parameter file for a model: what can vary in it, and in which range.

Places whose names differ in one part are tied where they are alike: of one type, at the
same depth of the tree, with the same values but for mirroring. Where the model says
zero (no friction, no armature) the range comes from the machine itself: from what its
drives or its weight can do, and from its inertia. What moves nothing is left out.
"""

import copy
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import mujoco
import numpy as np

from easi_jax.errors import UserError
from easi_jax.model import addresses as language
from easi_jax.model.joint_space import driven_joint, is_scalar, scalar_dofs
from easi_jax.model.parameters import Parameter, ParameterSpace, Range, declare

_GRAVITY = 9.81
_SHORTEST = 0.01  # m, arm of a weight
_SPEED = {"slide": 1.0, "hinge": 10.0}  # m/s, rad/s: of a brisk motion
_FACTOR = 1e3  # of the middle of the range, that bounds allow either way
_DIGITS = 4  # significant ones, of a proposed number
# Share of a joint's inertia, or of the weight on it, that a body must have, and the
# acceleration [rad/s2, m/s2] that such a weight must make: no log shows less.
_FELT = 1e-3
_INERTIA_DECIMALS = 9  # kg m2: rounding of what is said in a model
_RANGE_DECIMALS = 4  # rad or m: as ends are written
_POSES = 4  # in which bodies are felt for, drawn at random
_SHARES = {  # of the drive's force, of that over a brisk speed, of the inertia
    "frictionloss": (1e-3, 0.1),
    "damping": (1e-3, 0.3),
    "armature": (1e-3, 0.5),
}


@dataclass(frozen=True)
class Proposal:
    """One proposed parameter.

    Attributes:
        parameter: name, addresses and ranges.
        note: what a person should know of it; may be empty.
        tied: names of the places that have it in common; empty where it is one place.
    """

    parameter: Parameter
    note: str = ""
    tied: tuple[str, ...] = ()


def propose(m: mujoco.MjModel, tie: bool = True) -> list[Proposal]:
    """What can vary in a model, in a sensible order.

    Args:
        tie: places that look alike are one parameter.

    Raises:
        UserError: nothing that has a name can vary.
    """
    joints = [n for n, j in language.names(m, "joint").items() if is_scalar(m, j)]
    out: list[Proposal] = []
    for quantity in ("damping", "frictionloss", "armature"):
        out += _tied(m, "joint", quantity, joints, tie)
    drives = [
        n for n, a in language.names(m, "actuator").items() if m.actuator_gear[a].any()
    ]
    for quantity in ("kp", "kv", "gain", "force_limit"):
        out += _tied(m, "actuator", quantity, drives, tie)
    felt = _felt(m)
    heavy = [n for n, b in language.names(m, "body").items() if felt[b]]
    out += _tied(m, "body", "mass", heavy, tie)
    touching = [n for n, g in language.names(m, "geom").items() if not m.geom_bodyid[g]]
    out += _tied(m, "geom", "friction", touching, tie)
    if not out:
        raise UserError(
            "nothing can vary in this model: give its joints, actuators and bodies "
            "names"
        )
    return _with_own_names(out)


def _felt(m: mujoco.MjModel) -> np.ndarray:
    """Which bodies have a mass that a joint feels, ``(nbody,)`` bool."""
    rng = np.random.default_rng(0)
    poses = []
    for _ in range(_POSES):
        d = mujoco.MjData(m)
        mujoco.mj_integratePos(m, d.qpos, rng.uniform(-1, 1, m.nv), 1.0)
        mujoco.mj_forward(m, d)
        poses.append(d)
    out = np.zeros(m.nbody, bool)
    inertia, weight = _loads(m, poses)
    for b in np.flatnonzero((m.body_weldid > 0) & (m.body_mass > 0)):
        # Half of it: without any, a body's own joint would have no inertia.
        lighter = copy.copy(m)
        lighter.body_mass[b] *= 0.5
        lighter.body_inertia[b] *= 0.5
        mujoco.mj_setConst(lighter, mujoco.MjData(lighter))
        rest = _loads(lighter, poses)
        lost = 2.0 * np.abs(weight - rest[1])
        heavy = lost > _FELT * np.maximum(np.abs(weight).max(0), inertia)
        moved = 2.0 * (inertia - rest[0]) > _FELT * inertia
        out[b] = bool(heavy.any() or moved.any())
    return out


def _loads(
    m: mujoco.MjModel, poses: Sequence[mujoco.MjData]
) -> tuple[np.ndarray, np.ndarray]:
    """Inertia and weight on each degree of freedom, ``(poses, nv)`` both."""
    inertia, weight = [], []
    for d in poses:
        d.qvel[:] = 0.0
        mujoco.mj_forward(m, d)
        full = np.zeros((m.nv, m.nv))
        mujoco.mj_fullM(m, d, full)
        inertia.append(np.diagonal(full).copy())
        weight.append(d.qfrc_bias.copy())
    return np.array(inertia), np.array(weight)


def space_of(proposals: list[Proposal]) -> ParameterSpace:
    """The proposed parameters as a space."""
    return ParameterSpace(tuple(p.parameter for p in proposals))


def _tied(
    m: mujoco.MjModel, kind: str, quantity: str, names: list[str], tie: bool
) -> list[Proposal]:
    """One proposal for every group of places that look alike."""
    objects = language.names(m, kind)
    traits: dict[str, tuple[Any, ...]] = {}
    for name in names:
        address = (f"{kind}.{name}.{quantity}",)
        try:
            unit, _ = language.describe(m, address)
            traits[name] = (
                language.nominal(m, address),
                unit,
                *_look(m, kind, objects[name]),
            )
        except UserError:  # cannot vary here, or the model states no value
            continue
    out = []
    for pattern, members in _groups(traits, list(objects), tie):
        value, unit = traits[members[0]][:2]
        made = _proposal(m, kind, quantity, pattern, members[0], value, unit)
        if made is not None:
            tied = tuple(members) if len(members) > 1 else ()
            out.append(replace(made, tied=tied))
    return out


def _groups(
    traits: Mapping[str, tuple[Any, ...]], every: list[str], tie: bool
) -> Iterator[tuple[str, list[str]]]:
    """Places of the same traits by a pattern that matches them alone, or one by one."""
    left = dict(traits)
    for name in traits:
        if name not in left:
            continue
        pattern = _pattern(name, left, every) if tie else name
        members = language.matching(pattern, left)
        for member in members:
            del left[member]
        yield pattern, members


def like_places(m: mujoco.MjModel, kind: str) -> dict[str, tuple[str, ...]]:
    """Groups of joints, actuators or bodies with mass that are alike in type, depth in
    the tree and what the model states, up to mirroring: names by the pattern of each
    group."""
    objects = language.names(m, kind)
    some = dict(objects)
    if kind == "joint":
        some = {name: i for name, i in objects.items() if is_scalar(m, i)}
    if kind == "body":
        some = {name: i for name, i in objects.items() if m.body_mass[i] > 0}
    traits = {n: (*_look(m, kind, i), *_stated(m, kind, i)) for n, i in some.items()}
    groups = _groups(traits, list(objects), True)
    return {k: tuple(members) for k, members in groups if len(members) > 1}


def _stated(m: mujoco.MjModel, kind: str, i: int) -> tuple[float, ...]:
    """Numbers of a joint, an actuator or a body."""
    if kind == "body":
        return (float(f"{m.body_mass[i]:.9g}"),)  # but for rounding of mirrored meshes
    if kind == "joint":
        d = int(m.jnt_dofadr[i])
        own = (m.dof_damping[d], m.dof_frictionloss[d], m.dof_armature[d])
        return (*map(float, own), float(m.jnt_stiffness[i]))
    gains = np.concatenate([m.actuator_gainprm[i, :3], m.actuator_biasprm[i, :3]])
    return tuple(gains.tolist())


def _look(m: mujoco.MjModel, kind: str, i: int) -> tuple[Any, ...]:
    """What places must have in common to be tied.

    Depth in the tree is part of it: joints of one serial chain differ in load and
    gear, whatever their names and values are. Ranges of equal width are alike: that of
    a mirrored joint, and that of one that is mounted turned (thighs of front and rear
    legs).
    """
    if kind == "joint":
        return int(m.jnt_type[i]), _depth(m, i), _width(m.jnt_range[i])
    if kind == "actuator":
        at = driven_joint(m, i)
        look = (
            int(m.actuator_trntype[i]),
            int(m.actuator_dyntype[i]),
            *m.actuator_dynprm[i].tolist(),
            int(m.actuator_gaintype[i]),
            int(m.actuator_biastype[i]),
            _width(m.actuator_ctrlrange[i]),
            _mirrored(m.actuator_forcerange[i]),
            abs(float(m.actuator_gear[i, 0])),
        )
        return look if at is None else (*look, *_look(m, "joint", at))
    if kind == "body":
        return (_body_depth(m, i), *np.round(m.body_inertia[i], _INERTIA_DECIMALS))
    return ()


def _mirrored(ends: np.ndarray) -> tuple[float, ...]:
    """A range ``(2,)`` so that it equals that of its mirror image."""
    return tuple(sorted(np.abs(ends).tolist()))


def _width(ends: np.ndarray) -> float:
    """Of a range ``(2,)``, as it is written in files."""
    return round(float(ends[1] - ends[0]), _RANGE_DECIMALS)


def _depth(m: mujoco.MjModel, joint: int) -> int:
    """Joints on the way from the world to a joint."""
    b = int(m.jnt_bodyid[joint])
    return _body_depth(m, int(m.body_parentid[b])) + joint - int(m.body_jntadr[b])


def _body_depth(m: mujoco.MjModel, body: int) -> int:
    """Joints on the way from the world to a body."""
    count = 0
    while body:
        count += int(m.body_jntnum[body])
        body = int(m.body_parentid[body])
    return count


def _pattern(name: str, traits: dict[str, tuple[Any, ...]], every: list[str]) -> str:
    """The pattern that ties most places that are like ``name``, or ``name``."""
    best, size = name, 1
    tries = [re.sub(head, "*_", name) for head in (r"^[^_]+_", r"^.*_")]
    tries += [re.sub(tail, "", name) + "*" for tail in (r"[^_]+$", r"\d+$")]
    for pattern in (t for t in tries if t.strip("*_")):
        members = language.matching(pattern, every)
        alike = all(m in traits and traits[m] == traits[name] for m in members)
        if alike and len(members) > size:
            best, size = pattern, len(members)
    return best


def _proposal(
    m: mujoco.MjModel,
    kind: str,
    quantity: str,
    pattern: str,
    example: str,
    value: float,
    unit: str,
) -> Proposal | None:
    """None where no range can be given that physics allows."""
    address = f"{kind}.{pattern}.{quantity}"
    stem = re.sub(r"[*_]+$|^[*_]+", "", pattern) or kind
    name = re.sub(r"\W", "_", f"{stem}_{quantity}")
    _, (least, most) = language.describe(m, (address,))
    note = ""
    if value != 0:
        initial = _ordered(value / 3, 3 * value)
        bounds = _ordered(value / _FACTOR, _FACTOR * value)
        if value < 0:
            bounds = least, most
        elif quantity in _SHARES:
            bounds = 0.0, bounds[1]
    elif quantity in _SHARES:
        scale = _scale(m, m.joint(example).id, quantity)
        initial = _ordered(*(s * scale for s in _SHARES[quantity]))
        bounds, note = (0.0, _FACTOR * initial[1]), "the model has none"
    else:
        return None
    bounds = _inside(bounds, (least, most))
    initial = _inside(initial, bounds)
    try:
        parameter = declare(m, name, address, initial=initial, bounds=bounds, unit=unit)
    except UserError:  # its own value is beyond what physics allows
        return None
    return Proposal(parameter, note)


def _ordered(a: float, b: float) -> Range:
    return min(a, b), max(a, b)


def _inside(ends: Range, outer: Range) -> Range:
    """A range with few digits that lies within another."""
    low, high = (float(f"{x:.{_DIGITS}g}") for x in ends)
    return max(low, outer[0]), min(high, outer[1])


def _scale(m: mujoco.MjModel, joint: int, quantity: str) -> float:
    """What a quantity of a joint is compared with, SI units."""
    if quantity == "armature":
        return float(m.dof_M0[m.jnt_dofadr[joint]])
    d = mujoco.MjData(m)
    mujoco.mj_forward(m, d)
    kind = "slide" if m.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE else "hinge"
    body = int(m.jnt_bodyid[joint])
    weight = _GRAVITY * float(m.body_subtreemass[body])
    if kind == "hinge":
        arm = np.linalg.norm(d.subtree_com[body] - d.xanchor[joint])
        weight *= max(float(arm), _SHORTEST)
    # What brings it to a brisk speed within a second counts where nothing weighs on it.
    push = _SPEED[kind] * float(m.dof_M0[m.jnt_dofadr[joint]])
    force = max([weight, push, *_drives(m, joint)])
    return force / _SPEED[kind] if quantity == "damping" else force


def _drives(m: mujoco.MjModel, joint: int) -> list[float]:
    """Largest forces of the actuators at a joint, where the model says them."""
    out = []
    for a in range(m.nu):
        if driven_joint(m, a) != joint:
            continue
        gear = abs(float(m.actuator_gear[a, 0]))
        if m.actuator_forcelimited[a]:
            out.append(gear * float(np.abs(m.actuator_forcerange[a]).max()))
        elif m.actuator_ctrllimited[a]:
            reach = float(np.abs(m.actuator_ctrlrange[a]).max())
            out.append(gear * reach * abs(float(m.actuator_gainprm[a, 0])))
    return out


def _with_own_names(proposals: list[Proposal]) -> list[Proposal]:
    """Numbered where two would have one name."""
    seen: dict[str, int] = {}
    out = []
    for p in proposals:
        name = p.parameter.name
        seen[name] = seen.get(name, 0) + 1
        if seen[name] > 1:
            name = f"{name}_{seen[name]}"
        out.append(replace(p, parameter=replace(p.parameter, name=name)))
    return out


def as_text(proposals: list[Proposal], head: list[str], notes: dict[str, str]) -> str:
    """The proposals as a parameter file, remarks as comments.

    Args:
        head: lines of comment at the top.
        notes: a remark for each parameter by name, where there is one.
    """
    lines = [f"# {line}" for line in head] + ["parameters:"]
    for p in proposals:
        q = p.parameter
        remarks = "; ".join(x for x in (p.note, notes.get(q.name, "")) if x)
        lines += [f"  - name: {q.name}" + (f"  # {remarks}" if remarks else "")]
        if p.tied:
            lines += [f"    # one value for {', '.join(p.tied)}"]
        lines += [
            f"    address: {_text(q.addresses[0])}",
            f"    initial: [{_number(q.initial[0])}, {_number(q.initial[1])}]",
            f"    bounds: [{_number(q.bounds[0])}, {_number(q.bounds[1])}]",
            f"    unit: {_text(q.unit)}",
        ]
    return "\n".join(lines) + "\n"


def _text(x: str) -> str:
    """In quotes, as YAML and JSON both read it."""
    return json.dumps(x, ensure_ascii=False)


def _number(x: float) -> str:
    """All digits, and a number to every YAML reader."""
    if np.isinf(x):
        return ".inf" if x > 0 else "-.inf"
    text = repr(float(x))
    mantissa, e, power = text.partition("e")
    return text if not e or "." in mantissa else f"{mantissa}.0e{power}"


def own_space(m: mujoco.MjModel) -> ParameterSpace:
    """What the model states and a refit may move: damping, frictionloss and stiffness
    of joints where they are not zero, each within a factor of 5."""
    found = []
    for j, (_, d) in scalar_dofs(m).items():
        name = m.joint(j).name
        if not name:
            continue
        for quantity, value in (
            ("damping", m.dof_damping[d]),
            ("frictionloss", m.dof_frictionloss[d]),
            ("stiffness", m.jnt_stiffness[j]),
        ):
            value = float(np.atleast_1d(value)[0])
            if value > 0:
                edge = (value / 5, value * 5)
                address = f"joint.{name}.{quantity}"
                found.append(Parameter(address, (address,), value, edge, edge))
    return ParameterSpace(tuple(found))
