"""A recording's channels, at their own times, as rows of a log."""

from collections.abc import Sequence
from dataclasses import replace

import mujoco
import numpy as np
from jaxtyping import Bool, Float

from easi_jax.errors import UserError
from easi_jax.io.importers.names import Use, assign
from easi_jax.io.importers.streams import Recording, Stream, listed
from easi_jax.io.logs.checks import repeated_stamps
from easi_jax.io.logs.mapping import LogMapping
from easi_jax.model.joint_space import joint_name, turns_fully

_HOLE_STEPS = 3.0
# A command that comes this soon after nearly every row answers that row.
_SOON = 0.25


def to_table(
    recording: Recording,
    mapping: LogMapping,
    model: mujoco.MjModel,
    *,
    unmeasured: Sequence[str] = (),
    slack: float = 0.0,
    allow_nan: bool = False,
) -> tuple[dict[str, np.ndarray], list[str]]:
    """The log of ``recording``: its columns, and notes.

    The first stream of positions gives the rows. Commands are held: a row has the
    last one sent until then, or up to ``slack`` (s) later. Other positions,
    velocities and sensors are interpolated linearly. Rows before the first command,
    and where another stream pauses for more than three of its steps, are left out.
    Joints that are ``unmeasured``, as for `easi_jax.io.logs.reader.read_logs`, get no
    column.

    Raises:
        UserError: names that do not fit, time that is not finite or goes back,
            a position or command that is not finite (unless ``allow_nan``), or fewer
            than two rows.
    """
    recording, notes = _without_repeats(recording)
    uses, unused = assign(recording, mapping, model, unmeasured)
    mapping.check_used({"time": None, **{use.column: None for use in uses}})
    notes += [f"not used: {listed(unused)}"] if unused else []
    times = _times(recording, mapping, uses)
    read = [use.stream for use in uses if use.column.startswith("qpos.")]
    rows = next(s for s in recording.streams if any(s is stream for stream in read))
    time = times[rows]
    table = {"time": time}
    known = np.ones(len(time), bool)
    joints = range(model.njnt)
    turning = {f"qpos.{joint_name(model, j)}" for j in joints if turns_fully(model, j)}
    for use in uses:
        values = mapping.apply(use.column, use.stream.values[:, use.index])
        kind = use.column.partition(".")[0]
        if kind in ("qpos", "ctrl") and not allow_nan:
            _refuse_non_finite(recording, use, values)
        if kind == "qvel" and not np.isfinite(values).any():
            notes.append(f"{use.stream.channels[use.index]} is empty: left out")
            continue
        at = times[use.stream]
        if kind == "ctrl":
            table[use.column], there = _held(at, values, time, slack)
        elif use.stream is rows or np.array_equal(at, time):
            table[use.column] = values
            continue
        else:
            if use.column in turning:
                read = np.isfinite(values)
                values = values.copy()
                values[read] = np.unwrap(values[read])
            table[use.column], there = _interpolated(at, values, time)
        lost = int(np.sum(known & ~there))
        known &= there
        if lost:
            what = "before its first message" if kind == "ctrl" else "where it pauses"
            notes.append(f"{lost} rows left out {what}: {use.stream.source}")
    if known.sum() < 2:
        raise UserError(
            f"{recording.path}: positions and commands have no two rows in common "
            f"({rows.source}: {_span(time)}; "
            f"{'; '.join(_spans(uses, times, rows))}); are their clocks the same?"
        )
    notes += _early_rows(uses, times, rows, slack)
    return {name: column[known] for name, column in table.items()}, notes


def _without_repeats(recording: Recording) -> tuple[Recording, list[str]]:
    """Without rows whose time stamp repeats that of the row before; of commands the
    later message counts, so that both stay."""
    streams, notes = [], []
    for stream in recording.streams:
        again = repeated_stamps(stream.time)
        if len(again) and stream.role != "ctrl":
            notes.append(
                f"{stream.source}: rows dropped whose time stamp repeats that of the "
                f"row before: {len(again)} (the first is row {again[0] + 1})"
            )
            stream = replace(
                stream,
                time=np.delete(stream.time, again),
                values=np.delete(stream.values, again, axis=0),
            )
        streams.append(stream)
    return replace(recording, streams=tuple(streams)), notes


