"""LeRobot datasets: Parquet files and ``meta/info.json``, of versions 2 and 3."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from easi_jax.errors import UserError, nearest
from easi_jax.io.files import read_json
from easi_jax.io.importers.streams import (
    Recording,
    Role,
    Selection,
    Stream,
    listed,
    stream,
)
from easi_jax.io.logs.tables import parquet_file

_STATE, _COMMAND = "observation.state", "action"
_SUFFIXES: dict[str, Role] = {".pos": "qpos", ".vel": "qvel"}
_NUMBERS = ("float64", "float32", "float16", "int64", "int32")


def is_lerobot(path: Path) -> bool:
    """Whether the folder ``path`` is laid out as a LeRobot dataset."""
    return (path / "meta" / "info.json").is_file()


def read_lerobot(path: Path, selection: Selection) -> Iterator[Recording]:
    """Reads each episode of the dataset in folder ``path``.

    A name that ends in ``.pos`` or ``.vel`` is that of a joint and its position or
    velocity; names without such an end are positions, if none has one.

    Raises:
        UserError: another version, no such feature or episode, damaged, or rows that
            differ in length.
    """
    info = read_json(path / "meta" / "info.json")
    features = info.get("features") if isinstance(info, dict) else None
    if not isinstance(features, dict):
        raise UserError(f"{path}: meta/info.json has no features")
    version = str(info.get("codebase_version", ""))
    if not version.startswith(("v2.", "v3.")):
        raise UserError(
            f'{path}: LeRobot version "{version}"; versions 2 and 3 are read'
        )
    states = selection.state or (_STATE,)
    commands = selection.command or (_COMMAND,)
    for key in (*states, *commands):
        if key not in features:
            raise UserError(
                f'{path}: no feature "{key}"{nearest(key, features)} '
                f"(it has {listed(list(features))})"
            )
    wanted = list(dict.fromkeys((*states, *commands)))
    wanted += [
        key
        for key, feature in features.items()
        if key not in wanted
        and key.startswith(("observation.", "action."))
        and isinstance(feature, dict)
        and str(feature.get("dtype")) in _NUMBERS
        and len(_shape(feature)) == 1
    ]
    roles: dict[str, Role] = dict.fromkeys(states, "qpos")
    roles |= dict.fromkeys(commands, "ctrl")
    episodes = _episodes(path, wanted, selection.episodes)
    name = path.resolve().name
    for number, columns in episodes:
        where = f"{path}: episode {number}"
        time = _time(where, columns, info)
        streams: list[Stream] = []
        for key in wanted:
            names = _names(features[key], columns[key].shape[1])
            streams += _split(key, roles.get(key, ""), time, columns[key], names)
        yield Recording(where, f"{name}_{number:06d}", tuple(streams))


def _episodes(
    path: Path, wanted: Sequence[str], chosen: tuple[int, ...]
) -> Iterator[tuple[int, dict[str, np.ndarray]]]:
    """Number and columns, ``(T, K)``, of each episode, file by file."""
    files = sorted((path / "data").rglob("*.parquet"))
    if not files:
        raise UserError(f"{path}: no Parquet files below data/")
    left = set(chosen)
    seen: set[int] = set()
    for file in files:
        columns = _read(file, wanted)
        numbers = columns["episode_index"][:, 0]
        for number in np.unique(numbers).astype(int).tolist():
            if chosen and number not in chosen:
                continue
            if number in seen:
                raise UserError(f"{file}: episode {number} is in two files")
            seen.add(number)
            rows = numbers == number
            yield number, {key: values[rows] for key, values in columns.items()}
        left -= seen
        if chosen and not left:
            return
    if left:
        raise UserError(f"{path}: no episode {min(left)}")


def _read(file: Path, wanted: Sequence[str]) -> dict[str, np.ndarray]:
    with parquet_file(file) as parquet:
        there = parquet.schema_arrow.names
        for key in ("episode_index", *wanted):
            if key not in there:
                raise UserError(f'{file}: no column "{key}"{nearest(key, there)}')
        extra = [key for key in ("timestamp", "frame_index") if key in there]
        table = parquet.read(columns=["episode_index", *extra, *wanted])
        return {
            name: _numbers(file, name, column.combine_chunks())
            for name, column in zip(table.column_names, table.columns, strict=True)
        }


def _numbers(file: Path, name: str, column: Any) -> np.ndarray:
    """A column of numbers or of lists of one length as ``(T, K)``; null is NaN."""
    import pyarrow
    import pyarrow.compute

    types = pyarrow.types
    kind = column.type
    width = 1
    if (
        types.is_list(kind)
        or types.is_large_list(kind)
        or types.is_fixed_size_list(kind)
    ):
        lengths = pyarrow.compute.call_function("list_value_length", [column])
        lengths = lengths.fill_null(0).to_numpy(zero_copy_only=False)
        width = int(lengths[0]) if len(lengths) else 0
        differs = np.flatnonzero(lengths != width)
        if len(differs):
            raise UserError(
                f"{file}: row {differs[0] + 1} of {name} has {lengths[differs[0]]} "
                f"numbers where the first has {width}"
            )
        column = column.flatten()
        kind = column.type
    if not (types.is_integer(kind) or types.is_floating(kind)):
        raise UserError(f"{file}: {name} holds {kind}, not numbers")
    values = column.cast(pyarrow.float64(), safe=False)
    return values.to_numpy(zero_copy_only=False).reshape(-1, max(width, 1))


def _time(where: str, columns: dict[str, np.ndarray], info: dict[str, Any]) -> Any:
    if "timestamp" in columns:
        return columns["timestamp"][:, 0]
    rate = info.get("fps")
    if "frame_index" in columns and isinstance(rate, int | float) and rate > 0:
        return columns["frame_index"][:, 0] / rate
    raise UserError(f"{where} has neither timestamp nor frame_index with fps")


def _shape(feature: dict[str, Any]) -> list[Any]:
    shape = feature.get("shape")
    return shape if isinstance(shape, list) else [1]


def _names(feature: Any, width: int) -> list[str] | None:
    names = feature.get("names") if isinstance(feature, dict) else None
    if isinstance(names, dict):  # {"motors": [...]}
        lists = [value for value in names.values() if isinstance(value, list)]
        names = [name for value in lists for name in value]
    if not isinstance(names, list) or len(names) != width:
        return None
    return [str(name) for name in names]


def _split(
    key: str, role: Role, time: np.ndarray, values: np.ndarray, names: list[str] | None
) -> list[Stream]:
    """One stream, or where the names say it, one for each quantity."""
    whole = stream(key, role, time, values, names)
    if names is None or not role:
        return [whole]
    ends = [next((end for end in _SUFFIXES if n.endswith(end)), "") for n in names]
    if not any(ends):
        return [whole]
    parts: list[Stream] = []
    for end in dict.fromkeys(ends):
        at = [i for i, e in enumerate(ends) if e == end]
        of_joint = role if role == "ctrl" else _SUFFIXES.get(end, "")
        parts.append(
            Stream(
                source=key,
                role=of_joint,
                channels=tuple(whole.channels[i] for i in at),
                names=tuple(names[i].removesuffix(end) for i in at),
                named=True,
                time=time,
                values=values[:, at],
            )
        )
    return parts
