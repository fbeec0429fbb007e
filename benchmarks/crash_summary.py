"""Section of the results page on commands that were killed."""

from pathlib import Path

from benchmarks._cells import read_rows
from benchmarks._common import markdown_table
from benchmarks.crash import COMMANDS


def crashes(folder: Path) -> list[str]:
    """Kills by command, and how many went on to the same end."""
    out = ["## Killed and gone on"]
    rows = read_rows(folder / "crash.jsonl")
    if not rows:
        return [*out, "Not run: `python -m benchmarks.crash`."]
    commits = sorted({(r["versions"]["commit"] or "unknown")[:7] for r in rows})
    lines = []
    for command in COMMANDS:
        mine = [r for r in rows if r["command"] == command]
        alive = [r for r in mine if r["killed"]]
        lines.append(
            (
                f"train.{command}",
                len(mine) or "not run",
                sum(r["checkpoints"] > 0 for r in alive),
                sum(not r["different"] for r in mine),
                "; ".join(f"{r['key']}: {r['different'][0]}" for r in bad(mine)),
            )
        )
    head = ("command", "kills", "with a checkpoint", "to the same end", "others")
    return [
        *out,
        f"`python -m benchmarks.crash`, commits {', '.join(commits)}: killed by signal "
        "9 at moments drawn from the time that the command takes, then gone on with "
        "`--resume`; every number and policy is compared, to the last bit, with those "
        "of a job that was left alone.",
        markdown_table(head, lines),
    ]


def bad(rows: list[dict]) -> list[dict]:
    """Those that ended otherwise."""
    return [r for r in rows if r["different"]]
