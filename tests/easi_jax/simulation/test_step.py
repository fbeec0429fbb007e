"""One control step against MuJoCo C, on Cartpole."""

from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx

from easi_jax.simulation import step as physics
from envs.cartpole import Cartpole

STEPS = 200


def tight(m: mujoco.MjModel, timestep: float) -> mujoco.MjModel:
    """A copy that C solves to the end."""
    copy = m.__copy__()
    copy.opt.iterations, copy.opt.ls_iterations = 100, 50
    copy.opt.tolerance, copy.opt.timestep = 1e-14, timestep
    return copy


@pytest.fixture(scope="module")
def episode() -> dict[str, np.ndarray]:
    """Commands held for random times, and what MuJoCo C makes of them."""
    env = Cartpole()
    rng = np.random.default_rng(3)
    ctrl = np.repeat(rng.choice([-0.2, -0.1, 0.1, 0.2], STEPS // 5), 5)[:, None]
    simulator = env.simulator
    limit = np.array([0.6, np.inf])
    m = tight(env.mj_model, simulator.dt / simulator.substeps)
    d = mujoco.MjData(m)
    d.qpos[:], d.qvel[:] = (0.2, 0.3), (0.6, -1.0)
    start = np.concatenate([d.qpos, d.qvel])
    states, forces, ends = [], [], 0
    for u in ctrl:
        d.ctrl[:] = u
        for _ in range(simulator.substeps):
            mujoco.mj_step(m, d)
            d.qvel[:] = np.clip(d.qvel, -limit, limit)
            forces.append(d.actuator_force[0])
            ends += abs(d.qpos[0]) > 0.22
        states.append(np.concatenate([d.qpos, d.qvel]))
    return {
        "ctrl": ctrl,
        "start": start,
        "states": np.array(states),
        "forces": np.array(forces),
        "ends": np.array(ends),
    }


def simulate(episode: dict[str, np.ndarray]) -> np.ndarray:
    env = Cartpole()
    simulator = env.simulator
    model = env.model()

    @jax.jit
    def run(start: jax.Array, ctrl: jax.Array) -> jax.Array:
        def step(state: Any, u: jax.Array) -> Any:
            state = simulator.step(model, state, u)
            return state, jnp.concatenate([state.qpos, state.qvel])

        return jax.lax.scan(step, simulator.start(start[:2], start[2:]), ctrl)[1]

    return np.asarray(run(jnp.asarray(episode["start"]), jnp.asarray(episode["ctrl"])))


def test_the_episode_meets_every_limit(episode: dict[str, np.ndarray]) -> None:
    assert np.mean(np.abs(episode["forces"]) == 5.0) > 0.05
    assert np.mean(np.abs(episode["states"][:, 2]) == 0.6) > 0.05
    assert episode["ends"] > 0


def test_equals_mujoco_c_over_an_episode_x64(episode: dict[str, np.ndarray]) -> None:
    with jax.enable_x64(True):
        got = simulate(episode)
    np.testing.assert_allclose(got, episode["states"], atol=1e-9, rtol=1e-9)


def test_equals_mujoco_c_over_an_episode_float32(
    episode: dict[str, np.ndarray],
) -> None:
    got = simulate(episode)
    assert got.dtype == np.float32
    np.testing.assert_allclose(got, episode["states"], atol=1e-3, rtol=1e-3)


def test_a_saturated_servo_brakes_as_in_c_and_not_as_in_mjx() -> None:
    env = Cartpole()
    m = tight(env.mj_model, 0.005)
    m.actuator_biasprm[0, 2] = -30.0  # kv, so that the difference is large
    d = mujoco.MjData(m)
    d.qpos[:], d.qvel[:], d.ctrl[:] = (-0.15, 0.1), (0.4, 0.5), 0.2
    d.ctrl[0] = -0.2
    with jax.enable_x64(True):
        put = mjx.put_model(m, impl="jax")
        data = mjx.put_data(m, d, impl="jax")
        ours = jax.jit(physics.mjx_step)(put, data)
        theirs = jax.jit(mjx.step)(put, data)
    mujoco.mj_step(m, d)
    assert d.actuator_force[0] == -5.0
    np.testing.assert_allclose(ours.qvel, d.qvel, atol=1e-9)
    assert np.abs(np.asarray(theirs.qvel) - d.qvel).max() > 1e-3
