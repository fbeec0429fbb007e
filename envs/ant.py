"""Ant: a four-legged machine with torque motors runs along x.

Task, figures and parameters: EASI (NeurIPS 2024) and its reference implementation.
Joint friction is MuJoCo's `frictionloss` (N m). MuJoCo has no coefficient of
restitution: the floor's contact damping takes its place (at 40 1/s and a stiffness of
2,500 1/s^2 a dropped foot comes back with a third of its speed). Only the feet touch
the floor; an episode ends before the torso could.
"""

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx
from mujoco.mjx._src import support

from easi_jax.devices.mesh import own_device
from easi_jax.model.mjx_model import Model
from easi_jax.simulation.action_map import ActionMap
from easi_jax.simulation.env import EnvState, advance, start
from easi_jax.simulation.simulator import Simulator
from easi_jax.simulation.step import Physics
from envs.frames import matrix, roll_yaw
from envs.robot import Robot, not_finite, vector

LEGS = ("front_left", "front_right", "back_left", "back_right")
JOINTS = tuple(f"{joint}_{i}" for i in (1, 2, 3, 4) for joint in ("hip", "ankle"))
START_HEIGHT = 0.44  # m
FALLEN = 0.31  # m
_JOINTS = slice(7, 15)
_SPEEDS = slice(6, 14)

ADDRESSES = {
    "foot_friction": "geom.floor.friction",
    "foot_contact_damping": "geom.floor.contact_damping",
    "hip_friction": "joint.hip_*.frictionloss",
    "hip_damping": "joint.hip_*.damping",
    "hip_armature": "joint.hip_*.armature",
    "ankle_friction": "joint.ankle_*.frictionloss",
    "ankle_damping": "joint.ankle_*.damping",
    "ankle_armature": "joint.ankle_*.armature",
    "leg_mass": "body.*_leg.mass",
    "foot_mass": "body.*_foot.mass",
    "torso_mass": "body.torso.mass",
}


class Ant(Robot):
    """Run along x for 200 steps of 1/60 s.

    Observation ``(60,)``: torso height [m]; linear and angular velocity in the torso's
    frame [m/s, rad/s]; yaw, roll, angle to the target, which is far along x [rad];
    projections of the torso's z on up and of its x on the target's direction; 8 joint
    angles scaled by their limits; 8 joint speeds x 0.2; 4 x (force, torque) of the
    floor on the foot, in the foot's frame, x 0.1; the 8 last actions. Action ``(8,)``:
    torques in units of 15 N m.

    Reward: forward speed + 0.5 + 0.1 [up > 0.93] + 0.5 min(1, heading / 0.8)
    - 0.005 sum a^2 - 0.05 sum |a 0.2 joint speed| - 0.1 for each joint at its upper
    limit; -2 and the end where the torso is below 0.31 m.
    """

    name = "ant"
    obs_size = 60
    action_size = 8
    episode_length = 200
    dt = 1 / 60
    default_target = ("torso_mass*0.5",)
    action_map = ActionMap()
    obs_names = (
        "height",
        *vector("velocity"),
        *vector("rate"),
        *("yaw", "roll", "angle_to_target", "up", "heading"),
        *(f"{joint}.angle" for joint in JOINTS),
        *(f"{joint}.speed" for joint in JOINTS),
        *(
            f"{leg}_foot.{what}.{axis}"
            for leg in LEGS
            for what in ("force", "torque")
            for axis in "xyz"
        ),
        *(f"last.{joint}" for joint in JOINTS),
    )

    def __init__(self) -> None:
        super().__init__(ADDRESSES)
        loads = FootLoads.of(self.mj_model)
        self.simulator = Simulator(
            *(self.mj_model, self.space, self.dt, loads, 24),
            engine=self.simulator.engine,
        )
        m = self.mj_model
        low, high = m.jnt_range[1:].T
        self._middle, self._half = (low + high) / 2, (high - low) / 2
        self._low, self._high = low, high
        self._home = np.clip(0.0, low, high)

    def reset(self, model: Model, key: jax.Array) -> EnvState:
        """Joints within 0.2 rad of home and their limits, speeds within 0.1 rad/s."""
        del model
        k_angle, k_speed = jax.random.split(key)
        spread = jax.random.uniform(k_angle, (8,), minval=-0.2, maxval=0.2)
        angles = jnp.clip(self._home + spread, self._low, self._high)
        base = jnp.array([0.0, 0.0, START_HEIGHT, 1.0, 0.0, 0.0, 0.0])
        speeds = jax.random.uniform(k_speed, (8,), minval=-0.1, maxval=0.1)
        physics = self.simulator.start(
            jnp.concatenate([base, angles]), jnp.concatenate([jnp.zeros(6), speeds])
        )
        still = jnp.zeros(8)
        return start(physics, self.observe(physics, still), still)

    def control(self, state: EnvState, action: jax.Array) -> jax.Array:
        """Motor commands ``(8,)`` for an action in [-1, 1]."""
        del state
        return self.action_map(None, action)

    def observe(self, physics: Physics, last: jax.Array) -> jax.Array:
        """Observation ``(60,)`` of a physics state after the action ``last``."""
        q, v = physics.qpos, physics.qvel
        rotation = matrix(q[3:7])
        roll, yaw = roll_yaw(rotation)
        # The target lies at infinity along x, so its direction never changes.
        base = jnp.stack(
            [yaw, roll, -yaw, rotation[2, 2], _heading(rotation)],
        )
        return jnp.concatenate(
            [
                q[2:3],
                rotation.T @ v[:3],
                v[3:6],
                base,
                (q[_JOINTS] - self._middle) / self._half,
                0.2 * v[_SPEEDS],
                0.1 * physics.sensed,
                last,
            ]
        )

    def step(self, model: Model, state: EnvState, action: jax.Array) -> EnvState:
        """One control step of 1/60 s; never resets."""
        action = self.control(state, action)
        physics = self.advance_physics(model, state, action)
        q, v = physics.qpos, physics.qvel
        rotation = matrix(q[3:7])
        obs = self.observe(physics, action)
        scaled = (q[_JOINTS] - self._middle) / self._half
        reward = (
            (q[0] - state.physics.qpos[0]) / self.dt
            + 0.5
            + 0.1 * (rotation[2, 2] > 0.93)
            + 0.5 * jnp.minimum(1.0, _heading(rotation) / 0.8)
            - 0.005 * jnp.sum(action**2)
            - 0.05 * jnp.sum(jnp.abs(action * 0.2 * v[_SPEEDS]))
            - 0.1 * jnp.sum(scaled > 0.99)
        )
        failed = (q[2] < FALLEN) | not_finite(obs, v)
        reward = jnp.where(failed, -2.0, reward)
        return advance(state, physics, obs, reward, failed, self.episode_length, action)


