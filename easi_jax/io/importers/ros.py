"""MCAP files and rosbag2 recordings of ROS 2.

Messages are decoded by the standard definitions of their types; definitions that a
recording carries are not used.
"""

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from easi_jax.errors import UserError, nearest
from easi_jax.io.importers.streams import (
    Recording,
    Role,
    Selection,
    Stream,
    listed,
    stream,
)

JOINTS = "sensor_msgs/msg/JointState"
ARRAY = "std_msgs/msg/Float64MultiArray"
POINT = "trajectory_msgs/msg/JointTrajectoryPoint"
TRAJECTORY = "trajectory_msgs/msg/JointTrajectory"
_COMMANDS = (ARRAY, POINT, TRAJECTORY, JOINTS)
_FIELDS = {
    JOINTS: {"position": "position", "velocity": "velocity", "effort": "effort"},
    POINT: {"position": "positions", "velocity": "velocities", "effort": "effort"},
}


class _Message(NamedTuple):
    """``stamp`` in ns; ``entries`` without names where the type has none."""

    number: int
    stamp: int
    content: Any


@dataclass
class _Rows:
    """Values of one list of entries as they come, ns."""

    names: tuple[str, ...] | None
    stamps: list[int] = field(default_factory=list)
    values: list[Any] = field(default_factory=list)


def read_ros(path: Path, selection: Selection) -> Recording:
    """Reads an ``.mcap`` or ``.db3`` file, or a rosbag2 folder.

    Times are seconds since the first message with positions.

    Raises:
        UserError: rosbags is not installed, damaged, no such topic, a topic of
            another type, or arrays that differ in length.
    """
    try:
        from rosbags.rosbag2 import Reader
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise UserError(
            f"{path}: needs the package rosbags: pip install 'easi-jax[import]'"
        ) from None
    if selection.episodes:
        raise UserError(f"{path}: a ROS recording has no episodes to choose from")
    store = get_typestore(Stores.ROS2_HUMBLE)
    bag = _Bag(path, Reader, store, selection)
    return bag.read()


