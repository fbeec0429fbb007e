"""Sweeps: cells become jobs, failures are told, what is done is not done again."""

import dataclasses
import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from benchmarks import paper
from benchmarks.paper_cells import recipe
from scripts import sweep
from tests.commands import refused
from tests.documented import ROOT

without_submitit = pytest.mark.skipif(
    importlib.util.find_spec("submitit") is None, reason="submitit is not installed"
)
# Two cells that search and train nothing long: see `tiny`.
CELLS = ("table5", "--methods", "EASI paper", "--seeds", "0")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["tabel5"], "table5"),
        ([*CELLS, "--jobs", "0"], "--jobs"),
        ([*CELLS, "--hours", "-1"], "--hours"),
        ([*CELLS, "--shard", "1/2"], "--shard"),
    ],
)
def test_mistakes_are_one_line(words: list[str], said: str, capsys: Any) -> None:
    assert said in refused(capsys, sweep, *words)


def test_a_job_that_is_requeued_has_the_same_part() -> None:
    pytest.importorskip("submitit")
    config = paper.Config("table5", shard="2/3")
    again = sweep.Part(config).checkpoint()
    assert again.function.config == config


def call(folder: Path, *words: object, **env: str) -> subprocess.CompletedProcess[str]:
    """Jobs on this machine, in processes of their own."""
    out = ("--out", folder / "paper.jsonl", "--folder", folder / "udr")
    where = ("--engine", "local", "--gpus", 0, "--logs", folder / "logs")
    words = ("-m", "scripts.sweep", *words, *out, *where)
    return subprocess.run(
        [sys.executable, *map(str, words)],
        cwd=ROOT,
        env={**os.environ, **env},
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )


@without_submitit
def test_done_cells_are_skipped_and_failures_told(tmp_path: Path) -> None:
    config = paper.Config("table5", methods=("EASI paper",), seeds=(0,))
    rows = [
        {"key": c.key, **dataclasses.asdict(c), "recipe": recipe(c.method, c.robot)}
        for c in paper.cells(config)
    ]
    assert len(rows) == 5
    text = "".join(json.dumps(r) + "\n" for r in rows)
    (tmp_path / "paper.jsonl").write_text(text)
    done = call(tmp_path, *CELLS, "--jobs", 2)
    assert done.returncode == 0, done.stderr
    assert "part 2/2" in done.stdout and "5 cells are done" in done.stdout
    assert (tmp_path / "paper.jsonl").read_text() == text  # nothing ran again
    # No place for a UDR training: the jobs fail, and it is said why and where to look.
    (tmp_path / "paper.jsonl").unlink()
    (tmp_path / "udr").write_text("a file in the way")
    done = call(tmp_path, *CELLS, "--jobs", 2)
    assert done.returncode == 2
    assert "part 1 failed: " in done.stdout and "logs" in done.stdout
    assert "cannot write" in done.stdout and "another --folder" in done.stdout
    assert done.stderr.startswith("error: 2 of 2 jobs failed")


@pytest.mark.slow
@without_submitit
def test_two_jobs_run_real_cells(tmp_path: Path) -> None:
    steps = ("--env-steps", 2500)
    done = call(tmp_path, *CELLS, *steps, "--jobs", 2)
    assert done.returncode == 0, done.stdout + done.stderr
    lines = (tmp_path / "paper.jsonl").read_text().splitlines()
    config = paper.Config(
        "table5", methods=("EASI paper",), seeds=(0,), env_steps=steps[1]
    )
    keys = [c.key for c in paper.cells(config)]
    assert sorted(json.loads(x)["key"] for x in lines) == sorted(keys)
