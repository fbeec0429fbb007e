"""What a robot of the test data is, and the draw of one joint's numbers.

All joints are hinges or slides, and every actuator drives one joint.
"""

from dataclasses import dataclass, replace

import numpy as np

GRAVITY = 9.81
ON_GROUND = ("leg", "hopper")
LEGS = ("FL", "FR", "RL", "RR")
"""Of a robot that hangs in a stand; its joints are LEG_hip, LEG_thigh and LEG_calf."""


@dataclass(frozen=True)
class Stated:
    """Which of its own passive numbers the owner's model states as nonzero."""

    damping: bool = False
    armature: bool = False
    stiffness: bool = False
    frictionloss: bool = False


@dataclass(frozen=True)
class Joint:
    """One joint and the drive at it; lengths in m or rad, by the joint's type.

    `filter` is the time constant of a drive that has an activation of its own [s].
    """

    name: str
    body: str
    kind: str
    home: float
    amplitude: float
    inertia: float
    drive: str
    actuator: str = ""
    damping: float = 0.0
    armature: float = 0.0
    stiffness: float = 0.0
    frictionloss: float = 0.0
    gear: float = 1.0
    kp: float = 0.0
    kv: float = 0.0
    reach: float = 0.0
    filter: float = 0.0

    @property
    def unit(self) -> str:
        return "rad" if self.kind == "hinge" else "m"


@dataclass(frozen=True)
class Mechanism:
    """A robot as its owner models it."""

    name: str
    joints: tuple[Joint, ...]
    bodies: str
    timestep: float
    control_step: float
    speed: float
    open_loop: bool = False

    @property
    def driven(self) -> tuple[int, ...]:
        """Joint of each actuator, in the order of the actuators."""
        return tuple(i for i, joint in enumerate(self.joints) if joint.actuator)

    @property
    def on_ground(self) -> bool:
        """Whether it stands on a foot."""
        return self.name in ON_GROUND

    def xml(self) -> str:
        """The MJCF text; joints stand in it as `{name}` of `bodies`."""
        joints = {joint.name: _joint_xml(joint) for joint in self.joints}
        drives = "\n    ".join(_drive_xml(self.joints[i]) for i in self.driven)
        return (
            f'<mujoco model="{self.name}">\n'
            f'  <option timestep="{self.timestep:g}" integrator="implicitfast"/>\n'
            f"  <worldbody>\n{self.bodies.format(**joints)}  </worldbody>\n"
            f"  <actuator>\n    {drives}\n  </actuator>\n</mujoco>\n"
        )

    def calmer(self, share: float) -> "Mechanism":
        """The same machine, asked for a share of the motion."""
        joints = (replace(j, amplitude=share * j.amplitude) for j in self.joints)
        return replace(self, joints=tuple(joints))

    def with_timestep(self, timestep: float) -> "Mechanism":
        return replace(self, timestep=timestep)


def _joint_xml(joint: Joint) -> str:
    parts = [f'name="{joint.name}" type="{joint.kind}"']
    for name in ("damping", "armature", "stiffness", "frictionloss"):
        if getattr(joint, name):
            parts.append(f'{name}="{getattr(joint, name):g}"')
    if joint.reach:
        # The compiler reads a hinge's range in degrees.
        scale = 180 / np.pi if joint.kind == "hinge" else 1.0
        low, high = scale * (joint.home + np.array([-joint.reach, joint.reach]))
        parts.append(f'range="{low:.4g} {high:.4g}"')
    return " ".join(parts)


def _drive_xml(joint: Joint) -> str:
    if joint.filter:
        stiffness = f'gainprm="{joint.kp:g}" biastype="affine"'
        servo = f'{stiffness} biasprm="0 {-joint.kp:g} {-joint.kv:g}"'
        kind = f'gear="{joint.gear:g}"' if joint.drive == "motor" else servo
        return (
            f'<general name="{joint.actuator}" joint="{joint.name}" {kind} '
            f'dyntype="filterexact" dynprm="{joint.filter:g}"/>'
        )
    text = f'<{joint.drive} name="{joint.actuator}" joint="{joint.name}"'
    if joint.drive == "motor":
        return f'{text} gear="{joint.gear:g}"/>'
    if joint.drive == "position":
        return f'{text} kp="{joint.kp:g}" kv="{joint.kv:g}"/>'
    return f'{text} kv="{joint.kv:g}"/>'


def _digits(value: float, digits: int = 3) -> float:
    """`value` to a few digits, as an owner would write it."""
    return float(f"{value:.{digits}g}")


class Draw:
    """Draws the numbers of one mechanism."""

    def __init__(self, rng: np.random.Generator, stated: Stated) -> None:
        self.rng, self.stated, self.first = rng, stated, True

    def near(self, value: float, spread: float = 0.25) -> float:
        """`value` within a relative spread."""
        return _digits(value * float(np.exp(self.rng.uniform(-spread, spread))))

    def joint(
        self,
        name: str,
        body: str,
        kind: str,
        amplitude: float,
        inertia: float,
        drive: str = "",
        home: float = 0.0,
        stiff: tuple[float, float] = (12.0, 25.0),
    ) -> Joint:
        """A joint whose passive numbers and servo gains suit its inertia.

        `stiff` bounds the servo's natural frequency in rad/s; an empty drive makes a
        passive joint.
        """
        rng, stated = self.rng, self.stated
        # The first joint has what is stated; the others may lack it.
        has = self.first or rng.random() < 0.75
        self.first = False
        omega, zeta = rng.uniform(*stiff), rng.uniform(0.5, 1.0)
        damping = inertia * self.near(0.7 if drive else 0.25, 0.5)
        # Geared drives reflect as much inertia as they move.
        armature = inertia * self.near(0.5 if drive else 0.1, 1.0 if drive else 0.4)
        joint = Joint(
            name=name,
            body=body,
            kind=kind,
            home=home,
            amplitude=self.near(amplitude, 0.15),
            inertia=inertia,
            drive=drive,
            actuator=f"{name}_{drive}" if drive else "",
            damping=_digits(damping) if has and stated.damping else 0.0,
            armature=_digits(armature) if has and stated.armature else 0.0,
            stiffness=_digits(inertia * self.near(8.0))
            if has and stated.stiffness
            else 0.0,
            frictionloss=(
                _digits(inertia * self.near(1.2))
                if has and stated.frictionloss
                else 0.0
            ),
            reach=_digits(4.0 * amplitude) if rng.random() < 0.3 else 0.0,
        )
        total = inertia + joint.armature
        if drive == "motor" and rng.random() < 0.3:
            joint = replace(joint, gear=_digits(self.near(10.0 * inertia, 0.5), 2))
        if drive == "position":
            kp, kv = total * omega**2, 2.0 * zeta * total * omega
            joint = replace(joint, kp=_digits(kp), kv=_digits(kv))
        if drive == "velocity":
            joint = replace(joint, kv=_digits(total * omega))
        return joint

    def drive(self, *names: str) -> str:
        return str(self.rng.choice(names))
