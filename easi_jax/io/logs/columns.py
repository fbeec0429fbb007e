"""The columns that a model gives a log, and their check."""

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import mujoco

from easi_jax.data.unmeasured import placed_by_model
from easi_jax.errors import UserError, closest, nearest
from easi_jax.io.logs.cure import cure
from easi_jax.io.models.completed import held_joint
from easi_jax.model.addresses import matching
from easi_jax.model.joint_space import (
    FREE_WIDTH,
    carrying_joints,
    driven_joint,
    given_name,
    numbered,
    widths,
)

_CHECKED = ("qpos.", "qvel.", "ctrl.")
_ALL = "all"  # joints that a log lacks
_LISTED = 5  # names in a message


@dataclass(frozen=True)
class LogColumns:
    """Column names of a model.

    Attributes:
        qpos: in the order of ``qpos``, ``nq`` names.
        qvel: in the order of ``qvel``, ``nv`` names.
        ctrl: in the order of ``ctrl``, ``nu`` names.
        positions: each joint's position columns.
        joints: each joint's velocity columns (all of them or none are given).
        bases: names of free joints that carry others.
        held: columns of a held base's free joint, which the model no longer has: the
            pose first.
        sensors: each named sensor's columns.
    """

    qpos: tuple[str, ...]
    qvel: tuple[str, ...]
    ctrl: tuple[str, ...]
    positions: tuple[tuple[str, ...], ...]
    joints: tuple[tuple[str, ...], ...]
    sensors: Mapping[str, tuple[str, ...]]
    bases: tuple[str, ...] = ()
    held: tuple[str, ...] = ()

    @property
    def known(self) -> tuple[str, ...]:
        """Every name that has a meaning."""
        sensors = (name for names in self.sensors.values() for name in names)
        return ("time", "run", *self.qpos, *self.qvel, *self.ctrl, *sensors, *self.held)


def log_columns(model: mujoco.MjModel) -> LogColumns:
    """The columns of ``model``'s logs.

    Raises:
        UserError: a joint or actuator without a name, names that make two columns
            one, or a model without joints.
    """
    positions: list[tuple[str, ...]] = []
    joints: list[tuple[str, ...]] = []
    for i in range(model.njnt):
        name = given_name(model, i)
        if not name:
            body = model.body(int(model.jnt_bodyid[i])).name
            raise UserError(
                f'the model\'s joint {i} (in body "{body}") has no name, by which logs '
                "find joints: read the model with easi_jax.read_model, which names it"
            )
        size, dofs = widths(model, i)
        positions.append(numbered(f"qpos.{name}", size))
        joints.append(numbered(f"qvel.{name}", dofs))
    if not positions:
        raise UserError("the model has no joint: there is nothing to log")
    ctrl: list[str] = []
    for i in range(model.nu):
        name = model.actuator(i).name
        if not name:
            raise UserError(
                f"the model's actuator {i} has no name, by which logs find actuators: "
                "read the model with easi_jax.read_model, which names it"
            )
        ctrl.append(f"ctrl.{name}")
    sensors = {
        model.sensor(i).name: numbered(
            f"sensor.{model.sensor(i).name}", int(model.sensor_dim[i])
        )
        for i in range(model.nsensor)
        if model.sensor(i).name
    }
    columns = LogColumns(
        qpos=tuple(name for names in positions for name in names),
        qvel=tuple(name for names in joints for name in names),
        ctrl=tuple(ctrl),
        positions=tuple(positions),
        joints=tuple(joints),
        sensors=sensors,
        bases=tuple(given_name(model, j) for j in carrying_joints(model)),
        held=_held(model),
    )
    for name, count in Counter(columns.known).items():
        if count > 1:
            raise UserError(
                f'two parts of the model share the log column "{name}"; rename one'
            )
    return columns


