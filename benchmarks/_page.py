"""What the page of results is made of: sections of files, tables of rows."""

import dataclasses
import math
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

from benchmarks._cells import read_rows
from benchmarks._common import markdown_table

Column = str | Callable[[Any], object]


@dataclasses.dataclass(frozen=True)
class Section:
    """Paragraphs made of one source; called with the folder of results.

    Attributes:
        title: with its ``#``; nothing is shown of a section without one that was not
            run.
        source: ``NAME.jsonl``, the rows of a file; ``NAME.json``, its content;
            a pattern such as ``NAME_*.json``, the contents by name, sorted.
        command: what makes it, without ``python -m benchmarks.``.
        body: the paragraphs after the title.
    """

    title: str
    source: str
    command: str
    body: Callable[[Any], list[str]]

    def __call__(self, folder: Path) -> list[str]:
        found = load(folder, self.source)
        if found:
            return [self.title, *self.body(found)] if self.title else self.body(found)
        return [self.title, not_run(self.command)] if self.title else []


def load(folder: Path, source: str) -> Any:
    """A source as `Section` has it; empty or None where nothing was run."""
    from easi_jax.io.files import read_json

    if source.endswith(".jsonl"):
        return read_rows(folder / source)
    if "*" in source:
        return {p.stem: read_json(p) for p in sorted(folder.glob(source))}
    path = folder / source
    return read_json(path) if path.is_file() else None


def not_run(command: str) -> str:
    """The sentence for what no file is there of."""
    return f"Not run: `python -m benchmarks.{command}`."


def table(rows: Iterable[Any], columns: Mapping[str, Column]) -> str:
    """A Markdown table of rows.

    Args:
        columns: by its head, a format of the row's keys (``"{seconds:.0f} s"``), or a
            function of the row.
    """
    lines = [
        [c.format_map(row) if isinstance(c, str) else c(row) for c in columns.values()]
        for row in rows
    ]
    return markdown_table(list(columns), lines)


def met(ok: object) -> str:
    """Whether a goal is reached."""
    return "met" if ok else "**missed**"


def percent(log_ratio: float) -> str:
    """A log ratio as a difference in percent."""
    return f"{100 * (math.exp(log_ratio) - 1):.1f}"


def each_of(values: Iterable[float], digits: int) -> str:
    """Numbers in a row."""
    return ", ".join(f"{v:.{digits}f}" for v in values)
