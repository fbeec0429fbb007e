"""Sensors of a log, read in simulation where the log's rows are."""

from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from easi_jax.data.proprioception import proprioception
from easi_jax.errors import UserError
from easi_jax.model.parameters import ParameterSpace
from easi_jax.model.torque_speed import TorqueSpeed
from easi_jax.simulation.engine import Engine
from easi_jax.simulation.reading import ReadingSimulator, reading_env
from easi_jax.simulation.rollout import policy_rollout
from easi_jax.simulation.sent_commands import SentCommands, on_its_feet
from easi_jax.simulation.simulator import Simulator
from tests.walker import DT, walk

STEPS = 5


def test_reads_what_mujoco_does_at_the_beginning_of_a_step() -> None:
    m, run = walk(2.0, kept=True)
    of, _ = proprioception(m, [run], "mujoco")
    simulator = Simulator(m, ParameterSpace(()), DT, engine="mujoco")
    env = reading_env(SentCommands("walker", simulator, [run], STEPS), of.sensors)
    key = jax.random.key(0)

    def act(obs: jax.Array, key: jax.Array) -> jax.Array:
        return jnp.zeros(0)

    seg = jax.jit(lambda k: policy_rollout(env, env.model(), act, k, STEPS))(key)
    data = mujoco.MjData(m)
    for k in range(STEPS):
        data.qpos, data.qvel, data.ctrl = (
            np.asarray(x[k], float) for x in (seg.qpos, seg.qvel, seg.ctrl[:, 0])
        )
        mujoco.mj_forward(m, data)
        read = data.sensordata[list(of.sensors.columns)]
        np.testing.assert_allclose(seg.sensed[k, 0], read, rtol=2e-3, atol=2e-3)


def test_a_state_keeps_its_form_on_either_engine() -> None:
    """On MJX, and on native MuJoCo where a call is made each physics step, a step is a
    scan over states."""
    m, run = walk(2.0, kept=True)
    curve = TorqueSpeed(
        *(jnp.full(4, x) for x in (5.0, 20.0, 9.0, 9.0)), dof=jnp.arange(6, 10)
    )
    kinds: tuple[tuple[Engine, TorqueSpeed | None], ...]
    kinds = ("mjx", None), ("mujoco", curve)
    for engine, torque_speed in kinds:
        of, _ = proprioception(m, [run], engine)
        simulator = Simulator(
            *(m, ParameterSpace(()), DT), torque_speed=torque_speed, engine=engine
        )
        env = reading_env(SentCommands("walker", simulator, [run], STEPS), of.sensors)

        def roll(key: jax.Array, env: Any = env) -> Any:
            def act(obs: jax.Array, key: jax.Array) -> jax.Array:
                return jnp.zeros(0)

            return policy_rollout(env, env.model(), act, key, STEPS)

        seg = jax.eval_shape(roll, jax.random.key(0))
        assert seg.sensed.shape == (STEPS, 1, len(of.sensors))


def test_needs_a_simulator() -> None:
    m, run = walk(2.0)
    of, _ = proprioception(m, [run], "mujoco")

    class Other:
        name, simulator = "other", object()

    with pytest.raises(UserError, match="other: readings of sensors need"):
        reading_env(Other(), of.sensors)


def test_a_hidden_base_stands_on_its_feet() -> None:
    m, run = walk(2.0)
    data = mujoco.MjData(m)
    feet = [m.geom(f"{j}_foot").id for j in "abcd"]
    for row in on_its_feet(m, run)[::30]:
        data.qpos = row
        mujoco.mj_forward(m, data)
        lowest = min(data.geom_xpos[g, 2] - m.geom_size[g, 0] for g in feet)
        assert abs(lowest) < 1e-3 and row[3] == 1.0


def test_too_short_a_log_for_the_commands_is_told() -> None:
    m, run = walk(1.0)
    simulator = Simulator(m, ParameterSpace(()), DT, engine="mujoco")
    with pytest.raises(UserError, match=r"\(walk\) has 50 rows, too few to send 80"):
        SentCommands("walker", simulator, [run], 80)


def test_reading_leaves_an_environments_own_reading_alone() -> None:
    m, run = walk(2.0)
    of, _ = proprioception(m, [run], "mujoco")

    class Height:
        fields, size = ("xipos",), 1

        def __call__(self, xipos: np.ndarray) -> np.ndarray:
            return xipos[:, 1, 2:]

    class Own:
        """The height of the base's center, of either engine."""

        native = Height()

        def __call__(self, m: object, d: object) -> jax.Array:
            return d.xipos[1, 2:]  # type: ignore[attr-defined]

    own = Simulator(m, ParameterSpace(()), DT, Own(), 1, engine="mujoco")
    both = ReadingSimulator(own, of.sensors)
    state = jnp.asarray(run.qpos[9]).at[2].set(0.3), jnp.asarray(run.qvel[9])
    ctrl = jnp.asarray(run.ctrl[9])
    nothing = jnp.zeros(0)
    alone, beside = (
        s.step(s.model(nothing), s.start(*state), ctrl) for s in (own, both)
    )
    np.testing.assert_array_equal(alone.sensed, beside.sensed)
    np.testing.assert_array_equal(alone.qpos, beside.qpos)
    assert beside.read.shape == (len(of.sensors),)
