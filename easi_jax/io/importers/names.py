"""Which channel of a recording becomes which column of the log."""

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco

from easi_jax.errors import UserError, nearest
from easi_jax.io.importers.streams import Recording, Stream, listed
from easi_jax.io.logs.columns import LogColumns, hidden_joints, log_columns
from easi_jax.io.logs.mapping import LogMapping
from easi_jax.model.joint_space import FREE_WIDTH, driven_joint, joint_name, widths

_KINDS = {FREE_WIDTH: "free", 4: "ball"}  # by their number of positions


@dataclass(frozen=True)
class Use:
    """Entry ``index`` of ``stream`` is ``column`` of the log."""

    column: str
    stream: Stream
    index: int


def assign(
    recording: Recording,
    mapping: LogMapping,
    model: mujoco.MjModel,
    unmeasured: Sequence[str] = (),
) -> tuple[list[Use], list[str]]:
    """Finds every channel's column.

    A channel that ``columns`` of the mapping names goes there. Positions and
    velocities go by their joint's name; commands by that of the actuator, or of the
    joint that one actuator alone drives. What becomes of ``unmeasured`` joints is as in
    `easi_jax.io.logs.columns.hidden_joints`.

    Returns:
        Uses in the order of the log's columns, and the channels that have none.

    Raises:
        UserError: a name that the model or the recording does not have, two channels
            for one column, or a column that the model needs and nothing gives.
    """
    return _Assignment(recording, mapping, model).result(unmeasured)


