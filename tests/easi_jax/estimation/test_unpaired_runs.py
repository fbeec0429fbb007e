"""Logs of a robot under its controller, made ready."""

from dataclasses import replace
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.export import drawn_policy
from easi_jax.data.measured import MeasuredRuns
from easi_jax.data.noise import pooled_noise
from easi_jax.errors import UserError
from easi_jax.estimation.unpaired_runs import (
    acting,
    at_control_step,
    command_step,
    stretches,
    unpaired_problem,
)
from easi_jax.model.parameters import ParameterSpace
from easi_jax.rl.networks import act
from easi_jax.search.unpaired import MEMORY
from easi_jax.simulation.sent_commands import SentCommands
from easi_jax.simulation.simulator import Simulator
from tests.walker import DT, walk


def test_of_dense_rows_those_are_kept_in_which_commands_change() -> None:
    _, run = walk(4.0)
    held = np.repeat(np.arange(50.0), 4)[: len(run)]
    ctrl = np.roll(held, 3)[:, None] * np.ones(4)
    dense = replace(run, ctrl=ctrl, dt=DT / 4, time=DT / 4 * np.arange(len(run)))
    (thin,) = at_control_step([dense], DT)
    assert thin.dt == pytest.approx(DT)
    np.testing.assert_array_equal(thin.qpos, dense.qpos[3::4])
    np.testing.assert_array_equal(thin.sensors["gyro"], dense.sensors["gyro"][3::4])
    np.testing.assert_array_equal(thin.ctrl[:-1, 0] + 1, thin.ctrl[1:, 0])
    # A sensor as fast as the controller reads a row later, and is missing once.
    gyro = np.full_like(dense.sensors["gyro"], np.nan)
    gyro[::4] = dense.sensors["gyro"][::4]
    gyro[40] = np.nan
    slow = replace(dense, sensors={**dense.sensors, "gyro": gyro})
    (thin,) = at_control_step([slow], DT)
    before = dense.sensors["gyro"][:-3:4]
    np.testing.assert_array_equal(
        np.isnan(thin.sensors["gyro"][:, 0]), [k == 10 for k in range(len(thin))]
    )
    there = np.arange(len(thin)) != 10
    np.testing.assert_array_equal(
        thin.sensors["gyro"][there], before[: len(thin)][there]
    )


def test_rows_follow_a_clock_that_drifts() -> None:
    """Commands every 10.05 rows: each row that is kept is one in which they change."""
    _, run = walk(40.0)
    number = np.floor(np.arange(len(run)) / 10.05)
    drifting = replace(run, ctrl=number[:, None] * np.ones(4), dt=DT / 10)
    assert command_step(drifting) == pytest.approx(DT)
    (thin,) = at_control_step([drifting], DT)
    np.testing.assert_array_equal(np.diff(thin.ctrl[:, 0]), 1.0)


@pytest.mark.parametrize("share", [0.7, 1.5])
def test_rows_that_do_not_divide_a_step_are_told(share: float) -> None:
    _, run = walk(2.0)
    with pytest.raises(UserError, match="walk has a row every"):
        at_control_step([replace(run, dt=share * DT)], DT)


def test_a_policy_sees_what_it_was_asked_for() -> None:
    from envs import make

    env = make("cartpole")
    policy = drawn_policy(env)
    obs = jnp.linspace(-0.2, 0.2, env.obs_size)
    at = env.obs_names.index(env.obs_names[2])
    told = acting(env, policy, {env.obs_names[2]: 0.4}, False)
    want = act(policy, obs.at[at].set(0.4), deterministic=True)
    np.testing.assert_array_equal(told(policy, obs, jax.random.key(0)), want)
    drawn = acting(env, policy, {}, True)
    one, other = (drawn(policy, obs, jax.random.key(k)) for k in (0, 1))
    assert np.abs(one - other).max() > 0


def test_pieces_cross_no_run_and_offsets_say_nothing() -> None:
    m, run = walk(8.0)
    simulator = Simulator(m, ParameterSpace(()), DT, engine="mujoco")
    off = {"gyro": run.sensors["gyro"] + 3.0}
    shifted = replace(run, sensors={**run.sensors, **off})
    found = []
    for each in (run, shifted):
        parts = [each, replace(each, name="again")]
        given = MeasuredRuns((each,), pooled_noise([run]), parts, parts, "all", [])
        env = SentCommands("walker", simulator, parts, 75)
        problem = unpaired_problem(env, None, given, 250)
        found.append(problem.data().pieces)
    # 200 of 250 rows of a simulation are compared: so long are stretches of the log.
    count = sum(len(part) - MEMORY - 1 for part in stretches([run], 200))
    assert found[0].weight.shape == (2 * count,)
    np.testing.assert_allclose(found[0].before[:count], found[0].before[count:])
    np.testing.assert_allclose(found[0].before, found[1].before, atol=1e-4)


def test_too_few_rows_are_told() -> None:
    m, run = walk(1.0)
    given = MeasuredRuns((run,), pooled_noise([run]), [run], [run], "all", [])
    simulator = Simulator(m, ParameterSpace(()), DT, engine="mujoco")
    env = SimpleNamespace(
        name="walker", dt=DT, mj_model=m, simulator=simulator, action_size=0
    )
    with pytest.raises(UserError, match="47 pieces of 4 rows: record 2 s"):
        unpaired_problem(env, None, given, 250)
