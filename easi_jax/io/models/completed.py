"""A user's model with what logs and addresses need: names, and a base that was held."""

import itertools
from collections.abc import Mapping
from pathlib import Path

import mujoco

from easi_jax.model.joint_space import given_name

_LISTED = 6  # new names in the note
_TARGETS = {
    mujoco.mjtTrn.mjTRN_JOINT: "joint",
    mujoco.mjtTrn.mjTRN_JOINTINPARENT: "joint",
    mujoco.mjtTrn.mjTRN_TENDON: "tendon",
    mujoco.mjtTrn.mjTRN_SITE: "site",
    mujoco.mjtTrn.mjTRN_BODY: "body",
    mujoco.mjtTrn.mjTRN_SLIDERCRANK: "site",
}


def new_names(m: mujoco.MjModel) -> tuple[dict[int, str], dict[int, str]]:
    """Names for the joints and for the actuators of ``m`` that have none, by number.

    A joint is called ``BODY_joint``, a free joint ``BODY``, an actuator
    ``TARGET_actuator``; a body, tendon or site without a name is called after its kind
    and number. ``_2``, ``_3`` ... make names unique.
    """
    joints = _unique(
        {
            j: given_name(m, j) or f"{_called(m, 'body', int(m.jnt_bodyid[j]))}_joint"
            for j in range(m.njnt)
            if not m.joint(j).name
        },
        {m.joint(j).name for j in range(m.njnt)},
    )
    actuators = {}
    for a in range(m.nu):
        kind = _TARGETS.get(mujoco.mjtTrn(int(m.actuator_trntype[a])))
        target = int(m.actuator_trnid[a, 0])
        if m.actuator(a).name:
            continue
        named = joints.get(target) if kind == "joint" else None
        name = named or (_called(m, kind, target) if kind else f"drive{a}")
        actuators[a] = f"{name}_actuator"
    return joints, _unique(actuators, {m.actuator(a).name for a in range(m.nu)})


def _called(m: mujoco.MjModel, kind: str, i: int) -> str:
    return getattr(m, kind)(i).name or f"{kind}{i}"


def _unique(wanted: Mapping[int, str], taken: set[str]) -> dict[int, str]:
    out: dict[int, str] = {}
    for i, name in wanted.items():
        tried = itertools.chain([name], (f"{name}_{k}" for k in itertools.count(2)))
        out[i] = next(n for n in tried if n not in taken)
        taken.add(out[i])
    return out


def named(spec: mujoco.MjSpec, m: mujoco.MjModel) -> mujoco.MjModel:
    """Gives ``spec``, of which ``m`` was compiled, the names of `new_names`.

    Returns:
        The model with these names.
    """
    joints, actuators = new_names(m)
    if not joints and not actuators:
        return m
    spec.compile()  # numbers its elements
    for elements, names in ((spec.joints, joints), (spec.actuators, actuators)):
        for element in elements:
            if element.id in names:
                element.name = names[element.id]
    return spec.compile()


def names_note(m: mujoco.MjModel) -> str:
    """What is told of the names that ``m`` is given; ``""`` where it has all."""
    said = []
    for kind, names in zip(("joint", "actuator"), new_names(m), strict=True):
        if names:
            shown = ", ".join([*names.values()][:_LISTED])
            more = f" and {len(names) - _LISTED} more" if len(names) > _LISTED else ""
            plural = "s" if len(names) > 1 else ""
            said.append(
                f"{len(names)} {kind}{plural} without a name, called {shown}{more}"
            )
    if not said:
        return ""
    return f"{'; '.join(said)}: logs and addresses use these names"


def as_read(path: Path) -> mujoco.MjSpec:
    """The model file ``path`` with a name for every joint and actuator.

    Raises:
        ValueError: MuJoCo cannot read it.
    """
    spec = mujoco.MjSpec.from_file(str(path))
    named(spec, spec.compile())
    return spec
