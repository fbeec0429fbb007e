"""Logs of a joint whose zero is off, from the search's end to what is stated."""

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

_DT, _ROWS, _NOISE, _OFFSET = 0.01, 1000, 1e-4, 0.02  # s, rows, rad, rad
_XML = """<mujoco><option timestep="0.005" integrator="implicitfast"/>
  <worldbody><body><joint name="shoulder" axis="0 1 0" damping="0.2"
      armature="0.01"/>
    <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.03" mass="1"/>
    <body name="fore" pos="0.3 0 0"><joint name="elbow" axis="0 1 0" damping="0.08"
        armature="0.005"/>
      <geom type="capsule" fromto="0 0 0 0.25 0 0" size="0.025" mass="0.66"/></body>
  </body></worldbody>
  <actuator><position name="s" joint="shoulder" kp="40" kv="1.5"/>
    <position name="e" joint="elbow" kp="20" kv="0.6"/></actuator></mujoco>"""
_PLACES = {
    "damping": ("joint.elbow.damping", 0.08),
    "kp": ("actuator.e.kp", 20.0),
    "mass": ("body.fore.mass", 0.66),
}


def _recorded(m: mujoco.MjModel, seed: int, name: str) -> Run:
    rng, d = np.random.default_rng(seed), mujoco.MjData(m)
    turn, phase = rng.uniform(0.6, 7.0, (2, 4)), rng.uniform(0.0, 6.0, (2, 4))
    q, ctrl = np.zeros((_ROWS, 2)), np.zeros((_ROWS, 2))
    for k in range(_ROWS):
        ctrl[k] = 0.35 * np.sin(turn * k * _DT + phase).sum(1)
        q[k] = d.qpos + [0.0, _OFFSET] + _NOISE * rng.normal(size=2)
        d.ctrl[:] = ctrl[k]
        mujoco.mj_step(m, d, 2)
    shape = Configuration.of(m)
    v, time = fitted_velocity(q, _DT, shape), _DT * np.arange(_ROWS)
    return Run(name, name, _DT, time, q, v, False, ctrl, shape)


@pytest.mark.slow
def test_an_offset_does_not_move_what_is_stated() -> None:
    """Without the offset in mind, the best fit has no damping at all: as good as zero,
    where the logarithm has no slope. What is fitted with it finds the way back."""
    m = mujoco.MjModel.from_xml_string(_XML)
    space = ParameterSpace(
        tuple(
            declare(m, name, address, nominal=value, initial=(value / 3, 3 * value))
            for name, (address, value) in _PLACES.items()
        )
    )
    truth = np.asarray(space.to_unit(jnp.asarray(space.nominal)), float)
    runs = tuple(_recorded(m, k, f"r{k}") for k in range(3))
    cleaned = measured_runs(m, Log(runs[:2], ()), Log(runs[2:], ()), 0.2)
    with engine.using("mujoco"):
        problem = problem_of("arm", m, space, cleaned)
        config = SearchConfig(source="replay", horizon=problem.piece, population=4)
        finish = from_runs.ready_finish(problem, Search(problem.simulator, config))
        mean = jnp.asarray(truth + np.array([0.2, -0.2, 0.1]))
        ((found,), notes) = finish(mean[None], 0.04 * jnp.eye(3)[None])
    std = np.sqrt(np.diag(covariance(found.distribution)))
    off = np.asarray(found.distribution.mean, float) - truth
    assert (np.abs(off) < 3.0 * std).all() and (std < 0.05).all(), (off, std)
    assert any('readings of "elbow" have an offset, by 0.02' in n for n in notes)
