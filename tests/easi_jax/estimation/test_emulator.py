"""Parameters by a linear emulator: a known truth, and how sure it says it is."""

from types import SimpleNamespace
from typing import Any, cast

import jax
import numpy as np

from easi_jax.estimation.emulator import matched, one_row_errors
from easi_jax.search.unpaired import MEMORY, Pieces, Simulations

ROWS, SETTLED, DT = 150, 200, 0.05


class Springs:
    """Stands for simulations: a driven mass on a spring, of which nobody sees the
    speed; stiffness and damping are searched, a third number does nothing."""

    size = 128
    search = SimpleNamespace(
        space=SimpleNamespace(unit_bounds=(np.full(3, -5.0), np.full(3, 5.0)))
    )

    def __init__(self, noise: float = 0.002) -> None:
        self.noise = noise

    def __call__(self, unit: np.ndarray, key: jax.Array) -> tuple[Pieces, np.ndarray]:
        data = np.asarray(jax.random.key_data(key)).ravel()
        rng = np.random.default_rng(data.tolist())
        return self.read(unit, rng, ROWS), np.ones(len(unit), bool)

    def read(self, unit: np.ndarray, rng: np.random.Generator, rows: int) -> Pieces:
        stiffness, damping = 9.0 * 4.0 ** (unit[:, :2] - 0.5).T * [[1.0], [0.15]]
        x, v = 0.1 * rng.standard_normal((2, len(unit)))
        seen, sent = [], []
        for k in range(SETTLED + rows):
            u = np.sin(1.7 * DT * k + 3 * rng.random(len(unit)))
            u += 0.5 * np.sign(rng.standard_normal(len(unit)))
            seen.append(x + self.noise * rng.standard_normal(len(unit)))
            sent.append(u)
            for _ in range(5):
                v = v + DT / 5 * (u - stiffness * x - damping * v)
                x = x + DT / 5 * v
        y, u = (np.array(z)[SETTLED:].T[..., None] for z in (seen, sent))
        count = rows - MEMORY - 1
        past = [z[:, k : k + count] for k in range(MEMORY + 1) for z in (y, u)]
        change = y[:, MEMORY + 1 :] - y[:, MEMORY:-1]
        return Pieces(np.concatenate(past, -1), change, np.ones((len(unit), count)))


def log_of(truth: np.ndarray, seed: int, rows: int = 600) -> Pieces:
    rng = np.random.default_rng([7, seed])
    p = Springs().read(truth[None], rng, rows)
    return Pieces(p.before[0], p.change[0], p.weight[0])


def fit(truth: np.ndarray, seed: int) -> Any:
    start = np.array([0.5, 0.5, 0.5])
    springs = cast(Simulations, Springs())
    return matched(springs, log_of(truth, seed), start, jax.random.key(seed))


def test_a_truth_is_found_and_the_spread_holds() -> None:
    """Ten truths, anywhere in the initial range: errors in units of what is stated."""
    off, size = [], []
    for seed in range(10):
        truth = np.random.default_rng(seed).uniform(0.05, 0.95, 3)
        found = fit(truth, seed)
        std = np.sqrt(np.diag(found.cov))
        off.append((found.mean - truth)[:2] / std[:2])
        size.append(np.abs(found.mean - truth)[:2])
        assert 0.8 < found.excess < 1.25 and found.lost == 0
        # What leaves no trace keeps the initial range.
        assert std[2] > 0.2 and abs(found.mean[2] - 0.5) < 2.5 * std[2]
    assert np.median(size) < 0.03
    inside = np.mean(np.abs(off) < 1.645)
    assert inside >= 0.75, off
    assert np.abs(np.mean(off)) < 0.7, off


def test_from_the_wrong_end_of_the_range() -> None:
    truth = np.array([0.9, 0.1, 0.5])
    springs, start = cast(Simulations, Springs()), np.array([0.0, 1.0, 0.5])
    found = matched(springs, log_of(truth, 3), start, jax.random.key(0))
    std = np.sqrt(np.diag(found.cov))[:2]
    assert (np.abs(found.mean - truth)[:2] < 3 * std).all() and (std < 0.2).all()


def test_the_same_key_gives_the_same_fit() -> None:
    truth = np.array([0.4, 0.6, 0.5])
    one, other = fit(truth, 4), fit(truth, 4)
    np.testing.assert_array_equal(one.mean, other.mean)
    np.testing.assert_array_equal(one.cov, other.cov)


def test_errors_of_the_next_row_are_least_at_the_truth() -> None:
    truth, springs = np.array([0.3, 0.8, 0.5]), cast(Simulations, Springs())
    held, key = log_of(truth, 5), jax.random.key(2)
    (right, floor), (wrong, _) = (
        one_row_errors(springs, unit, held, key) for unit in (truth, np.full(3, 0.5))
    )
    assert abs(right[0] / floor[0] - 1) < 0.1
    assert wrong[0] > 1.02 * right[0]


def test_no_individual_on_its_feet_is_no_number() -> None:
    class Falls(Springs):
        def __call__(self, unit: np.ndarray, key: Any) -> tuple[Pieces, np.ndarray]:
            return super().__call__(unit, key)[0], np.zeros(len(unit), bool)

    falls, log = cast(Simulations, Falls()), log_of(np.full(3, 0.5), 0)
    found = matched(falls, log, np.full(3, 0.5), jax.random.key(0))
    assert np.isnan(found.mean).all() and found.lost > 0
    errors = one_row_errors(falls, np.full(3, 0.5), log, jax.random.key(0))
    assert np.isnan(errors).all()


class TwoReadings(Springs):
    """The mass is read by two sensors; one of them is scaled by ``gain``."""

    def __init__(self, gain: float = 1.0) -> None:
        super().__init__()
        self.gain = gain

    def read(self, unit: np.ndarray, rng: np.random.Generator, rows: int) -> Pieces:
        p = super().read(unit, rng, rows)
        other = unit.copy()
        # As if the second one were on a spring that is stiffer.
        other[:, 0] += np.log(self.gain) / np.log(4.0)
        q = super().read(other, rng, rows)
        before = np.concatenate([p.before, q.before], -1)
        change = np.concatenate([p.change, q.change], -1)
        return Pieces(before, change, p.weight)


def test_channels_that_disagree_widen_what_is_stated() -> None:
    """A log that errs the same way all the time, which blocks of it do not show."""
    truth, start = np.array([0.5, 0.5, 0.5]), np.full(3, 0.5)
    springs, told = cast(Simulations, TwoReadings()), {}
    for gain in (1.0, 1.5):
        p = TwoReadings(gain).read(truth[None], np.random.default_rng(3), 600)
        log = Pieces(p.before[0], p.change[0], p.weight[0])
        told[gain] = matched(springs, log, start, jax.random.key(0))
    right, wrong = told[1.0], told[1.5]
    assert wrong.disagree and not right.disagree
    std = {k: float(np.sqrt(f.cov[0, 0])) for k, f in told.items()}
    assert std[1.5] > 2 * std[1.0]
    # One sensor asks for this stiffness, the other for half as much again.
    apart = np.log(1.5) / np.log(4.0)
    assert abs(wrong.mean[0] - truth[0] - 0.5 * apart) < 0.5 * apart
    assert abs(wrong.mean[0] - truth[0]) < 3 * std[1.5]
