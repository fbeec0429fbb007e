"""The one bounded least-squares step, on problems whose answers are known."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from easi_jax.estimation.least_squares import (
    AT_BOUND,
    CONVERGED,
    DIVERGED,
    NOT_DETERMINED,
    OUTCOMES,
    Damping,
    bounded_step,
    flag_codes,
    held_back,
    is_settled,
    moved,
    result_code,
)
from easi_jax.gap.batched_least_squares import Bounds, least_squares, lockstep
from easi_jax.model.parameters import Parameter, ParameterSpace


def problem(n: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Information over six decades, and a gradient."""
    rng = np.random.default_rng(seed)
    slope = rng.normal(size=(3 * n, n)) * 10.0 ** rng.uniform(-1.5, 1.5, n)
    return slope.T @ slope, slope.T @ rng.normal(size=3 * n)


def test_without_bounds_it_is_the_newton_step() -> None:
    hessian, gradient = problem(6)
    every = np.ones(6, bool)
    np.testing.assert_allclose(
        hessian @ bounded_step(hessian, gradient, every), -gradient, rtol=1e-9
    )
    # With damping as with so much more on the diagonal.
    more = hessian + 0.3 * np.diag(np.diag(hessian))
    step = bounded_step(hessian, gradient, every, 0.3)
    np.testing.assert_allclose(more @ step, -gradient, rtol=1e-9)
    # What takes no part stays, and the others do as if it were not there.
    some = np.arange(6) % 3 > 0
    step = bounded_step(hessian, gradient, some)
    assert (step[~some] == 0).all()
    np.testing.assert_allclose((hessian @ step + gradient)[some], 0.0, atol=1e-9)


def test_entries_stop_at_their_bounds_and_the_others_are_solved_for_anew() -> None:
    stopped = 0
    for seed in range(20):
        hessian, gradient = problem(5, seed)
        every = np.ones(5, bool)
        whole = bounded_step(hessian, gradient, every)
        low, high = -0.5 * np.abs(whole), 0.8 * np.abs(whole).max() * np.ones(5)
        step = bounded_step(hessian, gradient, every, within=(low, high))
        at = (step == low) | (step == high)
        assert (step >= low).all() and (step <= high).all() and at.any()
        left = hessian @ step + gradient
        np.testing.assert_allclose(left[~at] / np.abs(gradient).max(), 0, atol=1e-9)
        stopped += at.sum()
    assert 20 < stopped < 100, "some entries of each, not all"


def test_a_batch_in_a_program_is_each_on_the_host() -> None:
    given = [problem(4, seed) for seed in range(3)]
    hessian, gradient = (np.stack(x) for x in zip(*given, strict=True))
    within = np.full(4, -0.02), np.full(4, 0.02)
    free = np.array([True, True, True, False])
    damping = np.array([0.0, 0.1, 10.0])

    with jax.enable_x64(True):
        args = hessian, gradient, free, damping
        batched = bounded_step(*args, within=within)
        for i in range(3):
            one = hessian[i], gradient[i], free, damping[i]
            alone = bounded_step(*one, within=within)
            np.testing.assert_allclose(batched[i], alone, rtol=1e-10)
        run = jax.jit(lambda *a: bounded_step(*a[:4], within=(a[4], a[5])))
        told = run(*(jnp.asarray(x) for x in (*args, *within)))
        np.testing.assert_allclose(told, batched, rtol=1e-8, atol=1e-12)
        assert np.abs(batched).max() == 0.02
    # Many dampings of one system are the same shape of work.
    tried = bounded_step(hessian[0], gradient[0], free, damping)
    assert (np.diff(np.linalg.norm(tried, axis=1)) < 0).all()


def test_a_slope_that_is_none_makes_no_long_step() -> None:
    hessian, gradient = np.diag([1.0, 1e-8]), np.array([1.0, 1e-3])
    every = np.ones(2, bool)
    assert bounded_step(hessian, gradient, every, 0.1)[1] < -1e4
    assert abs(bounded_step(hessian, gradient, every, 0.1, dim=1e-2)[1]) < 2


