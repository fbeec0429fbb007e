"""Sections of the results page on kills and on long use."""

from typing import Any

from benchmarks._common import commits_of, markdown_table
from benchmarks._page import Section, table
from benchmarks.crash import COMMANDS


def _crashes(rows: list[Any]) -> list[str]:
    """Kills by command, and how many went on to the same end."""
    columns = {
        "command": lambda c: f"train.{c[0]}",
        "kills": lambda c: len(c[1]) or "not run",
        "with a checkpoint": lambda c: sum(r["checkpoints"] > 0 for r in c[1]),
        "to the same end": lambda c: sum(not r["different"] for r in c[1]),
        "others": lambda c: "; ".join(
            f"{r['key']}: {r['different'][0]}" for r in c[1] if r["different"]
        ),
    }
    by_command = [(c, [r for r in rows if r["command"] == c]) for c in COMMANDS]
    return [
        f"`python -m benchmarks.crash`, commits {commits_of(rows)}: killed by signal "
        "9 at moments drawn from the time that the command takes, then gone on with "
        "`--resume`; every number and policy is compared, to the last bit, with those "
        "of a job that was left alone.",
        table(by_command, columns),
    ]


def _faults(found: dict[str, Any]) -> list[str]:
    """Everything that was broken on purpose, in one table."""
    out, lines = [], []
    if "faults" in found:
        r = found["faults"]
        out.append(f"Tests: `{r['command']}`, commit {commits_of([r])}.")
        lines += [
            (fault, "tests", c["tried"], c["survived"])
            for fault, c in r["counts"].items()
        ]
    if "fuzz" in found:
        cases, failed = (found["fuzz"]["total"][k] for k in ("cases", "failed"))
        what = "files changed, drawn or written to do harm"
        lines.append((what, "`benchmarks.fuzz`", cases, cases - failed))
    if "crash" in found:
        same = sum(not r["different"] for r in found["crash"])
        what = "commands killed at random moments"
        lines.append((what, "`benchmarks.crash`", len(found["crash"]), same))
    head = ("what breaks", "by", "tried", "survived")
    return [*out, markdown_table(head, lines)]


def _soak(r: Any) -> list[str]:
    """Memory over many searches in one process."""
    counts = [k for k in r["megabytes"] if int(k) % 500 == 0]
    first = str(r["config"]["warm_up"])
    shown = {k: r["megabytes"][k] for k in dict.fromkeys((first, *counts))}
    return [
        f"`{r['command']}`, commit {commits_of([r])}: "
        f"{r['config']['searches']} searches, {r['finite']} with finite results, in "
        f"{r['seconds']:.0f} s; the process "
        f"grows by {r['growth_megabytes']:.1f} MB after the first {first}.",
        markdown_table(
            ("after searches", *shown),
            [("memory [MB]", *(f"{x:.1f}" for x in shown.values()))],
        ),
    ]


_FILES = {"faults": "faults.json", "fuzz": "fuzz.json", "crash": "crash.jsonl"}
SECTIONS = (
    Section("## Faults tried and survived", _FILES, "{name}", _faults),
    Section("## Killed and gone on", "crash.jsonl", "crash", _crashes),
    Section("## Many searches in one process", "soak.json", "soak", _soak),
)