def _held(model: mujoco.MjModel) -> tuple[str, ...]:
    name = held_joint(model)
    if not name:
        return ()
    return (*numbered(f"qpos.{name}", FREE_WIDTH), *numbered(f"qvel.{name}", 6))


def named_joints(model: mujoco.MjModel, unmeasured: Sequence[str]) -> set[str]:
    """Joints that names and patterns of --unmeasured stand for, ``all`` aside.

    Raises:
        UserError: a name or pattern without a joint.
    """
    joints = [given_name(model, j) for j in range(model.njnt)]
    out = set[str]()
    for pattern in unmeasured:
        found = matching(pattern, joints)
        if not found and pattern != _ALL:
            raise UserError(
                f'--unmeasured "{pattern}": the model has no such joint'
                f"{nearest(pattern, joints)} (known: {', '.join(joints)})"
            )
        out.update(found)
    return out


def hidden_joints(
    path: Path | str,
    names: Mapping[str, object],
    columns: LogColumns,
    model: mujoco.MjModel,
    unmeasured: Sequence[str],
) -> dict[int, str]:
    """Joints without a reading in a file, and why that is no mistake.

    Args:
        path: the file, for messages.
        names: its columns.
        columns: of the model.
        model: the machine.
        unmeasured: names and patterns of joints that the user says nobody measured;
            ``all``: whatever the file lacks.

    Raises:
        UserError: a name or pattern without a joint, or no joint is left.
    """
    said = named_joints(model, unmeasured)
    lacking = [
        j
        for j, group in enumerate(columns.positions)
        if any(name not in names for name in group)
    ]
    joints = range(model.njnt)
    out = {j: "--unmeasured" for j in joints if given_name(model, j) in said}
    if _ALL in unmeasured:
        out |= dict.fromkeys(lacking, "--unmeasured")
    measured = set(range(model.njnt)).difference(out, lacking)
    placed = placed_by_model(model, measured)
    out |= {j: placed[j] for j in {*out, *lacking} if j in placed}
    if len(out) == model.njnt:
        raise UserError(
            f"{path}: no joint is measured, so nothing can be determined: log the "
            f"position of one (column {columns.qpos[0]} ...)"
        )
    return dict(sorted(out.items()))


def check_columns(
    path: Path,
    names: Mapping[str, object],
    columns: LogColumns,
    model: mujoco.MjModel,
    hidden: Collection[int] = (),
) -> list[str]:
    """Checks a file's column names against the model's, in which nobody measured the
    joints ``hidden``.

    Returns:
        Names that are ignored, in the file's order.

    Raises:
        UserError: a column that the model needs is missing (what cannot be determined
            without it is said), or a position, velocity or command has a name that
            the model does not know.
    """
    needed = [
        name
        for j, group in enumerate(columns.positions)
        if j not in hidden
        for name in group
    ]
    missing = [n for n in ("time", *needed, *columns.ctrl) if n not in names]
    if missing:
        known = set(columns.known)
        strangers = [name for name in names if name not in known]
        first = f'"{missing[0]}"'
        others = ", ".join(f'"{name}"' for name in missing[1:_LISTED])
        more = f" (also missing: {others}" if others else ""
        if more and len(missing) > _LISTED:
            more += f" and {len(missing) - _LISTED} more"
        theirs = _closest(missing[0], strangers)
        near, lost = "", "" if theirs else _undetermined(model, columns, missing)
        if theirs:
            renamed = cure(f"columns: {{{theirs}: {missing[0]}}}")
            near = f'; did you mean "{theirs}"? ({renamed} renames it)'
        elif strangers:
            shown = " ".join(", ".join(strangers[:_LISTED]).split())
            near = f" (it has {shown}; " + (
                f"{cure(f'columns: {{THEIRS: {missing[0]}}}')} renames one)"
            )
        for name in columns.bases:
            if missing[0].startswith(f"qpos.{name}."):
                near += (
                    f"; if {name} was held (the base does not move in this log), "
                    "remove its free joint, or give --held-base"
                )
        raise UserError(
            f"{path}: no column {first}, which the model needs"
            f"{near}{more + ')' if more else ''}{lost}"
            f"{_without_sensor(model, columns, missing)}"
        )
    ignored = [name for name in names if name not in columns.known]
    for name in ignored:
        if name.startswith(_CHECKED):
            raise UserError(
                f'{path}: the model has nothing for column "{name}"'
                f"{nearest(name, columns.known)}"
            )
    for j, group in enumerate(columns.joints):
        if j in hidden:
            continue
        given = [name for name in group if name in names]
        if given and len(given) < len(group):
            lacking = next(name for name in group if name not in names)
            raise UserError(
                f'{path}: column "{given[0]}" needs "{lacking}" beside it; '
                "give all velocities of a joint or none"
            )
    return ignored


