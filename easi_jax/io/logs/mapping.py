"""The mapping file: how names, units and forms of a foreign recording become ours.

One schema for tables (``--mapping`` of every command that reads logs) and for the
recordings that are imported.
"""

import math
import os
import re
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from easi_jax.errors import UserError, nearest
from easi_jax.io.logs.tables import Cells, Table
from easi_jax.io.strict_yaml import check_keys, number_of, read_yaml
from easi_jax.model.addresses import matching

_NAMES = ("columns", "joints", "actuators")
_NUMBERS = ("scale", "offset")
_KEYS = (*_NAMES, *_NUMBERS, "quaternions", "decimal")
_OURS = "wxyz"
_ORDERS = (_OURS, "xyzw")
_OF_KIND = {"qpos": "joints", "qvel": "joints", "ctrl": "actuators"}


@dataclass(frozen=True)
class LogMapping:
    """Foreign names to the model's; ``ours = theirs * scale + offset``.

    Attributes:
        source: the mapping file, for messages.
        columns: column or channel -> our column; None leaves it out.
        joints: their joint -> the model's; None leaves it out.
        actuators: entry of a command -> the model's actuator; None leaves it out.
        scale: by our column, ``*`` allowed, 1 where missing.
        offset: by our column, ``*`` allowed, in our units, 0 where missing.
        quaternions: order in which the quaternion of a joint is written, ``wxyz`` or
            ``xyzw``.
        decimal: decimal sign of a text file.
    """

    source: str = ""
    columns: Mapping[str, str | None] = field(default_factory=dict)
    joints: Mapping[str, str | None] = field(default_factory=dict)
    actuators: Mapping[str, str | None] = field(default_factory=dict)
    scale: Mapping[str, float] = field(default_factory=dict)
    offset: Mapping[str, float] = field(default_factory=dict)
    quaternions: Mapping[str, str] = field(default_factory=dict)
    decimal: str = "."

    def rename(self, table: Table) -> Table:
        """``table`` under our names.

        Raises:
            UserError: a name of the mapping is not in the file, or two columns get
                one name.
        """
        self.check_names("columns", table.columns, table.path)
        for key in ("joints", "actuators"):
            self.check_names(key, self._parts(key, table.columns), table.path)
        renamed: dict[str, Cells] = {}
        for theirs, column in table.columns.items():
            ours = self._renamed(theirs)
            if ours is None:
                continue
            if ours in renamed:
                raise UserError(
                    f'{table.path}: two columns become "{ours}" by {self.source}'
                )
            renamed[ours] = column
        self.check_used(renamed)
        ordered = {self.component(name, renamed): c for name, c in renamed.items()}
        return replace(table, columns=ordered, decimal=self.decimal)

    def check_names(self, key: str, known: Collection[str], where: object) -> None:
        """Refuses names under ``key`` that the recording ``where`` does not have.

        Raises:
            UserError: naming it and the nearest ``known``.
        """
        for theirs in getattr(self, key):
            if theirs not in known:
                names = list(known)
                has = f" (it has {', '.join(names[:8])})" if 0 < len(names) < 9 else ""
                raise UserError(
                    f'{self.source}: {key} name "{theirs}" is not in {where}'
                    f"{nearest(theirs, names) or has}"
                )

    def check_used(self, columns: Collection[str]) -> None:
        """Refuses what is said of none of the log's ``columns``.

        Raises:
            UserError: naming it and the nearest column.
        """
        for key in (*self.scale, *self.offset):
            if not matching(key, columns):
                raise UserError(
                    f'{self.source}: scale or offset of "{key}", which no column of '
                    f"the log is called{nearest(key, columns)}"
                )
        for joint in self.quaternions:
            if f"qpos.{joint}.3" not in columns:
                many = [c for c in columns if re.fullmatch(r"qpos\..+\.\d", c)]
                known = {c[len("qpos.") : -len(".0")] for c in many}
                raise UserError(
                    f'{self.source}: quaternions of "{joint}", which has none in the '
                    f"log{nearest(joint, known)}"
                )

    def apply(self, column: str, values: np.ndarray) -> np.ndarray:
        """``values`` of our ``column`` in our units, of any shape.

        Raises:
            UserError: two patterns fit the column.
        """
        with np.errstate(over="ignore", invalid="ignore"):
            scaled = values * self._number("scale", column, 1.0)
            return scaled + self._number("offset", column, 0.0)

    def component(self, column: str, columns: Collection[str]) -> str:
        """Our name of ``column`` where it is part of a quaternion in another order; a
        joint among ``columns`` with seven positions is a free one."""
        for joint, order in self.quaternions.items():
            first = 3 if f"qpos.{joint}.6" in columns else 0
            for i, part in enumerate(order):
                if column == f"qpos.{joint}.{first + i}":
                    return f"qpos.{joint}.{first + _OURS.index(part)}"
        return column

    def _renamed(self, theirs: str) -> str | None:
        if theirs in self.columns:
            return self.columns[theirs]
        kind, _, rest = theirs.partition(".")
        names: Mapping[str, str | None] = getattr(self, _OF_KIND.get(kind, ""), {})
        for name in _owners(rest):
            if name in names:
                ours = names[name]
                return ours and f"{kind}.{ours}{rest.removeprefix(name)}"
        return theirs

    def _parts(self, key: str, columns: Iterable[str]) -> list[str]:
        """Joints or actuators that ``columns`` may be of."""
        split = [name.partition(".") for name in columns]
        rests = [rest for kind, _, rest in split if _OF_KIND.get(kind) == key]
        return list(dict.fromkeys(name for rest in rests for name in _owners(rest)))

    def _number(self, kind: str, column: str, default: float) -> float:
        table: Mapping[str, float] = getattr(self, kind)
        if column in table:
            return table[column]
        fitting = [key for key in table if matching(key, [column])]
        if len(fitting) > 1:
            raise UserError(
                f'{self.source}: {kind} of "{column}" is given by "{fitting[0]}" and '
                f'"{fitting[1]}"'
            )
        return table[fitting[0]] if fitting else default


