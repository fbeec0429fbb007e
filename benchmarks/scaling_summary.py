"""Section of the results page on how cost grows."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks._cells import read_rows
from benchmarks._common import commits_of, markdown_table

OF = {
    "parameters": "generation by parameters searched",
    "population": "generation by individuals",
    "horizon": "generation by control steps of a piece",
    "seeds": "iteration of training by seeds in one program",
}


def growth(folder: Path) -> list[str]:
    """Seconds by size, on every device that was timed."""
    out = ["## How cost grows"]
    rows = read_rows(folder / "scaling.jsonl")
    if not rows:
        return [*out, "Not run: `python -m benchmarks.scaling`."]
    out.append(
        f"`python -m benchmarks.scaling`, commits {commits_of(rows)}: seconds once "
        "compiled, the least of three; control steps simulated a second in brackets."
    )
    for what, title in OF.items():
        part = [r for r in rows if r["what"] == what]
        sizes = sorted({r["size"] for r in part})
        machines = sorted({_machine(r) for r in part})
        lines = [
            (m, *(_cell([r for r in part if _machine(r) == m], s) for s in sizes))
            for m in machines
        ]
        if lines:
            table = markdown_table(("", *map(str, sizes)), lines)
            out += [f"Seconds of a {title}:", table]
    return out


def _machine(row: dict[str, Any]) -> str:
    name = " ".join([row["robot"], *row["option"]])
    count = f"{row['devices']} {'core' if row['device'] == 'cpu' else row['device']}"
    return f"{name}, {count}{'s' if count.endswith('core') else ''}"


def _cell(rows: Sequence[dict[str, Any]], size: int) -> str:
    for r in rows:
        if r["size"] == size:
            return f"{r['seconds']:.3g} ({r['control_steps_per_s']:,.0f})"
    return "not run"
