"""Mistakes that a user can mend, and calls of an engine that failed."""

import difflib
import traceback
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any


class UserError(Exception):
    """Says in one line what is wrong, where, and what to do.

    Commands print it as ``error: ...`` and leave with status 2; the library
    raises it for bad files, names and values. Programming errors stay ordinary
    exceptions.
    """


def closest(name: str, known: Iterable[str]) -> str:
    """The known name that is most like ``name``, or ``''`` where none is."""
    found = difflib.get_close_matches(name, list(known), n=1, cutoff=0.5)
    return found[0] if found else ""


def nearest(name: str, known: Iterable[str]) -> str:
    """Returns ``'; did you mean "x"?'`` for the closest known name, or ``''``."""
    found = closest(name, known)
    return f'; did you mean "{found}"?' if found else ""


def source_of(function: Callable[..., Any]) -> str:
    """The file that a function is written in."""
    code = getattr(function, "__code__", None)
    return code.co_filename if code else "?"


def told_by_line(path: Path | str, error: BaseException) -> str:
    """What a user's Python file raised, and in which of its lines."""
    if isinstance(error, SyntaxError) and error.lineno:
        return f"{path}, line {error.lineno}: {error.msg}"
    frames = traceback.extract_tb(error.__traceback__)
    lines = [f.lineno for f in frames if Path(f.filename) == Path(path)]
    where = f", line {lines[-1]}" if lines else ""
    words = " ".join(str(error).split("\n")[0].split())
    return f"{path}{where}: {type(error).__name__}: {words}"


class EngineError(UserError):
    """Native MuJoCo could not go on with a simulation."""


class EngineCalls:
    """Calls of an engine from compiled programs that failed.

    Such a call must not raise where programs run on several devices: another device
    may wait for it without end. It gives no numbers, and what it raised is kept here
    until `check` is called, which happens before anything is written.

    Attributes:
        failures: what was raised, the first first.
        watched: somebody calls `check` in the end; where nobody does, calls raise.
    """

    def __init__(self) -> None:
        self.failures: list[Exception] = []
        self.watched = False

    def check(self) -> None:
        """Raises `EngineError` where a call failed."""
        if self.failures:
            what = self.failures[0]
            raise EngineError(
                "the engine mujoco failed in a simulation: "
                f"{type(what).__name__}: {what}"
            ) from what


engine_calls = EngineCalls()
