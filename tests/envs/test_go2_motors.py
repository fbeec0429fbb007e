"""The torque-speed curve of the Go2's motors."""

from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from easi_jax.errors import UserError
from easi_jax.pipeline.stages import Pipeline, PipelineConfig
from easi_jax.simulation import engine
from envs import make, open_env
from envs.go2 import MOTOR, motor_curve


def test_the_curve_is_flat_then_falls_to_nothing_and_brakes_at_any_speed() -> None:
    corner, free, driving, braking = MOTOR
    for speed, most, least in (
        (0.0, braking, -braking),
        (corner, driving, -braking),
        (0.5 * (corner + free), 0.5 * driving, -braking),
        (free + 1, 0.0, -braking),
        (-free - 1, braking, 0.0),
    ):
        qvel = jnp.zeros(18).at[6].set(speed)
        np.testing.assert_allclose(
            motor_curve().limits(qvel)[0], (least, most), rtol=1e-6
        )
    knee = motor_curve().limits(jnp.zeros(18))[2, 1]
    np.testing.assert_allclose(knee, braking * 45.43 / 23.7, rtol=1e-6)


@pytest.fixture(
    scope="module", params=["mujoco", pytest.param("mjx", marks=pytest.mark.slow)]
)
def kicked(request: pytest.FixtureRequest) -> Any:
    """States of a Go2 thrown into the air with fast joints, strong commands."""
    out = {}
    for curve in (False, True):
        with engine.using(request.param):
            env = make("go2", torque_speed=curve)
        qpos, qvel = _start(env)
        model = env.model()
        step = jax.jit(env.simulator.step)
        state, states = env.simulator.start(qpos, qvel), []
        for u in _commands(env):
            state = step(model, state, jnp.asarray(u, jnp.float32))
            states.append(np.concatenate([state.qpos, state.qvel]))
        out[curve] = np.array(states)
    return out


def _start(env: Any) -> tuple[Any, Any]:
    qpos = jnp.asarray(env.mj_model.key_qpos[0]).at[2].set(3.0)
    qvel = jnp.zeros(18).at[6:].set(jnp.tile(jnp.array([8.0, -20.0, 12.0]), 4))
    return qpos, qvel


def _commands(env: Any) -> np.ndarray:
    low, high = env.mj_model.actuator_ctrlrange.T
    return np.array([low if k % 2 else high for k in range(5)])


def test_equals_mujoco_c_with_limits_set_before_each_step(kicked: Any) -> None:
    env = make("go2")
    m, d = env.mj_model, mujoco.MjData(env.mj_model)
    own = m.actuator_forcerange.copy()
    curve = motor_curve()
    d.qpos[:], d.qvel[:] = _start(env)
    for u, ours in zip(_commands(env), kicked[True], strict=True):
        d.ctrl[:] = u
        for _ in range(env.simulator.substeps):
            limits = np.asarray(curve.limits(jnp.asarray(d.qvel)))
            m.actuator_forcerange[:, 0] = np.maximum(own[:, 0], limits[:, 0])
            m.actuator_forcerange[:, 1] = np.minimum(own[:, 1], limits[:, 1])
            mujoco.mj_step(m, d)
        np.testing.assert_allclose(ours[:19], d.qpos, atol=2e-3)


def test_the_curve_changes_a_fast_motion(kicked: Any) -> None:
    assert np.abs(kicked[True] - kicked[False])[:, 7:19].max() > 0.02


def test_options_by_name_and_their_mistakes() -> None:
    full = open_env("go2", None, ("parameters=full", "torque_speed=true"))
    assert full.space.size == 25 and full.simulator.base.torque_speed is not None
    for options, said in (
        (("parameter=full",), 'no option "parameter"'),
        (("full",), "write NAME=VALUE"),
        (("parameters=all",), "unknown parameters"),
        (("torque_speed=maybe",), "true or false"),
        (("episode_length=\u00b2",), "whole number"),
        (("episode_length=0",), "whole number"),
        (("commands=3",), "cannot be given on the command line"),
    ):
        with pytest.raises(UserError, match=said):
            open_env("go2", None, options)
    with pytest.raises(UserError, match="no option"):
        open_env("cartpole", None, ("parameters=full",))


def test_a_search_simulates_the_motors_too() -> None:
    with engine.using("mujoco"):
        env, ant = make("go2", torque_speed=True), make("ant")
        pipe = Pipeline(env, PipelineConfig(), start=(0.5, 2.0))
        other = Pipeline(ant, PipelineConfig())
    assert pipe.simulator.base.torque_speed is not None
    assert other.simulator.base.sense_size == ant.simulator.base.sense_size > 0
