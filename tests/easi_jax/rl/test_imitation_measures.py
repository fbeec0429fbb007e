"""Measures of imitation against cases whose answer is known."""

import numpy as np
import pytest

from easi_jax.rl.imitation_measures import (
    Classifier,
    confusion_of,
    mutual_information,
    prior_distance,
    skill_entropy,
    told_apart,
)


def test_confusions() -> None:
    same, none = np.diag([20, 20, 20]), np.full((3, 3), 20)
    one = np.array([[20, 0, 0], [20, 0, 0], [20, 0, 0]])
    assert mutual_information(same) == pytest.approx(1.0)
    assert mutual_information(same[[1, 2, 0]]) == pytest.approx(1.0)
    assert mutual_information(none) == pytest.approx(0.0, abs=1e-9)
    assert mutual_information(one) == pytest.approx(0.0, abs=1e-9)
    assert skill_entropy(same) == pytest.approx(0.0, abs=1e-9)
    assert skill_entropy(none) == pytest.approx(np.log(3))
    # Three rows of entropy 0; one column of ln 3 and two that are never said.
    assert skill_entropy(one) == pytest.approx(np.log(3) / 2)
    half = np.array([[10, 10], [0, 20]])
    h = -(0.25 * np.log(0.25) + 0.75 * np.log(0.75))
    joint = -(0.25 * np.log(0.25) * 2 + 0.5 * np.log(0.5))
    want = 2 * (np.log(2) + h - joint) / (np.log(2) + h)
    assert mutual_information(half) == pytest.approx(want)


def test_distance_of_priors() -> None:
    true, found = np.array([0.6, 0.3, 0.1]), np.array([0.1, 0.6, 0.3])
    assert prior_distance(found, true) == pytest.approx(0.5)
    assert prior_distance(found, true, named=False) == pytest.approx(0.0)


def windows(rng: np.random.Generator, mean: float) -> tuple[np.ndarray, np.ndarray]:
    episodes = np.repeat(np.arange(20), 50)
    own = rng.standard_normal((20, 4))[episodes]
    return mean + own + rng.standard_normal((1000, 4)), episodes


def test_sources_are_told_apart_where_they_differ() -> None:
    rng = np.random.default_rng(0)
    (a, i), (b, j) = windows(rng, 0.0), windows(rng, 0.0)
    # Episodes differ from each other: a split by windows would know them again.
    assert told_apart(a, b, i, j) == pytest.approx(0.5, abs=0.15)
    (far, k) = windows(rng, 6.0)
    assert told_apart(a, far, i, k) > 0.98


def test_the_smaller_source_counts_as_much() -> None:
    rng = np.random.default_rng(1)
    a, i = windows(rng, 0.0)
    b, j = windows(rng, 6.0)
    few = j < 2
    assert told_apart(a, b[few], i, j[few]) > 0.95


def test_episodes_are_classified_by_all_their_windows() -> None:
    rng = np.random.default_rng(2)
    x = np.concatenate([rng.standard_normal((500, 3)) + k for k in (0.0, 1.0)])
    classifier = Classifier(x, np.repeat([0, 1], 500), 2, 0)
    episodes = [rng.standard_normal((60, 3)) + k for k in (0.0, 1.0, 1.0)]
    found = confusion_of(classifier, episodes, np.array([0, 1, 0]), 2)
    np.testing.assert_array_equal(found, [[1, 1], [0, 1]])
