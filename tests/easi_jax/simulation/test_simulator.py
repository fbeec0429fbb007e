"""Control step, names and the tangent space of a robot's states."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from easi_jax.errors import UserError
from easi_jax.model.parameters import ParameterSpace, declare
from easi_jax.simulation.simulator import Simulator
from envs import make

XML = """<mujoco><option timestep="0.004"/><worldbody>
<body name="base" pos="0 0 1"><freejoint name="root"/><geom size="0.1" mass="1"/>
 <body pos="0.2 0 0"><joint name="shoulder" type="ball"/><geom size="0.05" mass="0.3"/>
  <body pos="0.2 0 0"><joint name="elbow" type="hinge" axis="0 1 0"/>
   <geom size="0.05" mass="0.2"/></body></body></body></worldbody></mujoco>"""


def simulator(dt: float | None = None) -> Simulator:
    m = mujoco.MjModel.from_xml_string(XML)
    space = ParameterSpace((declare(m, "mass", "body.base.mass"),))
    return Simulator(m, space, dt)


def test_names_follow_the_layout_of_a_difference() -> None:
    names = simulator().state_names
    assert len(names) == len(set(names)) == 2 * 10
    assert names[5:10] == (
        "qpos.root.5",
        *(f"qpos.shoulder.{i}" for i in range(3)),
        "qpos.elbow",
    )
    assert names[10] == "qvel.root.0" and names[-1] == "qvel.elbow"


@pytest.mark.parametrize(
    ("dt", "substeps"), [(None, 1), (0.02, 5), (0.01, 3), (0.001, 1), (0.0040000001, 1)]
)
def test_physics_steps_fill_the_control_step(dt: float | None, substeps: int) -> None:
    m = simulator(dt)
    assert m.substeps == substeps
    step = float(m.base.mjx.opt.timestep)
    assert step * substeps == pytest.approx(dt or 0.004, rel=1e-5)
    assert step <= 0.004 * (1 + 1e-5)


@pytest.mark.parametrize("dt", [0.0, -0.02, 20.0])
def test_an_impossible_control_step_is_told(dt: float) -> None:
    with pytest.raises(UserError, match="control step"):
        simulator(dt)


def test_difference_and_move_are_mujocos() -> None:
    with jax.enable_x64(True):
        m = simulator()
        rng = np.random.default_rng(0)
        difference, move = jax.jit(m.difference), jax.jit(m.move)
        for _ in range(5):
            qa, qb = rng.normal(size=(2, 12))
            for q in (qa, qb):
                q[3:7] /= np.linalg.norm(q[3:7])
                q[7:11] /= np.linalg.norm(q[7:11])
            va, vb = rng.normal(size=(2, 10))
            want = np.zeros(10)
            mujoco.mj_differentiatePos(m.mj_model, want, 1.0, qa, qb)
            got = np.asarray(difference(qa, va, qb, vb))
            np.testing.assert_allclose(got[:10], want, atol=1e-9)
            np.testing.assert_allclose(got[10:], vb - va, atol=1e-12)
            moved = qa.copy()
            mujoco.mj_integratePos(m.mj_model, moved, want, 1.0)
            np.testing.assert_allclose(move(qa, want), moved, atol=1e-9)


def test_no_difference_is_zero_with_a_finite_slope() -> None:
    m = simulator()
    q = jnp.zeros(12).at[3].set(1.0).at[7].set(1.0)
    v = jnp.zeros(10)
    np.testing.assert_array_equal(jax.jit(m.difference)(q, v, q, v), 0.0)
    slope = jax.jit(jax.jacfwd(lambda t: m.difference(q, v, m.move(q, t), v)[:10]))(v)
    np.testing.assert_allclose(slope, np.eye(10), atol=1e-4)


@pytest.mark.parametrize("cpu", [True, False])
def test_a_device_works_on_as_many_as_suit_it(
    cpu: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A core on what its cache holds, an accelerator on thousands."""
    monkeypatch.setattr("easi_jax.simulation.simulator.on_cpu", lambda: cpu)
    env = make("cartpole")
    assert (Simulator(env.mj_model, env.space, env.dt).batch >= 4096) != cpu
