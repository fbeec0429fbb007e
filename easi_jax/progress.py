"""How a library function tells how far it is, without printing."""

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from typing import Protocol


class Steps(Protocol):
    """What is told of each step of a stage."""

    def advance(self, n: int = 1) -> None:
        """``n`` steps are done."""
        ...


# ``progress(stage, total)``: a context for as long as the stage lasts.
Progress = Callable[[str, int], AbstractContextManager[Steps]]


class _Unseen:
    def advance(self, n: int = 1) -> None:
        pass


def silent(stage: str, total: int) -> AbstractContextManager[Steps]:
    """Shows nothing."""
    return nullcontext(_Unseen())
