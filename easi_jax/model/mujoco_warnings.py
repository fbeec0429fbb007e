"""Where MuJoCo's warnings go, which else are printed and written to a file."""

import contextlib
from collections.abc import Callable, Iterator

import mujoco


def _ignored(_: str) -> None:
    """Says nothing."""


@contextlib.contextmanager
def warnings_to(told: Callable[[str], None] = _ignored) -> Iterator[None]:
    """Inside, ``told`` takes each warning, of every thread; they are lost without."""
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(told)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(before)
