"""The mapping file of an import: whose joint is whose."""

import fnmatch
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from easi_jax.errors import UserError, nearest
from easi_jax.io.strict_yaml import check_keys, read_yaml

_KEYS = ("joints", "actuators", "columns", "scale", "offset")


@dataclass(frozen=True)
class ImportMapping:
    """Foreign names to the model's; ``ours = theirs * scale + offset``.

    Attributes:
        source: the file, for messages.
        joints: their joint -> the model's; None leaves it out.
        actuators: entry of a command -> the model's actuator; None leaves it out.
        columns: channel -> column of the log; None leaves it out.
        scale: by column, ``*`` allowed, 1 where missing.
        offset: by column, ``*`` allowed, in our units, 0 where missing.
    """

    source: str = ""
    joints: Mapping[str, str | None] = field(default_factory=dict)
    actuators: Mapping[str, str | None] = field(default_factory=dict)
    columns: Mapping[str, str | None] = field(default_factory=dict)
    scale: Mapping[str, float] = field(default_factory=dict)
    offset: Mapping[str, float] = field(default_factory=dict)

    def apply(self, column: str, values: np.ndarray) -> np.ndarray:
        """``values`` of our ``column`` in our units, of any shape.

        Raises:
            UserError: two patterns fit the column.
        """
        with np.errstate(over="ignore", invalid="ignore"):
            scaled = values * self._number("scale", column, 1.0)
            return scaled + self._number("offset", column, 0.0)

    def check_used(self, columns: Mapping[str, object]) -> None:
        """Refuses a scale or offset that fits none of the log's ``columns``.

        Raises:
            UserError: naming it and the nearest column.
        """
        for key in (*self.scale, *self.offset):
            if not any(fnmatch.fnmatchcase(name, key) for name in columns):
                raise UserError(
                    f'{self.source}: scale or offset of "{key}", which no column of '
                    f"the log is called{nearest(key, columns)}"
                )

    def _number(self, kind: str, column: str, default: float) -> float:
        table: Mapping[str, float] = getattr(self, kind)
        if column in table:
            return table[column]
        fitting = [key for key in table if fnmatch.fnmatchcase(column, key)]
        if len(fitting) > 1:
            raise UserError(
                f'{self.source}: {kind} of "{column}" is given by "{fitting[0]}" and '
                f'"{fitting[1]}"'
            )
        return table[fitting[0]] if fitting else default


def read_import_mapping(path: str | os.PathLike[str]) -> ImportMapping:
    """Reads a mapping file.

    ``joints`` and ``actuators`` are ``theirs: ours``, or a list in the order of a
    recording without names; an empty name leaves an entry out.

    Raises:
        UserError: unreadable, not YAML, an unknown key, or a value that is not a
            finite number (a scale of zero included).
    """
    path = Path(path)
    content = read_yaml(path)
    if not isinstance(content, dict):
        raise UserError(f"{path}: a mapping file has the keys {', '.join(_KEYS)}")
    check_keys(path, content, _KEYS)
    scale = _numbers(path, content, "scale")
    for name, value in scale.items():
        if value == 0:
            raise UserError(f'{path}: scale of "{name}" is zero')
    offset = _numbers(path, content, "offset")
    if "time" in offset:
        raise UserError(f"{path}: time has no offset, only a scale")
    return ImportMapping(
        str(path),
        _names(path, content, "joints"),
        _names(path, content, "actuators"),
        _names(path, content, "columns"),
        scale,
        offset,
    )


def _names(path: Path, content: dict[Any, Any], key: str) -> dict[str, str | None]:
    section = content.get(key) or {}
    if isinstance(section, list) and key != "columns":
        section = dict(enumerate(section))
    if not isinstance(section, dict):
        raise UserError(f'{path}: "{key}:" must hold one "name: name" per line')
    for theirs, ours in section.items():
        if isinstance(ours, list | dict):
            raise UserError(f'{path}: {key} of "{theirs}" is not a name')
    return {
        str(theirs): None if ours in (None, "") else str(ours)
        for theirs, ours in section.items()
    }


def _numbers(path: Path, content: dict[Any, Any], key: str) -> dict[str, float]:
    section = content.get(key) or {}
    if not isinstance(section, dict):
        raise UserError(f'{path}: "{key}:" must hold one "column: number" per line')
    numbers: dict[str, float] = {}
    for name, value in section.items():
        try:
            # YAML 1.1 takes 1e-3 for text
            number = float(value)
        except (TypeError, ValueError):
            number = math.nan
        if not math.isfinite(number):
            raise UserError(f'{path}: {key} of "{name}" is {value!r}, not a number')
        numbers[str(name)] = number
    return numbers
