"""Central differences, for larger robots, say what forward-mode derivatives say."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from easi_jax import information
from easi_jax.information import Normal, PairedFit
from easi_jax.machine import Machine
from easi_jax.refine import refine, step_weights
from easi_jax.segments import Segments, windows
from envs.cartpole import Cartpole

NOISE = jnp.array([5e-4, 2e-3, 1e-2, 2e-2])
WEIGHED = ("pole_length", "pole_mass", "cart_mass")


@pytest.fixture(scope="module")
def problem(cartpole: Cartpole, trajectories: Segments) -> Any:
    space = cartpole.space.select([n for n in cartpole.space.names if n not in WEIGHED])
    machine = Machine(cartpole.mj_model, space, cartpole.dt)
    pieces = windows(trajectories, 6, 6)
    # An odd number: devices and batches do not divide it.
    return machine, space, pieces.spread(37)


def normal(problem: Any, free_starts: bool) -> Normal:
    machine, space, pieces = problem
    paired = PairedFit(machine, space, pieces, NOISE, None, free_starts)
    off = np.where(np.arange(space.size) % 2, 0.9, 1.1)
    unit = space.to_unit(jnp.asarray(off * space.nominal))
    delta = 1e-3 * jnp.ones((pieces.count, 4))
    run = jax.jit(lambda u, d: paired.normal(u, d, step_weights(pieces, NOISE)))
    return run(unit, delta)


@pytest.fixture(scope="module")
def exact(problem: Any) -> dict[bool, Normal]:
    return {free: normal(problem, free) for free in (True, False)}


@pytest.mark.parametrize("free", [True, False])
def test_equal_forward_mode(
    problem: Any, exact: dict[bool, Normal], free: bool, monkeypatch: Any
) -> None:
    monkeypatch.setattr(information, "WRITTEN_OUT", 0)
    found, known = normal(problem, free), exact[free]
    scale = np.sqrt(np.diag(np.asarray(known.hessian)))
    np.testing.assert_allclose(
        np.asarray(found.hessian) / scale / scale[:, None],
        np.asarray(known.hessian) / scale / scale[:, None],
        atol=4e-2,  # where a limit is met, differences see both its sides
    )
    size = np.sqrt(2 * float(known.cost))
    np.testing.assert_allclose(
        np.asarray(found.gradient) / scale / size,
        np.asarray(known.gradient) / scale / size,
        atol=2e-2,
    )
    np.testing.assert_allclose(found.cost, known.cost, rtol=1e-4)
    assert found.start_gain.shape == known.start_gain.shape
    apart = np.abs(np.asarray(found.start_step - known.start_step))
    assert np.median(apart) < 1e-5 and np.percentile(apart, 80) < 3e-4


def test_exact_starts_say_more(exact: dict[bool, Normal]) -> None:
    more = np.asarray(exact[False].hessian - exact[True].hessian, float)
    scale = np.sqrt(np.diag(np.asarray(exact[False].hessian, float)))
    assert np.linalg.eigvalsh(more / scale / scale[:, None]).min() > -1e-4
    assert not exact[False].start_step.any() and not exact[False].start_gain.any()


def test_a_parameter_at_its_bound_has_a_slope(problem: Any, monkeypatch: Any) -> None:
    monkeypatch.setattr(information, "WRITTEN_OUT", 0)
    machine, space, pieces = problem
    paired = PairedFit(machine, space, pieces, NOISE, None, False)
    _, high = space.unit_bounds
    k = space.names.index("cart_kp")
    unit = space.to_unit(jnp.asarray(space.nominal)).at[k].set(high[k])
    run = jax.jit(lambda u: paired.around(u, jnp.zeros((pieces.count, 4))))
    units, _ = run(unit)
    n = space.size
    up, down = units[1 : n + 1], units[n + 1 : 2 * n + 1]
    gone = np.diag(np.asarray(up - down))
    assert (gone > 0).all() and gone[k] == pytest.approx(gone.max() / 2, rel=1e-3)


def test_refines_to_the_truth(problem: Any, monkeypatch: Any) -> None:
    monkeypatch.setattr(information, "WRITTEN_OUT", 0)
    machine, space, pieces = problem
    off = np.where(np.arange(space.size) % 2, 0.7, 1.3)
    unit = space.to_unit(jnp.asarray(off * space.nominal))
    run = jax.jit(
        lambda u: refine(
            machine, space, u, pieces, 1e-2 * NOISE, iterations=15, free_starts=False
        )
    )
    out = run(unit)
    found = np.asarray(space.to_si(out.unit)) / space.nominal
    np.testing.assert_allclose(found, 1.0, atol=5e-3)
    assert out.cost[-1] < 1e-3 * out.cost[0]
