"""The smallest robot with a task: one joint, one motor, nothing that takes long."""

from collections.abc import Mapping

import jax
import jax.numpy as jnp
import mujoco

from easi_jax.model import Model
from easi_jax.rl.config import SacConfig
from easi_jax.rl.trainer import TrainingConfig
from easi_jax.simulation.action_map import ActionMap
from easi_jax.simulation.env import EnvState, advance, start
from envs.robot import Robot, not_finite

XML = """
<mujoco model="tiny">
  <option timestep="0.02" integrator="implicitfast"/>
  <worldbody>
    <body name="arm">
      <joint name="hinge" axis="0 1 0" damping="0.1"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.02" mass="0.5"/>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="hinge" gear="2" ctrlrange="-1 1"/></actuator>
</mujoco>
"""


class Tiny(Robot):
    """Hold a pendulum still, hanging down. Observation ``(2,)``: angle [rad], rate
    [rad/s]. Action ``(1,)``: torque as a share of the motor's range."""

    name = "tiny"
    obs_size = 2
    action_size = 1
    episode_length = 30
    dt = 0.02
    default_target = ("gear*0.5",)
    obs_names = ("hinge", "hinge.speed")
    action_map = ActionMap()
    training: Mapping[str, TrainingConfig] = {
        "sac": SacConfig(
            env_steps=1200,
            num_envs=50,
            random_steps=200,
            updates_per_step=1,
            batch_size=32,
            buffer_size=2000,
            hidden=(16, 16),
            evaluate_every=12,
        )
    }

    def __init__(self, xml: str = XML) -> None:
        super().__init__(
            {"gear": "actuator.motor.gear", "damping": "joint.hinge.damping"},
            mujoco.MjModel.from_xml_string(xml),
        )

    def reset(self, model: Model, key: jax.Array) -> EnvState:
        """Up to a radian away, at rest."""
        del model
        qpos = jax.random.uniform(key, (1,), minval=-1.0)
        physics = self.simulator.start(qpos, jnp.zeros(1))
        return start(physics, jnp.concatenate([physics.qpos, physics.qvel]))

    def control(self, state: EnvState, action: jax.Array) -> jax.Array:
        """The torque as a share of its range."""
        del state
        return self.action_map(None, action)

    def step(self, model: Model, state: EnvState, action: jax.Array) -> EnvState:
        """One control step."""
        p = self.advance_physics(model, state, action)
        obs = jnp.concatenate([p.qpos, p.qvel])
        reward = jnp.exp(-jnp.sum(p.qpos**2))
        failed = not_finite(p.qpos, p.qvel)
        return advance(state, p, obs, reward, failed, self.episode_length)


make = Tiny
