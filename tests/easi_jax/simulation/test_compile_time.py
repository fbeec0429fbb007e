"""What is said of the time to compile: from a committed measurement."""

import json
from pathlib import Path

import numpy as np
import pytest

from benchmarks.compile_times import arm
from easi_jax.model.contact_pairs import pair_ids
from easi_jax.model.parameters import ParameterSpace
from easi_jax.simulation.compile_time import (
    CONSTANTS,
    Size,
    expected,
    expected_of,
    fitted,
    size_of,
)
from easi_jax.simulation.logged import Logged
from easi_jax.simulation.simulator import Simulator

RESULT = Path(__file__).parents[3] / "benchmarks" / "results" / "compile_times.json"


def test_the_fit_finds_what_made_the_times() -> None:
    sizes = [Size(j, p) for j in (1, 3, 6) for p in (0, 4)]
    times = [expected_of(s) for s in sizes]
    np.testing.assert_allclose(fitted(sizes, times), CONSTANTS, rtol=1e-6)


def test_the_constants_are_those_of_the_committed_measurement() -> None:
    told = json.loads(RESULT.read_text())
    assert told["constants"] == pytest.approx(CONSTANTS, rel=0.02, abs=0.01)
    rows = told["rows"]
    sizes = [Size(r["joints"], r["pairs"]) for r in rows]
    times = [r["seconds"] for r in rows]
    assert told["constants"] == pytest.approx(fitted(sizes, times))
    off = np.array([expected_of(s) for s in sizes]) / times
    assert off.min() > 0.5 and off.max() < 2


def test_pairs_that_are_left_out_cost_nothing_and_native_compiles_none() -> None:
    m = arm(2, 3)
    space = ParameterSpace(())
    still = Logged(np.zeros((2, 2)), np.zeros((2, 2)), np.zeros((2, 2)))
    every = Simulator(m, space)
    fewer = Simulator(m, space, logged=still)
    assert size_of(every) == Size(2, len(pair_ids(m))) and pair_ids(m)
    assert size_of(fewer) == Size(2, 0)
    assert (expected(fewer) or 0) < (expected(every) or 0)
    assert expected(Simulator(m, space, engine="mujoco")) is None
