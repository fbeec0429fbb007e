"""An environment file that was written for version 0.1, as it is."""

import sys
from collections.abc import Iterator
from pathlib import Path

import jax
import numpy as np
import pytest

import easi_jax
from easi_jax._moved import MOVED
from easi_jax.simulation.simulator import Simulator
from envs import load

OLD = '''
import jax
import jax.numpy as jnp
import mujoco

from easi_jax.action_map import ActionMap
from easi_jax.env import EnvState, advance, start
from easi_jax.machine import Machine
from easi_jax.model import Model
from easi_jax.parameters import ParameterSpace, declare
from easi_jax.physics import Physics

XML = """
<mujoco>
  <option timestep="0.02" integrator="implicitfast"/>
  <worldbody><body name="arm">
    <joint name="hinge" axis="0 1 0" damping="0.1"/>
    <geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.02" mass="0.5"/>
  </body></worldbody>
  <actuator><motor name="motor" joint="hinge" gear="2"/></actuator>
</mujoco>
"""


class Arm:
    name, obs_size, action_size, episode_length, dt = "arm", 2, 1, 10, 0.02
    action_map = ActionMap()

    def __init__(self):
        self.mj_model = mujoco.MjModel.from_xml_string(XML)
        one = declare(self.mj_model, "gear", "actuator.motor.gear")
        self.space = ParameterSpace((one,))
        self.machine = Machine(self.mj_model, self.space, self.dt)

    def model(self, theta=None) -> Model:
        nominal = jnp.asarray(self.space.nominal)
        return self.machine.model(nominal if theta is None else theta)

    def reset(self, model, key) -> EnvState:
        physics = self.machine.start(0.1 * jax.random.normal(key, (1,)), jnp.zeros(1))
        return start(physics, self.observe(physics))

    def observe(self, physics: Physics):
        return jnp.concatenate([physics.qpos, physics.qvel])

    def control(self, state, action):
        return self.action_map(None, action)

    def step(self, model, state, action) -> EnvState:
        p = self.machine.step(model, state.physics, self.control(state, action))
        failed = jnp.abs(p.qpos[0]) > 3
        obs = self.observe(p)
        return advance(state, p, obs, jnp.ones(()), failed, self.episode_length)


make = Arm
'''


@pytest.fixture
def afresh(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """As in a process that has imported none of the old names yet."""
    for name in MOVED:
        monkeypatch.delitem(sys.modules, f"easi_jax.{name}", raising=False)
        monkeypatch.delattr(easi_jax, name, raising=False)
    yield
    for name in MOVED:
        sys.modules.pop(f"easi_jax.{name}", None)


@pytest.mark.usefixtures("afresh")
def test_it_runs_and_says_what_to_change(tmp_path: Path) -> None:
    path = tmp_path / "env.py"
    path.write_text(OLD)
    with pytest.warns(DeprecationWarning) as told:
        env = load(path)
    said = "\n".join(str(w.message) for w in told)
    for old, new in (
        ("action_map", "simulation.action_map"),
        ("env", "simulation.env"),
        ("machine", "simulation.simulator"),
        ("parameters", "model.parameters"),
        ("physics", "simulation.step"),
    ):
        line = f"easi_jax.{old} is now easi_jax.{new}: change the import"
        assert line in said
    assert isinstance(env.machine, Simulator)
    assert env.simulator is env.machine

    @jax.jit
    def two(theta: jax.Array) -> jax.Array:
        model = env.model(theta)
        first = env.reset(model, jax.random.key(0))
        after = env.step(model, first, jax.numpy.ones(1))
        return jax.numpy.stack([first.obs, after.obs])

    weak, strong = (np.asarray(two(jax.numpy.array([g]))) for g in (0.0, 4.0))
    np.testing.assert_array_equal(weak[0], strong[0])
    assert strong[1, 1] > weak[1, 1] + 0.1


@pytest.mark.usefixtures("afresh")
@pytest.mark.filterwarnings("ignore:easi_jax:DeprecationWarning")
@pytest.mark.parametrize("name", sorted(MOVED))
def test_every_old_name_is_the_new_module(name: str) -> None:
    old = __import__(f"easi_jax.{name}", fromlist=["x"])
    new = __import__(f"easi_jax.{MOVED[name]}", fromlist=["x"])
    assert old is new
    assert new.__spec__ is not None
    assert new.__spec__.name == f"easi_jax.{MOVED[name]}"
