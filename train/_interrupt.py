"""Ctrl-C and SIGTERM that do not get lost.

Python raises ``KeyboardInterrupt`` wherever the main thread happens to be. In a
finalizer or a garbage-collection callback (jax has one) it is printed and dropped; an
event loop (orbax saves in one) turns it into a cancellation. The wish is therefore
remembered, and ``check`` raises again between two chunks of work.
"""

import contextlib
import signal
from collections.abc import Iterator
from types import FrameType

_asked = False


def asked() -> bool:
    """Whether this command was told to stop."""
    return _asked


def check() -> None:
    """Raises KeyboardInterrupt where the command was told to stop."""
    if _asked:
        raise KeyboardInterrupt


@contextlib.contextmanager
def remembered() -> Iterator[None]:
    """SIGINT and SIGTERM inside are remembered, and raise ``KeyboardInterrupt``.

    A signal that the caller ignores, as ``nohup`` does, stays ignored.
    """

    def stop(number: int, frame: FrameType | None) -> None:
        global _asked
        _asked = True
        raise KeyboardInterrupt

    global _asked
    _asked = False
    old = {}
    for number in (signal.SIGINT, signal.SIGTERM):
        if signal.getsignal(number) != signal.SIG_IGN:
            old[number] = signal.signal(number, stop)
    try:
        yield
    finally:
        for number, handler in old.items():
            signal.signal(number, handler)
