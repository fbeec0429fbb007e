"""How a fit ended: a result with a reason, never a number that is none."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from easi_jax.data.segments import Segments
from easi_jax.errors import UserError
from easi_jax.estimation.contradictions import (
    Recording,
    alone,
    compared,
    contradiction,
    worst,
)
from easi_jax.estimation.from_runs import _Finish, _most_steps
from easi_jax.estimation.identifiability import seed_result
from easi_jax.estimation.posterior import diverged, sound
from easi_jax.model.parameters import Parameter, ParameterSpace

NAMES = ("kp", "kv")
SPACE = ParameterSpace(
    tuple(
        Parameter(n, (f"actuator.a.{n}",), 1.0, (0.5, 2.0), (0.01, 100.0))
        for n in NAMES
    )
)
SURE = np.diag([1e4, 1e4])
NONE: Any = None
RECORDING = Recording("a.csv", NONE)


def found(mean: Any = (0.5, 0.5), **changes: Any) -> Any:
    given: dict[str, Any] = {
        "distribution": SimpleNamespace(mean=np.array(mean), factor=0.01 * np.eye(2)),
        "cost": np.ones(3),
        "hessian": SURE,
        "fit": np.array(mean),
        "excess": np.zeros(()),
    }
    return SimpleNamespace(**{**given, **changes})


@pytest.mark.parametrize(
    ("mean", "hessian", "outcome", "reason"),
    [
        ((0.5, 0.5), SURE, "converged", ""),
        ((float(SPACE.unit_bounds[1][0]), 0.5), SURE, "at bound", "kp: wider bounds"),
        ((0.5, 0.5), 0 * SURE, "not determined", "none of kp, kv"),
    ],
)
def test_each_seed_says_how_its_fit_ended(
    mean: Any, hessian: np.ndarray, outcome: str, reason: str
) -> None:
    result = seed_result(SPACE, np.array(mean), 1e-4 * np.eye(2), hessian)
    assert result.outcome == outcome and reason in result.reason
    at_bound = [w == "at bound" for w in result.flags]
    assert at_bound == [outcome == "at bound", False]


def test_a_fit_at_a_bound_is_one_though_its_mean_is_not() -> None:
    """The initial range draws the mean inside."""
    top = float(SPACE.unit_bounds[1][0])
    given = np.array([0.9 * top, 0.5]), np.diag([(0.2 * top) ** 2, 1e-4])
    at = np.array([top, 0.5])
    result = seed_result(SPACE, *given, SURE, at)
    assert result.outcome == "at bound" and result.flags[0] == "at bound"
    # What no data hold back may be anywhere.
    loose = np.diag([0.0, 1e4])
    assert seed_result(SPACE, *given, loose, at).flags[0] == "not determined"
    # A logarithm far below its range is as good as zero, which is no bound.
    zero = np.array([float(SPACE.unit_bounds[0][0]), 0.5])
    low = seed_result(SPACE, np.array([0.0, 0.5]), 1e-4 * np.eye(2), SURE, zero)
    assert low.outcome == "converged"
    # What is stated lies within the bounds.
    below, above = result.interval_68[0]
    assert 0.01 <= below < above == pytest.approx(100.0)


def test_runs_shorter_than_a_piece_do_not_vanish() -> None:
    """Of 49 runs of 0.3 s and one of 6 s, pieces are as long as the most are."""
    assert _most_steps([150] * 49 + [3000], 20) == 149
    assert _most_steps([30, 5000], 20) == 4999, "a tenth of the rows at most is lost"
    assert _most_steps([15] * 10, 20) == 14


def test_a_seed_that_diverged_has_a_reason_and_no_number() -> None:
    lost = found((0.5, np.nan))
    exploded = found(cost=np.full(3, np.inf))
    assert not diverged(found(), NAMES)
    assert diverged(lost, NAMES).endswith("not finite for kv")
    assert "stays finite" in diverged(exploded, NAMES)
    assert "not finite" in diverged(found(hessian=np.nan * SURE), NAMES)
    good, why = sound((3, 7), (lost, found()), NAMES)
    assert list(good) == [7] and list(why) == [3]
    with pytest.raises(UserError, match=r"the fit diverged \(seed 3: .*kv"):
        sound((3, 7), (lost, exploded), NAMES)


def test_a_run_that_leads_elsewhere_is_named() -> None:
    everything = found()
    assert not contradiction(SPACE, RECORDING, found((0.505, 0.5)), everything)
    (line,) = contradiction(SPACE, RECORDING, found((0.7, 0.5)), everything)
    assert line.startswith("a.csv contradicts the other runs: alone it says kp 1.32")
    held = Recording("a.csv", NONE, held=True)
    (line,) = contradiction(SPACE, held, found((0.7, 0.5)), everything)
    assert "those that were fitted 1" in line
    # Not where the run determines nothing, or its fit is none.
    assert not contradiction(
        SPACE, RECORDING, found((0.7, 0.5), hessian=0 * SURE), everything
    )
    assert not contradiction(SPACE, RECORDING, found((np.nan, 0.5)), everything)


def test_of_many_runs_those_that_fit_worst_are_looked_at() -> None:
    names = [f"run{k}.csv" for k in range(12)]
    owner, weight = np.repeat(names, 5), np.ones(60)
    weight[50:55] = 0.2
    looked = worst(owner, weight)
    assert len(looked) == 8 and looked[-1] == "run10.csv"
    assert worst(owner[:10], weight[:10]) == names[:2]


def test_a_run_by_itself_has_its_pieces_and_no_others() -> None:
    rows = np.arange(6.0)
    steps = np.broadcast_to(rows[:, None, None], (6, 4, 1))
    pieces = Segments(
        *(rows[:, None], rows[:, None], steps, steps, steps, 0.5 * np.ones(6))
    )
    some = alone(pieces, np.array([0, 0, 1, 1, 0, 0], bool), 3)
    assert some.count == 3 and some.weight.tolist() == [0.5, 0.5, 0.0]
    assert some.qpos[:2, 0].tolist() == [2.0, 3.0]


def test_what_is_held_out_is_compared_as_well() -> None:
    """Also with a single recording that is fitted, which is then what all say."""
    rows = np.arange(6.0)
    steps = np.broadcast_to(rows[:, None, None], (6, 4, 1))
    whole = Segments(
        *(rows[:, None], rows[:, None], steps, steps, steps, 0.5 * np.ones(6))
    )
    apart = [Recording("b", whole.take(slice(4)), held=True)]
    one, two = np.repeat("a", 6), np.repeat(["a", "c"], 3)
    (only,) = compared(whole, one, np.ones(6), apart, few=False)
    assert only.name == "b" and only.pieces.count == 6, "a program is of one size"
    assert only.pieces.weight.tolist() == [0.5] * 4 + [0.0] * 2
    assert not list(compared(whole, one, np.ones(6), [], few=False))
    found = list(compared(whole, two, np.ones(6), apart, few=True))
    assert [r.name for r in found] == ["a", "c", "b"]
    assert [r.pieces.count for r in found] == [4, 4, 4]
    long = Recording("long", whole.take(np.arange(24) % 6), held=True)
    (some,) = compared(whole, one, np.ones(6), [long], few=True)
    assert some.pieces.count == 6 and some.pieces.qpos[-1, 0] == 5.0


def test_a_pass_more_is_made_where_readings_count_otherwise() -> None:
    finish: Any = object.__new__(_Finish)
    before = np.ones((4, 5, 3)) * [1.0, 100.0, 0.0]
    assert finish.alike(before, 1.05 * before)
    for channel, by in ((0, 1.2), (1, 0.8)):
        one = np.where(np.arange(3) == channel, by, 1.0)
        assert not finish.alike(before, before * one)
    # What sensors read counts nothing at first.
    assert not finish.alike(before, before + np.array([0, 0, 1]))
