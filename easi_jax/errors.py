"""The one exception for mistakes that a user can mend."""

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
