"""Cells of a benchmark: each is run once and is a line of a file.

A run that was stopped goes on, and several processes or batch jobs share the work by
``--shard`` (the second of four is 2/4) or ``--only``.
"""

import concurrent.futures
import contextlib
import dataclasses
import fcntl
import json
import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from train._command import say


@dataclasses.dataclass(frozen=True, kw_only=True)
class Share:
    """Which cells a process runs, and where their lines go; configs add to it."""

    shard: str = "1/1"
    """Which part of the cells this process runs."""
    only: str = ""
    """One cell, by its name as --list shows it."""
    list: bool = False
    """Show the cells, and which are done, without running any."""
    out: Path
    """Where a line for each cell is added."""


def run_cells(
    every: Sequence[Any],
    share: Share,
    solve: Callable[[Any], dict[str, Any]],
    told: Callable[[dict[str, Any]], str],
    *,
    workers: int = 1,
    passed: Callable[[dict[str, Any]], bool] = lambda row: True,
) -> None:
    """Runs the cells that have no line yet; each is a dataclass with a ``key``.

    Args:
        solve: runs a cell and returns what its line says of it.
        told: what is said of a line.
        workers: threads that run cells, for cells that are processes of their own.
        passed: whether a cell with this line is done.

    Raises:
        UserError: no such cell, or no such part.
    """
    from easi_jax.errors import UserError
    from easi_jax.io.runs.versions import versions

    if share.only:
        every = [c for c in every if c.key == share.only]
        if not every:
            raise UserError(f'no cell "{share.only}": see --list')
    if not every:
        raise UserError("no cells: none of these methods can run here")
    part, parts = shard(share.shard)
    done = {row["key"] for row in read_rows(share.out, ("key",)) if passed(row)}
    if share.list:
        for c in every:
            say(f"{'done' if c.key in done else 'open'}  {c.key}")
        return
    check_out(share.out)

    def one(c: Any) -> None:
        row = {"key": c.key, **dataclasses.asdict(c), **solve(c)}
        add_row(share.out, {**row, "versions": versions()})
        say(f"{c.key}: {told(row)}")

    left = [c for c in every[part - 1 :: parts] if c.key not in done]
    if workers == 1:
        for c in left:
            one(c)
        return
    with concurrent.futures.ThreadPoolExecutor(workers) as pool:
        for ended in concurrent.futures.as_completed(
            [pool.submit(one, c) for c in left]
        ):
            try:
                ended.result()
            except BaseException:
                pool.shutdown(wait=False, cancel_futures=True)
                raise


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


def check_out(path: Path) -> None:
    """Before hours of work: whether lines can be added.

    Raises:
        UserError: they cannot.
    """
    with _appending(path):
        pass


def read_rows(path: Path, names: Sequence[str] = ()) -> list[dict[str, Any]]:
    """One a cell, its last one; none where the file is missing.

    What a killed process left of its last line is no row; `add_row` takes it away.

    Args:
        names: what every line must have.

    Raises:
        UserError: the file cannot be read, or a line is not one of ours.
    """
    from easi_jax.errors import UserError
    from easi_jax.io.files import os_reason, regular_file

    try:
        regular_file(path)
        whole, end, _ = path.read_bytes().rpartition(b"\n")
    except FileNotFoundError:
        return []
    except OSError as error:
        raise UserError(f"cannot read {path}: {os_reason(error)}") from error
    rows = []
    for number, line in enumerate(whole.split(b"\n") if end else (), 1):
        try:
            row = json.loads(line)
        except (ValueError, RecursionError):
            row = None
        if not isinstance(row, dict) or not all(n in row for n in names):
            raise UserError(
                f"{path}, line {number}: not a line of this benchmark; take it out, "
                "or name another --out"
            )
        rows.append(row)
    # A cell that was run again has its last line.
    last = {row["key"]: k for k, row in enumerate(rows) if "key" in row}
    return [row for k, row in enumerate(rows) if last.get(row.get("key"), k) == k]


def add_row(path: Path, row: dict[str, Any]) -> None:
    """Adds a line; several processes may do so at once.

    Raises:
        UserError: it cannot be written; the lines before are kept.
    """
    with _appending(path) as file:
        _cut_torn_line(file)
        file.write(json.dumps(row).encode() + b"\n")
        file.flush()
        os.fsync(file.fileno())


@contextlib.contextmanager
def _appending(path: Path) -> Iterator[Any]:
    """The file, for this process alone."""
    from easi_jax.errors import UserError
    from easi_jax.io.files import os_reason

    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("a+b") as file:
            fcntl.flock(file, fcntl.LOCK_EX)
            yield file
    except OSError as error:
        raise UserError(
            f"cannot write {path}: {os_reason(error)}; free the disk or choose "
            "another --out"
        ) from error


def _cut_torn_line(file: Any) -> None:
    """Of a process that was killed, or of a full disk, as it wrote."""
    file.seek(0)
    whole, end, torn = file.read().rpartition(b"\n")
    if torn:
        file.truncate(len(whole) + len(end))
