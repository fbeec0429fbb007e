"""Go2: a quadruped follows a velocity command on flat ground at 50 Hz.

Parameters: EASI (NeurIPS 2024), section 4 and appendix A, which has no public Go2 code;
robot figures are the maker's. Reward terms are the usual ones of legged locomotion
(legged_gym, MuJoCo Playground), per step and not multiplied by its length.
"""

import itertools
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from easi_jax.errors import UserError, nearest
from easi_jax.model.mjx_model import Model
from easi_jax.model.torque_speed import TorqueSpeed
from easi_jax.simulation.action_map import ActionMap
from easi_jax.simulation.env import EnvState, advance, start
from easi_jax.simulation.simulator import Simulator
from easi_jax.simulation.step import Physics
from envs.frames import from_yaw, matrix
from envs.robot import Robot, not_finite, vector

LEGS = ("FL", "FR", "RL", "RR")
JOINTS = ("hip", "thigh", "calf")
ACTION_SCALE = 0.5  # rad of joint target at action 1
_FX = np.array([1.0, 1.0, -1.0, -1.0])
_SY = np.array([1.0, -1.0, 1.0, -1.0])
_UPPER = 0.213  # m, thigh and calf alike
FOOT = 0.022  # m, radius
SWING = 0.08  # m, height of a swinging foot
TOUCH = 0.004  # m above the floor within which a foot counts as touching

_CLASSES = {
    f"{joint}_{gain}": f"actuator.*_{joint}.{gain}"
    for gain, joint in itertools.product(("kp", "kv"), JOINTS)
}
_EACH = {
    f"{leg}_{joint}_{gain}": f"actuator.{leg}_{joint}.{gain}"
    for gain, leg, joint in itertools.product(("kp", "kv"), LEGS, JOINTS)
}
_BASE = {"base_mass": "body.base.mass"}
PARAMETERS = {
    "default": {**_CLASSES, **_BASE, "ground_friction": "geom.floor.friction"},
    "real": {**_CLASSES, **_BASE},
    "full": {**_EACH, **_BASE},
}

REWARDS = ("gait", "command")


@dataclass(frozen=True)
class Commands:
    """Ranges that commands are drawn from, one for each episode."""

    forward: tuple[float, float] = (-0.5, 1.0)
    """Speed along x [m/s]."""
    sideways: tuple[float, float] = (-0.3, 0.3)
    """Speed along y [m/s]."""
    turn: tuple[float, float] = (-0.7, 0.7)
    """Rate about z [rad/s]."""
    still: float = 0.1
    """Share of episodes without any command to move."""


def forward_only(text: str) -> Commands:
    """Commands to walk forward at speeds ``LOW:HIGH`` [m/s], nothing else.

    Raises:
        UserError: no such text.
    """
    try:
        low, high = (float(x) for x in text.split(":"))
    except ValueError:
        low, high = 1.0, 0.0
    if not -5.0 <= low <= high <= 5.0:
        raise UserError(
            f'forward is "{text}": write LOW:HIGH, two speeds in m/s from -5 to 5'
        )
    none = (0.0, 0.0)
    return Commands(forward=(low, high), sideways=none, turn=none, still=0.0)


# Corner and free speed [rad/s], torque driving and braking [N m] of the hip and thigh
# motors (unitree_rl_lab's T-N curve); the knee's further reduction divides the speeds
# and multiplies the torques.
MOTOR = (13.5, 30.0, 20.2, 23.4)
KNEE_REDUCTION = 45.43 / 23.7


def motor_curve() -> TorqueSpeed:
    """The 12 motors' torque-speed curve."""
    reduction = jnp.tile(jnp.array([1.0, 1.0, KNEE_REDUCTION]), 4)
    corner, free, driving, braking = MOTOR
    return TorqueSpeed(
        corner=corner / reduction,
        free=free / reduction,
        driving=driving * reduction,
        braking=braking * reduction,
        dof=jnp.arange(6, 18),
    )


