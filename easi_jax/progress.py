"""How a library function tells how far it is, without printing."""

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from typing import Any, Protocol

Tell = Callable[[str], None]  # takes a line on how far it is


class Steps(Protocol):
    """What is told of each step of a stage."""

    def advance(self, n: int = 1) -> None:
        """``n`` steps are done."""
        ...


# ``wait(work, seconds)``: what ``work`` returns, which takes about so long; None: it is
# not known how long.
Wait = Callable[[Callable[[], Any], float | None], Any]


def at_once(work: Callable[[], Any], seconds: float | None) -> Any:
    """What ``work`` returns; nothing is shown."""
    del seconds
    return work()


# ``progress(stage, total)``: a context for as long as the stage lasts.
Progress = Callable[[str, int], AbstractContextManager[Steps]]


class _Unseen:
    def advance(self, n: int = 1) -> None:
        pass


def silent(stage: str, total: int) -> AbstractContextManager[Steps]:
    """Shows nothing."""
    return nullcontext(_Unseen())
