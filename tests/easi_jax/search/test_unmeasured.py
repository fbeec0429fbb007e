"""The search is not told what nobody measured."""

import dataclasses
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from easi_jax.data.measured import MeasuredRuns
from easi_jax.data.recording import Run
from easi_jax.data.unmeasured import start_spread
from easi_jax.estimation.from_runs import search_data, spread_of_starts
from easi_jax.estimation.held_out import held_out_errors
from easi_jax.estimation.pieces import visible_steps
from easi_jax.estimation.problem import Problem, problem_of
from easi_jax.estimation.weights import step_weights
from easi_jax.model.joint_space import Configuration
from easi_jax.model.parameters import ParameterSpace, declare
from easi_jax.search.config import SearchConfig
from easi_jax.search.easi import Search
from easi_jax.simulation import engine

DT = 0.01
XML = """<mujoco><compiler angle="radian"/><option timestep="0.005"/><worldbody>
<body pos="0 0 1"><joint name="drive" axis="0 1 0" damping="0.5" armature="0.01"/>
<joint name="play" axis="0 1 0" range="-.04 .04" stiffness="50" damping="0.05"/>
<geom type="capsule" fromto="0 0 0 0 0 -.2" size=".02" mass=".2"/></body></worldbody>
<actuator><motor name="m" joint="drive"/></actuator></mujoco>"""


def _recorded(m: mujoco.MjModel, rows: int) -> Run:
    d, c = mujoco.MjData(m), Configuration.of(m)
    t = DT * np.arange(rows)
    out, ctrl = np.empty((2, rows, m.nv)), 0.6 * np.sin(6 * t)[:, None]
    for k in range(rows):
        out[:, k] = d.qpos, d.qvel
        d.ctrl[:] = ctrl[k]
        mujoco.mj_step(m, d, 2)
    out[:, :, 1] = 0.0
    hidden = np.array([False, True])
    qpos, qvel = out
    return Run("r", "r", DT, t, qpos, qvel, True, ctrl, c, hidden=hidden)


@pytest.fixture(scope="module")
def problem() -> Problem:
    m = mujoco.MjModel.from_xml_string(XML)
    space = ParameterSpace(
        (declare(m, "damping", "joint.drive.damping", nominal=0.5, initial=(0.2, 1)),)
    )
    run = _recorded(m, 120)
    noise = np.array([1e-3, np.inf, 1e-2, np.inf])
    with engine.using("mujoco"):
        runs = MeasuredRuns((run,), noise, [run], [run], "r", [])
        return problem_of("drive", m, space, runs)


def test_the_problem_knows_what_is_hidden(problem: Problem) -> None:
    assert np.isinf(problem.noise).tolist() == [False, True, False, True]
    assert problem.measured.tolist() == [True, False]
    assert not any("not the derivative" in n for n in problem.notes)
    m, run = problem.simulator.mj_model, problem.fit[0]
    given = problem.simulator.space
    runs = MeasuredRuns((run,), problem.noise, [run], [run], "r", [])
    with engine.using("mujoco"):
        told = problem_of("drive", m, given, runs, noise=(0.1, 0.2, 0.3, 0.4))
    assert told.noise.tolist() == [0.1, np.inf, 0.3, np.inf]
    noise = np.array([1e-9, np.inf, 1e-9, np.inf])
    assert visible_steps([run], noise, 20, 30.0) == 1


def test_starts_are_as_wide_as_the_model_allows(problem: Problem) -> None:
    m, runs = problem.simulator.mj_model, problem.fit
    spread = start_spread(m, runs)
    found = np.asarray(
        spread_of_starts(m, runs, jnp.asarray(problem.noise), problem.measured)
    )
    np.testing.assert_allclose(found, [1e-3, spread[1], 1e-2, spread[3]], rtol=1e-6)
    assert 0 < spread[1] <= 0.04


def test_what_is_not_measured_weighs_nothing(problem: Problem) -> None:
    data = search_data(problem)
    misfit = jnp.array([0.0, jnp.inf, 1e-2, jnp.inf])
    weight = step_weights(data.segments, jnp.asarray(problem.noise), misfit)
    assert np.isfinite(weight).all() and not np.asarray(weight)[..., 1::2].any()
    np.testing.assert_allclose(weight[..., 2], 0.5 * weight[..., 0], rtol=1e-6)


@pytest.mark.parametrize(("innovations", "deltas"), [(True, False), (False, False)])
def test_the_discriminator_is_not_told(
    problem: Problem, innovations: bool, deltas: bool
) -> None:
    config = replace(
        SearchConfig(source="replay", horizon=problem.piece, population=4, segments=8),
        innovation_inputs=innovations,
        delta_inputs=deltas,
    )
    search, data = Search(problem.simulator, config), search_data(problem)
    assert np.isfinite(data.noise).all() and data.hidden.tolist() == [False, True] * 2
    outcome = jnp.ones((3, problem.piece * 4))
    told = np.asarray(search._told(data, outcome)).reshape(3, -1, 4)
    assert told[..., 0::2].all() and not told[..., 1::2].any()
    assert search._told(dataclasses.replace(data, hidden=()), outcome) is outcome
    if innovations:
        state, info = jax.jit(search.step)(search.init(jax.random.key(0), data), data)
        assert np.isfinite(info.loss) and np.isfinite(state.mean).all()
        assert int(info.non_finite) == 0


def test_held_out_errors_are_of_what_was_measured(problem: Problem) -> None:
    class Errors:
        count = 7

        def of(self, theta: jax.Array) -> tuple[np.ndarray, int]:
            return np.array([0.2, 9.0]), 2

        def with_floor(self, theta: jax.Array) -> tuple[np.ndarray, int, np.ndarray]:
            return np.array([0.2, 9.0]), 1, np.array([0.05, 9.0])

    ready: Any = Errors(), Errors()
    found = held_out_errors(problem, problem.simulator.space, [jnp.ones(1)], ready)
    assert found.channels == ["drive"] and found.units == ["rad"]
    assert found.before == [0.2] and found.floor == [[0.05]] and found.fit == [1.0]
    assert found.windows == 7 and found.not_finite == [2, 1]
