"""The effects: their names, the kinds of their places, and the scales of a motion."""

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase

import numpy as np

from tests.gap_cases.mechanisms import Mechanism

Parameters = dict[str, float | str]


class CaseError(Exception):
    """The wanted case cannot be had; draw another."""


@dataclass(frozen=True)
class Effect:
    """One effect at one place, or at all like places of a pattern such as `*_calf`;
    `parameters` may leave some to be drawn."""

    name: str
    at: str
    parameters: Parameters = field(default_factory=dict)

    @property
    def kind(self) -> str:
        """What `at` is: joint, actuator, body, model, or "" outside the table."""
        if self.name in KINDS:
            return KINDS[self.name] if self.at else "model"
        return "outside"

    def number(self, name: str) -> float:
        return float(self.parameters[name])

    @property
    def tied(self) -> bool:
        """Whether several places have it alike."""
        return "*" in self.at

    def apart(self, names: Iterable[str]) -> list["Effect"]:
        """The same at each of its places, which are among `names`."""
        if not self.tied:
            return [self]
        return [replace(self, at=n) for n in names if fnmatchcase(n, self.at)]

    def having(self, **parameters: float | str) -> "Effect":
        return replace(self, parameters={**self.parameters, **parameters})


KINDS = {
    "coulomb_friction": "joint",
    "stribeck_friction": "joint",
    "viscous_damping": "joint",
    "quadratic_drag": "joint",
    "joint_stiffness": "joint",
    "constant_force": "joint",
    "torque_ripple": "joint",
    "armature": "joint",
    "backlash": "joint",
    "actuator_gain": "actuator",
    "drive_stiffness": "actuator",
    "drive_damping": "actuator",
    "actuator_strength": "actuator",
    "actuator_delay": "actuator",
    "actuator_lag": "actuator",
    "actuator_saturation": "actuator",
    "actuator_deadband": "actuator",
    "payload_mass": "body",
    "com_offset": "body",
    "gravity_tilt": "model",
    "sensor_bias": "joint",
    "sensor_delay": "joint",
    "contact_friction": "model",
    "contact_softness": "model",
}
ON_REQUEST = {"drive_stiffness", "drive_damping", "actuator_strength"}
"""Effects that a draw does not take by itself: seeds of older cases stay theirs."""
OUTSIDE = ("hysteresis", "gain_drift", "coupling_spring", "dropped_commands")
UNLISTED = (
    *OUTSIDE,
    *("cubic_spring", "one_way_damping", "place_friction", "warm_friction"),
    "bent_gain",
)
"""What no table has, in wide draws."""
LOSSES = ("coulomb_friction", "stribeck_friction", "viscous_damping", "armature")
"""What real drives have."""


@dataclass(frozen=True)
class Context:
    """Scales of a mechanism's motion without effects.

    Attributes:
        torque: (nq,) root mean square torque at each joint.
        speed: (nq,) root mean square speed.
        span: (nq,) range of positions.
        center: (nq,) middle of the range.
        inertia: (nq,) least inertia that a torque at the joint moves.
        command: (nu,) largest command.
        force: (nu,) largest actuator force.
        mass: mass of each body, kg.
        size: length of each body, m.
        friction: sliding friction of the contacts.
        fine: step of the truth, s.
    """

    mechanism: Mechanism
    torque: np.ndarray
    speed: np.ndarray
    span: np.ndarray
    center: np.ndarray
    inertia: np.ndarray
    command: np.ndarray
    force: np.ndarray
    mass: dict[str, float]
    size: dict[str, float]
    friction: float
    fine: float

    def joint(self, name: str) -> int:
        """The joint, or the first one of a pattern."""
        return _first(name, [joint.name for joint in self.mechanism.joints])

    def actuator(self, name: str) -> int:
        """The actuator, or the first one of a pattern."""
        joints = self.mechanism.joints
        return _first(name, [joints[i].actuator for i in self.mechanism.driven])


def _first(pattern: str, names: list[str]) -> int:
    return next(i for i, name in enumerate(names) if fnmatchcase(name, pattern))
