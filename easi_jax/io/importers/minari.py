"""Minari datasets kept as HDF5."""

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

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

FILE = "main_data.hdf5"
_EPISODE = "episode_"


def read_minari(path: Path, selection: Selection) -> Iterator[Recording]:
    """Reads each episode of an HDF5 file, or of the dataset folder around it.

    Row k has observation k and the action that followed it; the last observation,
    which no action follows, has the action before it. There are no names and no times
    in such a dataset: ``selection.step`` (s) gives the times, a mapping the names.

    Raises:
        UserError: h5py is not installed, damaged, not this layout, no step, or arrays
            that differ in length.
    """
    try:
        import h5py
    except ImportError:
        raise UserError(
            f"{path}: needs the package h5py: pip install 'easi-jax[import]'"
        ) from None
    if selection.step is None:
        raise UserError(
            f"{path}: a Minari dataset has no times; give its control step in seconds "
            "by --step"
        )
    file, name = _file(path)
    with contextlib.ExitStack() as stack:
        try:
            root: Any = stack.enter_context(h5py.File(file, "r"))
        except OSError:
            raise UserError(f"{file}: not an HDF5 file, damaged or cut short") from None
        episodes = _episodes(file, root, selection.episodes)
        for number in episodes:
            try:
                leaves = dict(_leaves(root[f"{_EPISODE}{number}"], ""))
            except (OSError, RuntimeError, KeyError, ValueError):
                raise UserError(
                    f"{file}: episode {number} cannot be read; damaged?"
                ) from None
            where = f"{file}: episode {number}"
            streams = _streams(where, leaves, selection, selection.step)
            label = name if len(episodes) == 1 else f"{name}_{number:06d}"
            yield Recording(where, label, streams)


def _file(path: Path) -> tuple[Path, str]:
    """The HDF5 file, and the dataset's name."""
    if not path.is_dir():
        inside = path.name == FILE and path.parent.name == "data"
        return path, path.parent.parent.name if inside else path.stem
    for file in (path / "data" / FILE, path / FILE):
        if file.is_file():
            return file, path.resolve().name
    raise UserError(f"{path}: holds no data/{FILE}")


def _episodes(file: Path, root: Any, chosen: tuple[int, ...]) -> list[int]:
    try:
        groups = [str(key).partition(_EPISODE) for key in root]
    except (OSError, RuntimeError, KeyError, ValueError):
        raise UserError(f"{file}: cannot be read; damaged?") from None
    numbers = sorted(
        int(number) for before, _, number in groups if not before and number.isdecimal()
    )
    if not numbers:
        raise UserError(f"{file}: no group {_EPISODE}0; not a Minari dataset")
    for number in chosen:
        if number not in numbers:
            raise UserError(
                f"{file}: no episode {number}; it has {numbers[0]} to {numbers[-1]}"
            )
    return list(chosen) or numbers


def _leaves(group: Any, prefix: str) -> Iterator[tuple[str, np.ndarray]]:
    """Numeric arrays by their path, such as ``observations.pose``."""
    for key, item in group.items():
        name = f"{prefix}{key}"
        if item is None:
            raise KeyError(name)  # h5py's word for a link that leads nowhere
        if hasattr(item, "items"):
            yield from _leaves(item, f"{name}.")
        elif item.dtype.kind in "biuf" and item.ndim in (1, 2):
            values = np.asarray(item, float)
            yield name, values.reshape(len(values), -1)


def _streams(
    where: str, leaves: dict[str, np.ndarray], selection: Selection, step: float
) -> tuple[Stream, ...]:
    commands = selection.command or ("actions",)
    for key in (*selection.state, *commands):
        if key not in leaves:
            raise UserError(
                f'{where} has no array "{key}"{nearest(key, leaves)} '
                f"(it has {listed(list(leaves))})"
            )
    roles: dict[str, Role] = dict.fromkeys(selection.state, "qpos")
    roles |= dict.fromkeys(commands, "ctrl")
    steps = len(leaves[commands[0]])
    streams: list[Stream] = []
    for key, values in leaves.items():
        role = roles.get(key, "")
        if not role and not key.startswith(("observations", "infos")):
            continue
        allowed = (steps,) if role == "ctrl" else (steps, steps + 1)
        if len(values) not in allowed:
            if not role and not key.startswith("observations"):
                continue
            raise UserError(
                f"{where} has {len(values)} rows of {key} where {steps} of "
                f"{commands[0]} call for {allowed[-1]}"
            )
        time = step * np.arange(len(values))
        streams.append(stream(key, role, time, values))
    return tuple(streams)