def test_damping_follows_what_helped() -> None:
    rule = Damping(falls=0.1, rises=10.0, least=1e-3, most=1e2, wakes=0.5)
    assert rule.after(1.0, np.array([True, False])).tolist() == [0.1, 10.0]
    assert rule.after(1e-3, np.array([True, False])).tolist() == [1e-3, 0.5]
    assert rule.after(50.0, False) == 100.0


def test_it_stops_where_there_is_no_more_to_gain() -> None:
    gain, cost = np.array([0.5, 0.04, 1.5, 0.5, np.nan]), np.array([1, 1, 1e3, 1e3, 1])
    told = is_settled(gain, cost, 0.1, 1e-3)
    assert told.tolist() == [False, True, False, True, False]


def test_a_bound_holds_back_what_goes_outwards() -> None:
    x, low, high = np.array([0.0, 0.0, 1.0, 1.0, 0.5]), np.zeros(5), np.ones(5)
    gradient = np.array([1.0, -1.0, -1.0, 1.0, 9.0])
    held = held_back(x, gradient, low, high)
    assert held.tolist() == [True, False, True, False, False]


def test_on_a_logarithmic_scale_a_step_goes_along_the_value() -> None:
    edge, far_off = (0.1, 10.0), (0.01, 100.0)
    a, b = (
        Parameter(n, (f"joint.{n}.damping",), 1.0, edge, far_off, log=n == "a")
        for n in "ab"
    )
    space = ParameterSpace((a, b))
    unit = space.to_unit(np.array([2.0, 2.0]))
    du = jnp.array([[0.05, 0.05], [-9.0, -0.1]])
    far = np.asarray(space.to_si(moved(space, unit, du)))
    width = np.log(100.0)
    told = [2 * (1 + 0.05 * width), 2 + 9.9 * 0.05]
    np.testing.assert_allclose(far[0], told, rtol=1e-5)
    # To a tenth at most.
    np.testing.assert_allclose(far[1], [0.2, 2 - 0.99], rtol=1e-5)


@pytest.mark.parametrize(
    ("x", "determined", "finite", "code"),
    [
        ([0.5, 0.5], [True, True], True, CONVERGED),
        ([0.5, 0.5], [True, False], True, CONVERGED),
        ([1.0, 0.5], [True, False], True, AT_BOUND),
        ([0.5, 0.5], [False, False], True, NOT_DETERMINED),
        ([0.5, 0.5], [True, True], False, DIVERGED),
    ],
)
def test_a_result_has_a_code(
    x: list[float], determined: list[bool], finite: bool, code: int
) -> None:
    flags = flag_codes(np.array(x), np.zeros(2), np.ones(2), np.array(determined), 1e-3)
    assert int(result_code(flags, finite)) == code
    # As a batch, in a program.
    many = jax.jit(result_code)(jnp.stack([flags, flags]), jnp.array([finite, False]))
    assert many.tolist() == [code, DIVERGED]
    assert OUTCOMES[code] in ("converged", "at bound", "not determined", "diverged")


def test_fits_in_lockstep_say_how_each_entry_ended() -> None:
    def simulate(x: np.ndarray) -> np.ndarray:
        return (x[:, :2] - np.array([2.0, 9.0]))[:, None, :] * np.ones((1, 3, 1))

    bounds = Bounds(np.full(3, -5.0), np.full(3, 5.0), np.full(3, 0.1))
    ask = least_squares(np.zeros((1, 3)), [0, 1, 2], bounds, np.ones(3))
    (fit,) = lockstep([ask], simulate)
    assert fit.codes(bounds).tolist() == [CONVERGED, AT_BOUND, NOT_DETERMINED]
    assert int(result_code(fit.codes(bounds))) == AT_BOUND
