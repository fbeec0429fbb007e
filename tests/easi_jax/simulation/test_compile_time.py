"""What is said of the time to compile: from a committed measurement."""

import json
from pathlib import Path

import mujoco
import numpy as np
import pytest
from mujoco.mjx._src.collision_driver import make_condim

from benchmarks.compile_times import arm, body
from benchmarks.parity_models import feature_models
from easi_jax.model.parameters import ParameterSpace
from easi_jax.simulation import engine
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
    sizes = [Size(j, p, o) for j in (1, 3, 6) for p in (0, 4) for o in (0, 3)]
    times = [expected_of(s) for s in sizes]
    np.testing.assert_allclose(fitted(sizes, times), CONSTANTS, rtol=1e-5)


def test_the_constants_are_those_of_the_committed_measurement() -> None:
    told = json.loads(RESULT.read_text())
    assert told["constants"] == pytest.approx(CONSTANTS, rel=0.02, abs=0.01)
    sizes = [Size(**r["size"]) for r in told["rows"]]
    times = [r["seconds"] for r in told["rows"]]
    assert told["constants"] == pytest.approx(fitted(sizes, times), rel=1e-4)
    off = np.array([expected_of(s) for s in sizes]) / times
    assert off.min() > 0.4 and off.max() < 2.5


def test_the_limit_of_auto_parts_what_is_faster_on_mjx() -> None:
    for r in json.loads(RESULT.read_text())["rows"]:
        small = expected_of(Size(**r["size"])) <= engine.LONGEST
        assert r["mujoco"] / r["mjx"] > 3 if small else r["mujoco"] / r["mjx"] < 1.5, r


@pytest.mark.parametrize(
    ("shape", "floor", "on_planes", "others"),
    [
        ("sphere", "plane", 1, 0),
        ("capsule", "plane", 2, 0),
        ("box", "plane", 4, 0),
        ("mesh", "plane", 4, 0),
        ("sphere", "box", 0, 1),
        ("box", "box", 0, 4),
    ],
)
def test_contacts_are_counted_as_mjx_makes_them(
    shape: str, floor: str, on_planes: int, others: int
) -> None:
    m = body("free", shape, floor)
    assert size_of(m) == Size(6, on_planes, others)
    assert make_condim(m).size == on_planes + others
    m.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    assert size_of(m) == Size(6, 0, 0)


def test_auto_goes_by_contacts(monkeypatch: pytest.MonkeyPatch) -> None:
    """One pair of geoms in each; nothing is compiled."""
    assert engine.by_size(body("in a plane", "sphere", "plane"))[0] == "mjx"
    text = feature_models()["contact plane box"]
    box = mujoco.MjModel.from_xml_string(text)
    name, why = engine.by_size(box)
    assert name == "mujoco" and "4 contacts" in why
    assert engine.by_size(body("upright", "box", "box"))[0] == "mujoco"
    monkeypatch.setattr(engine, "on_cpu", lambda: False)
    assert engine.by_size(box)[0] == "mjx"


def test_pairs_that_are_left_out_cost_nothing_and_native_compiles_none() -> None:
    m = arm(2, 3)
    space = ParameterSpace(())
    still = Logged(np.zeros((2, 2)), np.zeros((2, 2)), np.zeros((2, 2)))
    every = Simulator(m, space)
    fewer = Simulator(m, space, logged=still)
    assert size_of(every.base.mjx) == size_of(m) == Size(2, 0, 3)
    assert size_of(fewer.base.mjx) == Size(2, 0, 0)
    assert (expected(fewer) or 0) < (expected(every) or 0)
    assert expected(Simulator(m, space, engine="mujoco")) is None