class Memory(NamedTuple):
    """What a Go2 episode carries.

    Attributes:
        command: forward, sideways [m/s], turn [rad/s], ``(3,)``.
        last: the action before, ``(12,)``.
        feet: positions of the feet in the world, ``(4, 3)`` [m].
        air: time that each foot has been in the air, ``(4,)`` [s].
    """

    command: jax.Array
    last: jax.Array
    feet: jax.Array
    air: jax.Array


class Go2(Robot):
    """Follow a command for 200 steps of 20 ms.

    Observation ``(48,)``: linear [m/s] and angular [rad/s] velocity and gravity's
    direction in the base's frame; 12 joint angles from the standing pose [rad] and
    speeds [rad/s]; the 12 last actions; the command (m/s, m/s, rad/s). Action
    ``(12,)``: joint targets about the standing pose, in units of 0.5 rad, legs FL, FR,
    RL, RR.
    The episode ends, with reward -1, where the base tips beyond 60 degrees or sinks
    below 0.15 m.
    """

    name = "go2"
    obs_size = 48
    action_size = 12
    dt = 0.02
    k = 2.0
    default_target = ("thigh_kp*0.5",)
    obs_names = (
        *vector("velocity"),
        *vector("rate"),
        *vector("gravity"),
        *(f"{leg}_{joint}.angle" for leg in LEGS for joint in JOINTS),
        *(f"{leg}_{joint}.speed" for leg in LEGS for joint in JOINTS),
        *(f"last.{leg}_{joint}" for leg in LEGS for joint in JOINTS),
        *("command.forward", "command.sideways", "command.turn"),
    )

    def __init__(
        self,
        parameters: str = "default",
        commands: Commands | None = None,
        episode_length: int = 200,
        torque_speed: bool = False,
        rewarded: str = "gait",
        forward: str = "",
    ) -> None:
        """Builds the robot.

        Args:
            parameters: "default": 8, gains by kind of joint, base mass and friction;
                "real": the same without friction; "full": 25, the gains of every
                joint and base mass.
            commands: what it is asked to do.
            episode_length: control steps.
            torque_speed: let the motors' torque fall with speed, as `MOTOR` says.
            rewarded: "gait": the command is followed, by a gait as it should be;
                "command": the command is followed, and nothing else counts (for
                imitation, which learns its gait from demonstrations).
            forward: "LOW:HIGH": only forward, at these speeds [m/s]; in place of
                ``commands``.

        Raises:
            UserError: unknown set of parameters or reward, or no two speeds.
        """
        for what, given, known in (
            ("parameters", parameters, PARAMETERS),
            ("rewarded", rewarded, REWARDS),
        ):
            if given not in known:
                raise UserError(
                    f'unknown {what} "{given}" (known: {", ".join(known)})'
                    f"{nearest(given, known)}"
                )
        super().__init__(PARAMETERS[parameters])
        self.commands = forward_only(forward) if forward else commands or Commands()
        self.rewarded = rewarded
        self.episode_length = episode_length
        m = self.mj_model
        self._stand = m.key_qpos[0].copy()
        self._pose = self._stand[7:]
        low, high = m.actuator_ctrlrange.T
        self.action_map = ActionMap(ACTION_SCALE, self._pose, low, high)
        self._limit = m.actuator_forcerange[:, 1]
        if torque_speed:
            self.simulator = Simulator(
                *(m, self.space, self.dt),
                torque_speed=motor_curve(),
                engine=self.simulator.engine,
            )

    def reset(self, model: Model, key: jax.Array) -> EnvState:
        """Standing, turned anywhere, joints and speeds a little off."""
        del model
        k_yaw, k_joint, k_speed, k_command = jax.random.split(key, 4)
        yaw = jax.random.uniform(k_yaw, minval=-jnp.pi, maxval=jnp.pi)
        joints = self._pose + jax.random.uniform(
            k_joint, (12,), minval=-0.1, maxval=0.1
        )
        qpos = jnp.concatenate([self._stand[:3], from_yaw(yaw), joints])
        qvel = jax.random.uniform(k_speed, (18,), minval=-0.2, maxval=0.2)
        physics = self.simulator.start(qpos, qvel)
        memory = Memory(
            command=self.draw_command(k_command),
            last=jnp.zeros(12),
            feet=feet_in_world(qpos),
            air=jnp.zeros(4),
        )
        return start(physics, self.observe(physics, memory), memory)

    def begun(self, state: EnvState, command: jax.Array) -> EnvState:
        """The first state of an episode with another command ``(3,)``."""
        memory = state.memory._replace(command=command)
        obs = self.observe(state.physics, memory)
        return replace(state, memory=memory, obs=obs)

    def draw_command(self, key: jax.Array) -> jax.Array:
        """A command ``(3,)``."""
        c = self.commands
        k_move, k_still = jax.random.split(key)
        low, high = jnp.array([c.forward, c.sideways, c.turn]).T
        command = jax.random.uniform(k_move, (3,), minval=low, maxval=high)
        return command * (jax.random.uniform(k_still) >= c.still)

    def control(self, state: EnvState, action: jax.Array) -> jax.Array:
        """Joint targets ``(12,)`` [rad] for an action in [-1, 1]."""
        del state
        return self.action_map(None, action)

    def observe(self, physics: Physics, memory: Memory) -> jax.Array:
        """Observation ``(48,)`` of a physics state."""
        q, v = physics.qpos, physics.qvel
        rotation = matrix(q[3:7])
        return jnp.concatenate(
            [
                rotation.T @ v[:3],
                v[3:6],
                -rotation[2],
                q[7:] - self._pose,
                v[6:],
                memory.last,
                memory.command,
            ]
        )

    def step(self, model: Model, state: EnvState, action: jax.Array) -> EnvState:
        """One control step of 20 ms; never resets."""
        action = jnp.clip(action, -1.0, 1.0)
        physics = self.advance_physics(model, state, action)
        before: Memory = state.memory
        feet = feet_in_world(physics.qpos)
        touching = feet[:, 2] < FOOT + TOUCH
        air = jnp.where(touching, 0.0, before.air + self.dt)
        memory = before._replace(last=action, feet=feet, air=air)
        obs = self.observe(physics, memory)
        tipped = matrix(physics.qpos[3:7])[2, 2] < 0.5
        failed = tipped | (physics.qpos[2] < 0.15)
        failed |= not_finite(physics.qpos, physics.qvel)
        reward = self.reward(model, physics, memory, before, touching)
        reward = jnp.where(failed, -1.0, reward)
        return advance(state, physics, obs, reward, failed, self.episode_length, memory)

    def reward(
        self,
        model: Model,
        physics: Physics,
        memory: Memory,
        before: Memory,
        touching: jax.Array,
    ) -> jax.Array:
        """At most 1, not below 0: how well the command is followed, less what spoils
        a gait where that counts, too."""
        track = self.tracking(physics, memory.command)
        if self.rewarded == "command":
            return jnp.maximum(0.0, track / 1.5)
        moving = jnp.linalg.norm(memory.command) > 0.1
        landed = touching & (before.air > 0)
        airtime = jnp.sum((before.air - 0.1) * landed) * moving
        speed = self.foot_speed(memory, before)
        swing = jnp.abs(memory.feet[:, 2] - FOOT - SWING) * jnp.sqrt(speed)
        cost = (
            self.unsteadiness(model, physics, memory, before, touching)
            + 0.5 * jnp.sum(swing * ~touching)
            + jnp.where(moving, 0.0, 0.5)
            * jnp.sum(jnp.abs(physics.qpos[7:] - self._pose))
        )
        return jnp.maximum(0.0, (track + airtime - cost) / 1.5)

    def tracking(self, physics: Physics, command: jax.Array) -> jax.Array:
        """At most 1.5: how well a command is followed.

        Half of the speed's part is progress along the command, which also pays a robot
        that does not yet move anywhere near it.
        """
        v = physics.qvel
        speed = matrix(physics.qpos[3:7]).T @ v[:3]
        near = jnp.exp(-jnp.sum((command[:2] - speed[:2]) ** 2) / 0.25)
        size2 = jnp.sum(command[:2] ** 2)
        progress = jnp.sum(command[:2] * speed[:2]) / jnp.maximum(size2, 0.01)
        progress = jnp.where(size2 > 0.01, jnp.clip(progress, -1.0, 1.0), near)
        turn = jnp.exp(-((command[2] - v[5]) ** 2) / 0.25)
        return 0.5 * (near + progress) + 0.5 * turn

    def unsteadiness(
        self,
        model: Model,
        physics: Physics,
        memory: Memory,
        before: Memory,
        touching: jax.Array,
    ) -> jax.Array:
        """What a gait of any kind should have little of: bouncing, rolling, tipping,
        torque, power, jerks, and feet that slide."""
        q, v = physics.qpos, physics.qvel
        rotation = matrix(q[3:7])
        gain = model.mjx.actuator_gainprm[:, 0], model.mjx.actuator_biasprm[:, 2]
        target = self.action_map(None, memory.last)
        torque = gain[0] * (target - q[7:]) + gain[1] * v[6:]
        torque = jnp.clip(torque, -self._limit, self._limit)
        return (
            0.5 * (rotation.T @ v[:3])[2] ** 2
            + 0.05 * jnp.sum(v[3:5] ** 2)
            + 5.0 * jnp.sum(rotation[2, :2] ** 2)
            + 1e-4 * jnp.sum(torque**2)
            + 0.01 * jnp.sum((memory.last - before.last) ** 2)
            + 2e-4 * jnp.sum(jnp.abs(torque * v[6:]))
            + 0.1 * jnp.sum(self.foot_speed(memory, before) ** 2 * touching)
        )

    def foot_speed(self, memory: Memory, before: Memory) -> jax.Array:
        """How fast each foot went over ground in a step, ``(4,)`` [m/s]."""
        shift = jnp.linalg.norm(memory.feet[:, :2] - before.feet[:, :2], axis=1)
        return shift / self.dt

    def style(self, qpos: jax.Array, qvel: jax.Array) -> jax.Array:
        """What imitation compares, ``(42,)``: how the robot holds itself and moves, not
        where it goes.

        Joint angles from the standing pose [rad] and speeds [rad/s], feet in the base's
        frame [m], height of the base [m], gravity's direction there, and the base's
        roll and pitch rates [rad/s]. Speed over ground and turning belong to the task:
        commands that nobody demonstrated are not punished.
        """
        rotation = matrix(qpos[3:7])
        return jnp.concatenate(
            [
                qpos[7:] - self._pose,
                qvel[6:],
                feet_in_base(qpos[7:]).ravel(),
                qpos[2:3],
                -rotation[2],
                qvel[3:5],
            ]
        )


