"""Runs and rows that are kept out of fits."""

import mujoco
import numpy as np
import pytest

from easi_jax.data.drive_forces import drive_forces
from easi_jax.data.holdout import split_held_out
from easi_jax.errors import UserError
from tests.easi_jax.data.test_cleaning import make_run

SLIDE = mujoco.MjModel.from_xml_string("""
<mujoco>
  <worldbody><body><joint name="x" type="slide"/><geom size="0.1"/></body></worldbody>
  <actuator><position joint="x" kp="10" kv="2"/></actuator>
</mujoco>
""")


def test_forces_are_those_of_the_model():
    run = make_run(np.full(30, 0.2), size=1.0)
    assert drive_forces(SLIDE, run) == pytest.approx(np.full((30, 1), 10 * 0.8))
    moving = make_run(0.03 * np.arange(30), size=1.0)  # 3 m/s
    want = 10 * (1 - moving.qpos) - 2 * 3.0
    assert drive_forces(SLIDE, moving) == pytest.approx(want, abs=1e-6)


def test_whole_runs_are_held_out():
    lengths = enumerate((100, 90, 100, 10))
    runs = [make_run(np.zeros(n), f"r{i}", size=1.0) for i, n in lengths]
    fit, held, name = split_held_out(SLIDE, runs, 0.2)
    assert [r.name for r in held] == ["r1"] == [name]
    assert [r.name for r in fit] == ["r0", "r2", "r3"]
    many = [make_run(np.zeros(50), f"r{i}", size=1.0) for i in range(10)]
    fit, held, _ = split_held_out(SLIDE, many, 0.2)
    assert [r.name for r in held] == ["r7", "r8", "r9"]  # 150 of 500 rows
    assert len(fit) == 7


def test_runs_to_fit_reach_as_far_as_those_held_out():
    sizes = (4.0, 1.0, 3.8, 0.9)
    runs = [make_run(np.zeros(100), f"r{i}", size=c) for i, c in enumerate(sizes)]
    assert split_held_out(SLIDE, runs, 0.2)[2] == "r2"
    longer = [*runs[:2], make_run(np.zeros(300), "r2", size=3.8), runs[3]]
    assert split_held_out(SLIDE, longer, 0.2)[2] == "r0, r3", (
        "a third of the rows, not a half"
    )
    short = [make_run(np.zeros(20), f"s{i}", size=c) for i, c in enumerate(sizes * 3)]
    fit, held, _ = split_held_out(SLIDE, short, 0.2)
    assert len(held) == 3
    top = [max(r.ctrl.max() for r in part) for part in (fit, held)]
    assert top[1] <= top[0] <= 1.1 * top[1]


def test_a_single_run_is_split_behind_a_gap():
    run = make_run(np.arange(100.0))
    (fit,), (held,), name = split_held_out(SLIDE, [run], 0.2)
    assert held.qpos[0, 0] == 70
    assert len(held) == 30
    assert fit.qpos[-1, 0] == 49  # 20 steps before
    assert "30 %" in name
    with pytest.raises(UserError, match="too few"):
        split_held_out(SLIDE, [make_run(np.zeros(30))], 0.3)