def _owners(rest: str) -> tuple[str, ...]:
    """Whose number ``rest`` of a column may be: ``base.3`` is that of ``base``."""
    owner, _, number = rest.rpartition(".")
    return (rest, owner) if number.isdigit() and owner else (rest,)


def read_mapping(path: str | os.PathLike[str]) -> LogMapping:
    """Reads a mapping file.

    ``columns``, ``joints`` and ``actuators`` are ``theirs: ours``, and an empty name
    leaves an entry out; the last two may be a list, in the order of a recording
    without names. ``scale`` and ``offset`` take either name of a column as key.

    Raises:
        UserError: unreadable, not YAML, an unknown key, or a value that is not of
            its kind (a scale of zero included).
    """
    path = Path(path)
    content = read_yaml(path)
    if not isinstance(content, dict):
        raise UserError(
            f'{path}: a mapping file has keys such as "columns:" '
            f"(known: {', '.join(_KEYS)})"
        )
    check_keys(path, content, _KEYS)
    names = {key: _names(path, content, key) for key in _NAMES}
    numbers = {key: _numbers(path, content, key, names["columns"]) for key in _NUMBERS}
    for name, value in numbers["scale"].items():
        if value == 0:
            raise UserError(f'{path}: scale of "{name}" is zero')
    quaternions = _section(path, content, "quaternions")
    for joint, order in quaternions.items():
        if order not in _ORDERS:
            raise UserError(
                f'{path}: quaternions of "{joint}" is {order!r}, not one of '
                f"{', '.join(_ORDERS)}"
            )
    decimal = content.get("decimal", ".")
    if decimal not in (".", ","):
        raise UserError(f'{path}: decimal is {decimal!r}, not "." or ","')
    return LogMapping(
        str(path),
        **names,
        scale=numbers["scale"],
        offset=numbers["offset"],
        quaternions={str(joint): order for joint, order in quaternions.items()},
        decimal=decimal,
    )


def _section(path: Path, content: dict[Any, Any], key: str) -> dict[Any, Any]:
    section = content.get(key) or {}
    if isinstance(section, list) and key in ("joints", "actuators"):
        section = dict(enumerate(section))
    if not isinstance(section, dict):
        raise UserError(f'{path}: "{key}:" must hold one "name: value" per line')
    return section


def _names(path: Path, content: dict[Any, Any], key: str) -> dict[str, str | None]:
    section = _section(path, content, key)
    for theirs, ours in section.items():
        if isinstance(ours, list | dict):
            raise UserError(f'{path}: {key} of "{theirs}" is not a name')
        for word in (theirs, ours):
            if isinstance(word, bool):  # YAML's yes, no, on and off
                raise UserError(
                    f"{path}: {key}: a name that YAML takes for {word}: put it in "
                    "quotes"
                )
    return {
        str(theirs): None if ours in (None, "") else str(ours)
        for theirs, ours in section.items()
    }


def _numbers(
    path: Path, content: dict[Any, Any], key: str, columns: Mapping[str, str | None]
) -> dict[str, float]:
    numbers: dict[str, float] = {}
    for name, value in _section(path, content, key).items():
        ours = columns.get(str(name)) or str(name)
        number = number_of(value)
        if not math.isfinite(number):
            raise UserError(f'{path}: {key} of "{name}" is {value!r}, not a number')
        if ours in numbers:
            raise UserError(f'{path}: {key} of "{ours}" is given twice')
        numbers[ours] = number
    return numbers
