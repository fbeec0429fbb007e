"""Cells of a benchmark: each is run once and is a line of a file.

A run that was stopped goes on, and several processes or batch jobs share the work by
``--shard`` (the second of four is 2/4) or ``--only``.
"""

import dataclasses
import fcntl
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from train._command import say


@dataclasses.dataclass(frozen=True)
class Share:
    """Which cells a process runs, and where their lines go."""

    shard: str
    only: str
    list: bool
    out: Path


def run_cells(
    every: Sequence[Any],
    share: Share,
    solve: Callable[[Any], dict[str, Any]],
    told: Callable[[dict[str, Any]], str],
) -> None:
    """Runs the cells that have no line yet; each is a dataclass with a ``key``.

    Args:
        solve: runs a cell and returns what its line says of it.
        told: what is said of a line.

    Raises:
        UserError: no such cell, or no such part.
    """
    from easi_jax.errors import UserError
    from easi_jax.io.versions import versions

    if share.only:
        every = [c for c in every if c.key == share.only]
        if not every:
            raise UserError(f'no cell "{share.only}": see --list')
    part, parts = shard(share.shard)
    done = {row["key"] for row in read_rows(share.out)}
    if share.list:
        for c in every:
            say(f"{'done' if c.key in done else 'open'}  {c.key}")
        return
    for c in every[part - 1 :: parts]:
        if c.key in done:
            continue
        row = {"key": c.key, **dataclasses.asdict(c), **solve(c)}
        add_row(share.out, {**row, "versions": versions()})
        say(f"{c.key}: {told(row)}")


def shard(text: str) -> tuple[int, int]:
    """Which part, of how many.

    Raises:
        UserError: not written as PART/PARTS.
    """
    from easi_jax.errors import UserError

    part, _, parts = text.partition("/")
    good = part.isdigit() and parts.isdigit() and 1 <= int(part) <= int(parts)
    if not good:
        raise UserError(f"--shard {text}: write PART/PARTS, such as 2/4")
    return int(part), int(parts)


def read_rows(path: Path) -> list[dict[str, Any]]:
    """One a cell; none where the file is missing."""
    if not path.is_file():
        return []
    return [json.loads(line) for line in path.read_text().splitlines()]


def add_row(path: Path, row: dict[str, Any]) -> None:
    """Adds a line; several processes may do so at once."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        file.write(json.dumps(row) + "\n")
