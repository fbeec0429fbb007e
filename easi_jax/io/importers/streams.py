"""What an importer reads from a foreign recording, before it has our names."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float

from easi_jax.errors import UserError

Role = Literal["qpos", "qvel", "ctrl", ""]
Clock = Literal["record", "header"]
CommandField = Literal["auto", "position", "velocity", "effort"]


@dataclass(frozen=True)
class Selection:
    """What of a recording is read; what is not given is found where it is unambiguous.

    Attributes:
        state: topics, features or keys that hold positions; the first gives the rows.
        command: topics, features or keys that hold commands.
        field: field of a command message that counts.
        clock: ROS time stamps: when a message was recorded, or its header's.
        step: control step where the recording has no time, s.
        episodes: numbers of the episodes; all where empty.
    """

    state: tuple[str, ...] = ()
    command: tuple[str, ...] = ()
    field: CommandField = "auto"
    clock: Clock = "record"
    step: float | None = None
    episodes: tuple[int, ...] = ()


@dataclass(frozen=True, eq=False)
class Stream:
    """Channels that were recorded together.

    Attributes:
        source: topic, feature or key with its field, for messages.
        role: what the channels are; ``""`` where only a mapping file can say it.
        channels: unique names, such as ``/joint_states.position.hip``.
        names: of the joints or actuators as the file calls them, or ``0``, ``1`` ...
        named: whether ``names`` are the file's own.
        time: s, ``(N,)``.
        values: in the file's units, ``(N, K)``.
    """

    source: str
    role: Role
    channels: tuple[str, ...]
    names: tuple[str, ...]
    named: bool
    time: Float[np.ndarray, " N"]
    values: Float[np.ndarray, "N K"]


@dataclass(frozen=True, eq=False)
class Recording:
    """One uninterrupted recording.

    Attributes:
        path: where it came from.
        name: of its log, without extension.
        streams: at least one.
    """

    path: str
    name: str
    streams: tuple[Stream, ...]


def stream(
    source: str,
    role: Role,
    time: Float[np.ndarray, " N"],
    values: Float[np.ndarray, "N K"],
    names: Sequence[str] | None = None,
) -> Stream:
    """A stream whose channels are ``SOURCE.NAME``, or ``SOURCE.0`` ... without names.

    Raises:
        UserError: ``time`` (s) and ``values`` differ in length.
    """
    if len(time) != len(values):
        raise UserError(
            f"{source} has {len(values)} rows where its time has {len(time)}"
        )
    named = names is not None
    entries = tuple(names if named else map(str, range(values.shape[1])))
    channels = tuple(f"{source}.{name}" for name in entries)
    return Stream(source, role, channels, entries, named, time, values)


def listed(names: Sequence[str], most: int = 8) -> str:
    """``a, b, c`` for a message, cut after ``most``."""
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more if names else "none"
