"""Tensors out of a ``torch.save`` file, with neither torch nor unpickling.

Such a file is a zip of raw storages and a pickle program that puts them together.
The program is only interpreted here: a stack machine builds plain containers and
views of the storages, it imports nothing and calls nothing, and any opcode or global
that tensors in containers do not need ends the reading.
"""

import math
import pickletools
import struct
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from easi_jax.errors import UserError

_TYPES = {
    "DoubleStorage": "f8",
    "FloatStorage": "f4",
    "HalfStorage": "f2",
    "LongStorage": "i8",
    "IntStorage": "i4",
    "ShortStorage": "i2",
    "CharStorage": "i1",
    "ByteStorage": "u1",
    "BoolStorage": "?",
}
_ORDERED_DICT = ("collections", "OrderedDict")
_TENSOR = ("torch._utils", "_rebuild_tensor_v2")
_GLOBALS = {_ORDERED_DICT, _TENSOR, *(("torch", name) for name in _TYPES)}
_MOST_PROGRAM = 1 << 22  # bytes; a dictionary of tensors takes some thousands
_PUSHED = {
    *("INT", "BININT", "BININT1", "BININT2", "LONG", "LONG1", "LONG4"),
    *("FLOAT", "BINFLOAT", "UNICODE"),
    *("SHORT_BINUNICODE", "BINUNICODE", "BINUNICODE8"),
}
_CONSTANTS = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False}
_EMPTY: dict[str, Callable[[], Any]] = {
    "EMPTY_DICT": dict,
    "EMPTY_LIST": list,
    "EMPTY_TUPLE": tuple,
}
_TUPLES = {"TUPLE1": 1, "TUPLE2": 2, "TUPLE3": 3}
_NOTHING = {"PROTO", "FRAME"}


class _RefusedError(Exception):
    """Why the program is not that of tensors in containers."""


@dataclass(frozen=True)
class _Global:
    module: str
    name: str


class _Mark:
    """Where a group of items on the stack begins."""


def read_tensors(path: Path) -> dict[str, np.ndarray]:
    """The tensors of the dictionary that ``path`` holds; its other values are left out.

    Raises:
        UserError: not a zip of ``torch.save``, damaged, no dictionary, or it asks for
            anything but tensors.
    """
    broken = f"{path}: not a file of torch.save, damaged or cut short"
    try:
        with zipfile.ZipFile(path) as archive:
            found = _Program(archive).run()
    except _RefusedError as error:
        raise UserError(f"{path}: {error}") from None
    except zipfile.BadZipFile:
        raise UserError(
            f"{broken} (files of torch before 1.6 are to be saved again)"
        ) from None
    except (ValueError, KeyError, IndexError, TypeError, AttributeError):
        raise UserError(broken) from None  # a program that makes no sense
    except (EOFError, RuntimeError, NotImplementedError, struct.error, MemoryError):
        raise UserError(broken) from None  # entries cut short or encrypted
    if not isinstance(found, dict):
        raise UserError(
            f"{path}: holds a {type(found).__name__}, not a dictionary of tensors"
        )
    return {
        str(name): value
        for name, value in found.items()
        if isinstance(value, np.ndarray)
    }


