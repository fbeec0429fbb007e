"""A user's model with what logs and addresses need: names, and a base that was held."""

import itertools
from collections.abc import Mapping
from pathlib import Path

import mujoco
import numpy as np

from easi_jax.errors import UserError
from easi_jax.model.joint_space import (
    FREE_WIDTH,
    carrying_joints,
    given_name,
    widths,
)
from easi_jax.model.mjx_model import simulated

_HELD = "held_base"  # custom text and number of a model whose base was held
_LISTED = 6  # new names in the note
_TARGETS = {
    mujoco.mjtTrn.mjTRN_JOINT: "joint",
    mujoco.mjtTrn.mjTRN_JOINTINPARENT: "joint",
    mujoco.mjtTrn.mjTRN_TENDON: "tendon",
    mujoco.mjtTrn.mjTRN_SITE: "site",
    mujoco.mjtTrn.mjTRN_BODY: "body",
    mujoco.mjtTrn.mjTRN_SLIDERCRANK: "site",
}


def new_names(m: mujoco.MjModel) -> dict[str, dict[int, str]]:
    """Names for the bodies, joints and actuators of ``m`` that have none, by number.

    A body is called ``bodyNUMBER``, a joint ``BODY_joint``, a free joint ``BODY``, an
    actuator ``TARGET_actuator``; a tendon or site without a name is called after its
    kind and number. ``_2``, ``_3`` ... make names unique.
    """
    bodies = _unique(
        {b: f"body{b}" for b in range(m.nbody) if not m.body(b).name},
        {m.body(b).name for b in range(m.nbody)},
    )

    def body(j: int) -> str:
        b = int(m.jnt_bodyid[j])
        return bodies[b] if b in bodies else str(m.body(b).name)

    joints = _unique(
        {
            j: given_name(m, j) or body(j) + "_joint" * (widths(m, j)[0] < FREE_WIDTH)
            for j in range(m.njnt)
            if not m.joint(j).name
        },
        {m.joint(j).name for j in range(m.njnt)},
    )
    of_kind = {"body": bodies, "joint": joints}
    actuators, drives = {}, range(len(m.actuator_trntype))  # not nu: <pid> has several
    for a in drives:
        kind = _TARGETS.get(mujoco.mjtTrn(int(m.actuator_trntype[a])))
        target = int(m.actuator_trnid[a, 0])
        if m.actuator(a).name:
            continue
        named = of_kind.get(kind or "", {}).get(target)
        name = named or (_called(m, kind, target) if kind else f"drive{a}")
        actuators[a] = f"{name}_actuator"
    taken = {m.actuator(a).name for a in drives}
    return {**of_kind, "actuator": _unique(actuators, taken)}


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
    new = new_names(m)
    if not any(new.values()):
        return m
    spec.compile()  # numbers its elements
    each = {"body": spec.bodies, "joint": spec.joints, "actuator": spec.actuators}
    for kind, names in new.items():
        for element in each[kind]:
            if element.id in names:
                element.name = names[element.id]
    return spec.compile()


def names_note(m: mujoco.MjModel) -> str:
    """What is told of the names that joints and actuators of ``m`` are given; ``""``
    where they have all. Those of bodies say themselves what they are."""
    said = []
    for kind, names in new_names(m).items():
        if names and kind != "body":
            shown = ", ".join([*names.values()][:_LISTED])
            more = f" and {len(names) - _LISTED} more" if len(names) > _LISTED else ""
            plural = "s" if len(names) > 1 else ""
            said.append(
                f"{len(names)} {kind}{plural} without a name, called {shown}{more}"
            )
    if not said:
        return ""
    return f"{'; '.join(said)}: logs and addresses use these names"


def as_read(path: Path, like: mujoco.MjModel | None = None) -> mujoco.MjSpec:
    """The model file ``path`` with a name for every body, joint and actuator, its base
    held where it is in ``like``, which was read from it.

    Raises:
        ValueError: MuJoCo cannot read it.
    """
    spec = mujoco.MjSpec.from_file(str(path))
    m = spec.compile()
    simulated(m)
    m = named(spec, m)
    if like is not None and held_joint(like) and not held_joint(m):
        b = held_body(like)
        hold(spec, m, np.concatenate([like.body_pos[b], like.body_quat[b]]))
    return spec


def base_joint(m: mujoco.MjModel) -> int:
    """The free joint of the body that carries all other joints of its tree.

    Raises:
        UserError: none, or several.
    """
    free = carrying_joints(m)
    if len(free) == 1:
        return free[0]
    if not free:
        raise UserError(
            "the model has no free joint that carries other joints, so --held-base has "
            "nothing to hold: leave it out"
        )
    names = ", ".join(m.joint(j).name for j in free)
    raise UserError(
        f"several free joints carry others ({names}), so --held-base is ambiguous: "
        "remove those of held bodies from the model"
    )


def own_pose(m: mujoco.MjModel, j: int) -> np.ndarray:
    """Where free joint ``j`` is in the first key frame, or else in the model ``(7,)``:
    position [m], unit quaternion."""
    at = int(m.jnt_qposadr[j])
    return np.array((m.key_qpos[0] if m.nkey else m.qpos0)[at : at + 7])


def held_joint(m: mujoco.MjModel) -> str:
    """Name of the free joint that was removed from ``m`` for a held base, or ``""``."""
    i = mujoco.mj_name2id(m, mujoco.mjtObj.mjOBJ_TEXT, _HELD)
    if i < 0:
        return ""
    at = int(m.text_adr[i])
    data = bytes(m.text_data[at : at + int(m.text_size[i])])
    return data.rstrip(b"\0").decode()


def held_body(m: mujoco.MjModel) -> int:
    """The body whose free joint was removed, by `hold`."""
    return int(m.numeric(_HELD).data[0])


def hold(spec: mujoco.MjSpec, m: mujoco.MjModel, pose: np.ndarray) -> mujoco.MjModel:
    """Removes the base's free joint from ``spec``, of which ``m`` was compiled.

    The base stays at ``pose (7,)``, in the world: position [m], unit quaternion. Key
    frames lose the joint's numbers. A custom text of the model keeps the joint's name,
    so that logs may go on to have columns for it.

    Raises:
        UserError: as `base_joint`.
        ValueError: something else in the model needs the joint.
    """
    j = base_joint(m)
    b = int(m.jnt_bodyid[j])
    joint = next(x for x in spec.joints if x.id == j)
    body = joint.parent
    spec.add_text(name=_HELD, data=joint.name)
    spec.add_numeric(name=_HELD, data=[b], size=1)
    spec.delete(joint)
    body.alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
    body.pos, body.quat = (0, 0, 0), (1, 0, 0, 0)
    frame = spec.compile()  # of which only the frames around the base are left
    back, local, turn = np.zeros(4), np.zeros(3), np.zeros(4)
    mujoco.mju_negQuat(back, frame.body_quat[b])
    mujoco.mju_rotVecQuat(local, pose[:3] - frame.body_pos[b], back)
    mujoco.mju_mulQuat(turn, back, pose[3:] / np.linalg.norm(pose[3:]))
    body.pos, body.quat = local, turn
    return spec.compile()
