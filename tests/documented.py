"""Command lines of documents and scripts, and whether the commands take them."""

import importlib
import re
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import tyro

ROOT = Path(__file__).parents[1]
OTHERS = ("pip", "pytest", "venv")  # of Python, not of this project
_COMMAND = re.compile(r"(?:^|[\s`/$(])python -m ([\w.]+)([^`\n]*)")
_PLACEHOLDER = str.maketrans("", "", "[]…")


def commands(text: str) -> Iterator[list[str]]:
    """``[MODULE, ARGUMENT, ...]`` of each ``python -m`` in Markdown, a script or a
    docstring; marks of the reader's own files (``LOG…``, ``[LOG2 …]``) are taken off.
    """
    for found in _COMMAND.finditer(re.sub(r"\\\n[\s#]*", " ", text)):
        words = shlex.split(found[2], comments=True)
        plain = [w.translate(_PLACEHOLDER) for w in words]
        if found[1] not in OTHERS:
            yield [found[1], *(w for w in plain if w)]


def parsed(words: list[str]) -> Any:
    """The configuration that a command makes of ``[MODULE, ARGUMENT, ...]``.

    Raises:
        AssertionError: there is no such command, or it refuses them.
    """
    name, *arguments = words
    assert (ROOT / f"{name.replace('.', '/')}.py").is_file(), f"no command {name}"
    module = importlib.import_module(name)
    try:
        return tyro.cli(module.Config, args=arguments, console_outputs=False)
    except SystemExit:
        raise AssertionError(f"{name} does not take {shlex.join(arguments)}") from None