def _closest(column: str, strangers: Sequence[str]) -> str:
    """Which of a file's columns is named most like one that is missing, what all such
    columns begin with aside; empty where none is."""
    kind, dot, name = column.partition(".")
    by_name = {s.removeprefix(kind + dot) if dot else s: s for s in strangers}
    found = closest(name or kind, by_name)
    return by_name[found] if found else ""


def _undetermined(
    model: mujoco.MjModel, columns: LogColumns, missing: Sequence[str]
) -> str:
    """What a log can hardly determine that has some of ``columns``, but not
    ``missing``.

    Nothing is said of a free joint, nor where all positions are missing, which are
    then named otherwise.
    """
    lost = set(missing)
    if "time" in lost or lost.issuperset(columns.qpos):
        return ""
    joints, bodies = [], set[int]()
    for j in range(model.njnt):
        size, _ = widths(model, j)
        name = given_name(model, j)
        if size < FREE_WIDTH and lost.intersection(numbered(f"qpos.{name}", size)):
            joints.append(j)
            bodies.add(int(model.jnt_bodyid[j]))
    for b in range(model.nbody):
        if int(model.body_parentid[b]) in bodies:
            bodies.add(b)
    drives = [
        a
        for a in range(model.nu)
        if columns.ctrl[a] in lost or driven_joint(model, a) in joints
    ]
    said = [
        _listed("joint", [given_name(model, j) for j in joints]),
        _listed("drive", [model.actuator(a).name for a in drives]),
        _listed("body", [model.body(b).name for b in sorted(bodies)]),
    ]
    if not any(said):
        return ""
    it = "it" if len(missing) == 1 else "them"
    return (
        f"; without {it} {'little' if joints else 'nothing'} can be determined of "
        f"{', '.join(filter(None, said))}: log {it}"
    )


def _without_sensor(
    model: mujoco.MjModel, columns: LogColumns, missing: Sequence[str]
) -> str:
    """The option for joints that have no sensor; nothing where all positions are
    missing."""
    lost = set(missing)
    if lost.issuperset(columns.qpos):
        return ""
    joints = [
        given_name(model, j)
        for j, group in enumerate(columns.positions)
        if lost.intersection(group)
    ]
    if not joints:
        return ""
    several = len(joints) > 1
    given = " ".join(joints) if len(joints) <= _LISTED else _ALL
    return (
        f"; if {_listed('joint', joints)} {'have' if several else 'has'} no sensor, "
        f"give --unmeasured {given}"
    )


def _listed(kind: str, names: Sequence[str]) -> str:
    """``joint elbow``, ``joints elbow, wrist``, ``joints a, b, c, d, e and 3 more``."""
    names = [name for name in names if name]
    if len(names) < 2:
        return " ".join([kind, *names]) if names else ""
    more = f" and {len(names) - _LISTED} more" if len(names) > _LISTED else ""
    plural = {"body": "bodies"}.get(kind, f"{kind}s")
    return f"{plural} {', '.join(names[:_LISTED])}{more}"
