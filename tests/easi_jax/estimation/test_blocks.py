"""How far an estimate scatters between blocks of the data."""

import jax.numpy as jnp
import numpy as np
import pytest

from easi_jax.estimation.blocks import enough, scattered, too_few

PIECES, SIZE = 400, np.array([3.0, 40.0, 900.0])


def score(alike: float, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Information, and gradients whose neighbours are correlated by ``alike``, each
    with the covariance that the information gives a piece."""
    rng = np.random.default_rng(seed)
    mix = np.array([[1.0, 0.6, 0.0], [0.0, 1.0, 0.3], [0.0, 0.0, 1.0]])
    noise = rng.normal(size=(PIECES, 3))
    for k in range(1, PIECES):
        noise[k] = alike * noise[k - 1] + np.sqrt(1 - alike**2) * noise[k]
    gradients = noise @ mix * SIZE
    return PIECES * (mix * SIZE).T @ (mix * SIZE), gradients


def left(alike: float, seed: int) -> np.ndarray:
    """Variances with the scatter of blocks over those without."""
    info, gradients = score(alike, seed)
    found = scattered(*(jnp.asarray(x) for x in (info, info, gradients)))
    np.testing.assert_allclose(found, found.T, rtol=1e-4)
    variances = [np.diag(np.linalg.inv(np.asarray(x, float))) for x in (found, info)]
    return variances[0] / variances[1]


def test_a_right_model_keeps_what_it_knows() -> None:
    """Nearly: one direction in twenty seems to scatter more by chance."""
    ratios = np.array([left(0.0, seed) for seed in range(60)])
    assert (ratios > 1 - 1e-3).all()
    assert ratios.mean() < 1.08


@pytest.mark.parametrize("alike", [0.5, 0.8, 0.9])
def test_errors_that_hang_together_count_as_fewer(alike: float) -> None:
    """By the share that is known of such a series: (1 + a) / (1 - a)."""
    ratios = np.array([left(alike, seed) for seed in range(60)])
    assert np.median(ratios) == pytest.approx((1 + alike) / (1 - alike), rel=0.25)


def test_weak_directions_are_not_known_by_rounding() -> None:
    """Parameters of very different sizes, two of them nearly alike."""
    rng = np.random.default_rng(5)
    mix = np.array([[1.0, 0.999, 0.5], [0.0, 0.05, 0.3], [0.0, 0.0, 0.5]])
    root = mix * np.array([1.0, 3e2, 3e4])
    noise = rng.normal(size=(PIECES, 3))
    for k in range(1, PIECES):  # the last direction hangs together
        noise[k, 2] = 0.9 * noise[k - 1, 2] + 0.4 * noise[k, 2]
    info = PIECES * root.T @ root
    given = (jnp.asarray(x, jnp.float32) for x in (info, info, noise @ root))
    found = np.asarray(scattered(*given), float)
    before, after = (np.sqrt(np.diag(np.linalg.inv(x))) for x in (info, found))
    assert (after > 0.98 * before).all() and after[2] > 1.5 * before[2]


def test_no_slope_at_the_fit_is_not_told_by_others() -> None:
    """Of a parameter far down its logarithm, whose information is that at the low end
    of its range."""
    info, gradients = score(0.8, 3)
    flat = np.array([1e-4, 1.0, 1.0])
    given = info, info * np.outer(flat, flat), gradients * flat
    found = np.asarray(scattered(*(jnp.asarray(x, jnp.float32) for x in given)), float)
    size = np.sqrt(np.diag(info))
    lost = np.linalg.eigvalsh((info - found) / np.outer(size, size))
    assert lost.min() > -1e-5, "information is never more than it was"
    assert found[0, 0] == pytest.approx(info[0, 0], rel=0.5)
    assert found[2, 2] < 0.5 * info[2, 2]


def test_few_pieces_are_left_as_they_are() -> None:
    info, gradients = (jnp.asarray(x) for x in score(0.8, 0))
    assert enough(PIECES) and not enough(79)
    (note,) = too_few(79, "pieces")
    assert note.startswith("spreads are those of the noise model: 79 pieces make fewer")
    assert too_few(80, "pieces") == []
    np.testing.assert_array_equal(scattered(info, info, gradients[:79]), info)
    np.testing.assert_array_equal(scattered(info, info, gradients[:0]), info)
