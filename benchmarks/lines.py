"""Lines of Python by package, now and at an earlier commit.

    python -m benchmarks.lines --before 0d0fc7f

Prints a table in Markdown and writes ``results/lines.json``.
"""

import dataclasses
import io
import subprocess
import tarfile
from collections import Counter
from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from typing import Any

from benchmarks._common import RESULTS, ROOT, command_of, markdown_table, write_result
from benchmarks._page import met
from train._command import main, say

SUMMED = ("easi_jax", "train", "benchmarks")  # what is to become less
# Packages that were to have two thirds of the lines of what they took the place of.
SHARE = 2 / 3
REPLACED = {
    "easi_jax/estimation": (
        *("easi_jax/refine.py", "easi_jax/identify.py", "easi_jax/adjusted.py"),
        *("easi_jax/polish.py", "easi_jax/windows.py", "easi_jax/gap/fit.py"),
        *("easi_jax/gap/predictor.py", "easi_jax/gap/window_set.py"),
    ),
    "easi_jax/gap": ("easi_jax/gap/",),  # three of those above among them
}


@dataclasses.dataclass(frozen=True)
class Config:
    """Counts the lines of two commits."""

    before: str = "0d0fc7f"
    """The earlier commit."""
    after: str = "HEAD"
    """The later one."""
    results: Path = RESULTS
    """Folder of lines.json."""


def run(config: Config) -> None:
    """Counts, prints and writes."""
    old, new = (files(r) for r in (config.before, config.after))
    before, after = counts(old), counts(new)
    result = {
        "summed": SUMMED,
        "packages": {k: [before[k], after[k]] for k in sorted({*before, *after})},
        "replaced": {
            package: [
                sum(n for f, n in old.items() if f.startswith(parts)),
                after[package],
            ]
            for package, parts in REPLACED.items()
        },
    }
    command = command_of("benchmarks.lines", config)
    path = write_result("lines", command, config, config.results, **result)
    say("\n\n".join(paragraphs({"command": command, **result})))
    say(f"written: {path}")


def files(revision: str) -> dict[str, int]:
    """Lines of each Python file.

    Raises:
        UserError: git knows no such commit.
    """
    from easi_jax.errors import UserError

    words = ["git", "archive", "--format=tar", revision]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, timeout=60, check=False)
    if done.returncode:
        raise UserError(f"{revision}: {done.stderr.decode().strip()}")
    found = {}
    with tarfile.open(fileobj=io.BytesIO(done.stdout)) as archive:
        for member in archive:
            content = archive.extractfile(member)
            if member.name.endswith(".py") and content is not None:
                found[member.name] = content.read().count(b"\n")
    return found


def counts(lines: Mapping[str, int]) -> Counter[str]:
    """Lines by package: the first folder, or the first two in ``easi_jax``."""
    found = Counter[str]()
    for name, count in lines.items():
        folders = PurePosixPath(name).parts[:-1] or (".",)
        depth = 2 if folders[0] == "easi_jax" else 1
        found["/".join(folders[:depth])] += count
    return found


def paragraphs(result: dict[str, Any]) -> list[str]:
    """The table with its sums, as on the page of results."""
    rows = list(result["packages"].items())
    mine = [n for k, n in rows if k.split("/")[0] in result["summed"]]
    sums = {", ".join(result["summed"]): mine, "in all": [n for _, n in rows]}
    rows += [
        (f"**{name}**", [sum(column) for column in zip(*some, strict=True)])
        for name, some in sums.items()
    ]
    lines = [(k, f"{a:,}", f"{b:,}", f"{b - a:+,}") for k, (a, b) in rows]
    out = [
        f"`{result['command']}`: lines of Python.",
        markdown_table(("package", "before", "after", "change"), lines),
    ]
    for package, (was, now) in result.get("replaced", {}).items():
        goal = SHARE * was
        out.append(
            f"{package} was to have two thirds of the {was:,} lines of what it took "
            f"the place of, {goal:,.0f} at most, and has {now:,}: {met(now <= goal)}. "
            "It does more than that did (fitted starts, sensors, doubts, laws, tied "
            "places, unpaired logs), which these lines are spent on."
        )
    return out


if __name__ == "__main__":
    main(Config, run, name="benchmarks.lines")