def _times(
    recording: Recording, mapping: LogMapping, uses: list[Use]
) -> dict[Stream, Float[np.ndarray, " N"]]:
    times: dict[Stream, np.ndarray] = {}
    for use in uses:
        stream = use.stream
        if stream in times:
            continue
        time = mapping.apply("time", stream.time)
        least = 1 if stream.role == "ctrl" else 2
        if len(time) < least:
            raise UserError(
                f"{recording.path}: {stream.source} has {len(time)} rows; a log needs "
                f"at least {least}"
            )
        bad = np.flatnonzero(~np.isfinite(time))
        if len(bad):
            raise UserError(
                f"{recording.path}: the time of {stream.source} is {time[bad[0]]} in "
                f"row {bad[0] + 1}"
            )
        step = np.diff(time)
        # Two commands at once: the later message counts. Two rows cannot be.
        back = np.flatnonzero(step < 0 if stream.role == "ctrl" else step <= 0)
        if len(back):
            i = int(back[0])
            raise UserError(
                f"{recording.path}: the time of {stream.source} goes back or stands "
                f"still from row {i + 1} ({time[i]:.9g} s) to row {i + 2} "
                f"({time[i + 1]:.9g} s)"
            )
        times[stream] = time
    return times


def _refuse_non_finite(recording: Recording, use: Use, values: np.ndarray) -> None:
    bad = np.flatnonzero(~np.isfinite(values))
    if len(bad):
        channel = use.stream.channels[use.index]
        raise UserError(
            f"{recording.path}: {channel} is {values[bad[0]]} in row {bad[0] + 1} "
            f"({len(bad)} of {len(values)} rows); --allow-nan keeps "
            "such rows, and readers of the log split the run there"
        )


def _held(
    at: np.ndarray, values: np.ndarray, time: np.ndarray, slack: float
) -> tuple[Float[np.ndarray, " T"], Bool[np.ndarray, " T"]]:
    last = np.searchsorted(at, time + slack, side="right") - 1
    return values[np.maximum(last, 0)], last >= 0


def _interpolated(
    at: np.ndarray, values: np.ndarray, time: np.ndarray
) -> tuple[Float[np.ndarray, " T"], Bool[np.ndarray, " T"]]:
    step = np.diff(at)
    after = np.clip(np.searchsorted(at, time, side="left"), 1, len(at) - 1)
    there = (time >= at[0]) & (time <= at[-1])
    there &= step[after - 1] <= _HOLE_STEPS * np.median(step)
    return np.interp(time, at, values), there


def _early_rows(
    uses: list[Use],
    times: dict[Stream, np.ndarray],
    rows: Stream,
    slack: float,
) -> list[str]:
    """Notes on commands that answer a row but come just after it."""
    notes: list[str] = []
    time = times[rows]
    step = float(np.median(np.diff(time)))
    for stream in dict.fromkeys(use.stream for use in uses):
        if stream.role != "ctrl":
            continue
        at = times[stream]
        following = np.searchsorted(at, time, side="right")
        inside = following < len(at)
        wait = at[following[inside]] - time[inside]
        often = len(at) > 1 and float(np.median(np.diff(at))) < 0.5 * step
        if often or not len(wait):
            continue
        late = float(np.quantile(wait, 0.9))
        if slack < late < _SOON * step and not np.array_equal(at, time):
            notes.append(
                f"{stream.source} follows the rows by {late:.2g} s, so that each row "
                "has the command before; if they answer that row, --command-slack "
                f"{2 * late:.2g} puts them there"
            )
    return notes


def _span(time: np.ndarray) -> str:
    return f"{time[0]:.6g} to {time[-1]:.6g} s"


def _spans(uses: list[Use], times: dict[Stream, np.ndarray], rows: Stream) -> list[str]:
    others = dict.fromkeys(use.stream for use in uses if use.stream is not rows)
    return [f"{stream.source}: {_span(times[stream])}" for stream in others]
