"""Every command on every model of MuJoCo's features: files, or one line of refusal?

    python -m benchmarks.commands

Of each model of `benchmarks.parity_models` an owner's way is gone, as small as it can
be: a recording by MuJoCo C, ``train.parameters``, ``train.easi --data``, ``train.udr
--env`` and ``train.evaluate`` of its policy. A command ends well with its files, or
with one line and exit status 2; anything else is a failure. A model is a line of
``benchmarks/results/commands.jsonl``; a run that was stopped goes on. Models unlike
each other come first. One process runs model after model; a model that takes longer
than ``--limit``, or that ends the process, is noted, and another process goes on.
"""

import contextlib
import dataclasses
import io
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
import traceback
from collections import Counter, defaultdict
from collections.abc import Callable
from itertools import zip_longest
from pathlib import Path
from types import ModuleType
from typing import Any

from benchmarks._cells import Share, add_row, read_rows, run_cells, shard
from benchmarks._common import RESULTS, ROOT, commits_of
from benchmarks._page import Section, load, table
from benchmarks.parity_models import feature_models
from train._command import INTERRUPTED, USER_ERROR, main, say

COMMANDS = ("parameters", "easi", "udr", "evaluate")
FILES, REFUSED, FAILED = "files", "one line", "TRACEBACK"
LATE = "too long"
_CRASHES = {signal.SIGSEGV, signal.SIGABRT, signal.SIGBUS, signal.SIGFPE, signal.SIGILL}
_LATE_STATUS = 75  # of a process whose model took too long
# Programs run for a moment only, so that they need not be fast.
_QUICK = "--xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true"
_CONTROL_STEPS = 250  # of a log
_PHYSICS_STEPS = 4  # of a control step
_PUSH = 0.3  # rad/s, m/s: velocity that a log starts with
_WAVE = 1.5  # Hz
_SEARCH = ("--population", "8", "--generations", "2", "--set", "segments=8")
_BY_HAND = """parameters:
  - {name: gravity, address: option.gravity, initial: [8, 12], bounds: [1, 30]}
"""
ENV = """from pathlib import Path

from benchmarks.commands_env import Resting


def make():
    return Resting(Path({model!r}))
"""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Config(Share):
    """Runs the commands on small models with every feature of MuJoCo."""

    out: Path = RESULTS / "commands.jsonl"
    """Where a line for each model is added."""
    engine: str = "auto"
    """auto, mjx or mujoco."""
    limit: float = 120.0
    """Seconds that a model may take."""
    worker: bool = False
    """Run the models in this process, and end it with one that takes too long."""


@dataclasses.dataclass(frozen=True)
class Cell:
    """One model; its ``key`` is the feature's name."""

    key: str


def run(config: Config) -> None:
    """Starts processes until every model has a line."""
    if config.worker or config.list:
        _work(config)
        return
    given = ["--shard", config.shard, "--only", config.only, "--out", str(config.out)]
    given += ["--engine", config.engine, "--limit", str(config.limit), "--worker"]
    words = [sys.executable, "-m", "benchmarks.commands", *given]
    env = {**os.environ, "XLA_FLAGS": f"{os.environ.get('XLA_FLAGS', '')} {_QUICK}"}
    status = _LATE_STATUS
    while status == _LATE_STATUS or -status in _CRASHES:
        status = subprocess.run(words, cwd=ROOT, env=env, check=False).returncode
        if -status in _CRASHES:
            add_row(config.out, _crashed(config, signal.Signals(-status).name))
    if status:
        raise SystemExit(status)


def _crashed(config: Config, name: str) -> dict[str, Any]:
    """The line of the model at which a process was ended by a signal."""
    from easi_jax.io.runs.versions import versions

    part, parts = shard(config.shard)
    done = {r["key"] for r in read_rows(config.out)}
    mine = [config.only] if config.only else [c.key for c in cells()]
    key = next(k for k in mine[part - 1 :: parts] if k not in done)
    end = {"outcome": FAILED, "said": f"the process ended by {name}", "seconds": 0.0}
    row = {"key": key, "engine": "", "commands": {"?": end}, "versions": versions()}
    say(f"{key}: {_told(row)}")
    return row


