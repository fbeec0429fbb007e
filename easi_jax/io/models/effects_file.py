"""``effects.yaml``: found effects in a form that commands take with ``--effects``.

model: robot.xml
effects:
- effect: coulomb_friction
  at: hinge
  kind: joint
  columns: {coulomb: 0.12}
refitted:
- {address: joint.hinge.damping, value: 0.011}
"""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from easi_jax.errors import UserError, nearest
from easi_jax.io.files import atomic_write, to_plain
from easi_jax.io.strict_yaml import read_yaml
from easi_jax.model.effect_catalog import CATALOG
from easi_jax.model.effect_numbers import NUMBERS, is_column
from easi_jax.model.found_effects import EffectEntry, FoundEffects

_KEYS = ("effect", "at", "kind", "columns", "parameters", "std")


def write_effects(
    path: Path,
    model: str,
    entries: Sequence[EffectEntry],
    shown: Sequence[Mapping[str, Any]],
    refitted: Sequence[Mapping[str, Any]],
) -> None:
    """Writes the file; ``shown`` are each effect's parameters as people know them.

    Raises:
        UserError: the file cannot be written.
    """
    content = {
        "model": model,
        "effects": [
            {
                "effect": e.effect,
                "at": e.at,
                "kind": e.kind,
                "parameters": to_plain(s),
                "columns": to_plain(e.columns),
                "std": to_plain(e.std),
            }
            for e, s in zip(entries, shown, strict=True)
        ],
        "refitted": [
            {"address": r["address"], "value": float(r["to"])} for r in refitted
        ],
    }
    head = (
        "# Effects that the model lacks, found by train.gap; for --effects, with the\n"
        "# model as it was (model.xml beside this file holds what MJCF can say of "
        "them).\n"
    )
    text = yaml.safe_dump(content, sort_keys=False, allow_unicode=True)
    atomic_write(path, head + text)


def read_effects(path: Path) -> tuple[list[EffectEntry], dict[str, float]]:
    """Effects of a file, and values of the model's own parameters by address.

    Raises:
        UserError: not such a file; names the entry and what is wrong with it.
    """
    found = parsed_effects(read_yaml(path), str(path))
    return list(found.entries), dict(found.own or {})


def parsed_effects(content: Any, path: str) -> FoundEffects:
    """Effects from the content of a file; ``path`` is named in messages.

    Raises:
        UserError: as `read_effects`.
    """
    if not isinstance(content, dict) or not isinstance(content.get("effects"), list):
        raise UserError(f'{path}: an effects file has the key "effects:" with a list')
    for key in content:
        if key not in ("model", "effects", "refitted"):
            raise UserError(f'{path}: unknown key "{key}" (known: effects, refitted)')
    entries = [_entry(path, i, e) for i, e in enumerate(content["effects"], 1)]
    own: dict[str, float] = {}
    refitted = content.get("refitted") or []
    if not isinstance(refitted, list):
        raise UserError(f"{path}: refitted: holds a list")
    for i, item in enumerate(refitted, 1):
        if not isinstance(item, dict) or set(item) != {"address", "value"}:
            raise UserError(
                f"{path}, refitted {i}: write {{address: joint.NAME.damping, value: 1}}"
            )
        own[str(item["address"])] = _number(path, f"refitted {i}", item["value"])
    return FoundEffects(tuple(entries), own)


def _entry(path: str, i: int, item: Any) -> EffectEntry:
    where = f"effect {i}"
    if not isinstance(item, dict):
        raise UserError(f"{path}, {where}: write effect:, at:, kind: and columns:")
    for key in item:
        if key not in _KEYS:
            raise UserError(
                f'{path}, {where}: unknown key "{key}"{nearest(str(key), _KEYS)}'
            )
    name = str(item.get("effect", ""))
    if name not in CATALOG:
        raise UserError(
            f'{path}, {where}: unknown effect "{name}"{nearest(name, CATALOG)} '
            f"(known: {', '.join(CATALOG)}); one that you wrote yourself needs "
            "--effects-from FILE.py"
        )
    columns = item.get("columns")
    if not isinstance(columns, dict) or not columns:
        raise UserError(f"{path}, {where} ({name}): columns: holds its numbers")
    for key in columns:
        if not is_column(str(key)):
            raise UserError(
                f'{path}, {where} ({name}): unknown column "{key}"'
                f"{nearest(str(key), NUMBERS)}"
            )
    std = item.get("std") or {}
    if not isinstance(std, dict):
        raise UserError(
            f"{path}, {where} ({name}): std: holds a number for each column"
        )
    return EffectEntry(
        name,
        str(item.get("at", "")),
        str(item.get("kind", "model")),
        {str(k): _number(path, where, v) for k, v in columns.items()},
        {str(k): _number(path, where, v) for k, v in std.items()},
    )


def _number(path: str, where: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise UserError(f'{path}, {where}: "{value}" is not a number')
    try:
        number = float(value)
    except OverflowError:  # a whole number of hundreds of digits
        number = math.inf
    if not math.isfinite(number):
        raise UserError(f"{path}, {where}: {value} is not finite")
    return number
