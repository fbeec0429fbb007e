"""Parameters written into an `MjModel` are those of a model that MuJoCo compiled."""

from typing import Any

import mujoco
import numpy as np
import pytest

from easi_jax.model.parameters import ParameterSpace, declare
from easi_jax.simulation.mujoco_c import InMujoco
from easi_jax.simulation.simulator import Simulator
from envs import make
from tests.envs.robots import CASES, compiled

STEPS = 40


def rollout(m: mujoco.MjModel, start: tuple[Any, Any], ctrl: np.ndarray) -> np.ndarray:
    m.opt.iterations, m.opt.ls_iterations, m.opt.tolerance = 100, 50, 1e-14
    d = mujoco.MjData(m)
    d.qpos[:], d.qvel[:] = start
    rows = []
    for u in ctrl:
        d.ctrl[:] = u
        mujoco.mj_step(m, d)
        rows.append(np.concatenate([d.qpos, d.qvel]))
    return np.array(rows)


@pytest.mark.parametrize(
    "name",
    [
        "cartpole",
        pytest.param("ballbalance", marks=pytest.mark.slow),
        pytest.param("go2", marks=pytest.mark.slow),
    ],
)
def test_moves_as_a_model_compiled_with_the_values(name: str) -> None:
    case = CASES[name]
    env, rng = case.make(), np.random.default_rng(0)
    write = InMujoco(env.simulator)
    unit = rng.uniform(0.2, 0.8, env.space.size)
    si = np.asarray(env.space.to_si(unit), float)
    unit = np.asarray(env.space.to_unit(si), float)
    got = write.at(unit)
    want, _ = compiled(env, dict(zip(env.space.names, si, strict=True)))
    assert got.opt.timestep == want.opt.timestep
    home = want.key_qpos[0] if want.nkey else want.qpos0
    start = case.start or (home, np.zeros(want.nv))
    ctrl = np.repeat([case.commands(env, rng) for _ in range(4)], STEPS // 4, axis=0)
    ours, theirs = (rollout(m, start, ctrl) for m in (got, want))
    # Single precision is that of the values given.
    np.testing.assert_allclose(ours, theirs, atol=2e-5)
    still = rollout(write.at(np.full(env.space.size, 0.5)), start, ctrl)
    assert np.abs(still - theirs).max() > 1e-3, "the parameters changed something"
    no_word = [n for n, r in zip(env.space.names, write.reaches, strict=True) if not r]
    assert no_word == (["cart_speed_limit"] if name == "cartpole" else [])


def test_fixed_values_stay_and_bounds_hold() -> None:
    m = make("cartpole").mj_model
    mass = declare(m, "cart_mass", "body.cart.mass", bounds=(0.1, 0.5))
    space = ParameterSpace((mass,)).with_initial([0.2], [0.4])
    fixed = {"joint.pole.damping": 0.02, "effect.delay.cart": 0.01}
    write = InMujoco(Simulator(m, space, 0.02, fixed=fixed))
    model = write.at(np.array([50.0]))
    assert model.body("cart").mass[0] == pytest.approx(0.5)
    assert model.dof_damping[1] == pytest.approx(0.02)
    assert m.dof_damping[1] != pytest.approx(0.02), "the model given is as it was"
    assert write.reaches.all()
