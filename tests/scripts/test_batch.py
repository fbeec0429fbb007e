"""Batch scripts start the commands that they say, with arguments that these take."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.documented import ROOT, commands, parsed

BATCH = sorted((ROOT / "scripts" / "slurm").glob("*.sbatch"))
# What Slurm gives a job; `srun` here runs its command once, `python` says its words.
GIVEN = {"SLURM_ARRAY_TASK_ID": "3", "SLURM_ARRAY_TASK_COUNT": "8"}
SRUN = """#!/bin/bash
while [[ $1 == --* ]]; do shift; done
exec "$@"
"""
PYTHON = f"""#!{sys.executable}
import json, sys
print(json.dumps(sys.argv[1:]))
"""


def started(script: Path, folder: Path, *arguments: str) -> list[str]:
    """Words behind ``python`` that a job's script runs."""
    for name, text in (("srun", SRUN), ("python", PYTHON)):
        (folder / name).write_text(text)
        (folder / name).chmod(0o755)
    own = {"PATH": f"{folder}:{os.environ['PATH']}", "PYTHON": str(folder / "python")}
    done = subprocess.run(
        ["bash", script, *arguments],
        env={**os.environ, **GIVEN, **own},
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.returncode == 0, done.stderr
    flag, *words = json.loads(done.stdout)
    assert flag == "-m"
    return words


def test_there_is_one_for_each_kind_of_job() -> None:
    names = {p.stem for p in BATCH}
    assert names == {"one_gpu", "one_node", "several_nodes", "cells"}


@pytest.mark.parametrize("script", BATCH, ids=lambda p: p.stem)
def test_bash_reads_it(script: Path) -> None:
    subprocess.run(["bash", "-n", script], check=True, timeout=60)
    if shutil.which("shellcheck"):
        subprocess.run(["shellcheck", script], check=True, timeout=60)


@pytest.mark.parametrize("script", BATCH, ids=lambda p: p.stem)
def test_its_own_command_parses(script: Path, tmp_path: Path) -> None:
    words = started(script, tmp_path)
    config = parsed(words)
    if script.stem == "cells":
        assert config.shard == "3/8"
    else:
        assert config.resume  # a requeued job goes on


@pytest.mark.parametrize("script", BATCH, ids=lambda p: p.stem)
def test_the_command_in_its_head_parses(script: Path, tmp_path: Path) -> None:
    text = re.sub(r"\\\n#", " ", script.read_text())
    (given,) = re.findall(rf"sbatch .*{script.name}(.*)", text)
    words = started(script, tmp_path, *given.split())
    config = parsed(words)
    assert script.stem != "cells" or (config.experiment, config.robot) == (
        "table1",
        "ant",
    )


@pytest.mark.parametrize("script", BATCH, ids=lambda p: p.stem)
def test_slurm_options_are_written_as_slurm_reads_them(script: Path) -> None:
    """Only lines above the first command count, each ``--name=value`` or a flag."""
    head, rest = script.read_text().split("set -euo", 1)
    assert "#SBATCH" not in rest
    options = re.findall(r"^#SBATCH (.*)$", head, re.M)
    assert len(options) == head.count("#SBATCH")
    assert all(re.fullmatch(r"--[a-z-]+(=\S+)?", o) for o in options)
    assert {"--requeue", "--signal=TERM@120"} <= set(options)


def test_paths_with_blanks_stay_whole(tmp_path: Path) -> None:
    script = ROOT / "scripts" / "slurm" / "one_gpu.sbatch"
    words = started(script, tmp_path, "train.udr", "--out", "my results/udr")
    assert str(parsed(words).out) == "my results/udr"


def test_dockerfile_runs_a_command() -> None:
    text = (ROOT / "scripts" / "Dockerfile").read_text()
    (command,) = re.findall(r"^CMD (.*)$", text, re.M)
    parsed(json.loads(command))
    (extra,) = re.findall(r"-e '\.\[(\w+)\]'", text)
    assert f"\n{extra} = " in (ROOT / "pyproject.toml").read_text()
    (image,) = re.findall(r"^FROM (.*)$", text, re.M)
    assert re.fullmatch(r"python:3\.\d+-slim", image)


@pytest.mark.parametrize("name", ["notebooks", "sweep"])
def test_commands_in_docstrings_parse(name: str) -> None:
    found = list(commands((ROOT / "scripts" / f"{name}.py").read_text()))
    assert found
    for words in found:
        parsed(words)
