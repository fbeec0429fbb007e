"""Mistakes that a user can mend, and calls of an engine that failed."""

import difflib
from collections.abc import Iterable


class UserError(Exception):
    """Says in one line what is wrong, where, and what to do.

    Commands print it as ``error: ...`` and leave with status 2; the library
    raises it for bad files, names and values. Programming errors stay ordinary
    exceptions.
    """


def nearest(name: str, known: Iterable[str]) -> str:
    """Returns ``'; did you mean "x"?'`` for the closest known name, or ``''``."""
    found = difflib.get_close_matches(name, list(known), n=1, cutoff=0.5)
    return f'; did you mean "{found[0]}"?' if found else ""


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
