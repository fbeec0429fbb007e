"""Logs of a controller that acts on what it reads: commands that know of the noise."""

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from easi_jax.data.measured import measured_runs
from easi_jax.data.recording import Log, Run
from easi_jax.data.windows import fitted_velocity
from easi_jax.estimation import from_runs
from easi_jax.estimation.problem import problem_of
from easi_jax.model.distribution import covariance
from easi_jax.model.joint_space import Configuration
from easi_jax.model.parameters import ParameterSpace, declare
from easi_jax.search.config import SearchConfig
from easi_jax.search.easi import Search
from easi_jax.simulation import engine

_DT, _ROWS, _NOISE, _STEP = 0.01, 400, 2e-3, 2e-3  # s, rows, rad, rad
_XML = """<mujoco><option timestep="0.005" integrator="implicitfast"/>
  <worldbody><body name="rod"><joint name="j" axis="0 1 0" damping="0.06"/>
    <geom type="capsule" size="0.02" fromto="0 0 0 0 0 -0.3" mass="0.5"/>
    <body name="tip" pos="0 0 -.3"><joint name="soft" axis="0 1 0" stiffness="1"
        damping="0.02"/>
      <geom type="capsule" size="0.02" fromto="0 0 0 0 0 -0.2" mass="0.2"/></body>
  </body></worldbody>
  <actuator><motor name="a" joint="j"/></actuator></mujoco>"""
_PLACES = {
    "damping": ("joint.j.damping", 0.06),
    "mass": ("body.tip.mass", 0.2),
    "gear": ("actuator.a.gear", 1.0),
}
_SEEDS = 8


def _recorded(m: mujoco.MjModel, seed: int, name: str) -> Run:
    """A stiff loop about a target that wanders, on readings that are noisy and coarse;
    nobody reads the second joint, a spring."""
    rng, d = np.random.default_rng(seed), mujoco.MjData(m)
    turn, phase = rng.uniform(2.0, 9.0, 4), rng.uniform(0.0, 6.0, 4)
    q, ctrl, before = np.zeros((_ROWS, 2)), np.zeros((_ROWS, 1)), 0.0
    for k in range(_ROWS):
        read = d.qpos[0] + _NOISE * rng.normal()
        read = _STEP * np.round(read / _STEP)
        target = 0.25 * np.sin(turn * k * _DT + phase).sum()
        ctrl[k] = 12.0 * (target - read) - 0.3 * (read - before) / _DT
        q[k], before = (read, d.qpos[1]), read
        d.ctrl[:] = ctrl[k]
        mujoco.mj_step(m, d, 2)
    shape = Configuration.of(m)
    q[:, 1] = 0.0  # a guess
    v = fitted_velocity(q, _DT, shape)
    hidden, time = np.array([False, True]), _DT * np.arange(_ROWS)
    return Run(name, name, _DT, time, q, v, False, ctrl, shape, hidden=hidden)


@pytest.mark.slow
def test_an_estimate_from_a_closed_loop_has_no_bias() -> None:
    """Of several machines, with a joint that nobody measured, readings that are coarse,
    and velocities by the positions: errors are as large as they are said to be, and no
    parameter is off by the same in all."""
    m = mujoco.MjModel.from_xml_string(_XML)
    space = ParameterSpace(
        tuple(
            declare(m, name, address, nominal=value, initial=(value / 3, 3 * value))
            for name, (address, value) in _PLACES.items()
        )
    )
    truth = np.asarray(space.to_unit(jnp.asarray(space.nominal)), float)
    off = []
    for seed in range(_SEEDS):
        runs = tuple(_recorded(m, 10 * seed + k, f"r{k}") for k in range(3))
        cleaned = measured_runs(m, Log(runs[:2], ()), Log(runs[2:], ()), 0.2)
        with engine.using("mujoco"):
            problem = problem_of("rod", m, space, cleaned)
            config = SearchConfig(source="replay", horizon=problem.piece, population=4)
            finish = from_runs.ready_finish(problem, Search(problem.simulator, config))
            mean = jnp.asarray(truth + np.random.default_rng(seed).normal(size=3) / 5)
            ((found,), _) = finish(mean[None], 0.04 * jnp.eye(3)[None])
        std = np.sqrt(np.diag(covariance(found.distribution)))
        assert (std < 0.1).all(), "a third of what it may be"
        off.append((np.asarray(found.distribution.mean, float) - truth) / std)
    mean, size = np.mean(off, 0), np.sqrt(np.mean(np.square(off), 0))
    assert (np.abs(mean) < 3.0 / np.sqrt(_SEEDS)).all(), np.round(off, 2)
    # Late commands are in doubt, which they are not.
    assert (size < 1.6).all() and size.mean() > 0.3, np.round(off, 2)
