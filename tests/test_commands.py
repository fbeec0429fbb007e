"""Ends of commands on small models, as `benchmarks.commands` tells them apart."""

import signal
import subprocess
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from benchmarks import commands
from benchmarks._cells import add_row, read_rows
from benchmarks._page import shown
from benchmarks.parity_models import feature_models
from train import parameters

MADE = {"commit": "0123456789"}


def _outcome(module: Any, out: Path, *words: Any) -> tuple[str, str]:
    args = ("--out", out, *words)
    found = commands.outcome(module, args, out, time.monotonic())
    return found["outcome"], found["said"]


def test_files_a_line_and_a_traceback(tmp_path: Path) -> None:
    model, out = tmp_path / "m.xml", tmp_path / "p.yaml"
    assert _outcome(parameters, out, "--model", model) == (
        commands.REFUSED,
        "m.xml: no such model file, or not to be read",
    )
    model.write_text(feature_models()["actuator motor"])
    assert _outcome(parameters, out, "--model", model) == (commands.FILES, "")

    def broken(_: Any) -> None:
        raise ZeroDivisionError("by nothing")

    odd = SimpleNamespace(__name__="odd", Config=parameters.Config, run=broken)
    kind, said = _outcome(odd, out, "--model", model)
    assert kind == commands.FAILED
    assert said == "ZeroDivisionError: by nothing (test_commands.py, broken)"
    idle: Any = SimpleNamespace(**{**vars(odd), "run": lambda _: None})
    missing = tmp_path / "none.yaml"
    assert _outcome(idle, missing, "--model", model)[1] == "no none.yaml"


def test_what_no_engine_runs_is_recorded(tmp_path: Path) -> None:
    model, log = tmp_path / "m.xml", tmp_path / "log.csv"
    model.write_text(feature_models()["flag sleep enabled"])
    commands.write_recording(model, log)
    assert len(log.read_text().splitlines()) == 251


@pytest.mark.parametrize("name", ["actuator motor", "ball limit", "solver PGS"])
def test_a_recording_of_a_model_is_read_as_a_log(name: str, tmp_path: Path) -> None:
    from easi_jax.io.logs.reader import read_logs
    from easi_jax.io.models.mjcf import read_mjcf

    model, log = tmp_path / "m.xml", tmp_path / "log.csv"
    model.write_text(feature_models()[name])
    commands.write_recording(model, log)
    m = read_mjcf(model, tell=lambda _: None)
    run = read_logs([log], m).runs[0]
    assert len(run.time) == 250 and run.ctrl.shape[1] == m.nu


def test_a_model_that_ends_its_process_is_noted_and_the_next_follows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, ends = tmp_path / "commands.jsonl", [-signal.SIGSEGV, 0]
    start = subprocess.run

    def ended(words: list[str], **how: Any) -> Any:
        if "--worker" not in words:  # git
            return start(words, **how)
        return SimpleNamespace(returncode=ends.pop(0))

    monkeypatch.setattr(subprocess, "run", ended)
    commands.run(commands.Config(out=out))
    (row,) = read_rows(out)
    assert not ends and row["key"] == commands.cells()[0].key
    assert "SIGSEGV" in shown(commands.SECTIONS, tmp_path)[-2]


def test_the_page_counts_ends_and_says_each_refusal_once(tmp_path: Path) -> None:
    good = {"outcome": commands.FILES, "said": "", "seconds": 2.0}
    line = {"outcome": commands.REFUSED, "said": "no | actuators", "seconds": 1.0}
    for key in ("noslip", "solver PGS"):
        row = {"key": key, "engine": "mujoco", "versions": MADE}
        row["commands"] = {"easi": good, "udr": line}
        add_row(tmp_path / "commands.jsonl", row)
    page = "\n".join(shown(commands.SECTIONS, tmp_path))
    assert "2 of 171 models" in page and "mujoco on 2" in page
    assert "| train.easi | 2 | 0 | 0 | 0 |" in page
    assert "| one line | no \\| actuators | 2 | noslip (udr) |" in page
    assert "Not run: " in page and "noslip," not in page.split("Not run: ")[1]


def test_models_of_one_kind_are_far_apart() -> None:
    keys = [c.key for c in commands.cells()]
    assert sorted(keys) == sorted(feature_models())
    assert len({k.split()[0] for k in keys[:8]}) > 6