def cells() -> list[Cell]:
    """All models, those of one kind as far apart as can be; first those that MJX
    deviates on, which compile no physics."""
    known = load(RESULTS, "parity.json") or {"features": {}}
    native = {n for n, r in known["features"].items() if r["engine"] == "mujoco"}
    found: list[Cell] = []
    for now in (True, False):
        kinds: defaultdict[str, list[Cell]] = defaultdict(list)
        for name in feature_models():
            if (name in native) == now:
                kinds[name.split()[0]].append(Cell(name))
        found += [c for row in zip_longest(*kinds.values()) for c in row if c]
    return found


def _work(config: Config) -> None:
    """Runs the models in this process."""

    def solve(cell: Cell) -> dict[str, Any]:
        row: dict[str, Any] = {"engine": "", "commands": {}}
        running = [COMMANDS[0], time.monotonic()]
        ended = _ends_late(config, cell, row, running)
        try:
            with tempfile.TemporaryDirectory() as folder:
                tried(Path(folder), feature_models()[cell.key], config, row, running)
        finally:
            ended()
        return row

    run_cells(cells(), config, solve, _told)


def _ends_late(
    config: Config, cell: Cell, row: dict[str, Any], running: list[Any]
) -> Callable[[], None]:
    """Ends the process with a line where a model takes too long; returns what calls
    that off. A compiler in C++ hears no signal, but lets threads run."""
    from easi_jax.io.runs.versions import versions

    def end() -> None:
        command, since = running
        row["commands"][command] = _outcome(LATE, "", since)
        line = {"key": cell.key, **row, "versions": versions()}
        add_row(config.out, line)
        os.write(2, f"{cell.key}: {_told(line)}\n".encode())
        os._exit(_LATE_STATUS)

    timer = threading.Timer(config.limit, end)
    timer.daemon = True
    timer.start()
    return timer.cancel


def tried(
    folder: Path, text: str, config: Any, row: dict[str, Any], running: list[Any]
) -> None:
    """Fills a model's ``row``: its engine, and how each command ended.

    Args:
        folder: an empty one.
        text: MJCF of the model.
        running: the command that runs and since when; kept up to date.
    """
    import jax

    from easi_jax.io.files import read_json
    from train import easi, evaluate, parameters, udr

    model, log, env = (folder / n for n in ("m.xml", "log.csv", "env.py"))
    model.write_text(text)
    env.write_text(ENV.format(model=str(model)))
    write_recording(model, log)
    table, found, policy = (folder / n for n in ("p.yaml", "easi", "udr"))
    small = (*_SEARCH, "--no-refine")
    data = ("--parameters", table, "--data", log)
    returns = folder / "returns.json"
    steps: dict[str, tuple[ModuleType, Path, tuple[Any, ...]]] = {
        "parameters": (parameters, table, ("--model", model, "--out", table)),
        "easi": (
            *(easi, found / "report.html"),
            ("--model", model, *data, "--out", found, *small),
        ),
        "udr": (
            *(udr, policy / "report.html"),
            ("--env", env, "--out", policy, "--eval-episodes", 2),
        ),
        "evaluate": (
            *(evaluate, returns),
            ("--run", policy, "--env", env, "--episodes", 2, "--out", returns),
        ),
    }
    for name, (module, file, words) in steps.items():
        if name == "easi" and not table.exists():
            table.write_text(_BY_HAND)
        running[:] = name, time.monotonic()
        words = (*words, "--engine", config.engine)
        row["commands"][name] = outcome(module, words, file, running[1])
    for out in (found, policy):
        if (out / "engine.json").is_file():
            row["engine"] = read_json(out / "engine.json")["engine"]
    jax.clear_caches()


def outcome(
    module: ModuleType, words: tuple[Any, ...], file: Path, since: float
) -> dict[str, Any]:
    """How a command ended that was to write ``file``."""
    args, said = [str(w) for w in words], io.StringIO()
    try:
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
            main(module.Config, module.run, name=module.__name__, args=args)
    except SystemExit as stop:
        if stop.code == INTERRUPTED:
            raise
        last = (said.getvalue().strip().splitlines() or [""])[-1]
        if stop.code == USER_ERROR and last.startswith("error: "):
            line = last.removeprefix("error: ")
            for word in (*args, str(file.parent)):
                if word.startswith("/"):
                    line = line.replace(word, Path(word).name)
            return _outcome(REFUSED, line, since)
        return _outcome(FAILED, f"exit status {stop.code}: {last}", since)
    except BaseException as error:
        place = traceback.extract_tb(error.__traceback__)[-1]
        line = f"{type(error).__name__}: {error}".splitlines()[0]
        where = f"{Path(place.filename).name}, {place.name}"
        return _outcome(FAILED, f"{line} ({where})", since)
    if not file.is_file():
        return _outcome(FAILED, f"no {file.name}", since)
    return _outcome(FILES, "", since)


