"""What all benchmarks share: where figures go, and what they were made with."""

import dataclasses
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]  # of the checkout
RESULTS = ROOT / "benchmarks" / "results"


def markdown_table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """A Markdown table; rows that are too short are filled up."""
    lines = [
        "| " + " | ".join(head) + " |",
        "| " + " | ".join("---" for _ in head) + " |",
    ]
    lines += [
        "| " + " | ".join(str(c) for c in (*row, *[""] * (len(head) - len(row)))) + " |"
        for row in rows
    ]
    return "\n".join(lines)


def commits_of(rows: Iterable[Mapping[str, Any]]) -> str:
    """Commits that lines or results were made with, short; + is kept, which says that
    there were changes beside."""
    return ", ".join(sorted({short(r["versions"]["commit"]) for r in rows}))


def short(commit: str | None) -> str:
    """A commit as `easi_jax.io.runs.versions` has it, in 7 characters and its +."""
    return commit[:7] + "+" * commit.endswith("+") if commit else "unknown"


def at_least_one(config: Any, *names: str) -> None:
    """UserError for numbers of ``config`` below one; those not given pass."""
    from easi_jax.errors import UserError

    for name in names:
        value = getattr(config, name)
        if value is not None and value < 1:
            flag = name.replace("_", "-")
            raise UserError(f"--{flag} {value}: give at least 1")


def command_of(module: str, config: Any) -> str:
    """The command that makes ``config``: every field that is not its default."""
    words = [f"python -m {module}"]
    for field in dataclasses.fields(config):
        value, flag = getattr(config, field.name), field.name.replace("_", "-")
        if value == field.default:
            continue
        if isinstance(value, bool):
            words.append(f"--{flag}" if value else f"--no-{flag}")
        else:
            items = value if isinstance(value, tuple) else (value,)
            words += [f"--{flag}", *map(str, items)]
    return " ".join(words)


def show_returns(title: str, returns: Mapping[str, Mapping[str, float]]) -> None:
    """Prints the return in the target of each method, its mean and every seed."""
    from train._command import show_table

    seeds = next(iter(returns.values()))
    rows = [
        (m, *(f"{x:.1f}" for x in (sum(v.values()) / len(v), *v.values())))
        for m, v in returns.items()
    ]
    head = ("method", "mean", *(f"seed {s}" for s in seeds))
    show_table(f"{title}: return in the target", head, rows)


def wander(env: Any) -> Callable[[Any, Any], Any]:
    """A controller that draws its actions, ``act(obs, key) -> action``."""
    import jax
    import jax.numpy as jnp

    def act(_: Any, key: Any) -> Any:
        return jnp.clip(0.3 * jax.random.normal(key, (env.action_size,)), -1.0, 1.0)

    return act


def first_start(words: Sequence[str], cache: Path, limit: float) -> tuple[float, str]:
    """Seconds of ``python`` with ``words`` from the repository's root, in a process of
    its own with the compilation cache ``cache``, and what it printed."""
    begin = time.monotonic()
    done = subprocess.run(
        [sys.executable, *words],
        cwd=ROOT,
        env={**os.environ, "JAX_COMPILATION_CACHE_DIR": str(cache)},
        stdout=subprocess.PIPE,
        text=True,
        timeout=limit,
        check=True,
    )
    return time.monotonic() - begin, done.stdout


def _without_home(value: Any) -> Any:
    """Paths without the places of one machine; anything else as it is."""
    if not isinstance(value, Path) or not value.is_absolute():
        return value
    return value.relative_to(ROOT) if value.is_relative_to(ROOT) else value.name


def write_result(
    name: str, command: str, config: Any, folder: Path = RESULTS, **figures: Any
) -> Path:
    """Writes ``FOLDER/NAME.json`` with config, versions and device.

    ``config`` is a dataclass, or a dict of what decides the figures; its paths are
    written as seen from the repository's root, of those elsewhere the name alone.
    """
    from easi_jax.io.files import atomic_write, to_json
    from easi_jax.io.runs.versions import versions

    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{name}.json"
    settings = config if isinstance(config, dict) else dataclasses.asdict(config)
    body = {
        "command": command,
        "config": {k: _without_home(v) for k, v in settings.items()},
        "versions": versions(),
        "finished": time.strftime("%Y-%m-%d"),
        **figures,
    }
    atomic_write(path, to_json(body))
    return path
