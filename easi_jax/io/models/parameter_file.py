"""The parameter file: which physical parameters of a model may vary, in YAML.

parameters:
  - name: cart_mass
    address: body.cart.mass   # or a list; * ties several places
    nominal: 0.3              # default: the model's value
    initial: [0.1, 0.9]       # default: a third to three times the nominal
    bounds: [1e-3, 10]        # default: what physics allows
    scale: log                # or linear; default log
    unit: kg                  # default: the SI unit of the quantity
"""

import math
import os
from pathlib import Path
from typing import Any

import mujoco
import yaml

from easi_jax.errors import UserError, nearest
from easi_jax.io.files import atomic_write
from easi_jax.io.strict_yaml import check_keys, number_of, read_yaml
from easi_jax.model.parameters import ParameterSpace, Range, declare

_KEYS = ("name", "address", "nominal", "initial", "bounds", "scale", "unit")
_SCALES = ("log", "linear")


def read_parameter_file(
    path: str | os.PathLike[str], mj_model: mujoco.MjModel
) -> ParameterSpace:
    """Reads a parameter file for a model.

    Raises:
        UserError: the file cannot be read, is not YAML of this form, or an entry does
            not fit the model; names file and entry.
    """
    path = Path(path)
    content = read_yaml(path)
    if not isinstance(content, dict):
        raise UserError(f'{path}: a parameter file has the key "parameters:"')
    for key in content:
        if key != "parameters":
            raise UserError(
                f'{path}: unknown key "{key}"{nearest(str(key), ["parameters"])} '
                "(known: parameters)"
            )
    entries = content.get("parameters")
    if not isinstance(entries, list) or not entries:
        raise UserError(f'{path}: "parameters:" must hold a list of "- name: ..."')
    parameters = tuple(
        _entry(path, i, entry, mj_model) for i, entry in enumerate(entries, 1)
    )
    try:
        return ParameterSpace(parameters)
    except UserError as error:
        raise UserError(f"{path}: {error}") from None


def write_parameter_file(path: str | os.PathLike[str], space: ParameterSpace) -> None:
    """Writes a space so that `read_parameter_file` returns it, all keys explicit.

    Raises:
        UserError: the file cannot be written; an old one is kept.
    """
    entries = [
        {
            "name": p.name,
            "address": p.addresses[0] if len(p.addresses) == 1 else list(p.addresses),
            "nominal": float(p.nominal),
            "initial": [float(x) for x in p.initial],
            "bounds": [float(x) for x in p.bounds],
            "scale": "log" if p.log else "linear",
            "unit": p.unit,
        }
        for p in space.parameters
    ]
    text = yaml.safe_dump(
        {"parameters": entries}, sort_keys=False, allow_unicode=True, width=88
    )
    atomic_write(Path(path), text)


def _entry(path: Path, number: int, entry: Any, mj_model: mujoco.MjModel) -> Any:
    where = f"{path}: parameter {number}"
    if not isinstance(entry, dict):
        raise UserError(f'{where}: write "- name: ..." and "address: ..."')
    check_keys(where, entry, _KEYS)
    for key in ("name", "address"):
        if key not in entry:
            raise UserError(f'{where}: the key "{key}" is missing')
    name = _text(where, "name", entry["name"])
    where = f'{where} "{name}"'
    scale = entry.get("scale", "log")
    if scale not in _SCALES:
        raise UserError(f"{where}: scale is {scale!r}; write log or linear")
    nominal = entry.get("nominal")
    unit = entry.get("unit")
    try:
        return declare(
            mj_model,
            name,
            _addresses(where, entry["address"]),
            nominal=None if nominal is None else _number(where, "nominal", nominal),
            initial=_range(where, "initial", entry.get("initial")),
            bounds=_range(where, "bounds", entry.get("bounds")),
            unit=None if unit is None else _unit(where, unit),
            log=scale == "log",
        )
    except UserError as error:
        text = str(error).removeprefix(f'parameter "{name}": ')
        raise (
            error if text.startswith(where) else UserError(f"{where}: {text}")
        ) from None


def _text(where: str, key: str, value: Any) -> str:
    if not isinstance(value, str) or not value.strip():
        raise UserError(f"{where}: {key} is {value!r}, not a text")
    return value


def _unit(where: str, value: Any) -> str:
    # "unit: 1" is a number to YAML, and the unit of a ratio to people
    return str(value) if value in (1, "") else _text(where, "unit", value)


def _addresses(where: str, value: Any) -> tuple[str, ...]:
    values = value if isinstance(value, list) else [value]
    if not values:
        raise UserError(f"{where}: address is an empty list")
    return tuple(_text(where, "address", v) for v in values)


def _number(where: str, key: str, value: Any) -> float:
    number = number_of(value)
    if math.isnan(number):
        raise UserError(f"{where}: {key} is {value!r}, not a number")
    return number


def _range(where: str, key: str, value: Any) -> Range | None:
    if value is None:
        return None
    if not isinstance(value, list) or len(value) != 2:
        raise UserError(f"{where}: {key} is {value!r}; write [low, high]")
    return _number(where, key, value[0]), _number(where, key, value[1])
