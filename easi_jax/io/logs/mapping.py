"""The mapping file: how the columns of a foreign log become ours."""

import math
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from easi_jax.errors import UserError, nearest
from easi_jax.io.logs.tables import Table
from easi_jax.io.strict_yaml import check_keys, read_yaml

_KEYS = ("columns", "scale", "offset")


@dataclass(frozen=True)
class LogMapping:
    """``ours = theirs * scale + offset``, column by column.

    Attributes:
        source: the mapping file.
        columns: their name -> our name; other columns keep theirs.
        scale: by our name, 1 where missing.
        offset: by our name, in our units, 0 where missing.
    """

    source: str
    columns: Mapping[str, str] = field(default_factory=dict)
    scale: Mapping[str, float] = field(default_factory=dict)
    offset: Mapping[str, float] = field(default_factory=dict)

    def rename(self, table: Table) -> Table:
        """``table`` under our names.

        Raises:
            UserError: a column of the mapping is not in the file, or two columns
                get one name.
        """
        for theirs in self.columns:
            if theirs not in table.columns:
                raise UserError(
                    f'{self.source}: column "{theirs}" is not in {table.path}'
                    f"{nearest(theirs, table.columns)}"
                )
        renamed: dict[str, list[str] | np.ndarray | str] = {}
        for theirs, column in table.columns.items():
            ours = self.columns.get(theirs, theirs)
            if ours in renamed:
                raise UserError(
                    f'{table.path}: two columns become "{ours}" by {self.source}'
                )
            renamed[ours] = column
        for ours in (*self.scale, *self.offset):
            if ours not in renamed:
                raise UserError(
                    f'{self.source}: scale or offset of "{ours}", which {table.path} '
                    f"does not have{nearest(ours, renamed)}"
                )
        return Table(table.path, renamed, table.notes)

    def apply(self, name: str, values: np.ndarray) -> np.ndarray:
        """``values`` of our column ``name`` in our units."""
        with np.errstate(over="ignore", invalid="ignore"):
            return values * self.scale.get(name, 1.0) + self.offset.get(name, 0.0)


def read_mapping(path: str | os.PathLike[str]) -> LogMapping:
    """Reads a mapping file.

    ``columns`` maps their names to ours; ``scale`` and ``offset`` take either name
    as key.

    Raises:
        UserError: unreadable, not YAML, an unknown key, or a value that is not a
            finite number (a scale of zero included).
    """
    path = Path(path)
    content = read_yaml(path)
    if not isinstance(content, dict):
        raise UserError(f'{path}: a mapping file has the key "columns:"')
    check_keys(path, content, _KEYS)
    columns = {
        str(theirs): str(ours)
        for theirs, ours in _section(path, content, "columns").items()
    }
    scale = _numbers(path, content, "scale", columns)
    for name, value in scale.items():
        if value == 0:
            raise UserError(f'{path}: scale of "{name}" is zero')
    offset = _numbers(path, content, "offset", columns)
    return LogMapping(str(path), columns, scale, offset)


def _section(path: Path, content: dict[Any, Any], key: str) -> dict[Any, Any]:
    section = content.get(key) or {}
    if not isinstance(section, dict):
        raise UserError(f'{path}: "{key}:" must hold one "name: value" per line')
    return section


def _numbers(
    path: Path, content: dict[Any, Any], key: str, columns: Mapping[str, str]
) -> dict[str, float]:
    numbers: dict[str, float] = {}
    for name, value in _section(path, content, key).items():
        ours = columns.get(str(name), str(name))
        try:
            # YAML 1.1 takes 1e-3 for text
            number = float(value)
        except (TypeError, ValueError, OverflowError):
            number = math.nan
        if not math.isfinite(number):
            raise UserError(f'{path}: {key} of "{name}" is {value!r}, not a number')
        if ours in numbers:
            raise UserError(f'{path}: {key} of "{ours}" is given twice')
        numbers[ours] = number
    return numbers
