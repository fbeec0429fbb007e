"""Sections of the results page on kills and on long use."""

from pathlib import Path

from benchmarks._cells import read_rows
from benchmarks._common import commits_of, markdown_table
from benchmarks.crash import COMMANDS


def crashes(folder: Path) -> list[str]:
    """Kills by command, and how many went on to the same end."""
    out = ["## Killed and gone on"]
    rows = read_rows(folder / "crash.jsonl")
    if not rows:
        return [*out, "Not run: `python -m benchmarks.crash`."]
    lines = []
    for command in COMMANDS:
        mine = [r for r in rows if r["command"] == command]
        lines.append(
            (
                f"train.{command}",
                len(mine) or "not run",
                sum(r["checkpoints"] > 0 for r in mine),
                sum(not r["different"] for r in mine),
                "; ".join(
                    f"{r['key']}: {r['different'][0]}" for r in mine if r["different"]
                ),
            )
        )
    head = ("command", "kills", "with a checkpoint", "to the same end", "others")
    return [
        *out,
        f"`python -m benchmarks.crash`, commits {commits_of(rows)}: killed by signal "
        "9 at moments drawn from the time that the command takes, then gone on with "
        "`--resume`; every number and policy is compared, to the last bit, with those "
        "of a job that was left alone.",
        markdown_table(head, lines),
    ]


def faults(folder: Path) -> list[str]:
    """Everything that was broken on purpose, in one table."""
    from easi_jax.io.files import read_json

    out = ["## Faults tried and survived"]
    lines: list[tuple[object, ...]] = []
    path = folder / "faults.json"
    if path.exists():
        r = read_json(path)
        out.append(f"Tests: `{r['command']}`, commit {commits_of([r])}.")
        lines += [
            (fault, "tests", c["tried"], c["survived"])
            for fault, c in r["counts"].items()
        ]
    else:
        out.append("Not run: `python -m benchmarks.faults`.")
    path = folder / "fuzz.json"
    if path.exists():
        total = read_json(path)["total"]
        cases, failed = total["cases"], total["failed"]
        what = "files changed, drawn or written to do harm"
        lines.append((what, "`benchmarks.fuzz`", cases, cases - failed))
    rows = read_rows(folder / "crash.jsonl")
    if rows:
        same = sum(not r["different"] for r in rows)
        what = "commands killed at random moments"
        lines.append((what, "`benchmarks.crash`", len(rows), same))
    head = ("what breaks", "by", "tried", "survived")
    return [*out, markdown_table(head, lines)] if lines else out


def soak(folder: Path) -> list[str]:
    """Memory over many searches in one process."""
    from easi_jax.io.files import read_json

    out = ["## Many searches in one process"]
    path = folder / "soak.json"
    if not path.exists():
        return [*out, "Not run: `python -m benchmarks.soak`."]
    r = read_json(path)
    counts = [k for k in r["megabytes"] if int(k) % 500 == 0]
    first = str(r["config"]["warm_up"])
    shown = {k: r["megabytes"][k] for k in dict.fromkeys((first, *counts))}
    return [
        *out,
        f"`{r['command']}`, commit {commits_of([r])}: "
        f"{r['config']['searches']} searches, {r['finite']} with finite results, in "
        f"{r['seconds']:.0f} s; the process "
        f"grows by {r['growth_megabytes']:.1f} MB after the first {first}.",
        markdown_table(
            ("after searches", *shown),
            [("memory [MB]", *(f"{x:.1f}" for x in shown.values()))],
        ),
    ]
