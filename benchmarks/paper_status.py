"""What stands of the paper's cells, what it would take to run the rest, and that run.

``python -m benchmarks.paper status`` shows it, ``python -m benchmarks.paper all`` runs
what is missing or stale: the experiment that takes least first, seed by seed, so that
each seed completes a row of its table.
"""

import dataclasses
import os
import queue
import signal
import statistics
import subprocess
import sys
import time
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from benchmarks._cells import check_out, read_rows
from benchmarks.paper_cells import METHODS, Cell, changes, is_stale
from benchmarks.paper_experiments import EXPERIMENTS, Config, cells, robots
from benchmarks.paper_runtime import WAYS
from train._command import say, show_table

Row = Mapping[str, Any]
# A cell that takes so many times as long as others of its kind hangs; and the least
# that is waited for any [s].
_HANGS, _LEAST = 10.0, 3600.0


@dataclasses.dataclass(frozen=True)
class Part:
    """An experiment on one robot.

    Attributes:
        done: cells whose rows count; ``stale``: made before their method changed;
        ``missing``: never run.
    """

    experiment: str
    robot: str
    done: tuple[Cell, ...]
    stale: tuple[Cell, ...]
    missing: tuple[Cell, ...]

    @property
    def left(self) -> tuple[Cell, ...]:
        return (*self.stale, *self.missing)


def parts(config: Config, rows: Iterable[Row]) -> list[Part]:
    """All experiments, on ``config.robot`` alone where given, and with their methods
    among ``config.methods``."""
    have = {r["key"]: r for r in rows}
    found = []
    for name in EXPERIMENTS:
        for robot in robots(name):
            if config.robot not in ("", robot):
                continue
            one = dataclasses.replace(config, experiment=name, robot=robot, methods=())
            chosen = config.methods or METHODS + WAYS
            every = [c for c in cells(one) if c.method in chosen]
            known = [c for c in every if c.key in have]
            stale = [c for c in known if is_stale(have[c.key])]
            found.append(
                Part(
                    *(name, robot, tuple(c for c in known if c not in stale)),
                    *(tuple(stale), tuple(c for c in every if c.key not in have)),
                )
            )
    return found


class Costs:
    """How long cells take [s], by those that were run.

    Args:
        rows: of cells that were run; those of this ``device`` count before others.
    """

    def __init__(self, rows: Sequence[Row], device: str) -> None:
        self._kinds: dict[tuple[Any, ...], list[float]] = {}
        for r in rows:
            seconds = r.get("seconds", r.get("identify_s"))
            if seconds is None:
                continue
            here = r["versions"].get("runtime", {}).get("device_kind") == device
            for kind in _kinds(r["method"], r["robot"], r["policy"], here):
                self._kinds.setdefault(kind, []).append(seconds)

    def __call__(self, cell: Cell) -> float | None:
        """The median of cells of its kind; None where nothing like it was run."""
        for here in (True, False):
            for kind in _kinds(cell.method, cell.robot, cell.policy, here):
                if kind in self._kinds:
                    return statistics.median(self._kinds[kind])
        return None

    def sum(self, some: Sequence[Cell]) -> str:
        """Hours of all of them on one core, and how many are not known."""
        known = [self(c) for c in some]
        hours = sum(x for x in known if x is not None) / 3600
        unknown = sum(x is None for x in known)
        if not some:
            return ""
        text = f"{hours:.1f} h" if unknown < len(some) else ""
        return " + ".join([text] * bool(text) + [f"{unknown} unknown"] * bool(unknown))


def _kinds(method: str, robot: str, policy: bool, here: bool) -> list[tuple[Any, ...]]:
    """What cells are alike in, the closest first."""
    kinds = [(method, robot, policy, here)]
    return kinds + [("EASI", robot, policy, here)] * method.startswith("EASI")


def status(config: Config) -> None:
    """Shows what stands."""
    rows = read_rows(config.out, ("key",))
    found, costs = parts(config, rows), Costs(rows, _device())
    show_table(
        "Cells of the paper's experiments",
        ("experiment", "robot", "cells", "done", "stale", "missing", "left, one core"),
        [
            (
                *(p.experiment, p.robot, len(p.done) + len(p.left), len(p.done)),
                *(len(p.stale), len(p.missing), costs.sum(p.left)),
            )
            for p in found
        ],
    )
    every = _each(found)
    say(f"all that is left, cells shared by experiments once: {costs.sum(every)}")
    say("a seed's UDR training, once a robot and budget, comes on top")
    stale = {(c.method, changes(c.method, c.robot)) for p in found for c in p.stale}
    for method, why in sorted(stale):
        say(f"stale, {method}: {'; '.join(why)}")


