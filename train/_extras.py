"""Optional parts of a command, which begin once its results are on disk.

What to record next, pictures, a retrained policy: a failure in one of them becomes a
note of the report, and all else stays.
"""

import traceback
from collections.abc import Callable
from dataclasses import replace
from typing import TypeVar

from easi_jax.errors import UserError
from easi_jax.io.report.html import Report
from easi_jax.io.runs.folder import RunFolder
from train import _interrupt
from train._command import say

_T = TypeVar("_T")
FAILURES = "failures.txt"


class Extras:
    """Runs optional parts.

    Args:
        folder: of the results; tracebacks of programming errors go to
            ``failures.txt`` in it.

    Attributes:
        notes: of the parts that failed, a sentence each.
    """

    def __init__(self, folder: RunFolder) -> None:
        self.notes: list[str] = []
        self._folder = folder
        self._traces: list[str] = []

    def attempt(self, what: str, make: Callable[[], _T], otherwise: _T) -> _T:
        """What ``make`` returns, or ``otherwise`` and a note where it fails.

        Args:
            what: it makes, as in ``WHAT left out: ...``.
        """
        try:
            return make()
        except UserError as error:
            self._note(f"{what} left out: {error}")
        except Exception as error:
            # Some libraries turn an interrupt into an error of their own.
            _interrupt.check()
            self._traces.append(f"{what}\n{''.join(traceback.format_exception(error))}")
            self._folder.write(FAILURES, "\n".join(self._traces))
            self._note(
                f"{what} left out: {type(error).__name__}: {error} (an error of this "
                f"program, not of your data; {FAILURES} in the folder has the details)"
            )
        return otherwise

    def drawn(self, report: Report) -> Report:
        """``report`` with its pictures drawn; of those that fail there are notes."""
        pictures = []
        for p in report.pictures:
            text = self.attempt(f'the picture "{p.title}"', lambda p=p: p.text, "")
            pictures += [replace(p, svg=text)] if text else []
        return replace(report, pictures=pictures, notes=[*report.notes, *self.notes])

    def _note(self, text: str) -> None:
        said = " ".join(text.split())
        self.notes.append(said)
        say(f"note: {said}")
