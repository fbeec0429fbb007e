"""Predictions with effects that an owner wrote, against MuJoCo C."""

from collections.abc import Iterator

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from easi_jax import Number, OwnEffect
from easi_jax.data.recording import Run
from easi_jax.data.windows import fitted_velocity
from easi_jax.estimation.pieces import segments_from_runs
from easi_jax.model.joint_space import Configuration
from easi_jax.model.own_effects import registered
from easi_jax.model.parameters import ParameterSpace
from easi_jax.simulation import engine
from easi_jax.simulation.open_loop import errors
from easi_jax.simulation.simulator import Simulator
from tests.easi_jax.gap.test_late_readings import ARM, DT, STEPS, predictor, rms

SIZE, OFF = 0.8, 0.05


def pulled(now, p):
    return p.size * jnp.sin(2.0 * now.time)


def misread(now, p):
    q = now.position[now.here]
    return q + p.size * jnp.sin(2.0 * q)


TIDE = OwnEffect(
    "tide", "{size}", (Number("size", "N m", -2.0, 2.0),), force=pulled, on="joint"
)
ECCENTRIC = OwnEffect(
    *("eccentric", "{size}", (Number("size", "rad", -0.1, 0.1),)),
    reading=misread,
    on="joint",
)


@pytest.fixture
def own() -> Iterator[None]:
    with registered([TIDE, ECCENTRIC]):
        yield


def recorded(m: mujoco.MjModel, size: float, off: float) -> Run:
    d, c = mujoco.MjData(m), Configuration.of(m)
    t = DT * np.arange(300)
    ctrl = np.stack([2 * np.sin(7 * t) + np.sin(3.1 * t)], 1)
    q = []
    for u in ctrl:
        q.append(d.qpos + off * np.sin(2.0 * d.qpos))
        d.ctrl[:] = u
        for _ in range(STEPS):
            d.qfrc_applied[:] = size * np.sin(2.0 * d.time)
            mujoco.mj_step(m, d)
    qpos = np.array(q)
    return Run("r", "made", DT, t, qpos, fitted_velocity(qpos, DT, c), False, ctrl, c)


@pytest.mark.parametrize(
    "name", ["mujoco", pytest.param("mjx", marks=pytest.mark.slow)]
)
@pytest.mark.parametrize(
    ("effect", "value", "size", "off"),
    [("tide", SIZE, SIZE, 0.0), ("eccentric", OFF, 0.0, OFF)],
)
def test_windows(
    own: None, name, effect, value: float, size: float, off: float
) -> None:
    m = mujoco.MjModel.from_xml_string(ARM.format(""))
    with engine.using(name):
        p, vector = predictor(m, recorded(m, size, off))
        x = np.stack([p.neutral, vector(effect, "a", value)])
        error = p.errors(x)
    without, with_it = rms(error[:, 1:-1, :, 0])  # at a run's end speeds are rough
    assert with_it < 0.06 * without  # speeds come from positions


def test_pieces_know_their_time(own: None) -> None:
    m = mujoco.MjModel.from_xml_string(ARM.format(""))
    run = recorded(m, SIZE, 0.0)
    space = ParameterSpace(())
    off = []
    for fixed in ({}, {"effect.tide.a.size": SIZE}):
        s = Simulator(m, space, DT, fixed=fixed, engine="mujoco")
        pieces = segments_from_runs(s, [run], 20, 50)
        error = errors(s, s.model(jnp.zeros(0)), pieces)
        off.append(float(jnp.sqrt(jnp.mean(error[1:, :, 0] ** 2))))
    assert off[1] < 0.04 * off[0]
