"""Cartpole's task: reset, reward, end, time limit, parameters."""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from easi_jax.simulation.env import EnvState
from envs.cartpole import Cartpole, space


@pytest.fixture(scope="module")
def env() -> Cartpole:
    return Cartpole()


@pytest.fixture(scope="module")
def step(env: Cartpole) -> Any:
    """One step from (x, angle, v, rate) with an action, batched."""

    @jax.jit
    def run(states: jax.Array, actions: jax.Array, count: jax.Array) -> EnvState:
        model = env.model()

        def one(s: jax.Array, a: jax.Array) -> EnvState:
            start = env.reset(model, jax.random.key(0))
            physics = env.simulator.start(s[:2], s[2:])
            return env.step(model, replace(start, physics=physics, count=count), a)

        return jax.vmap(one)(states, actions)

    return lambda s, a, count=0: run(
        jnp.asarray(s, jnp.float32),
        jnp.broadcast_to(jnp.asarray(a, jnp.float32), (len(s), 1)),
        jnp.asarray(count, jnp.int32),
    )


def test_reset_is_uniform_in_its_ranges(env: Cartpole) -> None:
    keys = jax.random.split(jax.random.key(0), 2000)
    s = jax.vmap(lambda k: env.reset(env.model(), k))(keys)
    half = np.array([0.1, 0.2, 0.1, 0.2])
    obs = np.asarray(s.obs)
    assert (np.abs(obs) <= half).all()
    np.testing.assert_allclose(obs.std(0), half / 3**0.5, rtol=0.05)
    for x in (s.reward, s.terminated, s.truncated, s.count):
        assert (np.asarray(x) == 0).all()


def test_reward_and_end(step: Any) -> None:
    states = [
        [0.0, 0.1, 0.2, 0.5],
        [0.175, 0.0, 0.59, 0.0],  # beyond 0.18 m after the step
        [0.0, 1.55, 0.0, 3.0],  # beyond 90 degrees
        [-0.175, 0.0, -0.59, 0.0],
        [np.nan, 0.0, 0.0, 0.0],
    ]
    s = step(states, [[0.0], [1.0], [0.0], [-1.0], [0.0]])
    _, v, angle, rate = np.asarray(s.obs[0])
    want = 1 - angle**2 - 0.01 * abs(v) - 0.005 * abs(rate)
    assert float(s.reward[0]) == pytest.approx(want, rel=1e-5)
    assert abs(s.obs[1, 0]) > 0.18 and abs(s.obs[2, 2]) > np.pi / 2
    np.testing.assert_array_equal(s.terminated, [0, 1, 1, 1, 1])
    np.testing.assert_array_equal(s.reward[1:], -2.0)
    np.testing.assert_array_equal(s.truncated, 0)


def test_observation_is_position_speed_angle_rate(env: Cartpole) -> None:
    physics = env.simulator.start(jnp.array([1.0, 3.0]), jnp.array([2.0, 4.0]))
    np.testing.assert_array_equal(env.observe(physics), [1, 2, 3, 4])
    assert env.obs_names == ("x", "v", "angle", "rate")


def test_action_is_a_cart_target_and_saturates(env: Cartpole, step: Any) -> None:
    start: Any = None  # a cart's target does not depend on its state
    got = [float(env.control(start, jnp.array([a]))[0]) for a in (0.5, 1.0, 3.0, -3.0)]
    np.testing.assert_allclose(got, [0.1, 0.2, 0.2, -0.2], rtol=1e-6)
    s = step(np.zeros((3, 4)), [[1.0], [5.0], [-1.0]])
    np.testing.assert_array_equal(s.obs[0], s.obs[1])
    assert s.obs[0, 1] > 0.05 > -0.05 > s.obs[2, 1]


def test_time_limit_counts_only_where_the_task_goes_on(step: Any) -> None:
    states = [[0.0, 0.0, 0.0, 0.0], [0.3, 0.0, 0.0, 0.0]]
    np.testing.assert_array_equal(step(states, 0.0, 198).truncated, [0, 0])
    late = step(states, 0.0, 199)
    np.testing.assert_array_equal(late.truncated, [1, 0])
    np.testing.assert_array_equal(late.terminated, [0, 1])
    assert late.count[0] == 200


def test_an_upright_pole_falls_and_the_cart_speed_is_limited(step: Any) -> None:
    s = step([[0.0, 0.05, 0.0, 0.0], [-0.15, 0.0, 0.6, 0.0]], [[0.0], [1.0]])
    assert s.obs[0, 2] > 0.05  # gravity takes a pole that leans to +x further there
    assert s.obs[1, 1] == pytest.approx(0.6)


def test_nominal_parameters_are_the_models(env: Cartpole) -> None:
    m = env.mj_model
    value = dict(zip(env.space.names, env.space.nominal, strict=True))
    assert len(value) == 11
    assert value["cart_mass"] == m.body("cart").mass[0]
    assert value["pole_mass"] == m.body("pole").mass[0]
    assert value["pole_length"] == 2 * m.geom("pole").size[2]
    assert value["cart_kp"] == m.actuator("cart").gainprm[0]
    assert value["cart_kv"] == -m.actuator("cart").biasprm[2]
    assert value["cart_force_limit"] == m.actuator("cart").forcerange[1]
    assert value["pole_armature"] == m.joint("pole").armature[0]
    low, high = space(2.0).initial
    np.testing.assert_allclose(high / low, 4.0)


def test_every_parameter_changes_the_motion(env: Cartpole) -> None:
    @jax.jit
    def end(theta: jax.Array) -> jax.Array:
        model = env.model(theta)
        # To reach the force limit, the speed limit and stick alike.
        start = env.simulator.start(jnp.array([-0.19, 0.2]), jnp.array([0.0, 1.0]))
        ctrl = jnp.array([0.2] * 25 + [-0.2] * 5)[:, None]

        def step(s: Any, u: jax.Array) -> Any:
            s = env.simulator.step(model, s, u)
            return s, jnp.concatenate([s.qpos, s.qvel])

        return jax.lax.scan(step, start, ctrl)[1]

    nominal = jnp.asarray(env.space.nominal)
    base = end(nominal)
    assert np.isfinite(base).all()
    for i, name in enumerate(env.space.names):
        moved = end(nominal.at[i].multiply(0.8))
        assert np.abs(moved - base).max() > 1e-5, name
