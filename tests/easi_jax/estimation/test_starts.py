"""Starts that are fitted with a model's own dynamics: a linear one, known exactly."""

from dataclasses import replace

import numpy as np
import pytest

from easi_jax.estimation.prediction_error import believed
from easi_jax.estimation.starts import Starts, floor
from easi_jax.gap.whitening import make_residuals

W, T, ROWS, DT = 400, 31, 11, 0.01
NOISE = np.array([2e-3])


def path(start: np.ndarray) -> np.ndarray:
    """A falling mass from ``start (..., 2)``, ``(..., T, 1)``."""
    t = DT * np.arange(T)
    return (start[..., :1] + start[..., 1:] * t - 0.5 * 9.81 * t**2)[..., None]


def made(seed: int, pull: float = 0.0, step: float = 0.0) -> tuple[Starts, np.ndarray]:
    """Starts of windows read with noise; ``pull`` is what the model lacks [m/s2]."""
    rng = np.random.default_rng(seed)
    true = rng.normal(size=(W, 2))
    t = DT * np.arange(T)[:, None]
    read = path(true) + 0.5 * pull * t**2 + NOISE * rng.normal(size=(W, T, 1))
    if step:
        read = np.round(read / step) * step
    guess = np.stack([read[:, 0, 0], np.zeros(W)], 1)

    def simulate(x: np.ndarray, moved: np.ndarray) -> np.ndarray:
        return path(guess + moved) - read

    spread = np.array([0.1, 3.0])
    starts = Starts(
        simulate, NOISE, spread, ROWS, 1e-3 * spread, 0.1 * spread, 0.1 * spread
    )
    return starts, true - guess


def fitted(starts: Starts) -> tuple[np.ndarray, np.ndarray]:
    x = np.zeros(1)
    starts.linearize(x, np.zeros((W, 2)))
    moved, errors = starts.fit(x[None], np.zeros((1, W, 2)))
    return moved[0], errors[0]


def test_starts_are_those_of_least_squares() -> None:
    starts, off = made(0)
    moved, _ = fitted(starts)
    t = DT * np.arange(ROWS)
    design = np.stack([np.ones(ROWS), t], 1)
    std = NOISE * np.sqrt(np.diag(np.linalg.inv(design.T @ design)))
    np.testing.assert_allclose((moved - off).std(0), std, rtol=0.1)
    assert np.abs((moved - off).mean(0) / std).max() < 3 / np.sqrt(W)


@pytest.mark.parametrize("step", [0.0, 8e-3])
def test_a_perfect_model_leaves_its_floor(step: float) -> None:
    starts, _ = made(1, step=step)
    starts.noise = np.hypot(NOISE, step / np.sqrt(12.0))
    moved, errors = fitted(starts)
    got = (errors[:, ROWS:] ** 2).mean()
    rng = np.random.default_rng(0)
    drawn = floor(starts, np.zeros(1), moved, 20, np.array([step]), rng)
    assert np.sqrt(got / drawn[:, ROWS:].mean()) == pytest.approx(1.0, abs=0.06)
    if not step:
        due = starts.expected()
        np.testing.assert_allclose(drawn.mean(0), due.mean(0), rtol=0.1)


def test_starts_are_the_same_where_first_rows_are_simulated_alone() -> None:
    """From far off, and with noise that is not that of the readings."""
    whole, _ = made(8, pull=1.0)
    alone, x, far = made(8, pull=1.0)[0], np.zeros(1), np.full((W, 2), 0.05)
    counts = []

    def begins(x: np.ndarray, moved: np.ndarray) -> np.ndarray:
        return whole.simulate(x, moved)[:, :, :ROWS]

    def counted(x: np.ndarray, moved: np.ndarray) -> np.ndarray:
        counts.append(len(x))
        return whole.simulate(x, moved)

    alone.begins, alone.simulate = begins, counted
    given, wanted = (s.solve(x, far) for s in (alone, whole))
    assert counts == [5]  # errors and slopes of the end
    for got, due in zip(given, wanted, strict=True):
        np.testing.assert_allclose(got, due, atol=1e-3 * NOISE[0])
    np.testing.assert_allclose(alone.slope, whole.slope, atol=1e-9)
    readings = NOISE * np.random.default_rng(0).normal(size=(3, W, T, 1))
    begin = np.repeat(given[0][None], 3, 0)
    given, wanted = (s.fit(np.zeros((3, 1)), begin, readings) for s in (alone, whole))
    assert counts == [5, 3]
    for got, due in zip(given, wanted, strict=True):
        np.testing.assert_allclose(got, due, atol=1e-9)


