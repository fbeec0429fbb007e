"""The same result on one device and on eight, as `benchmarks.devices` compares them."""

import json
from pathlib import Path

import pytest

from benchmarks.devices import SAME
from tests.processes import Processes

SMALL = ("--robots", "cartpole", "--population", "12", "--generations", "5")


@pytest.mark.slow
def test_eight_devices_and_one(tmp_path: Path) -> None:
    kept = tmp_path / "one.npz"
    for devices, words in (
        (1, ("--save", kept)),
        (8, ("--against", kept, "--folder", tmp_path)),
    ):
        run = Processes(1, "benchmarks.devices", *SMALL, *words, devices=devices)
        ((status, said, error),) = run.ended(600)
        assert status == 0, said + error
    told = json.loads((tmp_path / "devices_1_cpu_8_cpu.json").read_text())
    assert max(max(s.values()) for s in told["positions"]["cartpole"]) < 1e-4
    # Ranks may differ by rounding; the finish ends where data tell no two apart.
    assert max(told["search_apart_std"] + told["refined_apart_std"]) < SAME
    assert min(told["refined_apart_std"]) < 0.1