def feet_in_base(joints: jax.Array) -> jax.Array:
    """Centers of the feet in the base's frame ``(4, 3)`` [m], from 12 joint angles."""
    hip, thigh, calf = joints.reshape(4, 3).T
    knee = thigh + calf
    foot = jnp.array([-0.002, -_UPPER])  # x, z in the calf's frame
    x = -_UPPER * jnp.sin(thigh) + foot[0] * jnp.cos(knee) + foot[1] * jnp.sin(knee)
    z = -_UPPER * jnp.cos(thigh) - foot[0] * jnp.sin(knee) + foot[1] * jnp.cos(knee)
    y = 0.0955 * _SY
    return jnp.stack(
        [
            0.1934 * _FX + x,
            0.0465 * _SY + y * jnp.cos(hip) - z * jnp.sin(hip),
            y * jnp.sin(hip) + z * jnp.cos(hip),
        ],
        axis=1,
    )


def feet_in_world(qpos: jax.Array) -> jax.Array:
    """Centers of the feet in the world ``(4, 3)`` [m]."""
    return qpos[:3] + feet_in_base(qpos[7:]) @ matrix(qpos[3:7]).T


class Commanded:
    """A Go2 whose episodes all begin with one command to walk forward."""

    def __init__(self, env: Go2, speed: Any) -> None:
        """``speed``: forward [m/s], ``()``."""
        self._env, self._speed = env, speed

    def __getattr__(self, name: str) -> Any:
        return getattr(self._env, name)

    def reset(self, model: Model, key: jax.Array) -> EnvState:
        """As the robot's own, with the command."""
        command = jnp.array([1.0, 0.0, 0.0]) * self._speed
        return self._env.begun(self._env.reset(model, key), command)
