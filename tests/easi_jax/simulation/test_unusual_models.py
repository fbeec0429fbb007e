"""Models whose parts MJX stumbles over move as in MuJoCo C."""

from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco.mjx._src.types import ConeType

from easi_jax.model.parameters import ParameterSpace
from easi_jax.simulation.simulator import Simulator

BALL = """<body pos="0 {0} 0.05"><joint type="slide" axis="1 0 0" damping="0.01"/>
<joint type="slide" axis="0 0 1"/><geom size="0.05" mass="1" {1}/></body>"""
FLOOR = """<mujoco><option timestep="0.002" cone="elliptic" impratio="20"
integrator="implicitfast" iterations="30" ls_iterations="30"/><worldbody>
<geom type="plane" size="5 5 .1" condim="1" friction="0.5"/>{0}</worldbody></mujoco>"""
LINKED = """<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody>
<site name="post" pos="0.3 0 1"/><body pos="0 0 1"><joint name="j" axis="0 1 0"/>
<geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.02" mass="0.5"/>
<site name="tip" pos="0 0 -0.3"/></body></worldbody><tendon><spatial name="s"
stiffness="20" damping="0.3" springlength="0.2"><site site="post"/><site site="tip"/>
</spatial></tendon><sensor><touch site="tip"/><rangefinder site="tip"/><e_kinetic/>
</sensor></mujoco>"""
STEPS, SUBSTEPS = 40, 5


def moved(m: mujoco.MjModel, qvel: Any) -> tuple[np.ndarray, np.ndarray, Simulator]:
    """Positions by us and by MuJoCo C."""
    simulator = Simulator(m, ParameterSpace(()), SUBSTEPS * m.opt.timestep)

    @jax.jit
    def run(qvel: jax.Array) -> jax.Array:
        def step(s: Any, _: None) -> Any:
            s = simulator.step(simulator.base, s, jnp.zeros(m.nu))
            return s, s.qpos

        first = simulator.start(jnp.asarray(m.qpos0, jnp.float32), qvel)
        return jax.lax.scan(step, first, None, length=STEPS)[1]

    d, want = mujoco.MjData(m), []
    d.qvel[:] = qvel
    for _ in range(STEPS):
        mujoco.mj_step(m, d, SUBSTEPS)
        want.append(d.qpos.copy())
    return np.asarray(run(jnp.asarray(qvel, jnp.float32))), np.array(want), simulator


@pytest.mark.parametrize("other", [1, 3])
def test_frictionless_contacts_with_an_elliptic_cone(other: int) -> None:
    balls = BALL.format(0, 'condim="1"') + BALL.format(1, f'condim="{other}"')
    m = mujoco.MjModel.from_xml_string(FLOOR.format(balls))
    got, want, simulator = moved(m, [0.5, -0.1, 0.5, -0.1])
    np.testing.assert_allclose(got, want, atol=2e-5)
    slower = want[-1, 0] - want[-1, 2]
    assert slower > 0.1 if other > 1 else slower == pytest.approx(0)
    # Without friction at all the pyramid is the same, and faster here.
    cone = simulator.base.mjx.opt.cone
    assert cone == (ConeType.ELLIPTIC if other > 1 else ConeType.PYRAMIDAL)


def test_a_tendon_and_sensors_that_nobody_reads() -> None:
    got, want, _ = moved(mujoco.MjModel.from_xml_string(LINKED), [2.0])
    np.testing.assert_allclose(got, want, atol=2e-5)
    assert np.ptp(want) > 0.1