def check(config: Config) -> None:
    """Raises UserError for options that status and all do not have, or that make no
    sense."""
    from easi_jax.errors import UserError, nearest

    cells(dataclasses.replace(config, experiment="table1", methods=()))
    for m in config.methods:
        if m not in METHODS + WAYS:
            raise UserError(f'--methods "{m}": unknown{nearest(m, METHODS + WAYS)}')
    if config.list or config.only or config.shard != "1/1":
        raise UserError(
            f"--list, --only and --shard are of one experiment: {config.experiment} "
            "goes without them"
        )


def run_all(config: Config) -> None:
    """Runs what is left, one cell a process; see `Config` for workers and minutes.

    A cell whose cost nobody knows is not begun where there is a limit.

    Raises:
        UserError: a cell that failed, after the others ended; no such options.
    """
    from benchmarks._common import at_least_one
    from easi_jax.errors import UserError

    at_least_one(config, "workers")
    if config.minutes is not None and not config.minutes > 0:
        raise UserError(f"--minutes {config.minutes}: give a number above 0")
    check_out(config.out)
    rows = read_rows(config.out, ("key",))
    costs = Costs(rows, _device())
    runs = _ordered(parts(config, rows), costs)
    end = None if config.minutes is None else time.monotonic() + 60 * config.minutes
    cores = queue.SimpleQueue[int]()
    for core in sorted(_cores())[: config.workers]:
        cores.put(core)
    for _ in range(config.workers - cores.qsize()):
        cores.put(-1)

    skipped: list[str] = []

    def one(run: tuple[str, Cell]) -> str | None:
        """What went wrong, where something did."""
        experiment, cell = run
        core, expected = cores.get(), costs(cell)
        try:
            left = None if end is None else end - time.monotonic()
            if left is not None and (expected is None or expected > left):
                skipped.append(cell.key)
                return None
            limit = max(_LEAST, _HANGS * (expected or 0.0))
            status = ran(_words(config, experiment, cell), core, limit)
            if status is None:
                return f"{cell.key}: stopped after {limit:.0f} s"
            return f"{cell.key}: status {status}" if status else None
        finally:
            cores.put(core)

    with ThreadPoolExecutor(config.workers) as pool:
        failed = [text for text in pool.map(one, runs) if text]
    if skipped:
        say(f"{len(skipped)} cells take longer than is left, or nobody knows how long")
    if failed:
        raise UserError("; ".join(failed))


def ran(words: list[str], core: int, limit: float) -> int | None:
    """Exit status of a process on one core (any where below 0); None where it did not
    end within ``limit`` seconds, and was killed with all that it had started."""
    with subprocess.Popen(words, start_new_session=True) as process:
        if core >= 0:
            os.sched_setaffinity(process.pid, {core})
        try:
            return process.wait(limit)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            return None


def _words(config: Config, experiment: str, cell: Cell) -> list[str]:
    words = [sys.executable, "-m", "benchmarks.paper", experiment]
    words += ["--robot", cell.robot, "--seeds", str(cell.seed), "--only", cell.key]
    words += ["--out", str(config.out), "--folder", str(config.folder)]
    if config.env_steps is not None:
        words += ["--env-steps", str(config.env_steps)]
    return words


def _ordered(found: Sequence[Part], costs: Costs) -> list[tuple[str, Cell]]:
    """Each cell once: the part that takes least first, seed by seed."""
    inf = float("inf")

    def takes(some: Sequence[Cell]) -> float:
        return sum(inf if (x := costs(c)) is None else x for c in some)

    runs: dict[str, tuple[str, Cell]] = {}
    for p in sorted(found, key=lambda p: takes(p.left)):
        for c in sorted(p.left, key=lambda c: (c.seed, costs(c) or inf)):
            runs.setdefault(c.key, (p.experiment, c))
    return list(runs.values())


def _each(found: Sequence[Part]) -> list[Cell]:
    return list({c.key: c for p in found for c in p.left}.values())


def _device() -> str:
    """Asked in a process of its own: this one starts others, and on a GPU leaves them
    the memory."""
    words = [sys.executable, "-c", "import jax; print(jax.devices()[0].device_kind)"]
    asked = subprocess.run(words, capture_output=True, text=True, timeout=300)
    return asked.stdout.strip()


def _cores() -> set[int]:
    return os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else set()
