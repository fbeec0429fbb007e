"""Runs and rows that are kept out of fits."""

import time

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
    fit, held, _ = split_held_out(SLIDE, short, 0.1)
    assert len(held) == 3
    top = [max(r.ctrl.max() for r in part) for part in (fit, held)]
    assert top[1] <= top[0] <= 1.1 * top[1]


def first_and_last(runs):
    return [(int(r.qpos[0, 0]), int(r.qpos[-1, 0])) for r in runs]


def test_of_a_single_run_blocks_behind_gaps_are_held_out():
    run = make_run(np.arange(1000.0), "arm")
    fit, held, name = split_held_out(SLIDE, [run], 0.2)
    assert first_and_last(held) == [(117, 216), (450, 549), (783, 882)]
    gap = 20  # rows of one horizon before each block
    want = [(0, 116 - gap), (217, 449 - gap), (550, 782 - gap), (883, 999)]
    assert first_and_last(fit) == want
    assert name == "30 % of arm: 1.17 to 2.16 s, 4.50 to 5.49 s, 7.83 to 8.82 s"
    names = [r.name for r in (*fit, *held)]
    assert len(set(names)) == len(names)
    assert "arm, 2.17 to 4.29 s" in names
    assert {r.recording for r in (*fit, *held)} == {"arm"}
    for part in (*fit, *held):  # what was sent before a piece is known
        first = int(part.qpos[0, 0])
        np.testing.assert_array_equal(part.sent_until, run.ctrl[: first + len(part)])


def test_the_parts_of_a_run_do_not_depend_on_the_horizon():
    """What is fitted decides on names, which are those of every horizon."""
    run = make_run(np.arange(1000.0), "arm")
    usual = [first_and_last(part) for part in split_held_out(SLIDE, [run], 0.2)[:2]]
    for horizon in (0.05, 0.5, 0.9):
        fit, held, _ = split_held_out(SLIDE, [run], horizon)
        assert [first_and_last(fit), first_and_last(held)] == usual, horizon
    _, held, _ = split_held_out(SLIDE, [run], 1.2)  # blocks of 1 s are too short
    assert first_and_last(held) == [(700, 999)]
    # Too short for 0.2 s, but not for 0.1 s.
    _, (held,), _ = split_held_out(SLIDE, [make_run(np.arange(60.0))], 0.1)
    assert first_and_last([held]) == [(42, 59)]


def test_blocks_of_a_short_run_are_fewer():
    # A prediction of 20 steps, 5 rows before it, and 20 more for a second one.
    fit, held, _ = split_held_out(SLIDE, [make_run(np.arange(330.0))], 0.2)
    assert len(held) == 2
    assert all(len(r) >= 46 for r in held)
    assert all(len(r) > 25 for r in fit), "each has room for a window"
    (fit,), (held,), _ = split_held_out(SLIDE, [make_run(np.arange(100.0))], 0.2)
    assert first_and_last([fit, held]) == [(0, 49), (70, 99)]


def test_a_run_with_no_room_for_a_prediction_is_refused():
    split_held_out(SLIDE, [make_run(np.zeros(87))], 0.2)
    with pytest.raises(UserError, match="needs 87: record more"):
        split_held_out(SLIDE, [make_run(np.zeros(86))], 0.2)


def test_a_log_in_many_short_runs_says_so():
    runs = [make_run(np.zeros(2), f"r{i}") for i in range(250)]
    with pytest.raises(UserError, match=r"2 rows .* the longest of 250 runs, are too"):
        split_held_out(SLIDE, runs, 0.2)


@pytest.mark.parametrize(
    "rows", [(1990, 9), (10, 1989), (1900, 100), (1985, 15), (800, 200), (950, 30, 20)]
)
def test_pieces_too_short_to_be_held_out_are_fitted(rows: tuple[int, ...]):
    """As a bad row or a hole near one end of a log makes them."""
    runs = [make_run(np.zeros(n), f"r{i}", size=1.0) for i, n in enumerate(rows)]
    fit, held, name = split_held_out(SLIDE, runs, 0.2)
    longest = int(np.argmax(rows))
    assert len(held) == 3 and f" % of r{longest}: " in name
    assert {run.recording for run in held} == {f"r{longest}"}
    assert all(len(run) >= 26 for run in held), "each has room for a prediction"
    usable = sum(n for n in rows if n >= 26)
    assert 0.25 <= sum(map(len, held)) / usable <= 0.35
    others = {f"r{i}" for i in range(len(rows))} - {f"r{longest}"}
    assert others < {run.name for run in fit}


def test_hundreds_of_runs_are_parted_at_once():
    """As holes every few rows make them of one log."""
    sizes = 2.0 + np.sin(np.arange(400))
    runs = [make_run(np.zeros(20), f"r{i}", size=c) for i, c in enumerate(sizes)]
    began = time.perf_counter()
    fit, held, _ = split_held_out(SLIDE, runs, 0.1)
    assert time.perf_counter() - began < 20.0
    assert 100 <= len(held) <= 108 and len(fit) + len(held) == 400
    top = [max(r.ctrl.max() for r in part) for part in (fit, held)]
    assert top == pytest.approx([3.0, 3.0], rel=0.01)
