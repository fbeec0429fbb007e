"""What Cartpole's motion says of its parameters, and how that is told."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from easi_jax.data.segments import Segments, windows
from easi_jax.devices.mesh import make_mesh
from easi_jax.estimation.identifiability import (
    Identifiability,
    describe,
    identifiability,
)
from easi_jax.estimation.normal_equations import Normal, PairedFit
from easi_jax.model.parameters import Parameter, ParameterSpace
from easi_jax.simulation import open_loop
from easi_jax.simulation.simulator import Simulator
from easi_jax.simulation.slopes import shift_start
from envs.cartpole import Cartpole

NOISE = jnp.array([5e-4, 2e-3, 1e-2, 2e-2])


@pytest.fixture(scope="module")
def found(cartpole: Cartpole, trajectories: Segments) -> Identifiability:
    space, simulator = cartpole.space, cartpole.simulator
    seg = windows(trajectories, 6, 6)

    @jax.jit
    def hessian(unit: jax.Array) -> jax.Array:
        ones = jnp.broadcast_to(seg.weight[:, None, None], (*seg.ctrl.shape[:2], 4))
        zero = jnp.zeros((seg.count, 4))
        paired = PairedFit(simulator, space, seg, NOISE, make_mesh())
        return paired.normal(unit, zero, ones).hessian

    return identifiability(space, np.asarray(hessian(jnp.full(11, 0.5))), weak=1e3)


def angle_to_null(found: Identifiability, direction: dict[str, float]) -> float:
    """Share of a direction in log parameters that the data do see."""
    v = np.array([direction.get(n, 0.0) for n in found.names])
    v /= np.linalg.norm(v)
    return float(np.linalg.norm(v - found.null @ (found.null.T @ v)))


@pytest.mark.slow
def test_steps_that_weigh_nothing_need_no_simulation(
    cartpole: Cartpole, trajectories: Segments
) -> None:
    seg = windows(trajectories, 6, 6).spread(8)
    simulator, space = cartpole.simulator, cartpole.space
    weight = jnp.zeros((8, 6, 4)).at[:, :2].set(1.0)
    fit = PairedFit(simulator, space, seg, NOISE)
    shift = jnp.zeros((8, 4))
    unit = jnp.full(space.size, 0.6)

    @jax.jit
    def normal(steps: jax.Array) -> Normal:
        return replace(fit, steps=steps).normal(unit, shift, weight)

    begun, all_steps = (
        replace(n, residuals=n.residuals[:, :2]) for n in (normal(2), normal(6))
    )
    for few, whole in zip(
        jax.tree.leaves(begun), jax.tree.leaves(all_steps), strict=True
    ):
        np.testing.assert_allclose(few, whole, rtol=1e-4, atol=1e-6 * abs(whole).max())
    model = simulator.model(space.to_si(unit))
    qpos, qvel = jax.jit(lambda n: open_loop.predict(simulator, model, seg, n))(2)
    whole = jax.jit(lambda: open_loop.predict(simulator, model, seg))()
    for found, all_, start in ((qpos, whole[0], seg.qpos), (qvel, whole[1], seg.qvel)):
        np.testing.assert_allclose(found[:, :2], all_[:, :2], rtol=1e-5, atol=1e-6)
        np.testing.assert_array_equal(found[:, 2:], start[:, None].repeat(4, 1))
        assert np.abs(all_[:, 2:] - start[:, None]).max() > 1e-2


def test_residuals_are_those_of_the_moved_starts(
    cartpole: Cartpole, trajectories: Segments
) -> None:
    """Of one look and by themselves, as a plain simulation has them."""
    seg, space = windows(trajectories, 6, 6).spread(8), cartpole.space
    simulator = Simulator(cartpole.mj_model, space, cartpole.dt, engine="mujoco")
    fit, unit = PairedFit(simulator, space, seg, NOISE), jnp.full(space.size, 0.6)
    shift = NOISE * jax.random.normal(jax.random.key(0), (8, 4))

    @jax.jit
    def every() -> tuple[jax.Array, ...]:
        moved = shift_start(simulator, seg, shift)
        model = simulator.model(space.to_si(unit))
        error = open_loop.errors_from(simulator, model, moved, seg)
        look = fit.normal(unit, shift, fit.weight)
        return look.residuals, fit.residuals(unit, shift), -error

    looked, alone, expected = every()
    assert np.abs(expected).max() > 1e-2
    np.testing.assert_allclose(looked, expected, rtol=1e-3, atol=1e-6)
    np.testing.assert_allclose(alone, expected, rtol=1e-3, atol=1e-6)


@pytest.mark.slow
def test_nine_of_eleven_directions_are_seen(found: Identifiability) -> None:
    assert found.rank == 9 and len(found.undetermined) == 2
    assert found.null.shape == (11, 2)


def test_the_common_scale_is_invisible(found: Identifiability) -> None:
    scale = {
        n: 1.0 for n in found.names if n not in ("pole_length", "cart_speed_limit")
    }
    assert angle_to_null(found, scale) < 0.02
    # Leaving one out makes it visible.
    assert angle_to_null(found, {**scale, "cart_kp": 0.0}) > 0.1


def test_the_user_is_told_of_the_common_scale_by_itself(
    found: Identifiability,
) -> None:
    scale, other = found.undetermined
    assert set(scale.values()) == {1.0} and len(scale) == 9
    assert "one common factor" in describe(scale)
    # The other one is about the bodies alone: no drive, no friction.
    assert set(other) == {"pole_length", "pole_mass", "pole_armature", "cart_mass"}
    for direction in (scale, other):
        assert angle_to_null(found, direction) < 0.03


def test_length_mass_and_armature_trade_against_each_other(
    found: Identifiability,
) -> None:
    # Seen are m l / 2 (twice: gravity and coupling) and m l^2 / 3 + armature; with
    # the cart's mass making up for the pole's.
    m, length, armature, cart = 0.1, 0.3, 5e-3, 0.3
    direction = {
        "pole_length": 1.0,
        "pole_mass": -1.0,
        "pole_armature": -m * length**2 / 3 / armature,
        "cart_mass": m / cart,
    }
    assert angle_to_null(found, direction) < 0.02


def test_undetermined_parameters_are_not_called_known(found: Identifiability) -> None:
    known = dict(zip(found.names, found.determined, strict=True))
    std = dict(zip(found.names, found.std, strict=True))
    assert known["cart_speed_limit"] and np.isfinite(std["cart_speed_limit"])
    for name in ("cart_mass", "pole_mass", "pole_length", "pole_armature", "cart_kp"):
        assert not known[name] and std[name] == np.inf


def two(low: float = 0.5, high: float = 2.0) -> ParameterSpace:
    return ParameterSpace(
        tuple(
            Parameter(n, (f"body.{n}.mass",), 1.0, (low, high), (1e-3, 1e3))
            for n in ("a", "b")
        )
    )


def test_a_common_factor_and_a_sentence_for_it() -> None:
    # Only the ratio of a and b is seen.
    out = identifiability(two(), 1e6 * np.array([[1.0, -1.0], [-1.0, 1.0]]))
    assert out.rank == 1 and not out.determined.any()
    assert out.undetermined[0] == pytest.approx({"a": 1.0, "b": 1.0})
    assert "one common factor" in describe(out.undetermined[0])


def test_no_trace_and_weak_traces() -> None:
    out = identifiability(two(), np.diag([1e6, 0.0]))
    width = np.log(4.0)
    assert out.rank == 1 and list(out.determined) == [True, False]
    assert out.std[0] == pytest.approx(width * 1e-3, rel=1e-3)
    assert out.std[1] == np.inf
    assert describe(out.undetermined[0]) == "b leaves no trace in these data"
    np.testing.assert_allclose(out.covariance[0, 0], 1e-6, rtol=1e-3)
    # A standard deviation of a factor e is no knowledge.
    weak = identifiability(two(), width**2 * np.diag([100.0, 1.0]))
    assert list(weak.determined) == [True, False]


def test_other_combinations_are_told_with_their_powers() -> None:
    v = np.array([2.0, 1.0]) / 5**0.5
    out = identifiability(two(), 1e6 * np.outer(v, v))
    assert out.undetermined[0] == pytest.approx({"b": 1.0, "a": -0.5})
    assert "b^1, a^-0.5" in describe(out.undetermined[0])
