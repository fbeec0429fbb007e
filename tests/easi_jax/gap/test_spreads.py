"""What is stated of a fit's numbers, by linear problems that are known exactly."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from easi_jax.gap.batched_least_squares import Bounds, Fitted
from easi_jax.gap.effect_set import Model
from easi_jax.gap.fitting import Fitting
from easi_jax.gap.forward_selection import Selector
from easi_jax.gap.result import Numbers, fit_covariance, score_of
from easi_jax.gap.whitening import Residuals

W, M = 200, 12  # windows, numbers of each
SIZE = np.array([0.1, 2.0])
BOUNDS = Bounds(np.full(2, -np.inf), np.full(2, np.inf), SIZE)


class Plain:
    """Errors that are white as they are."""

    of = Residuals.of
    groups, live = np.eye(M), np.ones((W, M), bool)

    def grouped(self, errors: np.ndarray) -> np.ndarray:
        return errors

    def whitened(self, grouped: np.ndarray, at: object = None) -> np.ndarray:
        return grouped[..., 0]


def fitted(noise: np.ndarray, **more: Any) -> tuple[Any, Any]:
    """The fit of two numbers to ``noise (W, M)``, the truth at zero."""
    slope = np.random.default_rng(7).normal(size=(W, M, 2)) / SIZE
    flat = slope.reshape(-1, 2)
    x = -np.linalg.lstsq(flat, noise.reshape(-1), rcond=None)[0]
    residual = noise + slope @ x
    fit = Fitted(x, np.arange(2), residual, slope, 0.5 * float((residual**2).sum()))
    zero = np.zeros(1)
    chosen = {
        "bounds": BOUNDS,
        "weight": np.ones(W),
        "rows_once": lambda: np.ones(W),
        "residuals": Plain(),
    }
    return SimpleNamespace(**{**chosen, **more}), Model([], fit, zero, zero)


def test_white_errors_leave_the_inverse_information() -> None:
    noise = np.random.default_rng(0).normal(size=(W, M))
    selector, model = fitted(noise)
    j = model.fit.slope.reshape(-1, 2)
    np.testing.assert_allclose(
        fit_covariance(selector, model), np.linalg.inv(j.T @ j), rtol=1e-3, atol=1e-9
    )
    # A row in two windows counts once.
    twice, _ = fitted(noise, rows_once=lambda: np.full(W, 0.5))
    ratio = fit_covariance(twice, model) / fit_covariance(selector, model)
    np.testing.assert_allclose(np.diag(ratio), 2.0, rtol=1e-3)


def test_spreads_cover_errors_that_hang_together() -> None:
    """Of 200 recordings, windows of which lean the same way ten at a time."""
    rng, off = np.random.default_rng(1), []
    slope = fitted(np.zeros((W, M)))[1].fit.slope * SIZE
    for _ in range(200):
        leaning = np.repeat(rng.normal(size=(W // 10, 2)), 10, axis=0)
        noise = rng.normal(size=(W, M)) + 0.4 * np.einsum("wma,wa->wm", slope, leaning)
        selector, model = fitted(noise)
        off.append(model.fit.x / np.sqrt(np.diag(fit_covariance(selector, model))))
    inside = (np.abs(off) < 1.645).mean()
    assert 0.85 < inside < 0.97, inside


def test_what_a_model_errs_by_and_its_own_steps_widen() -> None:
    noise = np.random.default_rng(2).normal(size=(W, M))
    selector, model = fitted(noise)
    plain = fit_covariance(selector, model)
    errs = fitted(3.0 * noise)[1]
    beyond = (errs.fit.residual**2).sum() - 1.44 * W * M
    wide = np.diag(fit_covariance(selector, errs)) / np.diag(plain)
    # And they scatter nine times as much as the noise would.
    scatter = wide / (1.0 + beyond / 10.0)
    assert (scatter > 6.0).all() and (scatter < 12.0).all(), scatter
    shift = np.array([0.3, -4.0])
    steps = (model.fit.slope @ shift)[..., None]
    pulls = [score_of(selector, model, steps)]
    moved = fit_covariance(selector, model, pulls) - plain
    np.testing.assert_allclose(moved, np.outer(shift, shift), rtol=1e-3)


def test_noise_of_starts_that_slopes_share_widens() -> None:
    """How far something goes by a speed that is read: noise in what a number is
    multiplied with draws it towards zero (attenuation)."""
    rng, noise, time = np.random.default_rng(3), 0.3, np.linspace(0.0, 1.0, M)
    speed = rng.uniform(0.5, 1.5, W)
    read = speed + noise * rng.normal(size=W)

    def errors(x: Any, some: Any = None, moved: np.ndarray | None = None) -> np.ndarray:
        begun = read if moved is None else read + moved[:, 1]
        ahead = (begun * x[:, :1] - speed)[..., None] * time
        return np.asarray(ahead)[..., None]

    best = float(read @ speed / (read @ read))
    slope = (read[:, None] * time)[..., None]
    residual = errors(np.array([[best]]))[0, ..., 0]
    fit = Fitted(np.array([best]), np.arange(1), residual, slope, 1.0)
    model = Model([], fit, np.zeros(1), np.zeros(1))
    one = np.ones(1)
    selector, _ = fitted(
        np.zeros((W, M)),
        bounds=Bounds(-np.inf * one, np.inf * one, 0.1 * one),
        errors=errors,
        moved=np.zeros((W, 2)),
    )
    starts = SimpleNamespace(scatter=np.array([0.0, noise]), noises=np.zeros(1))
    at: Any = SimpleNamespace(
        selector=selector,
        starts=starts,
        sticks=True,
        data=SimpleNamespace(m=SimpleNamespace(nv=1)),
    )
    pull = Fitting.pull_of_starts(at, model)
    due = best * W * noise**2 * (time**2).sum() * 0.1
    np.testing.assert_allclose(pull, due, rtol=0.15)
    plain, wide = (
        np.sqrt(fit_covariance(selector, model, p)[0, 0]) for p in ([], [pull])
    )
    assert best < 0.95 and abs(best - 1.0) > 2.0 * plain
    assert abs(best - 1.0) < 1.2 * wide
    at.sticks = False
    assert not Fitting.pull_of_starts(at, model).any()


def test_numbers_without_a_reading_hide_no_error() -> None:
    noise = 2.0 * np.random.default_rng(4).normal(size=(W, M))
    selector, model = fitted(noise)
    std = np.sqrt(np.diag(fit_covariance(selector, model)))
    fit = model.fit
    more = np.concatenate([fit.residual, np.zeros((W, M))], 1)
    slope = np.concatenate([fit.slope, np.zeros((W, M, 2))], 1)
    model.fit = Fitted(fit.x, fit.active, more, slope, fit.cost)
    selector.residuals.live = np.arange(2 * M)[None] < np.full((W, 1), M)
    dead = np.sqrt(np.diag(fit_covariance(selector, model)))
    np.testing.assert_allclose(dead, std, rtol=1e-6)


@pytest.mark.parametrize("apart", [0.0, 1e-9])
def test_numbers_that_data_tell_by_their_sum_are_not_determined(apart: float) -> None:
    """Of a log without noise, too."""
    selector, model = fitted(np.random.default_rng(5).normal(size=(W, M)))
    slope = model.fit.slope
    slope[..., 1] = 1e5 * slope[..., 0] * SIZE[0] / SIZE[1] * (1.0 + apart)
    slope[..., 0] *= 1e5
    cov = fit_covariance(selector, model)
    std = np.sqrt(np.diag(cov))
    assert np.isfinite(std).all() and (std > 50 * SIZE).all()
    both = np.array([1.0, SIZE[0] / SIZE[1]])
    assert np.sqrt(both @ cov @ both) < 1e-2 * std[0]


def test_what_no_data_show_may_be_anything() -> None:
    selector, model = fitted(np.random.default_rng(3).normal(size=(W, M)))
    model.fit.slope[..., 1] = 0.0
    assert np.sqrt(fit_covariance(selector, model)[1, 1]) > 100 * SIZE[1]
    selector.bounds = Bounds(np.zeros(2), np.full(2, 6.0), SIZE)
    left = np.sqrt(fit_covariance(selector, model)[1, 1])
    assert left == pytest.approx(6.0 / np.sqrt(12.0))


def test_each_row_of_a_run_counts_once() -> None:
    chosen: Any = object.__new__(Selector)
    row, run = np.array([0, 6, 12, 0, 40]), np.array([0, 0, 0, 1, 1])
    chosen.predictor = SimpleNamespace(windows=SimpleNamespace(row=row, run=run))
    chosen.residuals, chosen.blocks, chosen.count = Plain(), np.array([0]), 5
    counts = chosen.rows_once()
    assert counts.sum() * M == pytest.approx(24 + 12 + 12)
    np.testing.assert_allclose(counts, [0.75, 0.5, 0.75, 1.0, 1.0])


@pytest.mark.parametrize(
    ("slopes", "outcome"),
    [
        ((1.0, 1.0), "converged"),
        ((1.0, 1e-12), "converged"),  # one number that the data tell is enough
        ((1e-12, 1e-12), "not determined"),
    ],
)
def test_what_no_data_determine_is_said_so(
    slopes: tuple[float, float], outcome: str
) -> None:
    """Also of numbers that the data show by their sum alone."""
    wide = Bounds(np.full(2, -1e3), np.full(2, 1e3), SIZE)
    noise = np.random.default_rng(5).normal(size=(W, M))
    selector, model = fitted(noise, bounds=wide, columns=lambda *_, **__: np.arange(2))
    place: Any = None
    slope = model.fit.slope * slopes
    told = Numbers(selector, replace(model, fit=replace(model.fit, slope=slope)))
    assert told.outcome(place) == outcome
    alike = np.repeat(slope[..., :1], 2, -1) if slopes[0] == 1.0 else slope
    told = Numbers(selector, replace(model, fit=replace(model.fit, slope=alike)))
    assert told.outcome(place) == "not determined"
