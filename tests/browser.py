"""A headless Chromium, spoken to over its debugging pipe."""

import json
import os
import select
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

_NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome")
_PATIENCE = 60.0  # s for an answer
# The browser reads commands from 3 and answers on 4.
_PLACED = """
import os, sys
for end, free in zip(sys.argv[1:3], (30, 31)):
    os.dup2(int(end), free)
os.dup2(30, 3)
os.dup2(31, 4)
os.execv(sys.argv[3], sys.argv[3:])
"""


def chromium() -> str | None:
    """The browser's program; None where there is none."""
    return next((found for name in _NAMES if (found := shutil.which(name))), None)


class Page:
    """A page of a browser.

    Attributes:
        events: what the browser told of it, oldest first.
    """

    def __init__(self, read: int, write: int) -> None:
        self._read, self._write = read, write
        self._rest, self._count = b"", 0
        self.events: list[dict[str, Any]] = []
        target = self.ask("Target.createTarget", url="about:blank")["targetId"]
        self._session = ""
        attached = self.ask("Target.attachToTarget", targetId=target, flatten=True)
        self._session = attached["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.ask(f"{domain}.enable")

    _session = ""

    def ask(self, method: str, **params: Any) -> dict[str, Any]:
        """The answer to a command of the DevTools protocol."""
        self._count += 1
        said = {"id": self._count, "method": method, "params": params}
        if self._session:
            said["sessionId"] = self._session
        os.write(self._write, json.dumps(said).encode() + b"\0")
        end = time.monotonic() + _PATIENCE
        while True:
            answer = self._next(end)
            if answer.get("id") == self._count:
                if "error" in answer:
                    raise RuntimeError(f"{method}: {answer['error']}")
                return answer["result"]
            self.events.append(answer)

    def _next(self, end: float) -> dict[str, Any]:
        while b"\0" not in self._rest:
            ready, _, _ = select.select([self._read], [], [], end - time.monotonic())
            if not ready:
                raise TimeoutError("the browser does not answer")
            self._rest += os.read(self._read, 1 << 20)
        line, _, self._rest = self._rest.partition(b"\0")
        return json.loads(line)

    def open(self, path: Path, width: int = 1200, height: int = 900) -> None:
        """Opens a file and waits until all of it is there."""
        self.ask(
            "Emulation.setDeviceMetricsOverride",
            **{"width": width, "height": height, "deviceScaleFactor": 1},
            mobile=False,
        )
        self.events.clear()
        self.ask("Page.navigate", url=path.resolve().as_uri())
        end = time.monotonic() + _PATIENCE
        while not self.told("Page.loadEventFired"):
            self.events.append(self._next(end))

    def told(self, *methods: str) -> list[dict[str, Any]]:
        """Events of some kinds."""
        return [e for e in self.events if e.get("method") in methods]

    def value(self, script: str) -> Any:
        """What an expression is on the page."""
        got = self.ask("Runtime.evaluate", expression=script, returnByValue=True)
        if "exceptionDetails" in got:
            raise RuntimeError(got["exceptionDetails"])
        return got["result"].get("value")

    def point(self, x: float, y: float) -> None:
        """Moves the pointer."""
        self.ask("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=y)

    def press(self, x: float, y: float) -> None:
        """Clicks."""
        for kind in ("mousePressed", "mouseReleased"):
            words = {"type": kind, "x": x, "y": y, "button": "left", "clickCount": 1}
            self.ask("Input.dispatchMouseEvent", **words)


@contextmanager
def page(program: str, folder: Path) -> Iterator[Page]:
    """A page of a browser whose profile is in ``folder``."""
    ours_in, theirs_out = os.pipe()
    theirs_in, ours_out = os.pipe()

    process = subprocess.Popen(
        [
            *(sys.executable, "-S", "-c", _PLACED, str(theirs_in), str(theirs_out)),
            *(program, "--headless", "--no-sandbox", "--disable-gpu"),
            *("--remote-debugging-pipe", f"--user-data-dir={folder}"),
            *("--no-first-run", "--hide-scrollbars", "--disable-dev-shm-usage"),
        ],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        pass_fds=(theirs_in, theirs_out),
    )
    for end in (theirs_in, theirs_out):
        os.close(end)
    try:
        yield Page(ours_in, ours_out)
    finally:
        process.kill()
        process.wait(timeout=10)
        for end in (ours_in, ours_out):
            os.close(end)
