"""The chain as one compiled program, beside the same stages as separate programs.

    python -m benchmarks.paper runtime

Each way runs in a process of its own, with an empty compilation cache. Seconds of
compiling are those that jax reports, tracing and lowering included; a transfer is an
array whose values Python asked for.
"""

import dataclasses
import functools
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from benchmarks._common import ROOT
from train._command import main

if TYPE_CHECKING:
    from benchmarks.paper_cells import Cell

WAYS = ("one program", "separate programs")
_LIMIT = 6 * 3600.0  # s


@dataclasses.dataclass(frozen=True)
class Config:
    """Runs the chain once and writes what it took."""

    way: str = WAYS[0]
    """one program, or separate programs."""
    robot: str = "cartpole"
    """Built-in robot."""
    target: str = "cart_kp*0.5"
    """The pseudo-real robot."""
    seed: int = 0
    """Seed of everything random."""
    env_steps: int | None = None
    """Control steps of each training; the robot's preset where not given."""
    out: Path = Path("results/runtime")
    """Folder of the runs, and of cost.json."""


def timed(cell: "Cell") -> dict[str, Any]:
    """Runs a cell in a process of its own.

    Returns:
        ``seconds`` in all, ``compile_s``, ``programs`` compiled, ``transfers`` to the
        host and their ``bytes``; ``return`` in the target.
    """
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "out"
        words = ["--way", cell.method, "--robot", cell.robot, "--target", cell.target]
        words += ["--seed", str(cell.seed), "--out", str(out)]
        if cell.env_steps is not None:
            words += ["--env-steps", str(cell.env_steps)]
        begin = time.monotonic()
        subprocess.run(
            [sys.executable, "-m", "benchmarks.paper_runtime", *words],
            cwd=ROOT,
            env={**os.environ, "JAX_COMPILATION_CACHE_DIR": str(Path(folder) / "c")},
            timeout=_LIMIT,
            check=True,
        )
        seconds = time.monotonic() - begin
        return {**json.loads((out / "cost.json").read_text()), "seconds": seconds}


def run(config: Config) -> None:
    """One way, in this process."""
    from easi_jax.errors import UserError, nearest
    from easi_jax.io.files import atomic_write, read_json, to_json

    if config.way not in WAYS:
        raise UserError(f'--way "{config.way}": {WAYS}{nearest(config.way, WAYS)}')
    cost = _Cost()
    results = _chain(config)
    returns = read_json(results / "results.json")["returns"]["EASI"]
    (value,) = returns.values()
    atomic_write(config.out / "cost.json", to_json({**cost.told(), "return": value}))


def _chain(config: Config) -> Path:
    """The folder of the results."""
    from train import easi, pipeline, udr

    target, out = (config.target,), config.out
    given: dict[str, Any] = {"robot": config.robot, "target": target}
    given |= {"seeds": (config.seed,), "env_steps": config.env_steps}
    if config.way == WAYS[0]:
        pipeline.run(pipeline.Config(out=out / "pipeline", **given))
        return out / "pipeline"
    udr.run(udr.Config(out=out / "udr", **given))
    easi.run(
        easi.Config(udr=out / "udr", out=out / "easi", target=target, oracle=False)
    )
    return out / "easi"


class _Cost:
    """Counts from when it is made to the end of the process."""

    def __init__(self) -> None:
        import jax
        import numpy as np
        from jax._src.array import ArrayImpl

        self._compile_s, self._programs = 0.0, 0
        self._transfers, self._bytes = 0, 0
        jax.monitoring.register_event_duration_secs_listener(self._lasted)
        # jax has no counter of reads. This is where they pass, but for those by which
        # numpy looks into the memory of a CPU's array.
        read = ArrayImpl._value

        def value(array: Any) -> Any:
            if array._npy_value is None:
                self._count(array)
            return read.fget(array)

        ArrayImpl._value = property(value)  # type: ignore[misc]
        for name in ("asarray", "array"):
            setattr(np, name, self._counted(getattr(np, name)))

    def _counted(self, convert: Callable[..., Any]) -> Callable[..., Any]:
        import jax
        from jax.core import Tracer

        @functools.wraps(convert)
        def call(value: Any, *args: Any, **options: Any) -> Any:
            if isinstance(value, jax.Array) and not isinstance(value, Tracer):
                self._count(value)
            return convert(value, *args, **options)

        return call

    def _count(self, array: Any) -> None:
        self._transfers += 1
        self._bytes += array.nbytes

    def _lasted(self, event: str, duration_secs: float, **_: Any) -> None:
        if event.startswith("/jax/core/compile/"):
            self._compile_s += duration_secs
            self._programs += event.endswith("backend_compile_duration")

    def told(self) -> dict[str, Any]:
        """What was counted."""
        return {
            "compile_s": self._compile_s,
            "programs": self._programs,
            "transfers": self._transfers,
            "bytes": self._bytes,
        }


if __name__ == "__main__":
    main(Config, run, name="benchmarks.paper_runtime")
