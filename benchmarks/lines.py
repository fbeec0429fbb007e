"""Lines of Python by package, now and at an earlier commit.

    python -m benchmarks.lines --before 0d0fc7f

Prints a table in Markdown and writes ``results/lines.json``.
"""

import dataclasses
import io
import subprocess
import tarfile
from collections import Counter
from pathlib import Path, PurePosixPath
from typing import Any

from benchmarks._common import RESULTS, ROOT, command_of, markdown_table, write_result
from train._command import main, say

SUMMED = ("easi_jax", "train", "benchmarks")  # what is to become less


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
    before, after = (counts(r) for r in (config.before, config.after))
    result = {
        "summed": SUMMED,
        "packages": {k: [before[k], after[k]] for k in sorted({*before, *after})},
    }
    command = command_of("benchmarks.lines", config)
    path = write_result("lines", command, config, config.results, **result)
    say("\n\n".join(paragraphs({"command": command, **result})))
    say(f"written: {path}")


def counts(revision: str) -> Counter[str]:
    """Lines by package: the first folder, or the first two in ``easi_jax``.

    Raises:
        UserError: git knows no such commit.
    """
    from easi_jax.errors import UserError

    words = ["git", "archive", "--format=tar", revision]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, timeout=60, check=False)
    if done.returncode:
        raise UserError(f"{revision}: {done.stderr.decode().strip()}")
    found = Counter[str]()
    with tarfile.open(fileobj=io.BytesIO(done.stdout)) as archive:
        for member in archive:
            content = archive.extractfile(member)
            if member.name.endswith(".py") and content is not None:
                folders = PurePosixPath(member.name).parts[:-1] or (".",)
                depth = 2 if folders[0] == "easi_jax" else 1
                found["/".join(folders[:depth])] += content.read().count(b"\n")
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
    return [
        f"`{result['command']}`: lines of Python.",
        markdown_table(("package", "before", "after", "change"), lines),
    ]


if __name__ == "__main__":
    main(Config, run, name="benchmarks.lines")
