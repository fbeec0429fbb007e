"""Test signals: their spectra, their ends, and what they do to a free mass."""

import numpy as np
import pytest

from easi_jax.excite import signals

TIME = np.arange(1801) * 0.01


def rng() -> np.random.Generator:
    return np.random.default_rng(3)


def test_inputs_share_no_line() -> None:
    mine = [signals.lines(0.2, 8.0, 18.0, i, 3) for i in range(3)]
    assert all(len(f) > 8 for f in mine)
    every = np.concatenate(mine)
    assert len(np.unique(every.round(6))) == len(every)
    assert every.min() >= 0.2 - 1e-9 and every.max() <= 8.0 + 1e-9
    np.testing.assert_allclose(every * 18.0, (every * 18.0).round(), atol=1e-9)


def test_a_multisine_is_in_its_band_with_a_low_crest() -> None:
    u = signals.multisine(rng(), TIME, 1, 0.5, 5.0, 0.0)[:, 0]
    power = np.abs(np.fft.rfft(u)) ** 2
    f = np.fft.rfftfreq(len(u), 0.01)
    inside = (f > 0.3) & (f < 5.3)
    assert power[inside].sum() > 0.99 * power.sum()
    middle = u[100:-100]
    # Sines in phase would have the root of twice their number, 5.
    assert np.abs(middle).max() / middle.std() < 2.9


def test_a_chirp_speeds_up() -> None:
    u = signals.chirp(rng(), TIME, 1, 0.2, 5.0)[:, 0]
    crossings = np.flatnonzero(np.diff(np.sign(u)) != 0)
    gaps = np.diff(crossings)
    assert gaps[1] > 8 * gaps[-2]


@pytest.mark.parametrize("kind", ["multisine", "chirp", "pulses", "steps"])
def test_ends_at_rest_and_the_same_by_seed(kind: str) -> None:
    args = {"multisine": (0.2, 4.0, 0.0), "chirp": (0.2, 4.0)}.get(kind, (1.0,))
    make = getattr(signals, kind)
    u = make(rng(), TIME, 2, *args)
    assert u.shape == (len(TIME), 2)
    np.testing.assert_allclose(u[[0, -1]], 0.0, atol=1e-12)
    assert (np.abs(u).max(0) > 0.5).all()
    np.testing.assert_array_equal(u, make(rng(), TIME, 2, *args))
    other = make(np.random.default_rng(4), TIME, 2, *args)
    assert np.abs(u - other).max() > 0.1


def test_a_balanced_force_leaves_a_mass_where_it_was() -> None:
    u = signals.steps(rng(), TIME, 2, 0.8)
    force = signals.balanced(TIME, u)
    speed = np.cumsum(force, 0) * 0.01
    travel = np.cumsum(speed, 0) * 0.01
    assert np.abs(travel).max() > 0.1
    np.testing.assert_allclose(speed[-1], 0.0, atol=1e-9)
    np.testing.assert_allclose(travel[-1], 0.0, atol=0.02 * np.abs(travel).max())
    np.testing.assert_allclose(force[[0, -1]], 0.0, atol=1e-12)
