"""Fitted starts are paid for: friction from single noisy steps at low speed."""

from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from easi_jax.data.segments import Segments
from easi_jax.devices.runtime import quick_compile
from easi_jax.estimation.levenberg_marquardt import RefineResult, refine
from easi_jax.estimation.normal_equations import PairedFit
from easi_jax.estimation.polish import polish
from easi_jax.estimation.profile_score import adjust, less_scatter
from easi_jax.model.parameters import ParameterSpace, declare
from easi_jax.simulation.simulator import Simulator

_SLIDER = """
<mujoco>
  <option timestep="0.01" integrator="implicitfast"/>
  <worldbody>
    <body>
      <joint name="a" type="slide" damping="2" frictionloss="0.5"/>
      <geom type="box" size=".1 .1 .1" mass="1"/>
    </body>
  </worldbody>
  <actuator><motor name="push" joint="a"/></actuator>
</mujoco>
"""
_NOISE = jnp.array([1e-3, 0.03])
_SPEED = 0.12  # m/s, standard deviation: noise often decides its sign
_COUNT, _SEEDS = 8000, 5


def recorded(simulator: Simulator, key: jax.Array, spread: jax.Array) -> Segments:
    """Single steps from random speeds, start and end read with noise."""
    k_speed, k_push, *k_noise = jax.random.split(key, 4)
    speed = spread * jax.random.normal(k_speed, (_COUNT, 1))
    push = jax.random.normal(k_push, (_COUNT, 1))
    model = simulator.model(jnp.asarray(simulator.space.nominal))

    def one(speed: jax.Array, push: jax.Array) -> Any:
        first = simulator.start(jnp.zeros(1), speed, model)
        last = simulator.step(model, first, push)
        return last.qpos, last.qvel

    clean = jnp.concatenate(jax.vmap(one)(speed, push), 1)
    start, end = (_NOISE * jax.random.normal(k, (_COUNT, 2)) for k in k_noise)
    end = clean + end
    return Segments(
        qpos=start[:, :1],
        qvel=speed + start[:, 1:],
        ctrl=push[:, None],
        next_qpos=end[:, None, :1],
        next_qvel=end[:, None, 1:],
        weight=jnp.ones(_COUNT),
    )


@pytest.fixture(scope="module")
def fits() -> Any:
    """Takes how much too high the noise is assumed, and the spread of speeds.

    Returns ``(seeds, n)`` errors of the fit, then adjusted, in standard deviations of
    the noise as it is, and what is left of the score.
    """
    m = mujoco.MjModel.from_xml_string(_SLIDER)
    kinds = "damping", "frictionloss"
    space = ParameterSpace(tuple(declare(m, k, f"joint.a.{k}") for k in kinds))
    simulator = Simulator(m, space, 0.02)
    truth = space.to_unit(jnp.asarray(space.nominal))

    def run(assumed: float, spread: float) -> Any:
        def one(key: jax.Array) -> Any:
            pieces = recorded(simulator, key, jnp.asarray(spread))
            noise = assumed * _NOISE
            paired = PairedFit(simulator, space, pieces, noise)
            fit = refine(paired, truth, iterations=8)
            return fit, *adjust(paired, fit)

        return jax.lax.map(one, jax.random.split(jax.random.key(3), _SEEDS))

    # It runs for longer than it compiles.
    compiled = jax.jit(run, compiler_options=quick_compile())

    def fits(assumed: float = 1.0, spread: float = _SPEED) -> Any:
        fit, adjusted, left = jax.device_get(compiled(assumed, spread))
        std = np.sqrt([np.diag(np.linalg.inv(x)) for x in adjusted.hessian]) / assumed
        return *((x.unit - truth) / std for x in (fit, adjusted)), left

    return fits


@pytest.fixture(scope="module")
def slow(fits: Any) -> Any:
    return fits()