class _Bag:
    def __init__(self, path: Path, reader: Any, store: Any, selection: Selection):
        self.path = path
        self.reader = reader
        self.store = store
        self.selection = selection
        self.topics: dict[str, str] = {}

    def read(self) -> Recording:
        try:
            bag = self.reader(self.path)
            bag.open()
        except Exception as error:  # whatever its parsers meet in a damaged file
            raise self._broken(error) from None
        with contextlib.closing(bag):
            self.topics = {name: t.msgtype or "" for name, t in bag.topics.items()}
            states, commands = self._chosen()
            found = [s for topic in states for s in self._state(bag, topic)]
            found += [s for topic in commands for s in self._command(bag, topic)]
        first = min(found[0].stamps)
        streams = tuple(s.stream(first) for s in found)
        return Recording(str(self.path), self.path.stem, streams)

    def _chosen(self) -> tuple[Sequence[str], Sequence[str]]:
        states = self.selection.state
        commands = self.selection.command
        for topic in (*states, *commands):
            if topic not in self.topics:
                raise UserError(
                    f'{self.path}: no topic "{topic}"'
                    f"{nearest(topic, self.topics)} ({self._listed()})"
                )
        states = states or self._only("--state", (JOINTS,), commands)
        commands = commands or self._only("--command", _COMMANDS, states)
        for topics, types, option in (
            (states, (JOINTS,), "--state"),
            (commands, _COMMANDS, "--command"),
        ):
            for topic in topics:
                if self.topics[topic] not in types:
                    raise UserError(
                        f"{self.path}: {option} {topic} is of type "
                        f"{self.topics[topic] or 'more than one'}, not "
                        f"{' or '.join(types)}"
                    )
        return states, commands

    def _only(
        self, option: str, types: Sequence[str], taken: Sequence[str]
    ) -> tuple[str, ...]:
        fitting = [
            name
            for name, kind in self.topics.items()
            if kind in types and name not in taken
        ]
        if len(fitting) == 1:
            return (fitting[0],)
        if not fitting:
            raise UserError(
                f"{self.path}: no topic for {option} (types: {', '.join(types)}; "
                f"{self._listed()})"
            )
        raise UserError(
            f"{self.path}: {len(fitting)} topics could be {option}: {listed(fitting)}; "
            "name those that are"
        )

    def _listed(self) -> str:
        topics = [f"{name} [{kind}]" for name, kind in self.topics.items()]
        return f"the recording has {listed(topics)}"

    def _messages(self, bag: Any, topic: str) -> Iterator[_Message]:
        """Decoded messages of ``topic`` with their time by the chosen clock."""
        kind = self.topics[topic]
        chosen = [c for c in bag.connections if c.topic == topic]
        raw = bag.messages(connections=chosen)
        number = 0
        while True:
            number += 1
            try:
                _, stamp, data = next(raw)
                content = self.store.deserialize_cdr(data, kind)
            except StopIteration:
                break
            except Exception as error:  # see read
                raise self._broken(error) from None
            if self.selection.clock == "header":
                stamp = self._header_stamp(topic, number, content)
            yield _Message(number, stamp, content)
        if number == 1:
            raise UserError(f"{self.path}: topic {topic} has no messages")

    def _header_stamp(self, topic: str, number: int, content: Any) -> int:
        header = getattr(content, "header", None)
        if header is None:
            raise UserError(
                f"{self.path}: messages of {topic} have no header; use --clock record"
            )
        stamp = _nanoseconds(header.stamp)
        if not stamp:
            raise UserError(
                f"{self.path}: message {number} of {topic} has no time in its header; "
                "use --clock record"
            )
        return stamp

    def _state(self, bag: Any, topic: str) -> list["_Part"]:
        """Positions, velocities and efforts; one part for each list of joints."""
        groups: dict[frozenset[str], _Rows] = {}
        for message in self._messages(bag, topic):
            names, values = self._joint_values(topic, message)
            if not len(values["position"]):
                continue
            rows = groups.setdefault(frozenset(names), _Rows(tuple(names)))
            order = [names.index(name) for name in rows.names or ()]
            rows.stamps.append(message.stamp)
            lacking = np.full(len(names), np.nan)
            rows.values.append(
                [(v if len(v) else lacking)[order] for v in values.values()]
            )
        if not groups:
            raise UserError(f"{self.path}: no message of {topic} has positions")
        roles: tuple[tuple[str, Role], ...] = (
            ("position", "qpos"),
            ("velocity", "qvel"),
            ("effort", ""),
        )
        parts: list[_Part] = []
        for rows in groups.values():
            array = np.asarray(rows.values, float)
            for i, (name, role) in enumerate(roles):
                if np.isfinite(array[:, i]).any() or role == "qpos":
                    source = f"{topic}.{name}"
                    parts.append(
                        _Part(source, role, rows.names, rows.stamps, array[:, i])
                    )
        return parts

    def _joint_values(
        self, topic: str, message: _Message
    ) -> tuple[list[str], dict[str, np.ndarray]]:
        content = message.content
        names = list(content.name)
        if len(set(names)) < len(names):
            raise UserError(
                f"{self.path}: message {message.number} of {topic} names a joint twice"
            )
        values = {
            name: np.asarray(getattr(content, name), float)
            for name in ("position", "velocity", "effort")
        }
        for name, array in values.items():
            if len(array) not in (0, len(names)):
                raise UserError(
                    f"{self.path}: message {message.number} of {topic} has "
                    f"{len(names)} names and {len(array)} values of {name}"
                )
        return names, values

    def _command(self, bag: Any, topic: str) -> list["_Part"]:
        kind = self.topics[topic]
        if kind == TRAJECTORY:
            return self._trajectory(bag, topic)
        rows: _Rows | None = None
        chosen = ""
        for message in self._messages(bag, topic):
            content = message.content
            stamp = message.stamp
            names: list[str] | None = None
            if kind == ARRAY:
                values = np.asarray(content.data, float)
            else:
                chosen = chosen or self._field(topic, kind, content)
                values = np.asarray(getattr(content, _FIELDS[kind][chosen]), float)
                if kind == POINT:
                    stamp += _nanoseconds(content.time_from_start)
                else:
                    names, of_all = self._joint_values(topic, message)
                    values = of_all[chosen]
            if rows is None:
                rows = _Rows(None if names is None else tuple(names))
            if names is not None:
                values = self._ordered(topic, message, rows, names, values)
            self._append(topic, message, rows, stamp, values)
        assert rows is not None  # _messages refuses a topic without messages
        return [self._part(topic, chosen, rows)]

    def _trajectory(self, bag: Any, topic: str) -> list["_Part"]:
        """Points at their own times; a message replaces what earlier ones left."""
        rows: _Rows | None = None
        chosen = ""
        for message in self._messages(bag, topic):
            names = list(message.content.joint_names)
            rows = rows or _Rows(tuple(names))
            while rows.stamps and rows.stamps[-1] >= message.stamp:
                rows.stamps.pop()
                rows.values.pop()
            for point in message.content.points:
                chosen = chosen or self._field(topic, POINT, point)
                values = np.asarray(getattr(point, _FIELDS[POINT][chosen]), float)
                values = self._ordered(topic, message, rows, names, values)
                stamp = message.stamp + _nanoseconds(point.time_from_start)
                self._append(topic, message, rows, stamp, values)
        if rows is None or not rows.stamps:
            raise UserError(f"{self.path}: no message of {topic} has points")
        return [self._part(topic, chosen, rows)]

    def _field(self, topic: str, kind: str, content: Any) -> str:
        """The field that holds the command, by the topic's first message."""
        if self.selection.field != "auto":
            return self.selection.field
        for name, theirs in _FIELDS[kind].items():
            if len(getattr(content, theirs)):
                return name
        raise UserError(f"{self.path}: the first message of {topic} is empty")

    def _ordered(
        self,
        topic: str,
        message: _Message,
        rows: _Rows,
        names: list[str],
        values: np.ndarray,
    ) -> np.ndarray:
        known = list(rows.names or ())
        if sorted(names) != sorted(known):
            raise UserError(
                f"{self.path}: message {message.number} of {topic} names other joints "
                f"({listed(names)}) than the first ({listed(known)})"
            )
        if len(values) != len(names):
            raise UserError(
                f"{self.path}: message {message.number} of {topic} has {len(names)} "
                f"names and {len(values)} values"
            )
        return values[[names.index(name) for name in known]]

    def _append(
        self,
        topic: str,
        message: _Message,
        rows: _Rows,
        stamp: int,
        values: np.ndarray,
    ) -> None:
        before = len(rows.values[0]) if rows.values else len(values)
        if len(values) != before:
            raise UserError(
                f"{self.path}: message {message.number} of {topic} has {len(values)} "
                f"values where the first has {before}"
            )
        if not len(values):
            raise UserError(
                f"{self.path}: message {message.number} of {topic} has no values"
            )
        rows.stamps.append(stamp)
        rows.values.append(values)

    @staticmethod
    def _part(topic: str, chosen: str, rows: _Rows) -> "_Part":
        source = f"{topic}.{chosen}" if chosen else topic
        return _Part(source, "ctrl", rows.names, rows.stamps, np.asarray(rows.values))

    def _broken(self, error: Exception) -> UserError:
        if isinstance(error, FileNotFoundError):
            return UserError(f"{self.path}: not a ROS recording (no metadata.yaml)")
        reason = " ".join(str(error).split())[:120] or type(error).__name__
        return UserError(
            f"{self.path}: cannot be read as a ROS 2 recording, damaged or cut short "
            f"({reason})"
        )


class _Part(NamedTuple):
    """A stream whose time is still in ns since whenever."""

    source: str
    role: Role
    names: tuple[str, ...] | None
    stamps: list[int]
    values: np.ndarray

    def stream(self, first: int) -> Stream:
        time = np.array([stamp - first for stamp in self.stamps]) * 1e-9
        return stream(self.source, self.role, time, self.values, self.names)


def _nanoseconds(time: Any) -> int:
    return int(time.sec) * 1_000_000_000 + int(time.nanosec)
