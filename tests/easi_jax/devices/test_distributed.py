"""Several processes are one run: same result, one writer, an end for all, resume."""

import json
import shutil
import signal
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from easi_jax.devices import distributed
from easi_jax.devices.distributed import Place, find_place
from easi_jax.errors import UserError
from tests.processes import LIMIT, Processes, own_words

WALK = "tests.easi_jax.devices.distributed_run"
SAME = 1e-6  # relative; sums over devices may round otherwise


def walked(folder: Path, count: int, *words: object, devices: int = 1) -> Any:
    """Result and output of each process of a walk that ends well."""
    ended = Processes(count, WALK, "--out", folder, *words, devices=devices).ended()
    assert [status for status, *_ in ended] == [0] * count, ended
    result = json.loads((folder / "results.json").read_text())
    own = [own_words(out) for _, out, _ in ended]
    return result, [(out, error) for out, (*_, error) in zip(own, ended, strict=True)]


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """One process with two devices."""
    return walked(tmp_path_factory.mktemp("alone") / "run", 1, devices=2)[0]


@pytest.mark.parametrize("count", [2, pytest.param(4, marks=pytest.mark.slow)])
def test_several_processes_give_what_one_gives(
    tmp_path: Path, alone: Any, count: int
) -> None:
    folder = tmp_path / "run"
    result, (first, *others) = walked(folder, count)
    np.testing.assert_allclose(result["points"], alone["points"], rtol=SAME)
    assert result["mean"] == pytest.approx(alone["mean"], rel=SAME)
    np.testing.assert_allclose(result["far"], np.arange(8) + result["mean"], rtol=SAME)
    assert result["again"] == result["far"]
    assert first[0].startswith(f"devices: {count}") and "walk  6/6" in first[1]
    assert all(out == "" and "walk" not in error for out, error in others)
    lines = (folder / "metrics.jsonl").read_text().splitlines()
    assert [json.loads(x)["step"] for x in lines] == [2, 4, 6]
    again = Processes(count, WALK, "--out", folder).ended()
    assert [status for status, *_ in again] == [2] * count
    assert "already holds a run" in again[0][2]
    assert all("error" not in error for _, _, error in again[1:])


@pytest.mark.parametrize("victim", [0, pytest.param(1, marks=pytest.mark.slow)])
@pytest.mark.fault("one of several processes lost")
def test_one_is_killed_all_end_and_resume(
    tmp_path: Path, alone: Any, victim: int
) -> None:
    folder = tmp_path / "run"
    words = (WALK, "--out", folder, "--slow", "2")
    processes = Processes(2, *words)
    checkpoint = folder / "checkpoints" / "walk" / "step_000000000002"
    begin = time.monotonic()
    while not checkpoint.is_dir() and time.monotonic() - begin < LIMIT:
        time.sleep(0.1)
    processes.all[victim].kill()
    status, _, error = processes.ended(60)[1 - victim]
    assert checkpoint.is_dir()
    assert status in (1, -signal.SIGABRT)
    # jax ends a process that has lost the first one, before Python hears of it.
    own = "another process of this run has ended" in error and "--resume" in error
    assert own or "another task died" in error
    assert not (folder / "results.json").exists()
    shutil.copytree(folder, tmp_path / "copy")
    for out, count in ((folder, 2), (tmp_path / "copy", 1)):
        result, said = walked(out, count, "--resume", devices=3 - count)
        np.testing.assert_allclose(result["points"], alone["points"], rtol=SAME)
        assert "note: walk: went on after step" in said[0][0]


GIVEN = {
    "own words": (
        {
            "JAX_COORDINATOR_ADDRESS": "a:1",
            "JAX_NUM_PROCESSES": "3",
            "JAX_PROCESS_ID": "2",
        },
        Place("a:1", 3, 2, None),
    ),
    "Kubernetes": (
        {
            "JAX_COORDINATOR_ADDRESS": "train-0.train",
            "JAX_NUM_PROCESSES": "2",
            "JOB_COMPLETION_INDEX": "1",
        },
        Place("train-0.train:8476", 2, 1, None),
    ),
    "Kubeflow": (
        {"MASTER_ADDR": "m", "MASTER_PORT": "9", "WORLD_SIZE": "2", "RANK": "0"},
        Place("m:9", 2, 0, None),
    ),
    "Slurm, a process a node": (
        {
            "SLURM_STEP_NUM_TASKS": "2",
            "SLURM_PROCID": "1",
            "SLURM_LOCALID": "0",
            "SLURM_STEP_TASKS_PER_NODE": "1(x2)",
            "SLURM_STEP_NODELIST": "gpu[007-009,12]",
            "SLURM_JOB_ID": "4097",
            "CUDA_VISIBLE_DEVICES": "0,1,2,3",
        },
        Place("gpu007:61441", 2, 1, None),
    ),
    "Slurm, a process a GPU": (
        {
            "SLURM_STEP_NUM_TASKS": "8",
            "SLURM_PROCID": "6",
            "SLURM_LOCALID": "2",
            "SLURM_STEP_TASKS_PER_NODE": "4(x2)",
            "SLURM_STEP_NODELIST": "a,b",
            "SLURM_JOB_ID": "1",
            "CUDA_VISIBLE_DEVICES": "0,1,2,3",
        },
        Place("a:61441", 8, 6, (2,)),
    ),
    "Open MPI": (
        {
            "JAX_COORDINATOR_ADDRESS": "h:5",
            "OMPI_COMM_WORLD_SIZE": "2",
            "OMPI_COMM_WORLD_RANK": "1",
            "OMPI_COMM_WORLD_LOCAL_RANK": "1",
            "OMPI_COMM_WORLD_LOCAL_SIZE": "2",
        },
        Place("h:5", 2, 1, (1,)),
    ),
    "one GPU is shown to each": (
        {
            "JAX_COORDINATOR_ADDRESS": "h:5",
            "PMI_SIZE": "2",
            "PMI_RANK": "1",
            "MPI_LOCALRANKID": "1",
            "MPI_LOCALNRANKS": "2",
            "CUDA_VISIBLE_DEVICES": "1",
        },
        Place("h:5", 2, 1, None),
    ),
}


@pytest.mark.parametrize("name", GIVEN)
def test_the_environment_says_where(name: str) -> None:
    env, place = GIVEN[name]
    assert find_place(env) == place


@pytest.mark.parametrize(
    ("env", "said"),
    [
        ({}, "srun or mpirun"),
        # Inside a batch script, outside of srun, there are no other processes.
        ({"SLURM_PROCID": "0", "SLURM_NTASKS": "2"}, "srun or mpirun"),
        ({"PMI_SIZE": "2", "PMI_RANK": "0"}, "JAX_COORDINATOR_ADDRESS"),
        ({"PMI_SIZE": "2", "PMI_RANK": "2"}, "not below"),
        ({"PMI_SIZE": "two", "PMI_RANK": "0"}, "whole number"),
    ],
)
def test_what_is_missing_is_said(env: dict[str, str], said: str) -> None:
    with pytest.raises(UserError, match=said):
        find_place(env)


def test_one_process_is_no_special_case(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("JAX_NUM_PROCESSES", "1")
    monkeypatch.setenv("JAX_PROCESS_ID", "0")
    distributed.start()
    assert distributed.count() == 1 and distributed.leader()
    assert distributed.from_leader(lambda: "value") == "value"
