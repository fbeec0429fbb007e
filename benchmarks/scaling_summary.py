"""Section of the results page on how cost grows."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import nnls

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
    return out + on_paper(rows)


def on_paper(rows: Sequence[dict[str, Any]]) -> list[str]:
    """What more devices would make of a generation, reckoned from one machine's times.

    A generation of N individuals takes a + b N on what was timed; on P of them a +
    b N / P, and an all-gather of every simulated state: bytes (P - 1) / P at the
    link's rate, and its latency log2 P times.
    """
    lines: list[tuple[object, ...]] = []
    timed = [r for r in rows if r["what"] == "population" and "gathered_bytes" in r]
    for machine in sorted({_machine(r) for r in timed}):
        part = sorted(
            (r for r in timed if _machine(r) == machine), key=lambda r: r["size"]
        )
        if len(part) < 2:
            continue
        fixed, each = line_through(
            [r["size"] for r in part], [r["seconds"] for r in part]
        )
        for r in part:
            links = LINKS["cpu" if r["device"] == "cpu" else "gpu"]
            cells = []
            for _, count, rate, latency in links:
                told = gathering(r["gathered_bytes"], count, rate, latency)
                total = fixed + each * r["size"] / count + told
                cells.append(f"{total:.3g} ({told / total:.0%})")
            rate = links[-1][2]
            equal = each * r["size"] * rate / r["gathered_bytes"]
            shown = (machine, r["size"], f"{r['seconds']:.3g}", *cells, f"{equal:,.0f}")
            lines.append((len(links), *shown))
    out: list[str] = []
    if lines:
        out.append(
            "On paper: seconds of a generation on more machines of the kind timed, in "
            "brackets the share in which they tell each other what they simulated "
            "(`benchmarks/scaling_summary.py` has the formula). Last, the number of "
            "machines from which on telling takes longer than simulating. Seeds and "
            "cells of experiments tell each other nothing."
        )
    for kind, links in LINKS.items():
        own = [x[1:] for x in lines if ("core" in str(x[1])) == (kind == "cpu")]
        if own:
            head = ("", "individuals", "timed", *(name for name, *_ in links), "equal")
            out.append(markdown_table(head, own))
    return out


# Name, devices, bytes a second into each, seconds of latency. NVLink of an H100: 900
# GB/s both ways together; a ConnectX-7 for each GPU between nodes: 400 Gbit/s.
LINKS = {
    "gpu": (
        ("8 in a node (NVLink)", 8, 450e9, 1e-5),
        ("64 on 8 nodes (400 Gbit/s each)", 64, 50e9, 3e-5),
    ),
    "cpu": (
        ("8 such hosts (10 Gbit/s)", 8, 1.25e9, 1e-4),
        ("64 such hosts", 64, 1.25e9, 1e-4),
    ),
}


def gathering(size: float, count: int, rate: float, latency: float) -> float:
    """Seconds of an all-gather of ``size`` bytes in all over ``count`` devices."""
    return size * (count - 1) / count / rate + latency * math.log2(count)


def line_through(sizes: Sequence[float], seconds: Sequence[float]) -> tuple[float, ...]:
    """``a, b >= 0`` of seconds = a + b size, least squares of relative errors."""
    t = np.asarray(seconds, float)
    rows = np.stack([np.ones(len(t)), np.asarray(sizes, float)], 1) / t[:, None]
    return tuple(float(x) for x in nnls(rows, np.ones(len(t)))[0])


def _machine(row: dict[str, Any]) -> str:
    name = " ".join([row["robot"], *row["option"]])
    count = f"{row['devices']} {'core' if row['device'] == 'cpu' else row['device']}"
    return f"{name}, {count}{'s' if count.endswith('core') else ''}"


def _cell(rows: Sequence[dict[str, Any]], size: int) -> str:
    for r in rows:
        if r["size"] == size:
            return f"{r['seconds']:.3g} ({r['control_steps_per_s']:,.0f})"
    return "not run"
