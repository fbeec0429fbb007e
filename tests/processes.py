"""Several processes of one run, on this machine."""

import os
import re
import socket
import subprocess
import sys
import time

from tests.documented import ROOT

LIMIT = 110  # s


def port() -> int:
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return found.getsockname()[1]


class Processes:
    """The processes of one run on this machine."""

    def __init__(self, count: int, *words: object, devices: int = 1) -> None:
        address = f"127.0.0.1:{port()}"
        several = ("--distributed",) if count > 1 else ()
        self.all = []
        for index in range(count):
            told = {
                "JAX_COORDINATOR_ADDRESS": address,
                "JAX_NUM_PROCESSES": str(count),
                "JAX_PROCESS_ID": str(index),
                "JAX_NUM_CPU_DEVICES": str(devices),
                "JAX_PLATFORMS": "cpu",
                "PYTHONPATH": str(ROOT),
            }
            self.all.append(
                subprocess.Popen(
                    [sys.executable, "-m", *map(str, words), *several],
                    cwd=ROOT,
                    env={**os.environ, **told},
                    stdout=subprocess.PIPE,
                    stderr=subprocess.PIPE,
                    text=True,
                )
            )

    def ended(self, limit: float = LIMIT) -> list[tuple[int, str, str]]:
        """Exit status, output and error output of each."""
        end = time.monotonic() + limit
        try:
            said = [p.communicate(timeout=end - time.monotonic()) for p in self.all]
        finally:
            for p in self.all:
                p.kill()
        return [(p.returncode, *s) for p, s in zip(self.all, said, strict=True)]


def own_words(text: str) -> str:
    """Output but for that of gloo, which carries what CPUs send and says so."""
    return re.sub(r"(?m)^\[Gloo\].*\n", "", text)