def _outcome(kind: str, line: str, since: float) -> dict[str, Any]:
    seconds = round(time.monotonic() - since, 1)
    return {"outcome": kind, "said": line, "seconds": seconds}


def write_recording(model: Path, log: Path) -> None:
    """Two seconds by MuJoCo C, pushed at the start, commands that wave in their range;
    also of what no engine here runs."""
    import mujoco
    import numpy as np

    from easi_jax.io.logs.columns import log_columns
    from easi_jax.io.logs.tables import write_table
    from easi_jax.io.models.completed import named

    spec = mujoco.MjSpec.from_file(str(model))
    m = spec.compile()
    if m.nu != len(m.actuator_trntype):  # no column for several commands of a drive
        for drive in list(spec.actuators):
            spec.delete(drive)
    m = named(spec, spec.compile())
    d, columns, rows = mujoco.MjData(m), log_columns(m), []
    d.qvel[:] = _PUSH
    low, high = np.where(m.actuator_ctrllimited, m.actuator_ctrlrange.T, [[-1], [1]])
    phase = np.arange(m.nu)
    for _ in range(_CONTROL_STEPS):
        wave = np.sin(2 * np.pi * _WAVE * d.time + phase)
        d.ctrl[:] = (low + high + wave * (high - low)) / 2
        rows.append([d.time, *d.qpos, *d.qvel, *d.ctrl])
        mujoco.mj_step(m, d, _PHYSICS_STEPS)
    names = ("time", *columns.qpos, *columns.qvel, *columns.ctrl)
    write_table(log, dict(zip(names, np.array(rows).T, strict=True)), None)


def _told(row: dict[str, Any]) -> str:
    ends = [f"{c}: {e['outcome']} {e['said']}" for c, e in row["commands"].items()]
    return "; ".join([row["engine"] or "no engine", *ends])


def _paragraphs(rows: list[Any]) -> list[str]:
    """Outcomes by command, and each refusal and failure once."""
    ends = [(c, r["key"], e) for r in rows for c, e in r["commands"].items()]
    kinds = (FILES, REFUSED, LATE, FAILED)
    counts = Counter((c, e["outcome"]) for c, _, e in ends)
    said: defaultdict[tuple[str, str], list[str]] = defaultdict(list)
    for command, key, e in ends:
        if e["said"]:
            said[e["outcome"], e["said"]].append(f"{key} ({command})")
    every, engines = cells(), Counter(r["engine"] or "none" for r in rows)
    times = sorted(sum(e["seconds"] for e in r["commands"].values()) for r in rows)
    left = [c.key for c in every if c.key not in {r["key"] for r in rows}]
    taken = ", ".join(f"{e} on {n}" for e, n in sorted(engines.items()))
    out = [
        f"`python -m benchmarks.commands`, commits {commits_of(rows)}: {len(rows)} of "
        f"{len(every)} models of MuJoCo's features; engine taken: {taken}. A model "
        f"took {times[len(times) // 2]:.0f} s in the median, {times[-1]:.0f} s at most"
        ".",
        table(
            COMMANDS,
            {
                "command": lambda c: f"train.{c}",
                **{k: lambda c, k=k: counts[c, k] for k in kinds},
            },
        ),
        table(
            sorted(said.items()),
            {
                "end": lambda x: x[0][0],
                "what is said": lambda x: x[0][1].replace("|", "\\|"),
                "models": lambda x: len(x[1]),
                "such as": lambda x: x[1][0],
            },
        ),
    ]
    return [*out, f"Not run: {', '.join(left)}."] if left else out


SECTIONS = (
    Section("### Commands on these models", "commands.jsonl", "commands", _paragraphs),
)


if __name__ == "__main__":
    main(Config, run, name="benchmarks.commands")
