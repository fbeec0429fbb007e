"""Section of the results page on how cost grows."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.lines import Line2D
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator
from scipy.optimize import nnls

from benchmarks._cells import read_rows
from benchmarks._common import commits_of, markdown_table
from benchmarks._page import Section
from easi_jax.io.report.figure_style import (
    SERIES,
    dash,
    fit,
    grid,
    legend_above,
    styled,
    svg,
)
from easi_jax.search.config import SearchConfig

OF = {
    "parameters": "a generation by parameters searched",
    "population": "a generation by individuals",
    "horizon": "a generation by control steps of a piece",
    "seeds": "an iteration of training by seeds in one program",
}


def _growth(rows: Sequence[dict[str, Any]]) -> list[str]:
    """Seconds by size, on every device that was timed."""
    out = [
        f"`python -m benchmarks.scaling`, commits {commits_of(rows)}: seconds once "
        "compiled, the least of three; control steps simulated a second in brackets.",
        "![Seconds by size](scaling.svg)",
    ]
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
            out += [f"Seconds of {title}:", table]
    return out + on_paper(rows)


def figures(folder: Path) -> dict[str, str]:
    """The same as curves, by file name; nothing where nothing was timed."""
    rows = read_rows(folder / "scaling.jsonl")
    return {"scaling.svg": _curves(rows)} if rows else {}


@styled
def _curves(rows: Sequence[dict[str, Any]]) -> str:
    """Seconds by size, a panel for each quantity, a line for each machine."""
    figure, axes = grid(len(OF), 2, height=2.3)
    machines = sorted({_machine(r) for r in rows})
    for axis, (what, title) in zip(axes, OF.items(), strict=True):
        part = [r for r in rows if r["what"] == what]
        for i, machine in enumerate(machines):
            own = sorted(
                (r["size"], r["seconds"]) for r in part if _machine(r) == machine
            )
            if own:
                look = {"color": SERIES[i % len(SERIES)], "ls": dash(i), "lw": 1.4}
                axis.plot(*zip(*own, strict=True), marker="o", ms=3, **look)
        axis.set_xscale("log")
        sizes: list[int] = []
        for size in sorted({r["size"] for r in part}):
            if not sizes or size > 1.2 * sizes[-1]:  # else their labels would touch
                sizes.append(size)
        axis.xaxis.set_major_locator(FixedLocator(sizes))
        axis.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axis.xaxis.set_minor_locator(NullLocator())
        fit(axis, np.array([r["seconds"] for r in part]), log=True)
        axis.set_title(f"seconds of {title}")
    handles = [
        Line2D([], [], color=SERIES[i % len(SERIES)], ls=dash(i), lw=1.6, label=m)
        for i, m in enumerate(machines)
    ]
    legend_above(figure, handles)
    return svg(figure)


def on_paper(rows: Sequence[dict[str, Any]]) -> list[str]:
    """What more devices would make of a generation, reckoned from one machine's times.

    A generation of N individuals takes a + b N on what was timed; on P of them a +
    b N / P, and an all-gather of every simulated state: bytes (P - 1) / P at the
    link's rate, and its latency log2 P times. Where one population alone was timed, a
    and b are not known apart, and the two ends are told: all of it a, all of it b N.
    """
    # More devices than cores only show what is lost.
    rows = [r for r in rows if r["device"] != "cpu" or r["devices"] <= _cores(r)]
    gathered = {
        (r["robot"], *r["option"], r["size"]): r["gathered_bytes"]
        for r in rows
        if r["what"] == "population" and "gathered_bytes" in r
    }
    out: list[str] = []
    for kind, links in LINKS.items():
        lines: list[tuple[object, ...]] = []
        part = [r for r in rows if ("cpu" if r["device"] == "cpu" else "gpu") == kind]
        for machine in sorted({_machine(r) for r in part}):
            own = [r for r in part if _machine(r) == machine]
            lines += _reckoned(machine, own, gathered, links)
        if lines:
            head = ("", "individuals", "timed", *(name for name, *_ in links), "equal")
            out.append(markdown_table(head, lines))
    if not out:
        return []
    told = (
        "On paper: seconds of a generation on more machines of the kind timed, in "
        "brackets the share in which they tell each other what they simulated "
        "(`benchmarks/scaling_summary.py` has the formula; two figures where one "
        "population alone was timed: if its time did not depend on the population, and "
        "if it were proportional to it). Last, the number of machines from which on "
        "telling takes longer than simulating. Seeds and cells of experiments tell "
        "each other nothing."
    )
    return [told, *out]


def _reckoned(
    machine: str, rows: Sequence[dict[str, Any]], gathered: Any, links: Any
) -> list[tuple[object, ...]]:
    """Lines of the table on paper for one machine; none where nothing can be told."""
    robot = (rows[0]["robot"], *rows[0]["option"])
    seconds = {
        r["size"]: r["seconds"]
        for r in sorted(rows, key=lambda r: r["size"])
        if r["what"] == "population"
    }
    full = [r for r in rows if r["what"] == "parameters"]
    if len(seconds) > 1:
        ends = [line_through(list(seconds), list(seconds.values()))]
    elif full and rows[0]["device"] != "cpu":
        # Sizes of the search are timed at the preset's population.
        size = SearchConfig().population
        one = seconds.get(size) or max(full, key=lambda r: r["size"])["seconds"]
        seconds[size] = one
        ends = [(one, 0.0), (0.0, one / size)]
    else:
        return []
    lines = []
    for size in sorted(k[-1] for k in gathered if k[:-1] == robot):
        sent = gathered[(*robot, size)]
        cells = []
        for _, count, rate, latency in links:
            told = gathering(sent, count, rate, latency)
            total = [a + b * size / count + told for a, b in ends]
            share = " to ".join(f"{told / t:.0%}" for t in total)
            cells.append(" to ".join(f"{t:.3g}" for t in total) + f" ({share})")
        equal = ends[-1][1] * size * links[-1][2] / sent
        shown = f"{seconds[size]:.3g}" if size in seconds else "not run"
        lines.append((machine, size, shown, *cells, f"{equal:,.0f}"))
    return lines


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
    count, device = row["devices"], row["device"]
    if device != "cpu":
        return f"{name}, {count} {device}"
    cores = _cores(row)
    if count != cores:  # one device uses more cores than one
        few = "devices" if count > 1 else "device"
        return f"{name}, {count} {'virtual ' * (count > cores)}{few} on {cores} cores"
    return f"{name}, {count} {'cores' if count > 1 else 'core'}"


def _cores(row: dict[str, Any]) -> int:
    """Cores that were there; one for each device where the row does not say."""
    return row.get("versions", {}).get("runtime", {}).get("cores", row["devices"])


def _cell(rows: Sequence[dict[str, Any]], size: int) -> str:
    for r in rows:
        if r["size"] == size:
            return f"{r['seconds']:.3g} ({r['control_steps_per_s']:,.0f})"
    return "not run"


SECTIONS = (Section("## How cost grows", "scaling.jsonl", "scaling", _growth),)