class _Assignment:
    def __init__(
        self, recording: Recording, mapping: LogMapping, model: mujoco.MjModel
    ):
        self.recording = recording
        self.mapping = mapping
        self.model = model
        self.columns: LogColumns = log_columns(model)
        self.joints = [joint_name(model, i) for i in range(model.njnt)]
        self.actuators = [model.actuator(i).name for i in range(model.nu)]

    def result(self, unmeasured: Sequence[str]) -> tuple[list[Use], list[str]]:
        self._check_mapping()
        uses: dict[str, Use] = {}
        unused: list[str] = []
        for stream in self.recording.streams:
            for index, channel in enumerate(stream.channels):
                if channel in self.mapping.columns:
                    column = self.mapping.columns[channel]
                elif not stream.role:
                    unused.append(channel)
                    continue
                else:
                    column = self._column(stream, stream.names[index])
                if column is None:
                    continue
                column = self.mapping.component(column, self.columns.known)
                if column in uses:
                    raise self._twice(column, uses[column], channel)
                uses[column] = Use(column, stream, index)
        for column in uses:
            if column not in self.columns.known or column in ("time", "run"):
                raise UserError(
                    f"{self.mapping.source}: the model has nothing for column "
                    f'"{column}"'
                    f"{nearest(column, self.columns.known[2:])}"
                )
        positions, speeds = self.columns.positions, self.columns.joints
        given = self.recording.path, uses, self.columns, self.model
        hidden = {
            name
            for j in hidden_joints(*given, unmeasured)
            for name in (*positions[j], *speeds[j])
        }
        uses = {c: use for c, use in uses.items() if c not in hidden}
        for column in (*self.columns.qpos, *self.columns.ctrl):
            if column not in uses and column not in hidden:
                raise self._missing(column, unused)
        ordered = [uses[c] for c in self.columns.known if c in uses]
        return ordered, unused

    def _column(self, stream: Stream, name: str) -> str | None:
        if stream.role == "ctrl":
            return self._actuator(stream, name)
        joint = self._joint(stream, name)
        return None if joint is None else f"{stream.role}.{joint}"

    def _check_mapped(self, kind: str, name: str | None, known: Sequence[str]) -> None:
        if name is not None and name not in known:
            raise UserError(
                f'{self.mapping.source}: the model has no {kind} "{name}"'
                f"{nearest(name, known)}"
            )

    def _joint(self, stream: Stream, name: str) -> str | None:
        if name in self.mapping.joints:
            joint = self.mapping.joints[name]
            self._check_mapped("joint", joint, self.joints)
        elif stream.named:
            joint = name
        else:
            raise self._nameless(stream, "joints", self.joints)
        if joint is None:
            return None
        if joint not in self.joints:
            raise UserError(
                f'{self.recording.path}: the model has no joint "{joint}" of '
                f"{stream.source}{nearest(joint, self.joints)} (joints: in --mapping "
                "gives it the model's name, or leaves it out)"
            )
        kind = _KINDS.get(widths(self.model, self.joints.index(joint))[0])
        if kind:
            raise UserError(
                f'{self.recording.path}: joint "{joint}" is a {kind} joint, '
                f"which {stream.source}.{name} cannot hold; map its parts by columns: "
                "in --mapping"
            )
        return joint

    def _actuator(self, stream: Stream, name: str) -> str | None:
        if name in self.mapping.actuators:
            actuator = self.mapping.actuators[name]
            self._check_mapped("actuator", actuator, self.actuators)
            return None if actuator is None else f"ctrl.{actuator}"
        if stream.named and name in self.actuators:
            return f"ctrl.{name}"
        if not stream.named and name not in self.mapping.joints:
            raise self._nameless(stream, "actuators", self.actuators)
        joint = self.mapping.joints.get(name, name)
        if joint is None:
            return None
        drives = self._drives(joint)
        if len(drives) == 1:
            return f"ctrl.{drives[0]}"
        if drives:
            raise UserError(
                f"{self.recording.path}: {len(drives)} actuators drive joint "
                f'"{joint}" ({listed(drives)}); say by actuators: in --mapping which '
                f"one {stream.source}.{name} is"
            )
        known = {*self.actuators, *self.joints} - {joint}
        raise UserError(
            f'{self.recording.path}: the model has no actuator for "{joint}" of '
            f"{stream.source}{nearest(joint, known)} (actuators: in --mapping names "
            "it, or leaves it out)"
        )

    def _drives(self, joint: str) -> list[str]:
        at = (driven_joint(self.model, a) for a in range(self.model.nu))
        named = zip(self.actuators, at, strict=True)
        return [a for a, j in named if j is not None and self.joints[j] == joint]

    def _check_mapping(self) -> None:
        channels = [c for s in self.recording.streams for c in s.channels]
        names = [n for s in self.recording.streams for n in s.names if s.role]
        for key, known in (
            ("joints", names),
            ("actuators", names),
            ("columns", channels),
        ):
            self.mapping.check_names(key, known, self.recording.path)

    def _nameless(self, stream: Stream, key: str, known: list[str]) -> UserError:
        return UserError(
            f"{self.recording.path}: {stream.source} has {len(stream.names)} entries "
            f'without names; say whose they are, in order, by "{key}: [...]" in '
            f"--mapping (the model has {listed(known)})"
        )

    def _twice(self, column: str, first: Use, channel: str) -> UserError:
        before = first.stream.channels[first.index]
        if before == channel:
            return UserError(
                f"{self.recording.path}: {channel} is in messages that list different "
                "joints, so its rows cannot be put together"
            )
        return UserError(
            f'{self.recording.path}: "{before}" and "{channel}" both become {column}; '
            "leave one out in --mapping"
        )

    def _missing(self, column: str, unused: list[str]) -> UserError:
        role, _, name = column.partition(".")
        entries = [n for s in self.recording.streams for n in s.names if s.role == role]
        hint = nearest(name, [e for e in entries if e in self.mapping.joints])
        others = f" (not used: {listed(unused)})" if unused and not hint else ""
        groups = zip(self.joints, self.columns.positions, strict=True)
        joint = next((j for j, group in groups if column in group), "")
        option = f"; if joint {joint} has no sensor, give --unmeasured {joint}"
        return UserError(
            f'{self.recording.path}: nothing gives "{column}", which the model needs'
            f"{hint}{others}{option if joint else ''}"
        )
