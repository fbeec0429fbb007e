"""Whole files or nothing: atomic writes, and JSON that keeps non-finite numbers."""

import dataclasses
import enum
import errno
import hashlib
import json
import math
import os
import stat
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from easi_jax.devices import distributed
from easi_jax.errors import UserError, engine_calls

_NON_FINITE = {"NaN": math.nan, "Infinity": math.inf, "-Infinity": -math.inf}


def os_reason(error: OSError) -> str:
    """The operating system's own words, such as ``No space left on device``."""
    return error.strerror or type(error).__name__


def regular_file(path: Path) -> None:
    """Refuses what opening could wait for without end: a pipe, a device.

    Raises:
        UserError: it is there and no file.
        OSError: as `os.stat`; ``IsADirectoryError`` for a folder.
    """
    mode = path.stat().st_mode
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    if not stat.S_ISREG(mode):
        raise UserError(f"{path} is a pipe or a device, not a file")


def read_bytes(path: Path) -> bytes:
    """What a file holds.

    Raises:
        UserError: it cannot be read.
    """
    try:
        regular_file(path)
        return path.read_bytes()
    except OSError as error:
        raise UserError(f"cannot read {path}: {os_reason(error)}") from error


def atomic_write(path: Path, data: str | bytes) -> None:
    """Writes ``path`` so that it holds the old content or the new, never a part.

    Of several processes of one run, the leader alone writes.

    Raises:
        UserError: the file cannot be written; what was there before is kept.
        EngineError: a simulation failed, so that what would be written is worth
            nothing.
    """
    engine_calls.check()
    if not distributed.leader():
        return
    # Half of a surrogate pair, as a file's name may hold, is no UTF-8.
    raw = data.encode("utf-8", "backslashreplace") if isinstance(data, str) else data
    temp = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, temp = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
        with os.fdopen(handle, "wb") as file:
            file.write(raw)
            file.flush()
            os.fsync(file.fileno())
        os.chmod(temp, 0o666 & ~_umask())
        os.replace(temp, path)
    except OSError as error:
        raise UserError(
            f"cannot write {path}: {os_reason(error)}; free the disk or choose "
            "another --out"
        ) from error
    finally:
        if temp is not None and os.path.exists(temp):
            os.unlink(temp)


def _umask() -> int:
    current = os.umask(0o022)
    os.umask(current)
    return current


def to_plain(value: Any) -> Any:
    """Turns dataclasses, arrays, paths and enums into what JSON can hold.

    Numbers that are not finite become the strings ``"NaN"``, ``"Infinity"`` and
    ``"-Infinity"``, which ``float()`` reads back: strict JSON has no other way, and
    null would hide which it was.

    Raises:
        TypeError: for a type that has no place in a file.
    """
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = dataclasses.fields(value)
        return {field.name: to_plain(getattr(value, field.name)) for field in fields}
    if isinstance(value, Mapping):
        return {str(key): to_plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [to_plain(item) for item in value]
    if isinstance(value, set | frozenset):
        return sorted(to_plain(item) for item in value)
    if isinstance(value, enum.Enum):
        return value.name
    if isinstance(value, Path):
        return str(value)
    if value is None or isinstance(value, bool | int | str):
        return value
    if isinstance(value, float):
        if math.isfinite(value):
            return value
        return "NaN" if math.isnan(value) else f"{'-' if value < 0 else ''}Infinity"
    if hasattr(value, "__array__"):
        return to_plain(np.asarray(value).tolist())
    raise TypeError(f"{type(value).__name__} cannot be written to JSON")


def to_json(value: Any, indent: int | None = 2) -> str:
    """Strict JSON text of ``value`` (see ``to_plain``), ending in a newline."""
    return json.dumps(to_plain(value), indent=indent, allow_nan=False) + "\n"


def number(value: Any) -> float:
    """A number read from JSON, the strings for non-finite ones included.

    Raises:
        TypeError, ValueError: it is none.
    """
    if isinstance(value, str) and value in _NON_FINITE:
        return _NON_FINITE[value]
    try:
        return float(value)
    except OverflowError:  # a whole number of hundreds of digits
        raise ValueError("too large a number") from None


def read_json(path: Path) -> Any:
    """Reads a JSON file.

    Raises:
        UserError: it is missing, unreadable or no JSON.
    """
    try:
        regular_file(path)
        return json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise UserError(f"cannot read {path}: {os_reason(error)}") from error
    except ValueError as error:
        raise UserError(f"{path} is not valid JSON: {error}") from error
    except RecursionError as error:
        raise UserError(f"{path} is not valid JSON: nested too deeply") from error


def digest_of(path: Path) -> str:
    """SHA-256 of a file, hex.

    Raises:
        OSError: it cannot be read.
    """
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