def _heading(rotation: jax.Array) -> jax.Array:
    """Cosine between the torso's x axis, seen from above, and the world's."""
    ahead = rotation[:2, 0]
    return ahead[0] / jnp.maximum(jnp.linalg.norm(ahead), 1e-6)


@dataclass(frozen=True)
class FootLoads:
    """Reads force [N] and torque [N m] of the floor on each foot, ``(24,)``.

    Attributes:
        feet: geoms.
        bodies: for each foot, its body, in whose frame the loads are.
        mj_model: theirs.
    """

    feet: tuple[int, ...]
    bodies: tuple[int, ...]
    mj_model: mujoco.MjModel = field(compare=False, repr=False)

    @classmethod
    def of(cls, m: mujoco.MjModel) -> "FootLoads":
        """Of the four feet."""
        feet = [m.geom(f"{leg}_foot") for leg in LEGS]
        bodies = tuple(int(f.bodyid[0]) for f in feet)
        return cls(tuple(int(f.id) for f in feet), bodies, m)

    @cached_property
    def contacts(self) -> tuple[int, ...]:
        """For each foot, which contact of MJX is its own; the floor comes first in
        every pair."""
        with jax.ensure_compile_time_eval():
            put = mjx.put_model(self.mj_model, own_device(), impl="jax")

            def found() -> jax.Array:
                data: Any = mjx.collision(put, mjx.make_data(put, own_device()))
                return data._impl.contact.geom

            pairs = np.asarray(jax.jit(found)())  # the compiler drops all else
        return tuple(int(np.flatnonzero(pairs[:, 1] == g)[0]) for g in self.feet)

    @property
    def native(self) -> "NativeFootLoads":
        """The same on the engine ``mujoco``."""
        return NativeFootLoads(self.bodies)

    def __call__(self, m: Any, d: Any) -> jax.Array:
        out = []
        for k, body in zip(self.contacts, self.bodies, strict=True):
            contact = d._impl.contact
            force = support.contact_force(m, d, k, to_world_frame=True)[:3]
            frame = d.xmat[body].reshape(3, 3).T
            arm = contact.pos[k] - d.xpos[body]
            out += [frame @ force, frame @ jnp.cross(arm, force)]
        return jnp.concatenate(out)


@dataclass(frozen=True)
class NativeFootLoads:
    """As `FootLoads`, of MuJoCo C's forces from outside on each foot."""

    bodies: tuple[int, ...]
    fields = ("cfrc_ext", "subtree_com", "xpos", "xmat")
    size = 24
    root = 1  # the torso, whose subtree is the robot

    def __call__(self, *given: np.ndarray) -> np.ndarray:
        outer, com, pos, mat = given
        rows = np.array(self.bodies)
        torque, force = outer[:, rows, :3], outer[:, rows, 3:]
        # MuJoCo's torque is about the center of mass of the whole robot.
        arm = pos[:, rows] - com[:, self.root, None]
        torque = torque - np.cross(arm, force)
        frame = mat[:, rows].reshape(len(mat), len(rows), 3, 3)
        loads = np.stack([force, torque], 2)
        return np.einsum("nbji,nbkj->nbki", frame, loads).reshape(len(mat), self.size)