def test_what_a_model_lacks_is_not_hidden_and_enters_no_floor() -> None:
    starts, _ = made(2, pull=2.0)
    moved, errors = fitted(starts)
    got = np.sqrt((errors[:, ROWS:] ** 2).mean())
    drawn = floor(starts, np.zeros(1), moved, 20, np.zeros(1), np.random.default_rng(0))
    assert got > 5 * np.sqrt(drawn[:, ROWS:].mean())


def test_a_start_as_read_counts_its_row_once() -> None:
    """A right model whose windows begin where their first rows say."""
    rng = np.random.default_rng(12)
    true = rng.normal(size=(W, 2))
    read = path(true) + NOISE * rng.normal(size=(W, T, 1))
    known = np.array([NOISE[0], 0.05])
    guess = true + known * rng.normal(size=true.shape)
    guess[:, 0] = read[:, 0, 0]
    starts = Starts(
        lambda x, moved: path(guess + moved) - read,
        *(NOISE, 30 * known, ROWS, 0.1 * known, known, known),
    )
    errors = starts.linearize(np.zeros(1), np.zeros((W, 2)))
    found = make_residuals(starts.as_read(1), 5, np.full(1, 1e-9), np.ones(1))
    white = found.whitened(found.grouped(errors[None]))[0]
    some = found.live.all(0)
    assert np.square(white[:, some]).mean() == pytest.approx(1.0, abs=0.03)
    assert np.abs(np.square(white[:, some]).mean(0) - 1).max() < 0.35
    expected = float(np.sqrt(found.floor.mean()))
    assert found.gap(white) == pytest.approx(expected, rel=0.05)


def test_noise_is_read_off_the_first_rows() -> None:
    starts, _ = made(3)
    starts.noise = 3 * NOISE
    _, errors = fitted(starts)
    np.testing.assert_allclose(starts.measured_noise(errors), NOISE, rtol=0.05)


def test_noise_of_what_does_not_move_stays_above_zero() -> None:
    starts, _ = made(3)
    _, errors = fitted(starts)
    told = believed(starts.measured_noise(0.0 * errors), NOISE)
    assert 0 < told[0] < NOISE[0]
    # A model that errs makes no noise of it.
    assert believed(starts.measured_noise(5.0 * errors), NOISE) == NOISE


def test_what_small_errors_become() -> None:
    starts, _ = made(4)
    _, errors = fitted(starts)
    more = np.full((W, T, 1), 0.3)  # as if all were read 0.3 m too low
    np.testing.assert_allclose(starts.left(more), 0.0, atol=2e-3)
    np.testing.assert_allclose(starts.left(errors), errors, atol=0.03 * NOISE[0])


def test_separate_parts_are_moved_at_once() -> None:
    """Two masses that have nothing to do with each other: positions, then speeds."""
    asked = []

    def simulate(x: np.ndarray, moved: np.ndarray) -> np.ndarray:
        asked.append(len(x))
        return np.concatenate(
            [path(moved[..., i::2] * [1.0, i + 1]) for i in (0, 1)], -1
        )

    step = np.array([1e-3, 1e-3, 1e-2, 1e-2])
    noise, wide, still = np.repeat(NOISE, 2), np.ones(4), np.zeros((W, 4))
    given = simulate, noise, wide, ROWS, step, wide, wide
    alone, at_once = Starts(*given), Starts(*given, parts=np.array([0, 1, 0, 1]))
    for starts in (alone, at_once):
        starts.linearize(np.zeros(1), still)
    assert asked == [9, 5]
    np.testing.assert_allclose(at_once.slope, alone.slope, atol=1e-12)
    assert at_once.bent == pytest.approx(alone.bent, abs=1e-9)


