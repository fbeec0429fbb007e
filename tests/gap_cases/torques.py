"""Effects that push on joints or bodies, integrated at the truth's fine step.

Each has `reset(rng)` and `apply(data)`, which adds to the applied forces before a
step. Numbers are plain floats: the loop calls these a few thousand times a second of
motion.
"""

import math
from collections.abc import Callable
from typing import Protocol

import mujoco
import numpy as np


class Push(Protocol):
    """Something that adds to `data.qfrc_applied` or `data.xfrc_applied`."""

    def reset(self, rng: np.random.Generator) -> None: ...

    def apply(self, data: mujoco.MjData) -> None: ...


class Law:
    """A generalized force at one joint that depends on its position and speed."""

    def __init__(self, at: int, law: Callable[[float, float], float]) -> None:
        self.at, self.law = at, law

    def reset(self, rng: np.random.Generator) -> None:
        del rng

    def apply(self, data: mujoco.MjData) -> None:
        at = self.at
        data.qfrc_applied[at] += self.law(float(data.qpos[at]), float(data.qvel[at]))


class LuGre:
    """Bristle friction (Canudas de Wit 1995); Coulomb's where static equals kinetic.

    The bristles' stiffness is set by their natural frequency with the joint's inertia,
    so that presliding is far below what an encoder sees and the fine step resolves it.
    """

    def __init__(
        self,
        at: int,
        static: float,
        kinetic: float,
        velocity: float,
        inertia: float,
        fine: float,
        frequency: float = 300.0,
    ) -> None:
        self.at, self.fine = at, fine
        self.static, self.kinetic, self.velocity = static, kinetic, velocity
        self.stiffness = inertia * frequency**2
        self.damping = 0.6 * inertia * frequency
        self.bend = 0.0

    def reset(self, rng: np.random.Generator) -> None:
        del rng
        self.bend = 0.0

    def apply(self, data: mujoco.MjData) -> None:
        speed = float(data.qvel[self.at])
        data.qfrc_applied[self.at] -= self.force(speed)

    def force(self, speed: float) -> float:
        """Friction against the motion; moves the bristles on by one fine step."""
        level = self.kinetic
        if self.static != self.kinetic:
            fall = math.exp(-((speed / self.velocity) ** 2))
            level += (self.static - self.kinetic) * fall
        sliding = math.copysign(level / self.stiffness, speed) if speed else 0.0
        rate = abs(speed) * self.stiffness / level
        # Exact for a speed that holds during the step.
        kept = math.exp(-rate * self.fine)
        before = self.bend
        self.bend = sliding + (before - sliding) * kept if speed else before
        change = (self.bend - before) / self.fine
        return self.stiffness * self.bend + self.damping * change


class PlaceFriction(LuGre):
    """Coulomb's, whose level waves with the position by `share` of itself."""

    def __init__(
        self,
        at: int,
        torque: float,
        waves: float,
        inertia: float,
        fine: float,
        share: float = 0.9,
    ) -> None:
        super().__init__(at, torque, torque, 1.0, inertia, fine)
        self.torque, self.waves, self.share = torque, waves, share

    def apply(self, data: mujoco.MjData) -> None:
        wave = math.sin(self.waves * float(data.qpos[self.at]))
        self.static = self.kinetic = self.torque * (1.0 + self.share * wave)
        super().apply(data)


class WarmFriction(LuGre):
    """Coulomb's, which falls to two fifths over a travel of `distance`."""

    def __init__(
        self, at: int, torque: float, distance: float, inertia: float, fine: float
    ) -> None:
        super().__init__(at, torque, torque, 1.0, inertia, fine)
        self.torque, self.distance, self.travel = torque, distance, 0.0

    def reset(self, rng: np.random.Generator) -> None:
        super().reset(rng)
        self.travel = 0.0

    def apply(self, data: mujoco.MjData) -> None:
        self.travel += self.fine * abs(float(data.qvel[self.at]))
        cold = math.exp(-self.travel / self.distance)
        self.static = self.kinetic = self.torque * (0.4 + 0.6 * cold)
        super().apply(data)


class BoucWen:
    """Hysteresis: a torque with memory that saturates beyond `width` of travel."""

    def __init__(self, at: int, torque: float, width: float, fine: float) -> None:
        self.at, self.torque, self.width, self.fine = at, torque, width, fine
        self.memory = 0.0

    def reset(self, rng: np.random.Generator) -> None:
        del rng
        self.memory = 0.0

    def apply(self, data: mujoco.MjData) -> None:
        z, speed = self.memory, float(data.qvel[self.at]) / self.width
        change = speed - 0.5 * abs(speed) * abs(z) * z - 0.5 * speed * z * z
        self.memory = z + self.fine * change
        data.qfrc_applied[self.at] -= self.torque * self.memory


class BodyForce:
    """A force at a body's center of mass, in the world's axes."""

    def __init__(self, body: int, force: np.ndarray) -> None:
        self.body, self.force = body, force

    def reset(self, rng: np.random.Generator) -> None:
        del rng

    def apply(self, data: mujoco.MjData) -> None:
        data.xfrc_applied[self.body, :3] += self.force


class Coupling:
    """A spring between two joints that the model does not know."""

    def __init__(self, first: int, second: int, stiffness: float, rest: float) -> None:
        self.first, self.second = first, second
        self.stiffness, self.rest = stiffness, rest

    def reset(self, rng: np.random.Generator) -> None:
        del rng

    def apply(self, data: mujoco.MjData) -> None:
        stretch = float(data.qpos[self.first]) - float(data.qpos[self.second])
        force = self.stiffness * (stretch - self.rest)
        data.qfrc_applied[self.first] -= force
        data.qfrc_applied[self.second] += force


class TwoMassDrive:
    """A rotor that reaches the load through a dead zone and a stiff spring-damper.

    The rotor's inertia has left the joint's armature, and the actuator pushes on the
    rotor. `actuator(data)` gives its torque at the joint's side of the gear; the servo
    and the encoder read the load.
    """

    def __init__(
        self,
        at: int,
        actuator: Callable[[mujoco.MjData], float],
        rotor: float,
        load: float,
        width: float,
        fine: float,
    ) -> None:
        self.at, self.actuator, self.fine = at, actuator, fine
        self.rotor, self.width = rotor, width
        lesser = rotor * load / (rotor + load)
        self.stiffness = lesser * (0.25 / fine) ** 2
        # Well damped: teeth that bounce would hide behind the encoder's fit.
        self.damping = 1.4 * math.sqrt(self.stiffness * lesser)
        self.angle: float | None = None
        self.speed = 0.0

    def reset(self, rng: np.random.Generator) -> None:
        del rng
        self.angle, self.speed = None, 0.0

    def apply(self, data: mujoco.MjData) -> None:
        position, speed = float(data.qpos[self.at]), float(data.qvel[self.at])
        if self.angle is None:
            self.angle, self.speed = position, speed
        pushed = self.contact(self.angle - position, self.speed - speed)
        self.speed += self.fine * (self.actuator(data) - pushed) / self.rotor
        self.angle += self.fine * self.speed
        data.qfrc_applied[self.at] += pushed

    def contact(self, twist: float, slip: float) -> float:
        """Torque that reaches the load; faces of the teeth push and do not pull."""
        if abs(twist) <= 0.5 * self.width:
            return 0.0
        depth = abs(twist) - 0.5 * self.width
        side = 1.0 if twist > 0 else -1.0
        return side * max(0.0, self.stiffness * depth + self.damping * slip * side)
