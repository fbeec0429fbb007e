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
from easi_jax.io.strict_yaml import number_of, read_yaml
from easi_jax.model.effect_catalog import CATALOG
from easi_jax.model.effect_numbers import NUMBERS, is_column
from easi_jax.model.found_effects import EffectEntry, FoundEffects
from easi_jax.model.found_laws import (
    FOUND_LAW,
    add_law,
    law_of,
    public_name,
    read_law,
)

_KEYS = ("effect", "at", "kind", "columns", "parameters", "std")
_LAW_KEYS = ("law", "acts", "terms")


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
        "effects": [_written(e, shown=s) for e, s in zip(entries, shown, strict=True)],
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


def _written(e: EffectEntry, shown: Mapping[str, Any]) -> dict[str, Any]:
    law = law_of(e.effect)
    numbers = {"columns": dict(e.columns), "std": dict(e.std)}
    more: dict[str, Any] = {}
    if law is not None:
        numbers = {
            key: {column.rpartition(".")[2]: x for column, x in values.items()}
            for key, values in numbers.items()
        }
        values = [numbers["columns"][n] for n in law.numbers]
        more["law"] = law.shown(values, "(SI units)")
        more["acts"] = dict(law.acts)
        more["terms"] = [t.text for t in law.terms]
    return {
        "effect": public_name(e.effect),
        "at": e.at,
        "kind": e.kind,
        **more,
        "parameters": to_plain(shown),
        **to_plain(numbers),
    }


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
    name = str(item.get("effect", ""))
    known = (*_KEYS, *_LAW_KEYS) if name == FOUND_LAW else _KEYS
    for key in item:
        if key not in known:
            raise UserError(
                f'{path}, {where}: unknown key "{key}"{nearest(str(key), known)}'
            )
    if name == FOUND_LAW:
        item = _with_law(f"{path}, {where}", item)
        name = item["effect"]
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
    at, kind = item.get("at", ""), str(item.get("kind", "model"))
    if isinstance(at, list | dict):
        raise UserError(f"{path}, {where} ({name}): at: holds one name, not {at}")
    site = CATALOG[name].sites.get(kind)
    own = {p.column: p for p in site.parts} if site else {}
    odd = next((str(key) for key in columns if site and str(key) not in own), None)
    if odd:
        raise UserError(
            f'{path}, {where}: {name} at a {kind} has no column "{odd}" (it has '
            f"{', '.join(own)})"
        )
    # What was left out is as without the effect.
    given = {c: p.usual for c, p in own.items() if math.isfinite(p.usual)} | columns
    std = item.get("std") or {}
    if not isinstance(std, dict):
        raise UserError(
            f"{path}, {where} ({name}): std: holds a number for each column"
        )
    return EffectEntry(
        name,
        str(at),
        kind,
        {str(k): _number(path, where, v) for k, v in given.items()},
        {str(k): _number(path, where, v) for k, v in std.items()},
    )


def _with_law(where: str, item: dict[str, Any]) -> dict[str, Any]:
    """A law's entry by its name in the catalog, columns likewise."""
    acts, terms = item.get("acts"), item.get("terms")
    if not isinstance(acts, dict) or not isinstance(terms, list):
        raise UserError(
            f"{where} ({FOUND_LAW}): acts: holds joints with their shares, terms: a "
            "list of terms"
        )
    shares = {str(k): _number(where, "acts", v) for k, v in acts.items()}
    try:
        law = read_law(shares, [str(t) for t in terms])
    except UserError as error:
        raise UserError(f"{where}: {error}") from error
    numbers: dict[str, Any] = {}
    for key in ("columns", "std"):
        values = item.get(key) or {}
        if not isinstance(values, dict) or not {*values} <= {*law.numbers}:
            raise UserError(
                f"{where} ({FOUND_LAW}): {key}: holds a number for each term: "
                f"{', '.join(law.numbers)}"
            )
        numbers[key] = {f"{law.name}.{k}": v for k, v in values.items()}
    if len(numbers["columns"]) < len(law.numbers):
        raise UserError(f"{where} ({FOUND_LAW}): columns: lacks a number of a term")
    add_law(law)
    return {**item, **numbers, "effect": law.name, "at": law.at, "kind": "joint"}


def _number(path: str, where: str, value: Any) -> float:
    number = number_of(value)
    if not math.isfinite(number):
        raise UserError(f"{path}, {where}: {value!r} is no finite number")
    return number
