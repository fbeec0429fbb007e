"""Whether errors stand out of their floor, and what is said then."""

import numpy as np
import pytest

from easi_jax.gap.verdict import openness, surely_better, verdict_of

WINDOWS, SCALE = 80, np.array([1.0, 1.0, np.inf])
FLOOR = np.array([1e-4, 1e-6, 1e-4])


def errors(*times: float, seed: int = 0) -> np.ndarray:
    """Mean squares of windows, ``times`` the floor's root."""
    drawn = np.random.default_rng(seed).chisquare(20, (WINDOWS, 3)) / 20
    return drawn * FLOOR * np.square(times)


def test_a_small_channel_does_not_hide_behind_a_noisy_one() -> None:
    found = openness(errors(1.0, 3.0, 9.0), FLOOR, SCALE)
    assert found.is_open.tolist() == [False, True, False, False]
    assert found.ratio[:3] == pytest.approx([1.0, 3.0, 9.0], rel=0.05)
    assert not found.judged[2] and found.low[2] > 8, "left out, but it has its figures"


def test_a_perfect_model_of_many_channels_does_not_fail() -> None:
    wrong = 0
    for seed in range(40):
        square = np.random.default_rng(seed).chisquare(20, (WINDOWS, 30)) / 20
        wrong += openness(square, np.ones(30), np.ones(30)).is_open.any()
    assert wrong == 0


def test_what_few_data_leave_undecided() -> None:
    found = openness(errors(1.25, 1.0, 1.0)[:12], FLOOR, SCALE)
    assert not found.is_open[0] and found.undecided[0]
    assert not found.undecided[2]


@pytest.mark.parametrize(
    ("refit", "after", "found", "verdict"),
    [
        (3.0, 1.0, True, "explained"),
        (3.0, 2.0, True, "unexplained"),
        (3.0, 3.0, False, "unexplained"),
        (1.0, 1.0, False, "no_gap"),
    ],
)
def test_verdicts(refit: float, after: float, found: bool, verdict: str) -> None:
    both = (openness(errors(x, 1.0, 1.0), FLOOR, SCALE) for x in (refit, after))
    assert verdict_of(found, *both) == verdict


def test_better_by_more_than_chance() -> None:
    before = errors(1.5, 1.0, 1.0)
    assert surely_better(errors(1.0, 1.0, 1.0), before, SCALE)
    chance = []
    for k in range(40):
        first, second = (errors(1.5, 1.0, 1.0, seed=s) for s in (k, 100 + k))
        chance.append(surely_better(first, second, SCALE))
    assert np.mean(chance) <= 0.15, "of noise alone one in twenty"
