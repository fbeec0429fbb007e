"""What the page of results is made of: sections of files, tables of rows."""

import dataclasses
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from statistics import mean, median
from typing import Any

from benchmarks._cells import read_rows
from benchmarks._common import markdown_table

Column = str | Callable[[Any], object]


class Named(dict[Any, Any]):
    """What a section is about, by name; what is empty was not run."""


def _all(found: Any) -> Any:
    return found


@dataclasses.dataclass(frozen=True)
class Section:
    """Paragraphs made of one source; called with the folder of results.

    Attributes:
        title: with its ``#``; empty where the paragraphs belong to the section before.
        source: as `load` takes it.
        command: what makes it, without ``python -m benchmarks.``; ``{name}`` stands for
            the name of what is missing, where the source has names.
        body: the paragraphs after the title, of what is there.
        of: what of the source the section is about, empty where that was not run.
        optional: whether nothing is said of what was not run.
    """

    title: str
    source: str | Mapping[Any, str]
    command: str
    body: Callable[[Any], list[str]]
    of: Callable[[Any], Any] = _all
    optional: bool = False

    def __call__(self, folder: Path) -> list[str]:
        found = self.of(load(folder, self.source))
        said = [self.title] if self.title else []
        if isinstance(found, Named):
            missing = (self.command.format(name=n) for n, v in found.items() if not v)
            said += map(not_run, dict.fromkeys(missing))
            found = {name: value for name, value in found.items() if value}
        elif not found:
            said = [] if self.optional else [*said, not_run(self.command)]
        return said + self.body(found) if found else said


def those(keep: Callable[[Any], object]) -> Callable[[Iterable[Any]], list[Any]]:
    """Takes the rows of which ``keep`` is true."""
    return lambda rows: [row for row in rows if keep(row)]


def shown(sections: Iterable[Section], folder: Path) -> list[str]:
    """The paragraphs of all of them."""
    return [text for section in sections for text in section(folder)]


def load(folder: Path, source: str | Mapping[Any, str]) -> Any:
    """Results; empty or None where nothing was run.

    Args:
        source: ``NAME.jsonl``, the rows of a file; ``NAME.json``, its content; a
            pattern such as ``NAME_*.json``, the contents by name, sorted; several of
            these, by names.
    """
    from easi_jax.io.files import read_json

    if not isinstance(source, str):
        return Named({name: load(folder, one) for name, one in source.items()})
    if source.endswith(".jsonl"):
        return read_rows(folder / source)
    if "*" in source:
        return {p.stem: read_json(p) for p in sorted(folder.glob(source))}
    path = folder / source
    return read_json(path) if path.is_file() else None


def not_run(command: str) -> str:
    """The sentence for what no file is there of."""
    return f"Not run: `python -m benchmarks.{command}`."


def named(method: str, rows: Iterable[Mapping[str, Any]]) -> str:
    """A method, with the parameters that by its rows it has no word for."""
    mine = (r for r in rows if r["method"] == method)
    lacks = {name for r in mine for name in r.get("unreached", ())}
    return f"{method} (without {', '.join(sorted(lacks))})" if lacks else method


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


def computing(rows: Sequence[Mapping[str, Any]]) -> str:
    """How long all rows took, by those that say it."""
    told = [r["seconds"] for r in rows if "seconds" in r]
    if not told:
        return "Computing time: not recorded."
    each = f"{median(told):.0f} s each in the median"
    if len(told) == len(rows):
        return f"Computing time: {sum(told) / 3600:.1f} hours of a core, {each}."
    whole = mean(told) * len(rows) / 3600
    return (
        f"Computing time: about {whole:.1f} hours of a core, {each}, by the "
        f"{len(told)} of {len(rows)} that say it."
    )


def met(ok: object) -> str:
    """Whether a goal is reached."""
    return "met" if ok else "**missed**"


def percent(log_ratio: float) -> str:
    """A log ratio as a difference in percent."""
    return f"{100 * (math.exp(log_ratio) - 1):.1f}"


def each_of(values: Iterable[float], digits: int) -> str:
    """Numbers in a row."""
    return ", ".join(f"{v:.{digits}f}" for v in values)
