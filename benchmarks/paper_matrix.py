"""Which cells of the paper's experiments were run, where, and by which code."""

from collections.abc import Iterable, Mapping
from typing import Any

from benchmarks._common import commits_of, markdown_table
from benchmarks.paper_cells import METHODS, changes, is_stale
from benchmarks.paper_experiments import (
    EXPERIMENTS,
    MUST,
    SEARCHES,
    Config,
    cells,
    robots,
)
from benchmarks.rival_cells import AFTER_GAP

_OF_OTHERS = (SEARCHES[1], AFTER_GAP)

Row = Mapping[str, Any]


def paragraphs(rows: Iterable[Row]) -> list[str]:
    """A line for each experiment and robot of which a cell was run; then all others."""
    have = {r["key"]: r for r in rows}
    lines, none = [], []
    for name in EXPERIMENTS:
        for robot in robots(name):
            every = cells(Config(name, robot=robot))
            mine = [have[c.key] for c in every if c.key in have]
            if not mine:
                none.append(f"{name} of {robot}")
                continue
            whole = [
                s
                for s in Config(name).seeds
                if all(c.key in have for c in every if c.seed == s)
            ]
            lines.append(
                (
                    *(name, robot, f"{len(mine)} of {len(every)}"),
                    str(sum(map(is_stale, mine)) or ""),
                    ", ".join(map(str, whole)) or "none",
                    *(devices(mine), commits_of(mine)),
                )
            )
    tried = {r["method"] for r in have.values()}
    idle = [m for m in METHODS if m not in (*MUST, *tried, *_OF_OTHERS)]
    head = ("experiment", "robot", "cells run", "of these stale")
    head = (*head, "seeds complete", "on", "commits")
    out = [
        "[The paper's claims](CLAIMS.md), one by one, are on a page of their own.",
        "`python -m benchmarks.paper NAME --robot ROBOT`; `status` in place of NAME "
        "says what the rest takes, `all` runs it. A commit with + had changes that "
        "were not committed.",
        markdown_table(head, lines),
    ]
    reasons: dict[tuple[str, ...], list[str]] = {}
    stale = {(r["method"], r["robot"]) for r in have.values() if is_stale(r)}
    for m, robot in sorted(stale):
        methods = reasons.setdefault(changes(m, robot), [])
        methods += [m] * (m not in methods)
    for why, methods in reasons.items():
        out.append(f"Stale rows of {', '.join(methods)}: since then {'; '.join(why)}.")
    if none:
        out.append(f"Not run: {', '.join(none)}.")
    if idle:
        out.append(
            f"Not run in any of them: {', '.join(idle)} (`--methods`). What these "
            "identify is [further down](#identification-beside-rivals-and-todays-tools)"
            "."
        )
    return out


def device(row: Row) -> str:
    """What a row was made on."""
    return row["versions"].get("runtime", {}).get("device_kind", "?")


def devices(rows: Iterable[Row]) -> str:
    """How many of the rows were made on what."""
    kinds = [device(r) for r in rows]
    counted = sorted({k: kinds.count(k) for k in kinds}.items(), key=lambda x: -x[1])
    return ", ".join(k if len(counted) == 1 else f"{k} ({n})" for k, n in counted)
