"""A first parameter file for a model: what can vary in it, and in which range.

Places whose names differ in one part and whose values are the same are tied. Where the
model says zero (no friction, no armature) the range comes from the machine itself: from
what its drives or its weight can do, and from its inertia.
"""

import fnmatch
import re
from dataclasses import dataclass, replace

import mujoco
import numpy as np

from easi_jax.errors import UserError
from easi_jax.model import addresses as language
from easi_jax.model.joint_space import is_scalar, scalar_dofs
from easi_jax.model.parameters import Parameter, ParameterSpace, declare

_GRAVITY = 9.81
_SHORTEST = 0.01  # m, arm of a weight
_SPEED = {"slide": 1.0, "hinge": 10.0}  # m/s, rad/s: of a brisk motion
_FACTOR = 1e3  # of the middle of the range, that bounds allow either way
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
    """

    parameter: Parameter
    note: str = ""


def propose(m: mujoco.MjModel) -> list[Proposal]:
    """What can vary in a model, in a sensible order.

    Raises:
        UserError: nothing that has a name can vary.
    """
    joints = [n for n, j in language.names(m, "joint").items() if is_scalar(m, j)]
    out: list[Proposal] = []
    for quantity in ("damping", "frictionloss", "armature"):
        out += _tied(m, "joint", quantity, joints)
    drives = list(language.names(m, "actuator"))
    for quantity in ("kp", "kv", "gain", "force_limit"):
        out += _tied(m, "actuator", quantity, drives)
    moving = [
        n
        for n, b in language.names(m, "body").items()
        if m.body_weldid[b] and m.body_mass[b] > 0
    ]
    out += _tied(m, "body", "mass", moving)
    touching = [n for n, g in language.names(m, "geom").items() if not m.geom_bodyid[g]]
    out += _tied(m, "geom", "friction", touching)
    if not out:
        raise UserError(
            "nothing can vary in this model: give its joints, actuators and bodies "
            "names"
        )
    return _with_own_names(out)


def space_of(proposals: list[Proposal]) -> ParameterSpace:
    """The proposed parameters as a space."""
    return ParameterSpace(tuple(p.parameter for p in proposals))


def _tied(
    m: mujoco.MjModel, kind: str, quantity: str, names: list[str]
) -> list[Proposal]:
    """One proposal for every group of places that look alike."""
    values: dict[str, tuple[float, str]] = {}
    for name in names:
        address = (f"{kind}.{name}.{quantity}",)
        try:
            unit, _ = language.describe(m, address)
            values[name] = (language.nominal(m, address), unit)
        except UserError:  # cannot vary here, or the model states no value
            continue
    every = list(language.names(m, kind))
    out, left = [], dict(values)
    for name in values:
        if name not in left:
            continue
        pattern = _pattern(name, left, every)
        for member in fnmatch.filter(left, pattern):
            del left[member]
        made = _proposal(m, kind, quantity, pattern, name, *values[name])
        if made is not None:
            out.append(made)
    return out


def _pattern(name: str, values: dict[str, tuple[float, str]], every: list[str]) -> str:
    """The pattern that ties most places of one value to ``name``, or ``name``."""
    best, size = name, 1
    tries = [re.sub(head, "*_", name) for head in (r"^[^_]+_", r"^.*_")]
    tries += [re.sub(tail, "", name) + "*" for tail in (r"[^_]+$", r"\d+$")]
    for pattern in (t for t in tries if t != "*"):
        members = fnmatch.filter(every, pattern)
        alike = all(m in values and values[m] == values[name] for m in members)
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
    address = f"{kind}.{pattern}.{quantity}"
    stem = re.sub(r"[*_]+$|^[*_]+", "", pattern) or kind
    name = re.sub(r"\W", "_", f"{stem}_{quantity}")
    if value != 0:
        p = declare(m, name, address)
        low = 0.0 if quantity in _SHARES else value / _FACTOR
        bounds = (low, _FACTOR * value) if value > 0 else p.bounds
        return Proposal(replace(p, bounds=bounds))
    if quantity not in _SHARES:
        return None
    scale = _scale(m, m.joint(example).id, quantity)
    low, high = (s * scale for s in _SHARES[quantity])
    p = declare(
        m, name, address, initial=(low, high), bounds=(0.0, _FACTOR * high), unit=unit
    )
    return Proposal(p, "the model has none")


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
    force = max([weight, *_drives(m, joint)])
    return force / _SPEED[kind] if quantity == "damping" else force


def _drives(m: mujoco.MjModel, joint: int) -> list[float]:
    """Largest forces of the actuators at a joint, where the model says them."""
    out = []
    for a in range(m.nu):
        at_joint = m.actuator_trntype[a] == mujoco.mjtTrn.mjTRN_JOINT
        if not at_joint or m.actuator_trnid[a, 0] != joint:
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
        lines += [
            f"  - name: {q.name}" + (f"  # {remarks}" if remarks else ""),
            f'    address: "{q.addresses[0]}"',
            f"    initial: [{_number(q.initial[0])}, {_number(q.initial[1])}]",
            f"    bounds: [{_number(q.bounds[0])}, {_number(q.bounds[1])}]",
            f'    unit: "{q.unit}"',
        ]
    return "\n".join(lines) + "\n"


def _number(x: float) -> str:
    """Short, and a number to every YAML reader."""
    if np.isinf(x):
        return ".inf" if x > 0 else "-.inf"
    text = f"{x:.4g}"
    return text if "e" not in text else f"{x:.12f}".rstrip("0")


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