@pytest.mark.slow
def test_friction_is_neither_too_high_nor_too_sure(slow: Any) -> None:
    fit, adjusted, left = slow
    friction = 1
    # The mean of so many seeds has a standard deviation of 0.45.
    assert np.mean(fit[:, friction]) > 2.0
    assert np.abs(np.mean(adjusted, 0)).max() < 1.0
    assert np.sqrt(np.mean(adjusted**2)) < 1.6
    assert (left[:, 0] > 1.0).all()
    assert (left[:, 1] < 0.1).all()


@pytest.mark.slow
def test_noise_assumed_too_high_is_seen_in_the_cost(fits: Any, slow: Any) -> None:
    assert np.abs(fits(assumed=1.5)[1] - slow[1]).max() < 0.5


def test_what_is_linear_stays_as_it_is(fits: Any) -> None:
    fit, adjusted, _ = fits(spread=5.0)
    assert np.abs(fit - adjusted).max() < 0.3


def test_what_scatters_more_than_its_information_is_less_sure() -> None:
    """Along that direction alone, whatever the units; its own noise is no reason."""
    rng = np.random.default_rng(0)
    root = rng.normal(size=(5, 5)) * 10.0 ** rng.uniform(-3, 3, (5, 1))
    hessian = root @ root.T
    draws = root @ rng.normal(size=(5, 400))
    same = less_scatter(jnp.asarray(hessian), jnp.asarray(draws @ draws.T / 400), 400)
    np.testing.assert_allclose(same, hessian, rtol=1e-4, atol=1e-5 * hessian.max())

    odd = root[:, :1]
    scatter = hessian + 9.0 * odd @ odd.T
    found = less_scatter(jnp.asarray(hessian), jnp.asarray(scatter), 400)
    inverse = np.linalg.inv(root)  # to where the information is the identity
    values = np.linalg.eigvalsh(inverse @ np.asarray(found, float) @ inverse.T)
    noise = (1.0 + np.sqrt(5 / 400)) ** 2
    np.testing.assert_allclose(values, [noise / 10.0, 1, 1, 1, 1], rtol=5e-3)

    # A parameter that nothing is known of.
    none = jnp.pad(jnp.asarray(hessian), (0, 1))
    wide = less_scatter(none, jnp.pad(jnp.asarray(scatter), (0, 1)), 400)
    assert np.isfinite(wide).all()
    np.testing.assert_allclose(wide[5], 0.0, atol=1e-20)


@pytest.mark.parametrize("limit", [pytest.param(10.0, marks=pytest.mark.slow), 1.5])
def test_a_limit_that_was_not_met_is_not_known(limit: float) -> None:
    """Noise digs a dip into the edge of its plateau, and no score leads out of it."""
    bounds = f'joint="a" forcerange="{-limit} {limit}"'
    m = mujoco.MjModel.from_xml_string(_SLIDER.replace('joint="a"/>', bounds + "/>"))
    quantities = {
        "damping": "joint.a.damping",
        "frictionloss": "joint.a.frictionloss",
        "force_limit": "actuator.push.force_limit",
    }
    named = (declare(m, name, at) for name, at in quantities.items())
    space = ParameterSpace(tuple(named))
    simulator = Simulator(m, space, 0.02)
    truth = space.to_unit(jnp.asarray(space.nominal))
    # Of 8,000 pushes a handful is stronger than what is met from here.
    start = truth.at[2].set(0.0) if limit > 5.0 else truth

    def run(key: jax.Array) -> RefineResult:
        pieces = recorded(simulator, key, jnp.asarray(_SPEED))
        paired = PairedFit(simulator, space, pieces, _NOISE)
        return adjust(paired, polish(paired, start))[0]

    compiled = jax.jit(run, compiler_options=quick_compile())
    for seed in range(3):
        found = compiled(jax.random.key(seed))
        told = float(found.hessian[2, 2])
        if limit > 5.0:
            assert told < 1.0, seed
        else:
            std = np.sqrt(np.diag(np.linalg.inv(found.hessian)))
            assert told > 1e3, seed
            assert abs(found.unit - truth)[2] < 4.0 * std[2], seed
