"""How strong an effect is: its main parameter, and the draw of the others.

A strength runs from 0 (nothing) to 1 (as much as is still sensible); the context,
measured on a run without effects, turns it into SI units.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from tests.gap_cases.effects import ON_REQUEST, Context, Effect, Parameters
from tests.gap_cases.mechanisms import GRAVITY

Sizer = Callable[[Effect, float, Context], Parameters]
Filler = Callable[[Effect, np.random.Generator, Context], Parameters]


def _scaled(main: str, scale: Callable[[Effect, Context, int], float]) -> Sizer:
    def size(effect: Effect, strength: float, context: Context) -> Parameters:
        at = context.joint(effect.at) if effect.at else -1
        return {main: strength * scale(effect, context, at)}

    return size


def _stribeck(effect: Effect, strength: float, context: Context) -> Parameters:
    static = 0.8 * strength * context.torque[context.joint(effect.at)]
    return {"static": static, "kinetic": static * effect.number("kinetic_share")}


def _constant_force(effect: Effect, strength: float, context: Context) -> Parameters:
    if effect.at in context.mass:
        size = 0.5 * strength * context.mass[effect.at] * GRAVITY
        return {axis: size * effect.number(f"toward_{axis}") for axis in "xyz"}
    torque = 0.8 * strength * context.torque[context.joint(effect.at)]
    return {"torque": effect.number("sign") * torque}


def _factor(name: str) -> Sizer:
    def size(effect: Effect, strength: float, context: Context) -> Parameters:
        del context
        up = effect.number("sign") > 0
        return {name: 1.0 + 0.6 * strength if up else 1.0 - 0.55 * strength}

    return size


def _steps(longest: float, name: str) -> Sizer:
    """A time in whole fine steps, so that the truth has it exactly."""

    def size(effect: Effect, strength: float, context: Context) -> Parameters:
        del effect
        count = max(1, round(strength * longest / context.fine))
        return {name: count * context.fine}

    return size


def _lag(effect: Effect, strength: float, context: Context) -> Parameters:
    del effect, context
    return {"time_constant": 0.15 * strength}


def _saturation(effect: Effect, strength: float, context: Context) -> Parameters:
    peak = context.force[context.actuator(effect.at)]
    return {"limit": (1.0 - 0.8 * strength) * peak}


def _deadband(effect: Effect, strength: float, context: Context) -> Parameters:
    return {"width": 0.5 * strength * context.command[context.actuator(effect.at)]}


def _payload(effect: Effect, strength: float, context: Context) -> Parameters:
    up = effect.number("sign") > 0
    return {"mass": (1.5 if up else -0.6) * strength * context.mass[effect.at]}


def _com_offset(effect: Effect, strength: float, context: Context) -> Parameters:
    size = 0.5 * strength * context.size[effect.at]
    return {axis: size * effect.number(f"toward_{axis}") for axis in "xyz"}


def _tilt(effect: Effect, strength: float, context: Context) -> Parameters:
    del context
    return {
        axis: 0.35 * strength * effect.number(f"toward_{axis}")
        for axis in ("roll", "pitch")
    }


def _bias(effect: Effect, strength: float, context: Context) -> Parameters:
    at = context.joint(effect.at)
    most = 0.4 if context.mechanism.joints[at].kind == "hinge" else 0.1
    return {"bias": effect.number("sign") * strength * most}


def _contact_friction(effect: Effect, strength: float, context: Context) -> Parameters:
    factor = 1.0 + effect.number("sign") * 0.8 * strength
    return {"friction": factor * context.friction}


def _softness(effect: Effect, strength: float, context: Context) -> Parameters:
    del context
    # MuJoCo's own contact: 1 / (0.95 * 0.02)^2 and 2 / (0.95 * 0.02).
    softer = float(np.exp(-4.0 * strength))
    ratio = effect.number("ratio")
    stiffness = 2770.0 * softer
    return {"stiffness": stiffness, "damping": 2.0 * ratio * np.sqrt(stiffness)}


def _drag(effect: Effect, context: Context, at: int) -> float:
    del effect
    return 1.2 * context.torque[at] / max(context.speed[at], 1e-3) ** 2


def _play(effect: Effect, context: Context, at: int) -> float:
    del effect
    most = 0.1 if context.mechanism.joints[at].kind == "hinge" else 0.03
    return min(most, 0.15 * context.span[at])


SIZERS: dict[str, Sizer] = {
    "coulomb_friction": _scaled("torque", lambda e, c, j: 0.7 * c.torque[j]),
    "stribeck_friction": _stribeck,
    "viscous_damping": _scaled(
        "damping", lambda e, c, j: 1.2 * c.torque[j] / max(c.speed[j], 1e-3)
    ),
    "quadratic_drag": _scaled("coefficient", _drag),
    "joint_stiffness": _scaled(
        "stiffness", lambda e, c, j: 3 * c.torque[j] / c.span[j]
    ),
    "constant_force": _constant_force,
    "torque_ripple": _scaled("amplitude", lambda e, c, j: 0.8 * c.torque[j]),
    "armature": _scaled("armature", lambda e, c, j: 2.0 * c.inertia[j]),
    "backlash": _scaled("width", _play),
    "actuator_gain": _factor("gain"),
    **{name: _factor("factor") for name in ON_REQUEST},
    "actuator_delay": _steps(0.06, "delay"),
    "actuator_lag": _lag,
    "actuator_saturation": _saturation,
    "actuator_deadband": _deadband,
    "payload_mass": _payload,
    "com_offset": _com_offset,
    "gravity_tilt": _tilt,
    "sensor_bias": _bias,
    "sensor_delay": _steps(0.06, "delay"),
    "contact_friction": _contact_friction,
    "contact_softness": _softness,
    "hysteresis": _scaled("torque", lambda e, c, j: 0.7 * c.torque[j]),
    "place_friction": _scaled("torque", lambda e, c, j: 0.6 * c.torque[j]),
    "warm_friction": _scaled("torque", lambda e, c, j: 0.7 * c.torque[j]),
    "cubic_spring": _scaled(
        "stiffness", lambda e, c, j: 12.0 * c.torque[j] / c.span[j] ** 3
    ),
    "one_way_damping": _scaled(
        "damping", lambda e, c, j: 1.5 * c.torque[j] / max(c.speed[j], 1e-3)
    ),
    "bent_gain": lambda e, s, c: {
        "bend": e.number("sign") * 0.5 * s / c.command[c.actuator(e.at)]
    },
    "gain_drift": lambda e, s, c: {"drift": e.number("sign") * 0.6 * s},
    "coupling_spring": _scaled(
        "stiffness", lambda e, c, j: 4.0 * c.torque[j] / c.span[j]
    ),
    "dropped_commands": lambda e, s, c: {"probability": 0.7 * s},
}


def _sign(effect: Effect, rng: np.random.Generator, context: Context) -> Parameters:
    del effect, context
    return {"sign": float(rng.choice((-1.0, 1.0)))}


def _direction(
    effect: Effect, rng: np.random.Generator, context: Context
) -> Parameters:
    """A direction in the plane that the mechanism moves in, or in space."""
    spatial = any(joint.name in ("yaw", "j1") for joint in context.mechanism.joints)
    way = rng.standard_normal(3)
    if not spatial:
        way[1] = 0.0
    if context.mechanism.name == "slide":
        way[1:] = 0.0
    way /= np.linalg.norm(way)
    if effect.at not in context.mass:
        return _sign(effect, rng, context)
    return {f"toward_{axis}": float(x) for axis, x in zip("xyz", way, strict=True)}


def _tilt_direction(
    effect: Effect, rng: np.random.Generator, context: Context
) -> Parameters:
    del effect
    spatial = any(joint.name in ("yaw", "j1") for joint in context.mechanism.joints)
    angle = rng.uniform(0.0, 2 * np.pi)
    sign = float(rng.choice((-1.0, 1.0)))
    roll, pitch = (np.cos(angle), np.sin(angle)) if spatial else (0.0, sign)
    return {"toward_roll": float(roll), "toward_pitch": float(pitch)}


def _ripple(effect: Effect, rng: np.random.Generator, context: Context) -> Parameters:
    span = context.span[context.joint(effect.at)]
    # At least one and a half periods within the motion.
    least = int(np.ceil(1.5 * 2 * np.pi / span))
    cycles = int(rng.integers(least, 2 * least + 3))
    return {"cycles_per_rev": cycles, "phase": float(rng.uniform(-np.pi, np.pi))}


def _rest(effect: Effect, rng: np.random.Generator, context: Context) -> Parameters:
    at = context.joint(effect.at)
    return {
        "rest": float(context.center[at] + rng.uniform(-0.3, 0.3) * context.span[at])
    }


def _curve(effect: Effect, rng: np.random.Generator, context: Context) -> Parameters:
    speed = context.speed[context.joint(effect.at)]
    return {
        "kinetic_share": float(rng.uniform(0.35, 0.65)),
        "velocity": float(rng.uniform(0.15, 0.4) * speed),
    }


def _loop(effect: Effect, rng: np.random.Generator, context: Context) -> Parameters:
    span = context.span[context.joint(effect.at)]
    return {"width": float(rng.uniform(0.05, 0.15) * span)}


def _partner(effect: Effect, rng: np.random.Generator, context: Context) -> Parameters:
    names = [j.name for j in context.mechanism.joints if j.name != effect.at]
    return {"other": str(rng.choice(names))}


FILLERS: dict[str, Filler] = {
    "stribeck_friction": _curve,
    "joint_stiffness": _rest,
    "constant_force": _direction,
    "torque_ripple": _ripple,
    "backlash": lambda e, r, c: {"rotor_share": float(r.uniform(0.4, 0.8))},
    "actuator_gain": _sign,
    **dict.fromkeys(ON_REQUEST, _sign),
    "actuator_deadband": lambda e, r, c: {
        "shape": str(r.choice(("zeroed", "subtractive")))
    },
    "payload_mass": lambda e, r, c: {"sign": float(r.choice((1.0, 1.0, -1.0)))},
    "com_offset": _direction,
    "gravity_tilt": _tilt_direction,
    "sensor_bias": _sign,
    "contact_friction": _sign,
    "contact_softness": lambda e, r, c: {"ratio": float(r.uniform(0.3, 1.0))},
    "hysteresis": _loop,
    "gain_drift": _sign,
    "bent_gain": _sign,
    "place_friction": lambda e, r, c: {
        "waves": float(r.uniform(1.0, 3.0) * 2 * np.pi / c.span[c.joint(e.at)])
    },
    "warm_friction": lambda e, r, c: {
        "distance": float(r.uniform(1.0, 3.0) * c.speed[c.joint(e.at)])
    },
    "coupling_spring": _partner,
}
PRIVATE = ("sign", "kinetic_share", "ratio")


def filled(effect: Effect, rng: np.random.Generator, context: Context) -> Effect:
    """The effect with its secondary parameters drawn where they are not given."""
    filler = FILLERS.get(effect.name)
    drawn = filler(effect, rng, context) if filler else {}
    return replace(effect, parameters={**drawn, **effect.parameters})


def sized(effect: Effect, strength: float, context: Context) -> Effect:
    """The effect at a strength in [0, 1]."""
    return effect.having(**SIZERS[effect.name](effect, strength, context))


def reported(effect: Effect) -> Parameters:
    """The parameters that an answer names."""
    return {
        name: value
        for name, value in effect.parameters.items()
        if name not in PRIVATE and not name.startswith("toward_")
    }
