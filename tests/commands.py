"""Runs commands of ``train`` inside the tests' process."""

import json
from pathlib import Path
from typing import Any

import pytest

from train._command import main


def command(module: Any, *args: object) -> None:
    """``python -m MODULE ARGS``."""
    main(module.Config, module.run, name=module.__name__, args=[str(a) for a in args])


def refused(capsys: pytest.CaptureFixture[str], module: Any, *args: object) -> str:
    """The one line that a mistake ends with, exit status 2."""
    capsys.readouterr()
    with pytest.raises(SystemExit) as stop:
        command(module, *args)
    assert stop.value.code == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1 and lines[0].startswith("error: ")
    return lines[0]


def read(path: Path) -> Any:
    """A JSON file."""
    return json.loads(path.read_text())