def test_a_channel_without_readings_has_no_say() -> None:
    starts, _ = made(5)
    both = Starts(
        lambda x, moved: np.concatenate([starts.simulate(x, moved)] * 2, -1),
        np.array([NOISE[0], np.inf]),
        starts.spread,
        ROWS,
        starts.step,
        starts.known,
        starts.scatter,
    )
    alone, _ = fitted(starts)
    beside, errors = fitted(both)
    np.testing.assert_allclose(beside, alone, atol=1e-9)
    assert np.isinf(both.measured_noise(errors)[1])


def test_rows_without_a_reading_have_no_say() -> None:
    """A channel of which three rows of four were not read beside one that was read in
    all: starts, noise, floor and what fits compare are those of readings."""
    rng = np.random.default_rng(7)
    read = np.ones((W, T, 2))
    read[..., 1] = rng.uniform(size=(W, T)) < 0.25
    one, off = made(5)
    more = NOISE * rng.normal(size=(W, T, 1))

    def simulate(x: np.ndarray, moved: np.ndarray) -> np.ndarray:
        other = path(moved - off) - path(np.zeros(2)) - more
        return np.concatenate([one.simulate(x, moved), other], -1) * read

    noise = np.repeat(NOISE, 2)
    both = replace(one, simulate=simulate, noise=noise, read=read)
    _, errors = fitted(both)
    moved = both.solve(np.zeros(1), np.zeros((W, 2)))[0]
    np.testing.assert_allclose(both.share(ROWS), [1.0, 0.25], rtol=0.05)
    np.testing.assert_allclose(both.measured_noise(errors), noise, rtol=0.08)
    drawn = floor(both, np.zeros(1), moved, 20, np.zeros(2), np.random.default_rng(0))
    assert not drawn[read == 0].any()
    got = (both.counted(errors, ROWS) ** 2).mean((0, 1))
    due = drawn[:, ROWS:].mean((0, 1)) / both.share(ROWS)
    np.testing.assert_allclose(got / due, 1.0, atol=0.08)
    np.testing.assert_allclose(got[0], got[1], rtol=0.1)
    np.testing.assert_allclose(drawn.mean(0), both.expected().mean(0), rtol=0.15)
    whitening = make_residuals(both, 0, np.full(2, 1e-9), np.ones(2))
    grouped = whitening.grouped(errors[None])
    plain = whitening.whitened(grouped)[0]
    filled = whitening.grouped(read[None])[0].reshape(W, -1) > 0
    assert not plain[~filled].any()
    numbers = filled.sum(1).mean() - 2  # fitted, position and speed
    assert (plain**2).sum(1).mean() == pytest.approx(numbers, rel=0.03)
    expected = np.sqrt(whitening.floor.mean())
    assert whitening.gap(plain) == pytest.approx(expected, rel=0.05)


def test_what_is_not_linear_is_told() -> None:
    """Errors that jump with the start, as where a foot sticks or slips."""
    starts, _ = made(7)
    x, still, smooth = np.zeros(1), np.zeros((W, 2)), starts.simulate
    starts.linearize(x, still)
    assert starts.bent < 1e-3

    def sticking(x: np.ndarray, moved: np.ndarray) -> np.ndarray:
        return smooth(x, moved * (moved > 0))

    starts.simulate = sticking
    starts.linearize(x, still)
    assert starts.bent == pytest.approx(1.0, abs=0.01)
    assert (starts.as_read(1).spread < starts.spread).all()