class _Program:
    """Interprets the pickle program of ``archive``."""

    def __init__(self, archive: zipfile.ZipFile):
        self.archive = archive
        names = [
            name
            for name in archive.namelist()
            if name == "data.pkl" or name.endswith("/data.pkl")
        ]
        if len(names) != 1:
            raise _RefusedError("not a file of torch.save (no data.pkl in the zip)")
        self.root = names[0].removesuffix("data.pkl")
        self.stack: list[Any] = []
        self.memo: dict[int, Any] = {}
        self.storages: dict[str, np.ndarray] = {}
        order = self._entry("byteorder") if self._has("byteorder") else b"little"
        self.order = {b"little": "<", b"big": ">"}[order.strip()]

    def run(self) -> Any:
        program = self._entry("data.pkl", _MOST_PROGRAM)
        for opcode, argument, _ in pickletools.genops(program):
            if opcode.name == "STOP":
                return self.stack.pop()
            self._step(opcode.name, argument)
        raise _RefusedError("its program has no end")

    def _step(self, name: str, argument: Any) -> None:
        stack = self.stack
        if name in _NOTHING:
            return
        if name in _PUSHED:
            stack.append(argument)
        elif name in _CONSTANTS:
            stack.append(_CONSTANTS[name])
        elif name in _EMPTY:
            stack.append(_EMPTY[name]())
        elif name == "MARK":
            stack.append(_Mark)
        elif name in _TUPLES:
            items = [stack.pop() for _ in range(_TUPLES[name])]
            stack.append(tuple(reversed(items)))
        elif name == "TUPLE":
            stack.append(tuple(self._group()))
        elif name in ("PUT", "BINPUT", "LONG_BINPUT"):
            self.memo[argument] = stack[-1]
        elif name == "MEMOIZE":
            self.memo[len(self.memo)] = stack[-1]
        elif name in ("GET", "BINGET", "LONG_BINGET"):
            stack.append(self.memo[argument])
        elif name in ("APPEND", "APPENDS"):
            items = [stack.pop()] if name == "APPEND" else self._group()
            self._top(list).extend(items)
        elif name in ("SETITEM", "SETITEMS"):
            items = self._group() if name == "SETITEMS" else self._pair()
            for key, value in zip(items[::2], items[1::2], strict=True):
                self._top(dict)[key] = value
        elif name == "GLOBAL":
            stack.append(self._global(*argument.split(" ", 1)))
        elif name == "STACK_GLOBAL":
            module, attribute = self._pair()
            stack.append(self._global(str(module), str(attribute)))
        elif name == "BINPERSID":
            stack.append(self._storage(*stack.pop()))
        elif name == "REDUCE":
            what, arguments = self._pair()
            stack.append(self._made(what, arguments))
        else:
            raise _RefusedError(
                f"refused: its pickle uses {name}, which tensors do not need; only "
                "plain tensors in a dictionary are read, nothing is executed"
            )

    def _group(self) -> list[Any]:
        items: list[Any] = []
        while (item := self.stack.pop()) is not _Mark:
            items.append(item)
        return items[::-1]

    def _pair(self) -> list[Any]:
        second, first = self.stack.pop(), self.stack.pop()
        return [first, second]

    def _top(self, kind: type) -> Any:
        top = self.stack[-1]
        if not isinstance(top, kind):
            raise TypeError(top)
        return top

    def _global(self, module: str, name: str) -> _Global:
        if (module, name) not in _GLOBALS:
            # Escaped, as a terminal would obey what control characters say.
            asked = f"{module}.{name}"[:80].encode("unicode_escape").decode()
            raise _RefusedError(
                f"refused: its pickle asks for {asked}; only plain tensors in "
                "a dictionary are read, nothing is executed"
            )
        return _Global(module, name)

    def _made(self, what: Any, arguments: tuple[Any, ...]) -> Any:
        if what == _Global(*_ORDERED_DICT):
            return dict(*arguments) if not arguments else dict(arguments[0])
        if what == _Global(*_TENSOR):
            return _tensor(*arguments[:4])
        raise _RefusedError("refused: its pickle calls something that makes no tensor")

    def _storage(
        self, tag: str, kind: _Global, key: str, _place: str, count: int
    ) -> np.ndarray:
        if tag != "storage" or kind.name not in _TYPES or kind.module != "torch":
            raise _RefusedError(
                "refused: its pickle asks for something that is no storage"
            )
        if key not in self.storages:
            dtype = np.dtype(self.order + _TYPES[kind.name])
            name = f"data/{key}"
            raw = self._entry(name, count * dtype.itemsize)
            self.storages[key] = np.frombuffer(raw, dtype, count)
        return self.storages[key]

    def _has(self, name: str) -> bool:
        return self.root + name in self.archive.namelist()

    def _entry(self, name: str, most: int = 64) -> bytes:
        """An entry of at most ``most`` bytes; torch.save does not compress."""
        entry = self.archive.getinfo(self.root + name)
        if entry.compress_type != zipfile.ZIP_STORED:
            raise _RefusedError(
                "refused: the zip is compressed, which torch.save's is not"
            )
        if entry.file_size > most:
            raise _RefusedError(
                f"refused: {name} has {entry.file_size} bytes, not {most}"
            )
        return self.archive.read(entry)


def _tensor(
    storage: np.ndarray, offset: int, size: tuple[int, ...], stride: tuple[int, ...]
) -> np.ndarray:
    if not isinstance(storage, np.ndarray) or len(size) != len(stride):
        raise TypeError(storage)
    if min((offset, *size, *stride)) < 0 or math.prod(size) > len(storage):
        raise _RefusedError("refused: a tensor is larger than its storage")
    last = offset + sum((n - 1) * s for n, s in zip(size, stride, strict=True))
    if math.prod(size) and last >= len(storage):
        raise _RefusedError("refused: a tensor reaches beyond its storage")
    steps = [s * storage.itemsize for s in stride]
    return np.lib.stride_tricks.as_strided(storage[offset:], size, steps).copy()
