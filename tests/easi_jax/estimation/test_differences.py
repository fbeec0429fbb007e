"""Central differences, for larger robots, say what forward-mode derivatives say."""

import dataclasses
from collections.abc import Callable
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from easi_jax.data.segments import Segments, windows
from easi_jax.estimation.levenberg_marquardt import refine
from easi_jax.estimation.normal_equations import Normal, PairedFit
from easi_jax.model.parameters import ParameterSpace
from easi_jax.simulation.simulator import Simulator
from envs.cartpole import Cartpole

NOISE = jnp.array([5e-4, 2e-3, 1e-2, 2e-2])
WEIGHED = ("pole_length", "pole_mass", "cart_mass")


@pytest.fixture(scope="module")
def problem(cartpole: Cartpole, trajectories: Segments) -> Any:
    space = cartpole.space.select([n for n in cartpole.space.names if n not in WEIGHED])
    simulator = Simulator(cartpole.mj_model, space, cartpole.dt)
    pieces = windows(trajectories, 6, 6)
    simulator.batch = 60
    # An odd number: devices and batches do not divide it.
    return simulator, space, pieces.spread(37)


def normal(problem: Any, free_starts: bool, unit: Any = None) -> Normal:
    simulator, space, pieces = problem
    if unit is None:
        off = np.where(np.arange(space.size) % 2, 0.9, 1.1)
        unit = space.to_unit(jnp.asarray(off * space.nominal))
    delta = 1e-3 * jnp.ones((pieces.count, 4))
    run = program(simulator, space, free_starts, simulator.by_differences)
    return run(pieces, unit, delta)


@cache
def program(
    simulator: Simulator, space: ParameterSpace, free_starts: bool, differences: bool
) -> Callable[..., Normal]:
    """Compiled once for all pieces. The simulator says when it is traced, which is at
    once, whether it goes by ``differences``."""
    assert simulator.by_differences == differences

    @jax.jit
    def run(pieces: Segments, unit: jax.Array, delta: jax.Array) -> Normal:
        paired = PairedFit(simulator, space, pieces, NOISE, None, free_starts)
        return paired.normal(unit, delta, paired.weight)

    return run


@pytest.fixture(scope="module")
def exact(problem: Any) -> Callable[[bool], Normal]:
    return cache(lambda free: normal(problem, free))


@pytest.mark.parametrize("free", [pytest.param(True, marks=pytest.mark.slow), False])
def test_equal_forward_mode(
    problem: Any, exact: Callable[[bool], Normal], free: bool, monkeypatch: Any
) -> None:
    known = exact(free)
    monkeypatch.setattr(problem[0], "by_differences", True)
    found = normal(problem, free)
    scale = np.sqrt(np.diag(np.asarray(known.hessian)))
    np.testing.assert_allclose(
        np.asarray(found.hessian) / scale / scale[:, None],
        np.asarray(known.hessian) / scale / scale[:, None],
        atol=4e-2,  # where a limit is met, differences see both its sides
    )
    size = np.sqrt(2 * float(known.costs.sum()))
    np.testing.assert_allclose(
        np.asarray(found.gradient) / scale / size,
        np.asarray(known.gradient) / scale / size,
        atol=2e-2,
    )
    np.testing.assert_allclose(found.costs, known.costs, rtol=1e-4)
    gain = np.abs(np.asarray(found.start_gain - known.start_gain))
    assert np.median(gain) < 1e-4
    apart = np.abs(np.asarray(found.start_step - known.start_step))
    assert np.median(apart) < 1e-5 and np.percentile(apart, 80) < 3e-4


@pytest.mark.slow
def test_exact_starts_say_more(exact: Callable[[bool], Normal]) -> None:
    free, known = exact(True), exact(False)
    more = np.asarray(known.hessian - free.hessian, float)
    scale = np.sqrt(np.diag(np.asarray(known.hessian, float)))
    assert np.linalg.eigvalsh(more / scale / scale[:, None]).min() > -1e-4
    assert not known.start_step.any() and not known.start_gain.any()


def test_a_parameter_at_its_bound_has_its_slope(problem: Any, monkeypatch: Any) -> None:
    simulator, space, pieces = problem
    k = space.names.index("cart_kp")
    stiff = 1.1 * space.parameters[k].nominal
    edge = dataclasses.replace(
        space.parameters[k], initial=(stiff / 2, stiff), bounds=(1.0, stiff)
    )
    parameters = (*space.parameters[:k], edge, *space.parameters[k + 1 :])
    bounded = (simulator, ParameterSpace(parameters), pieces)
    slopes = []
    for differences in (False, True):
        monkeypatch.setattr(simulator, "by_differences", differences)
        _, s, _ = bounded
        unit = s.to_unit(jnp.asarray(s.nominal)).at[k].set(s.unit_bounds[1][k])
        slopes.append(np.asarray(normal(bounded, False, unit).hessian)[k, k])
    assert slopes[1] == pytest.approx(slopes[0], rel=0.1)


@pytest.mark.fault("simulations that explode, parameters at absurd corners")
def test_a_piece_that_explodes_is_left_out(problem: Any, monkeypatch: Any) -> None:
    simulator, space, pieces = problem
    monkeypatch.setattr(simulator, "by_differences", True)
    broken = dataclasses.replace(pieces, next_qvel=pieces.next_qvel.at[3].set(jnp.nan))
    without = dataclasses.replace(pieces, weight=pieces.weight.at[3].set(0.0))
    found = normal((simulator, space, broken), False)
    known = normal((simulator, space, without), False)
    np.testing.assert_allclose(found.hessian, known.hessian, rtol=1e-5)


@pytest.mark.parametrize("free", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_refines_to_the_truth(problem: Any, free: bool, monkeypatch: Any) -> None:
    simulator, space, pieces = problem
    monkeypatch.setattr(simulator, "by_differences", True)
    off = np.where(np.arange(space.size) % 2, 0.7, 1.3)
    unit = space.to_unit(jnp.asarray(off * space.nominal))
    noise = 1e-2 * NOISE

    @jax.jit
    def run(unit: jax.Array) -> Any:
        paired = PairedFit(simulator, space, pieces, noise, free_starts=free)
        return refine(paired, unit, iterations=15)

    out = run(unit)
    found = np.asarray(space.to_si(out.unit)) / space.nominal
    np.testing.assert_allclose(found, 1.0, atol=5e-3)
    assert out.cost[-1] < 1e-3 * out.cost[0]
