"""No run of lines stands in two places of the project's Python."""

import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
MOST = 10  # lines that two places may share


def lines_of(text: str) -> Iterator[tuple[int, str]]:
    """Lines that say something: not blank, a comment, an import or a bracket alone."""
    for number, line in enumerate(text.splitlines(), 1):
        plain = line.strip()
        if plain.strip("()[]{},:") and not plain.startswith(("#", "import ", "from ")):
            yield number, plain


def repeated(texts: dict[str, str], most: int) -> list[str]:
    """Pairs of places that share ``most + 1`` lines in a row."""
    seen: dict[tuple[str, ...], str] = {}
    found = []
    for name, text in texts.items():
        lines = list(lines_of(text))
        for i in range(len(lines) - most):
            run = tuple(line for _, line in lines[i : i + most + 1])
            place = f"{name}:{lines[i][0]}"
            if seen.setdefault(run, place) != place:
                found.append(f"{seen[run]} and {place}")
    return found


def test_nothing_is_written_twice() -> None:
    words = ["git", "-C", str(ROOT), "ls-files", "*.py"]
    told = subprocess.run(
        words, capture_output=True, text=True, timeout=60, check=False
    )
    if told.returncode:
        pytest.skip("no git checkout to list files of")
    paths = (ROOT / name for name in told.stdout.split())
    texts = {str(p.relative_to(ROOT)): p.read_text() for p in paths if p.is_file()}
    assert len(texts) > 100
    assert repeated(texts, MOST) == []


def test_what_is_written_twice_is_found() -> None:
    body = "".join(f"x{i} = {i}\n\n" for i in range(4))
    texts = {"a.py": "import os\n" + body, "b.py": "y = 1\n# a note\n" + body}
    assert repeated(texts, 3) == ["a.py:2 and b.py:3"]
    assert repeated(texts, 4) == []
