"""The robots of the test data: small MuJoCo models drawn from a seed.

Each builder returns the joints of the model that the owner believes in, and the MJCF
of its bodies, in which `{name}` stands for a joint's attributes.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from tests.gap_cases.mechanisms import (
    LEGS,
    ON_GROUND,
    Draw,
    Joint,
    Mechanism,
    Stated,
)

FILTERS = (0.01, 0.05)
"""Time constants of drives with an activation [s]."""
SPEEDS = (0.5, 4.0)
"""Highest frequencies of wide draws [Hz]."""
FOOT_RADIUS = 0.03
Parts = tuple[list[Joint], str]


def _slide(draw: Draw) -> Parts:
    mass = draw.near(1.5, 0.5)
    drive = draw.drive("motor", "motor", "position", "velocity")
    joint = draw.joint("slider", "carriage", "slide", 0.3, mass, drive)
    return [joint], (
        '    <body name="carriage" pos="0 0 0.5">\n'
        '      <joint {slider} axis="1 0 0"/>\n'
        f'      <geom type="box" size="0.1 0.08 0.05" mass="{mass:g}"/>\n'
        "    </body>\n"
    )


def _pendulum(draw: Draw) -> Parts:
    mass, length = draw.near(1.0, 0.5), draw.near(0.5)
    drive = draw.drive("motor", "motor", "position")
    inertia = mass * length**2 / 3.0
    joint = draw.joint("hinge", "rod", "hinge", 1.0, inertia, drive, stiff=(9.0, 18.0))
    return [joint], (
        '    <body name="rod" pos="0 0 1">\n'
        '      <joint {hinge} axis="0 1 0"/>\n'
        f'      <geom type="capsule" fromto="0 0 0 0 0 -{length:g}" size="0.02" '
        f'mass="{mass:g}"/>\n'
        "    </body>\n"
    )


def _cartpole(draw: Draw) -> Parts:
    cart, pole, length = draw.near(1.0, 0.4), draw.near(0.3, 0.4), draw.near(0.6)
    slider = draw.joint("slider", "cart", "slide", 0.25, cart + pole, "motor")
    hinge = draw.joint("hinge", "pole", "hinge", 0.6, pole * length**2 / 3.0)
    return [slider, hinge], (
        '    <body name="cart" pos="0 0 1">\n'
        '      <joint {slider} axis="1 0 0"/>\n'
        f'      <geom type="box" size="0.1 0.08 0.05" mass="{cart:g}"/>\n'
        '      <body name="pole">\n'
        '        <joint {hinge} axis="0 1 0"/>\n'
        f'        <geom type="capsule" fromto="0 0 0 0 0 -{length:g}" size="0.015" '
        f'mass="{pole:g}" contype="0" conaffinity="0"/>\n'
        "      </body>\n    </body>\n"
    )


def _link(length: float, mass: float, size: float, axis: str = "z") -> str:
    """A capsule along -z or x without contact."""
    end = f"0 0 -{length:g}" if axis == "z" else f"{length:g} 0 0"
    return (
        f'<geom type="capsule" fromto="0 0 0 {end}" size="{size:g}" mass="{mass:g}" '
        'contype="0" conaffinity="0"/>'
    )


def _arm2(draw: Draw) -> Parts:
    mass = draw.near(1.2), draw.near(0.8)
    long = draw.near(0.4, 0.2), draw.near(0.35, 0.2)
    drive = draw.drive("motor", "position")
    outer = mass[1] * long[1] ** 2 / 3.0
    inner = mass[0] * long[0] ** 2 / 3.0 + mass[1] * (long[0] ** 2 + long[1] ** 2 / 3)
    joints = [
        draw.joint("shoulder", "upper", "hinge", 0.8, inner, drive, stiff=(10, 18)),
        draw.joint("elbow", "fore", "hinge", 0.9, outer, drive, 0.4, (12, 22)),
    ]
    return joints, (
        '    <body name="upper" pos="0 0 1">\n'
        '      <joint {shoulder} axis="0 1 0"/>\n'
        f"      {_link(long[0], mass[0], 0.03)}\n"
        f'      <body name="fore" pos="0 0 -{long[0]:g}">\n'
        '        <joint {elbow} axis="0 1 0"/>\n'
        f"        {_link(long[1], mass[1], 0.025)}\n"
        "      </body>\n    </body>\n"
    )


def _arm3(draw: Draw) -> Parts:
    mass = draw.near(2.0), draw.near(1.2), draw.near(0.8)
    long = draw.near(0.35, 0.2), draw.near(0.3, 0.2)
    outer = mass[2] * long[1] ** 2 / 3.0
    inner = mass[1] * long[0] ** 2 / 3.0 + mass[2] * (long[0] ** 2 + long[1] ** 2 / 3)
    joints = [
        draw.joint("yaw", "turret", "hinge", 1.0, 0.01 + 0.8 * inner, "position"),
        draw.joint("shoulder", "upper", "hinge", 0.7, inner, "position", 0.5),
        draw.joint("elbow", "fore", "hinge", 0.8, outer, "position", -0.5, (15, 30)),
    ]
    return joints, (
        '    <body name="turret" pos="0 0 0.5">\n'
        '      <joint {yaw} axis="0 0 1"/>\n'
        f'      <geom type="cylinder" size="0.08 0.1" mass="{mass[0]:g}"/>\n'
        '      <body name="upper" pos="0 0 0.15">\n'
        '        <joint {shoulder} axis="0 1 0"/>\n'
        f"        {_link(long[0], mass[1], 0.03, 'x')}\n"
        f'        <body name="fore" pos="{long[0]:g} 0 0">\n'
        '          <joint {elbow} axis="0 1 0"/>\n'
        f"          {_link(long[1], mass[2], 0.025, 'x')}\n"
        "        </body>\n      </body>\n    </body>\n"
    )


def _arm6(draw: Draw) -> Parts:
    mass = [draw.near(m) for m in (3.0, 2.0, 1.2, 0.6, 0.5, 0.3)]
    long = [draw.near(x, 0.15) for x in (0.35, 0.3, 0.1, 0.1)]
    reach = long[0] + long[1]
    inner = mass[1] * long[0] ** 2 / 3.0 + sum(mass[2:]) * long[0] ** 2 + 0.1
    elbow = mass[2] * long[1] ** 2 / 3.0 + sum(mass[3:]) * long[1] ** 2 + 0.01
    wrist = sum(mass[4:]) * 0.008 + 0.004
    rows = (
        ("j1", "base", 0.9, 0.02 + mass[2] * reach**2 / 2, 0.0),
        ("j2", "upper", 0.5, inner, -0.5),
        ("j3", "fore", 0.6, elbow, 0.9),
        ("j4", "roll", 0.9, 0.004, 0.0),
        ("j5", "wrist", 0.7, wrist, 0.4),
        ("j6", "flange", 1.0, 0.0015, 0.0),
    )
    joints = [
        draw.joint(name, body, "hinge", amplitude, inertia, "position", home, (14, 26))
        for name, body, amplitude, inertia, home in rows
    ]
    return joints, (
        '    <body name="base" pos="0 0 0.3">\n      <joint {j1} axis="0 0 1"/>\n'
        f'      <geom type="cylinder" size="0.09 0.1" mass="{mass[0]:g}"/>\n'
        '      <body name="upper" pos="0 0 0.15">\n        <joint {j2} axis="0 1 0"/>\n'
        f"        {_link(long[0], mass[1], 0.04, 'x')}\n"
        f'        <body name="fore" pos="{long[0]:g} 0 0">\n'
        '          <joint {j3} axis="0 1 0"/>\n'
        f"          {_link(long[1], mass[2], 0.03, 'x')}\n"
        f'          <body name="roll" pos="{long[1]:g} 0 0">\n'
        '            <joint {j4} axis="1 0 0"/>\n'
        '            <geom type="box" size="0.05 0.07 0.05" contype="0" '
        f'conaffinity="0" mass="{mass[3]:g}"/>\n'
        f'            <body name="wrist" pos="{long[2]:g} 0 0">\n'
        '              <joint {j5} axis="0 1 0"/>\n'
        f"              {_link(long[3], mass[4], 0.025, 'x')}\n"
        f'              <body name="flange" pos="{long[3]:g} 0 0">\n'
        '                <joint {j6} axis="1 0 0"/>\n'
        '                <geom type="box" size="0.02 0.06 0.03" pos="0.02 0.02 0" '
        f'contype="0" conaffinity="0" mass="{mass[5]:g}"/>\n'
        + "".join("  " * n + "</body>\n" for n in range(7, 1, -1))
    )


def _leg(draw: Draw) -> Parts:
    base, thigh, calf = draw.near(4.0), draw.near(0.8), draw.near(0.4)
    length, bend = draw.near(0.25, 0.15), 0.7
    height = 2.0 * length * np.cos(bend) + FOOT_RADIUS
    swing = 0.05 * base
    joints = [
        draw.joint("height", "trunk", "slide", 0.05, base),
        draw.joint("hip", "thigh", "hinge", 0.3, swing, "position", -bend, (24, 36)),
        draw.joint(
            "knee", "calf", "hinge", 0.45, swing, "position", 2 * bend, (24, 36)
        ),
    ]
    # A base on rails has no joint limits, and its own passive numbers are zero.
    rails = replace(
        joints[0], reach=0.0, damping=0.0, armature=0.0, stiffness=0.0, frictionloss=0.0
    )
    friction = draw.near(0.6, 0.3)
    contact = f'friction="{friction:g} 0.005 0.0001"'
    foot = f'size="{FOOT_RADIUS}" pos="0 0 -{length:g}" mass="0.06" {contact}'
    return [rails, *joints[1:]], (
        f'    <geom name="floor" type="plane" size="5 5 0.1" {contact}/>\n'
        f'    <body name="trunk" pos="0 0 {height:.4g}">\n'
        '      <joint {height} axis="0 0 1"/>\n'
        '      <geom type="box" size="0.12 0.08 0.06" contype="0" conaffinity="0" '
        f'mass="{base:g}"/>\n'
        '      <body name="thigh">\n        <joint {hip} axis="0 -1 0"/>\n'
        f"        {_link(length, thigh, 0.025)}\n"
        f'        <body name="calf" pos="0 0 -{length:g}">\n'
        '          <joint {knee} axis="0 -1 0"/>\n'
        f"          {_link(length, calf, 0.02)}\n"
        f'          <geom name="foot" type="sphere" {foot}/>\n'
        "        </body>\n      </body>\n    </body>\n"
    )


def _hopper(draw: Draw) -> Parts:
    """A leg whose trunk slides along as well: it moves where its foot holds."""
    joints, bodies = _leg(draw)
    rails = replace(joints[0], name="along", amplitude=0.1)
    held = '      <joint {height} axis="0 0 1"/>\n'
    assert held in bodies
    return [rails, *joints], bodies.replace(
        held, '      <joint {along} axis="1 0 0"/>\n' + held
    )


def _stand(draw: Draw) -> Parts:
    """Four like legs that hang from a held trunk."""
    mass = draw.near(0.7), draw.near(1.0), draw.near(0.25)
    length = draw.near(0.21, 0.15)
    calf = mass[2] * length**2 / 3
    thigh = mass[1] * length**2 / 3 + mass[2] * (length**2 + length**2 / 3)
    rows = (
        ("hip", 0.35, thigh, 0.0),
        ("thigh", 0.5, thigh, 0.7),
        ("calf", 0.5, calf, -1.4),
    )
    like = [
        draw.joint(name, name, "hinge", amplitude, inertia, "position", home)
        for name, amplitude, inertia, home in rows
    ]
    joints, bodies = [], '    <body name="trunk" pos="0 0 1">\n'
    for i, leg in enumerate(LEGS):
        mine = [
            replace(
                joint,
                name=f"{leg}_{joint.name}",
                body=f"{leg}_{joint.name}_link",
                actuator=f"{leg}_{joint.actuator}",
            )
            for joint in like
        ]
        joints += mine
        hip, upper, lower = (joint.body for joint in mine)
        at = f"{0.19 - 0.38 * (i // 2):g} {0.05 - 0.1 * (i % 2):g} 0"
        bodies += (
            f'      <body name="{hip}" pos="{at}">\n'
            f'        <joint {{{leg}_hip}} axis="1 0 0"/>\n'
            f'        <geom type="sphere" size="0.04" mass="{mass[0]:g}" '
            'contype="0" conaffinity="0"/>\n'
            f'        <body name="{upper}" pos="0 {0.08 - 0.16 * (i % 2):g} 0">\n'
            f'          <joint {{{leg}_thigh}} axis="0 1 0"/>\n'
            f"          {_link(length, mass[1], 0.02)}\n"
            f'          <body name="{lower}" pos="0 0 -{length:g}">\n'
            f'            <joint {{{leg}_calf}} axis="0 1 0"/>\n'
            f"            {_link(length, mass[2], 0.015)}\n"
            "          </body>\n        </body>\n      </body>\n"
        )
    return joints, bodies + "    </body>\n"


_BUILDERS: dict[str, Callable[[Draw], Parts]] = {
    "slide": _slide,
    "pendulum": _pendulum,
    "cartpole": _cartpole,
    "arm2": _arm2,
    "arm3": _arm3,
    "arm6": _arm6,
    "leg": _leg,
    "hopper": _hopper,
}


MECHANISMS = tuple(_BUILDERS)
_BUILDERS["stand"] = _stand
WIDE = tuple(_BUILDERS)
"""Mechanisms of wide draws."""


def build(
    name: str, rng: np.random.Generator, stated: Stated, wide: bool = False
) -> Mechanism:
    """A mechanism with its masses, lengths, gains and rates drawn from `rng`; `wide`:
    control rates to 1 kHz, slow and fast, and drives with an activation."""
    machine = _narrow(name, rng, stated)
    if not wide:
        return machine
    control_step = 1.0 / float(rng.choice((50, 100, 125, 200, 250, 500, 1000)))
    steps = [h for h in (0.004, 0.002, 0.001, 0.0005) if h < control_step + 1e-9]
    filtered = rng.random() < 0.2
    time = float(f"{np.exp(rng.uniform(*np.log(FILTERS))):.2g}")
    joints = tuple(
        replace(j, filter=time) if filtered and j.drive in ("motor", "position") else j
        for j in machine.joints
    )
    return replace(
        machine,
        joints=joints,
        timestep=float(rng.choice(steps)),
        control_step=control_step,
        speed=float(np.exp(rng.uniform(*np.log(SPEEDS))))
        * (0.5 if name in ON_GROUND else 1.0),
    )


def _narrow(name: str, rng: np.random.Generator, stated: Stated) -> Mechanism:
    joints, bodies = _BUILDERS[name](Draw(rng, stated))
    slow = name in ("slide", "pendulum", "cartpole")
    rates = (50, 100, 125, 200) if slow else (100, 125, 200)
    control_step = 1.0 / float(rng.choice(rates))
    steps = [h for h in (0.004, 0.002, 0.001) if h < control_step + 1e-9]
    damped = all(joint.damping > 0 for joint in joints)
    return Mechanism(
        name=name,
        joints=tuple(joints),
        bodies=bodies,
        timestep=float(rng.choice(steps)),
        control_step=control_step,
        speed=float(rng.uniform(0.8, 1.6)) * (0.6 if name in ON_GROUND else 1.0),
        open_loop=name == "pendulum"
        and joints[0].drive == "motor"
        and damped
        and bool(rng.random() < 0.5),
    )