def test_what_is_not_finite_keeps_its_start() -> None:
    starts, _ = made(6)
    plain = starts.simulate

    def blown(x: np.ndarray, moved: np.ndarray) -> np.ndarray:
        out = plain(x, moved)
        out[:, 3, 20:] = np.nan
        return out

    starts.simulate = blown
    moved, _ = fitted(starts)
    assert np.isfinite(moved).all() and not moved[3].any()


def test_a_start_from_which_a_window_blows_up_later_is_taken_back() -> None:
    """Of which the rows that are simulated alone know nothing."""
    starts, _ = made(6)
    plain, x, still = starts.simulate, np.zeros(1), np.zeros((W, 2))

    def blown(x: np.ndarray, moved: np.ndarray) -> np.ndarray:
        out, far = plain(x, moved), np.abs(moved).max(-1) > 1.0
        out[:, :, 20:] = np.where(far[..., None, None], np.nan, out[:, :, 20:])
        return out

    starts.simulate = blown
    starts.begins = lambda x, moved: plain(x, moved)[:, :, :ROWS]
    moved, errors = starts.solve(x, still)
    assert np.isfinite(errors).all()
    kept = ~moved.any(1)
    assert 0.1 < kept.mean() < 0.7, "speeds beyond 1 m/s"
    moved, errors = starts.fit(x[None], still[None])
    assert np.isfinite(errors).all() and (~moved.any(2) == kept).mean() > 0.95


def test_the_floor_meets_the_wrong_minima_that_readings_lead_to() -> None:
    """A perfect model whose motion bends at its start, as where a foot touches."""
    rng, t = np.random.default_rng(11), DT * np.arange(T)[:, None]

    def bent(start: np.ndarray) -> np.ndarray:
        return np.abs(start[..., :1, None] + start[..., 1:, None] * t)

    true = np.stack([rng.uniform(0.0, 0.02, W), 0.3 * rng.normal(size=W)], 1)
    read = bent(true) + NOISE * rng.normal(size=(W, T, 1))
    near = np.array([NOISE[0], 0.05])
    guess = true + near * rng.normal(size=true.shape)
    wide = np.array([0.06, 1.0])
    starts = Starts(
        lambda x, moved: bent(guess + moved) - read,
        *(NOISE, wide, ROWS, 0.01 * wide, near, near),
    )
    moved, errors = starts.solve(np.zeros(1), np.zeros((W, 2)))
    got = (errors[:, ROWS:] ** 2).mean()
    drawn = floor(starts, np.zeros(1), moved, 20, np.zeros(1), np.random.default_rng(0))
    assert np.sqrt(got / drawn[:, ROWS:].mean()) == pytest.approx(1.0, abs=0.12)


def test_a_start_in_the_minimum_of_another_model_is_left() -> None:
    """Of a mirrored path, whose other branch an earlier model's start is on."""
    rng, t = np.random.default_rng(3), DT * np.arange(T)[:, None]

    def mirrored(start: np.ndarray) -> np.ndarray:
        q = start[..., :1, None] + start[..., 1:, None] * t
        return np.abs(q) + 0.02 * q

    true = np.stack([rng.uniform(0.2, 0.4, W), rng.uniform(0.0, 0.5, W)], 1)
    read = mirrored(true) + NOISE * rng.normal(size=(W, T, 1))
    guess = true + np.array([2e-3, 0.05]) * rng.normal(size=true.shape)
    wide = np.array([1.0, 1.0])
    starts = Starts(
        lambda x, moved: mirrored(guess + moved) - read,
        *(NOISE, wide, ROWS, 1e-3 * wide, 0.1 * wide, 0.1 * wide),
    )
    x, other = np.zeros(1), -2.0 * guess
    other[::2] = 0.01  # near enough, and kept
    moved, errors = starts.solve(x, other)
    right = (np.abs(guess + moved - true) < 0.1).all(1)
    assert right.mean() > 0.98
    near = errors[right, :ROWS]
    assert np.sqrt((near**2).mean()) == pytest.approx(NOISE[0], rel=0.15)
    (stuck,), _ = starts.fit(x[None], other[None])
    assert ((guess + stuck)[1::2, 0] < 0).all()
