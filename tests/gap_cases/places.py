"""Where an effect can be seen, and what physics cannot tell apart from it."""

from tests.gap_cases.effects import KINDS, ON_REQUEST, Effect
from tests.gap_cases.mechanisms import Joint, Mechanism

BODY_TURNED = ("turret", "base")
"""Bodies whose center of mass stays on a vertical axis."""


def _hinges(mechanism: Mechanism) -> list[Joint]:
    return [joint for joint in mechanism.joints if joint.kind == "hinge"]


def _bodies(mechanism: Mechanism) -> list[str]:
    return [j.body for j in mechanism.joints if j.body not in BODY_TURNED]


def _joints(mechanism: Mechanism, effect: str) -> list[Joint]:
    """Joints at which a joint's effect is new to the model and visible."""
    joints = list(mechanism.joints)
    if effect in ("cubic_spring", "one_way_damping"):
        return [joint for joint in joints if joint.name != "height"]
    if effect == "place_friction":
        return [joint for joint in _hinges(mechanism) if not joint.frictionloss]
    if effect in (
        *("coulomb_friction", "stribeck_friction", "hysteresis"),
        "warm_friction",
    ):
        return [joint for joint in joints if not joint.frictionloss]
    if effect == "viscous_damping":
        return [joint for joint in joints if not joint.damping]
    if effect == "joint_stiffness":
        return [joint for joint in joints if not joint.stiffness]
    if effect == "torque_ripple":
        return _hinges(mechanism)
    if effect == "backlash":
        return [
            joint
            for joint in joints
            if joint.armature and joint.drive and not joint.filter
        ]
    if effect == "armature":
        return [joint for joint in joints if joint.name != "height"]
    if effect == "coupling_spring":
        return _hinges(mechanism) if len(_hinges(mechanism)) > 1 else []
    if effect == "sensor_bias":
        # Nothing depends on where a slide or a yaw without servo is.
        return [
            joint
            for joint in joints
            if joint.drive == "position"
            or joint.stiffness
            or (joint.kind == "hinge" and joint.name not in ("yaw", "j1"))
            or joint.name == "height"
        ]
    return joints


def _holds(joint: Joint, effect: str) -> bool:
    """Whether an effect of drives is at this one, and no twin of another effect."""
    if joint.drive == "velocity":  # its strength is its damping
        return effect == "drive_damping"
    # A joint's own damping is refitted, and would do what the drive's does.
    refitted = effect == "drive_damping" and joint.damping
    return joint.drive == "position" and not refitted


def places(mechanism: Mechanism, effect: str) -> list[str]:
    """Names of the places where the effect changes what is measured."""
    driven = [mechanism.joints[i] for i in mechanism.driven]
    if effect in ON_REQUEST:
        return [joint.actuator for joint in driven if _holds(joint, effect)]
    if effect in ("contact_friction", "contact_softness"):
        return [""] if mechanism.on_ground else []
    if effect == "gravity_tilt":
        return [""]
    if effect == "bent_gain":
        return [joint.actuator for joint in driven if joint.drive == "motor"]
    if effect in ("gain_drift", "dropped_commands") or KINDS.get(effect) == "actuator":
        if effect == "actuator_deadband":
            driven = [joint for joint in driven if joint.drive != "position"]
        return [joint.actuator for joint in driven]
    if effect == "payload_mass":
        return _bodies(mechanism)
    if effect == "com_offset":
        return [joint.body for joint in _hinges(mechanism) if joint.name != "yaw"][
            1 if mechanism.name == "arm6" else 0 :
        ]
    names = [joint.name for joint in _joints(mechanism, effect)]
    return names + _bodies(mechanism) if effect == "constant_force" else names


def twins(mechanism: Mechanism, effect: Effect) -> list[str]:
    """Rivals, as `name@place`, that this mechanism's motion cannot tell from it.

    Only twins by nature are listed, exact or as good as exact; noise can make more.
    """
    joints = mechanism.joints
    if effect.tied:
        names = [n for j in joints for n in (j.name, j.actuator)]
        one = effect.apart(names)[0]
        leg = one.at.partition("_")[0]
        return [twin.replace(f"@{leg}_", "@*_") for twin in twins(mechanism, one)]
    single = len(joints) == 1
    first = joints[0]
    found: list[str] = []
    name, at = effect.name, effect.at
    mass = [f"armature@{first.name}", f"payload_mass@{first.body}"]
    force = [f"constant_force@{first.name}", f"constant_force@{first.body}"]
    if mechanism.name == "slide":
        force.append("gravity_tilt@")
        if first.drive == "position":
            force.append(f"sensor_bias@{first.name}")
        passive = first.damping or first.stiffness or first.frictionloss
        if first.drive == "motor" and not passive:
            mass.append(f"actuator_gain@{first.actuator}")
        for group in (mass, force):
            if f"{name}@{at}" in group:
                found += group
    elif mechanism.name == "cartpole" and at in ("slider", "cart"):
        if f"{name}@{at}" in mass:
            found += mass
    elif (
        mechanism.name == "pendulum" and first.drive == "motor" and not first.stiffness
    ):
        # All three turn gravity about the hinge.
        group = ["gravity_tilt@", f"sensor_bias@{first.name}"]
        if f"{name}@{at}" in group:
            found += [*group, f"com_offset@{first.body}"]
    if mechanism.name == "leg" and at in ("height", "trunk"):
        group = ["constant_force@height", "constant_force@trunk"]
        found += group if f"{name}@{at}" in group else []
    for joint in joints:
        # More of either is a torque against the speed.
        damping = f"viscous_damping@{joint.name}", f"drive_damping@{joint.actuator}"
        change = float(effect.parameters.get("factor", 2.0)) - 1.0
        more = change * float(effect.parameters.get("sign", 1.0)) > 0
        if joint.drive == "position" and f"{name}@{at}" in damping and more:
            found += damping
    if single and name in ("actuator_delay", "sensor_delay"):
        found += [f"actuator_delay@{first.actuator}", f"sensor_delay@{first.name}"]
    return sorted({twin for twin in found if twin != f"{name}@{at}"})


FRICTIONS = ("coulomb_friction", "stribeck_friction")
LAWS = {
    **dict.fromkeys(("hysteresis", "place_friction", "warm_friction"), FRICTIONS),
    **dict.fromkeys(FRICTIONS, FRICTIONS),
    **dict.fromkeys(("cubic_spring", "coupling_spring"), ("joint_stiffness",)),
    **dict.fromkeys(("one_way_damping", "quadratic_drag"), ("viscous_damping",)),
    **dict.fromkeys(("gain_drift", "bent_gain"), ("actuator_gain",)),
    "dropped_commands": ("actuator_delay", "actuator_lag"),
}
"""Effects of the table that are others in another law."""


def kindred(effect: Effect) -> list[str]:
    """Names, as `name@place`, of the same effect in another law."""
    other = effect.parameters.get("other")
    at = [effect.at, str(other)] if other else [effect.at]
    names = [n for n in LAWS.get(effect.name, ()) if n != effect.name]
    return [f"{name}@{place}" for name in names for place in at]
