"""A fit on few pieces ends where all of them have it."""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from easi_jax.data.segments import Segments, windows
from easi_jax.estimation import limits
from easi_jax.estimation.levenberg_marquardt import RefineResult, refine
from easi_jax.estimation.normal_equations import PairedFit
from easi_jax.estimation.polish import polish
from easi_jax.simulation import slopes
from easi_jax.simulation.rollout import measured
from easi_jax.simulation.simulator import Simulator
from envs.cartpole import Cartpole

NOISE = jnp.array([5e-4, 2e-3, 1e-2, 2e-2])
# None that may be as good as zero: on a logarithmic scale that takes many steps.
NAMES = ["pole_armature", "cart_kp", "cart_kv", "cart_force_limit", "cart_speed_limit"]


@pytest.fixture(scope="module")
def problem(cartpole: Cartpole, trajectories: Segments) -> Any:
    space = cartpole.space.select(NAMES)
    simulator = Simulator(cartpole.mj_model, space, cartpole.dt)
    noisy = measured(trajectories, NOISE, jax.random.key(3), simulator.configuration)
    return simulator, space, windows(noisy, 10, 10)


@pytest.fixture(scope="module")
def run(problem: Any) -> Any:
    simulator, space, _ = problem

    @jax.jit
    def run(fit: RefineResult, segments: Segments) -> RefineResult:
        return polish(PairedFit(simulator, space, segments, NOISE), fit.unit)

    return run


@pytest.fixture(scope="module")
def fits(problem: Any) -> tuple[RefineResult, RefineResult]:
    """On half of the pieces, and on all. Of a quarter so few meet the force limit
    that it might be noise, and it is not known."""
    simulator, space, pieces = problem
    start = space.to_unit(1.2 * jnp.asarray(space.nominal))

    @jax.jit
    def fitted(pieces: Segments) -> RefineResult:
        paired = PairedFit(simulator, space, pieces, NOISE)
        return refine(paired, start, iterations=20)

    part = jnp.arange(pieces.count) % 2 == 0
    few = replace(pieces, weight=pieces.weight * part)
    return fitted(few), fitted(pieces)


def far(a: RefineResult, b: RefineResult) -> float:
    """In standard deviations of what all pieces say."""
    off = np.asarray(a.unit - b.unit)
    return float(np.sqrt(off @ np.asarray(b.hessian) @ off))


@pytest.mark.slow
def test_few_pieces_end_where_all_have_it(problem: Any, run: Any, fits: Any) -> None:
    few, known = fits
    found = run(few, problem[2])
    assert far(few, known) > 2.0
    assert far(found, known) < 0.5
    assert float(found.cost.min()) == pytest.approx(float(known.cost[-1]), rel=1e-3)
    np.testing.assert_allclose(
        np.diag(np.asarray(found.hessian)),
        np.diag(np.asarray(known.hessian)),
        rtol=0.1,
    )
    assert found.delta.shape == known.delta.shape
    # Each of two limits is looked at on its plateau, too.
    assert np.isfinite(found.cost).sum() < 8
    assert np.isfinite(found.cost).sum() + 4 <= looks(problem, found) < 24
    assert (found.raised == found.unit).all()
    assert (found.raised_hessian == found.hessian).all()


def test_starts_are_fitted_where_the_parameters_are_right(
    problem: Any, run: Any, fits: Any
) -> None:
    """Then no step of the parameters gains anything, and all is in the starts."""
    known = fits[1]
    found = run(known, problem[2])
    assert far(found, known) < 0.2
    assert float(found.cost[0]) > 1.5 * float(known.cost[-1])
    assert float(found.cost.min()) == pytest.approx(float(known.cost[-1]), rel=1e-3)


def looks(problem: Any, found: RefineResult) -> float:
    _, space, pieces = problem
    whole = (1 + space.size + 4) * pieces.count * pieces.horizon
    return float(found.simulated) / whole


@pytest.mark.slow
def test_information_of_what_is_below_its_range_is_that_at_its_low_end(
    problem: Any, run: Any, fits: Any
) -> None:
    pieces = problem[2]
    begun = replace(fits[0], unit=fits[0].unit.at[1].set(-1.5))
    # So little counts that it stays there.
    still = replace(pieces, weight=1e-8 * pieces.weight)
    found = run(begun, still)
    assert float(found.unit[1]) == pytest.approx(-1.5, abs=0.1)
    assert looks(problem, found) == 1 + np.isfinite(found.cost).sum()
    np.testing.assert_array_equal(found.raised, jnp.maximum(found.unit, 0.0))
    assert (found.raised_hessian != found.hessian).any()


@pytest.mark.fault("simulations that explode, parameters at absurd corners")
def test_a_step_that_fits_worse_is_not_taken(problem: Any, run: Any, fits: Any) -> None:
    """From far off, or past a piece that explodes, the result is never worse."""
    _, space, pieces = problem
    corner = jnp.where(jnp.arange(space.size) % 2, 0.02, 0.98)
    broken = replace(pieces, next_qvel=pieces.next_qvel.at[3].set(jnp.nan))
    for given in (pieces, broken):
        found = run(replace(fits[0], unit=corner), given)
        assert np.isfinite(found.unit).all() and np.isfinite(found.hessian).all()
        assert float(found.cost.min()) <= float(found.cost[0])
        best = int(np.argmin(found.cost))
        assert (best == 0) == bool((found.unit == corner).all())


@pytest.mark.fault("simulations that explode beyond a place that fits better")
def test_a_step_that_makes_pieces_explode_is_not_taken(
    problem: Any, fits: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Fewer pieces would cost less; those lost at the fit itself count nowhere."""
    simulator, space, pieces = problem
    few, known = fits
    gap = few.unit - known.unit
    wall = 0.5 * (few.unit + known.unit)

    whole = slopes._residuals

    def walled(
        simulator: Simulator, space: Any, unit: jax.Array, *rest: Any
    ) -> jax.Array:
        s = rest[1]
        beyond = (unit - wall) @ gap < 0
        gone = jnp.where(beyond, s.qvel[0] > 0, s.qpos[0] > far_right)
        return jnp.where(gone, jnp.nan, whole(simulator, space, unit, *rest))

    far_right = float(np.quantile(pieces.qpos[:, 0], 0.9))
    monkeypatch.setattr(slopes, "_residuals", walled)
    monkeypatch.setattr(limits, "of", lambda _: [])  # plateaus lie off the wall
    paired = PairedFit(simulator, space, pieces, NOISE)
    found = jax.jit(lambda u: polish(paired, u))(few.unit)
    assert (found.unit - wall) @ gap >= 0
    assert np.isinf(found.cost[1]), "the first step leads beyond the wall"
    assert np.isfinite(found.cost[0]) and float(found.cost.min()) < float(found.cost[0])
    lost = np.asarray(pieces.qpos[:, 0]) > far_right
    assert 0 < lost.sum() < pieces.count and (np.asarray(found.delta)[lost] == 0).all()
