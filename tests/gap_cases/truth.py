"""The real machine: the owner's model at a fine step, with the effects in it."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import mujoco
import numpy as np

from tests.gap_cases import commands, torques
from tests.gap_cases.effects import Effect
from tests.gap_cases.mechanisms import GRAVITY, Mechanism

STAGE_ORDER = (
    "dropped_commands",
    "actuator_delay",
    "actuator_deadband",
    "actuator_gain",
    "gain_drift",
    "bent_gain",
    "actuator_lag",
)


@dataclass
class Truth:
    """A machine that can be stepped.

    Attributes:
        model: MuJoCo model at the fine step.
        stages: paths of the commands, in order.
        pushes: forces to apply before each step.
        bias: (nq,) offsets of the readings.
        late: (nq,) delays of the readings, in fine steps.
    """

    mechanism: Mechanism
    model: mujoco.MjModel
    stages: list[commands.Stage] = field(default_factory=list)
    pushes: list[torques.Push] = field(default_factory=list)
    bias: np.ndarray = field(default_factory=lambda: np.zeros(0))
    late: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=int))

    @property
    def fine(self) -> float:
        return float(self.model.opt.timestep)

    def reset(self, rng: np.random.Generator) -> None:
        for part in (*self.stages, *self.pushes):
            part.reset(rng)


def home(mechanism: Mechanism) -> np.ndarray:
    return np.array([joint.home for joint in mechanism.joints])


def felt_inertia(model: mujoco.MjModel, qpos: np.ndarray) -> np.ndarray:
    """Inertia (nv,) that a torque at each joint alone meets, the others free."""
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_forward(model, data)
    mass = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, mass)
    return 1.0 / np.diag(np.linalg.inv(mass))


def _servo(model: mujoco.MjModel, at: int) -> Callable[[mujoco.MjData], float]:
    """Torque at the joint that MuJoCo would give actuator `at`; then silence it."""
    joint = int(model.actuator_trnid[at, 0])
    gear = float(model.actuator_gear[at, 0])
    gain = float(model.actuator_gainprm[at, 0])
    constant, spring, damper = (float(x) for x in model.actuator_biasprm[at, :3])
    if model.actuator_biastype[at] == mujoco.mjtBias.mjBIAS_NONE:
        constant = spring = damper = 0.0
    low, high = -np.inf, np.inf
    if model.actuator_forcelimited[at]:
        low, high = (float(x) for x in model.actuator_forcerange[at])
    model.actuator_gainprm[at] = 0.0
    model.actuator_biasprm[at] = 0.0

    def torque(data: mujoco.MjData) -> float:
        length = gear * float(data.qpos[joint])
        speed = gear * float(data.qvel[joint])
        force = gain * float(data.ctrl[at])
        force += constant + spring * length + damper * speed
        return gear * min(max(force, low), high)

    return torque


def _change_model(truth: Truth, effect: Effect) -> None:
    """Effects that MuJoCo's own constants hold."""
    model, name, number = truth.model, effect.name, effect.number
    if name == "armature":
        model.dof_armature[model.joint(effect.at).dofadr[0]] += number("armature")
    elif name == "payload_mass":
        # A point at the center of mass adds no inertia about it.
        model.body_mass[model.body(effect.at).id] += number("mass")
    elif name == "com_offset":
        offset = [number(axis) for axis in "xyz"]
        model.body_ipos[model.body(effect.at).id] += offset
    elif name == "gravity_tilt":
        model.opt.gravity[:] = tilted(number("roll"), number("pitch"))
    elif name == "actuator_saturation":
        at = model.actuator(effect.at).id
        model.actuator_forcelimited[at] = 1
        model.actuator_forcerange[at] = [-number("limit"), number("limit")]
    elif name in ("drive_stiffness", "drive_damping", "actuator_strength"):
        # Of a velocity drive the rate gain is also what multiplies the command.
        at = model.actuator(effect.at).id
        position = model.actuator_biasprm[at, 1] != 0
        if name != "drive_damping" or not position:
            model.actuator_gainprm[at, 0] *= number("factor")
        if name != "drive_damping":
            model.actuator_biasprm[at, 1] *= number("factor")
        if name != "drive_stiffness":
            model.actuator_biasprm[at, 2] *= number("factor")
    elif name == "contact_friction":
        model.geom_friction[:, 0] = number("friction")
    elif name == "contact_softness":
        model.geom_solref[:] = [-number("stiffness"), -number("damping")]


def tilted(roll: float, pitch: float) -> np.ndarray:
    """Gravity in the axes of a base turned by `pitch` about y, then `roll` about x."""
    turn_x = np.array(
        [
            [1.0, 0.0, 0.0],
            [0.0, np.cos(roll), -np.sin(roll)],
            [0.0, np.sin(roll), np.cos(roll)],
        ]
    )
    turn_y = np.array(
        [
            [np.cos(pitch), 0.0, np.sin(pitch)],
            [0.0, 1.0, 0.0],
            [-np.sin(pitch), 0.0, np.cos(pitch)],
        ]
    )
    return (turn_y @ turn_x).T @ np.array([0.0, 0.0, -GRAVITY])


def _push(truth: Truth, effect: Effect, inertia: np.ndarray) -> torques.Push | None:
    """The applied force of an effect, if it is one."""
    model, number, fine = truth.model, effect.number, truth.fine
    bodies = {model.body(i).name for i in range(model.nbody)}
    if effect.name == "constant_force" and effect.at in bodies:
        force = np.array([number(axis) for axis in "xyz"])
        return torques.BodyForce(model.body(effect.at).id, force)
    joints = [model.joint(i).name for i in range(model.njnt)]
    if effect.at not in joints:
        return None
    at = joints.index(effect.at)
    if effect.name in ("coulomb_friction", "stribeck_friction"):
        plain = effect.name == "coulomb_friction"
        static = number("torque") if plain else number("static")
        kinetic = static if plain else number("kinetic")
        velocity = 1.0 if plain else number("velocity")
        return torques.LuGre(at, static, kinetic, velocity, inertia[at], fine)
    if effect.name == "place_friction":
        waves = number("waves")
        given = at, number("torque"), waves, inertia[at], fine
        return torques.PlaceFriction(*given)
    if effect.name == "warm_friction":
        given = at, number("torque"), number("distance"), inertia[at], fine
        return torques.WarmFriction(*given)
    if effect.name == "hysteresis":
        return torques.BoucWen(at, number("torque"), number("width"), fine)
    if effect.name == "coupling_spring":
        other = joints.index(str(effect.parameters["other"]))
        rest = truth.mechanism.joints[at].home - truth.mechanism.joints[other].home
        return torques.Coupling(at, other, number("stiffness"), rest)
    law = _law(effect, truth.mechanism.joints[at].home)
    return torques.Law(at, law) if law else None


def _law(effect: Effect, home: float) -> Callable[[float, float], float] | None:
    """Torque as a function of position and speed."""
    number = effect.number
    if effect.name == "cubic_spring":
        stiffness = number("stiffness")
        return lambda q, v: -stiffness * (q - home) ** 3
    if effect.name == "one_way_damping":
        damping = number("damping")
        return lambda q, v: -damping * max(v, 0.0)
    if effect.name == "viscous_damping":
        damping = number("damping")
        return lambda q, v: -damping * v
    if effect.name == "quadratic_drag":
        coefficient = number("coefficient")
        return lambda q, v: -coefficient * v * abs(v)
    if effect.name == "joint_stiffness":
        stiffness, rest = number("stiffness"), number("rest")
        return lambda q, v: stiffness * (rest - q)
    if effect.name == "constant_force":
        torque = number("torque")
        return lambda q, v: torque
    if effect.name == "torque_ripple":
        amplitude, phase = number("amplitude"), number("phase")
        cycles = number("cycles_per_rev")
        return lambda q, v: amplitude * float(np.sin(cycles * q + phase))
    return None


def _stage(truth: Truth, effect: Effect, duration: float) -> commands.Stage | None:
    """The stage of a command's path that an effect is, if it is one."""
    if effect.name not in STAGE_ORDER:
        return None
    at, number = truth.model.actuator(effect.at).id, effect.number
    if effect.name == "dropped_commands":
        return commands.Dropped(at, number("probability"))
    if effect.name == "actuator_delay":
        return commands.Delayed(at, number("delay"), truth.fine)
    if effect.name == "actuator_deadband":
        subtractive = effect.parameters["shape"] == "subtractive"
        return commands.Deadband(at, number("width"), subtractive)
    if effect.name == "actuator_gain":
        return commands.Gain(at, number("gain"))
    if effect.name == "bent_gain":
        return commands.Bent(at, number("bend"))
    if effect.name == "gain_drift":
        return commands.Gain(at, 1.0, number("drift"), duration)
    return commands.Lag(at, number("time_constant"), truth.fine)


def _with_own(mechanism: Mechanism, own: Mapping[str, float]) -> mujoco.MjModel:
    """The owner's model with true values of what it states."""
    model = mujoco.MjModel.from_xml_string(mechanism.xml())
    tables = {
        "damping": model.dof_damping,
        "stiffness": model.jnt_stiffness,
        "frictionloss": model.dof_frictionloss,
    }
    for address, value in own.items():
        _, name, parameter = address.split(".")
        tables[parameter][model.joint(name).id] = value
    return model


def nearest(
    mechanism: Mechanism, effects: Sequence[Effect], own: Mapping[str, float]
) -> mujoco.MjModel:
    """The owner's model with the effects as far as MuJoCo's constants have them.

    Only to push noise through: forces that do not depend on the state are left out.
    """
    truth = Truth(mechanism, _with_own(mechanism, own))
    model = truth.model
    for effect in apart(mechanism, effects):
        _change_model(truth, effect)
        if effect.name in ("coulomb_friction", "place_friction", "warm_friction"):
            at = model.joint(effect.at).id
            model.dof_frictionloss[at] += effect.number("torque")
        elif effect.name == "stribeck_friction":
            at = model.joint(effect.at).id
            model.dof_frictionloss[at] += effect.number("kinetic")
        elif effect.name == "viscous_damping":
            model.dof_damping[model.joint(effect.at).id] += effect.number("damping")
        elif effect.name == "joint_stiffness":
            at = model.joint(effect.at).id
            model.jnt_stiffness[at] += effect.number("stiffness")
            model.qpos_spring[at] = effect.number("rest")
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def apart(mechanism: Mechanism, effects: Sequence[Effect]) -> list[Effect]:
    """The effects, those of a pattern at each of its places."""
    joints = mechanism.joints
    names = [n for j in joints for n in (j.name, j.body, j.actuator) if n]
    return [one for effect in effects for one in effect.apart(names)]


def assemble(
    mechanism: Mechanism,
    effects: Sequence[Effect],
    fine: float,
    own: Mapping[str, float] | None = None,
    duration: float = 10.0,
) -> Truth:
    """The machine with all `effects`.

    `own` maps addresses such as `joint.hinge.damping` to true values of what the model
    states; `duration` is the time over which a gain drifts, s.
    """
    effects = apart(mechanism, effects)
    model = _with_own(mechanism, own or {})
    model.opt.timestep = fine
    truth = Truth(
        mechanism,
        model,
        bias=np.zeros(model.nq),
        late=np.zeros(model.nq, dtype=int),
    )
    for effect in effects:
        _change_model(truth, effect)
    inertia = felt_inertia(model, home(mechanism))
    backlashes = [effect for effect in effects if effect.name == "backlash"]
    for effect in backlashes:
        inertia = _add_backlash(truth, effect, inertia)
    mujoco.mj_setConst(model, mujoco.MjData(model))
    for effect in effects:
        push = _push(truth, effect, inertia)
        if push:
            truth.pushes.append(push)
        if effect.name == "sensor_bias":
            truth.bias[model.joint(effect.at).id] += effect.number("bias")
        if effect.name == "sensor_delay":
            late = round(effect.number("delay") / fine)
            truth.late[model.joint(effect.at).id] += late
    ordered = sorted(
        (effect for effect in effects if effect.name in STAGE_ORDER),
        key=lambda effect: STAGE_ORDER.index(effect.name),
    )
    stages = (_stage(truth, effect, duration) for effect in ordered)
    truth.stages = [stage for stage in stages if stage]
    return truth


def _add_backlash(truth: Truth, effect: Effect, inertia: np.ndarray) -> np.ndarray:
    """Move the rotor out of the armature; returns the loads' inertias."""
    model, mechanism = truth.model, truth.mechanism
    at = model.joint(effect.at).id
    rotor = effect.number("rotor_share") * mechanism.joints[at].armature
    if rotor <= 0.0:
        raise ValueError(f"backlash needs an armature at {effect.at}")
    model.dof_armature[at] -= rotor
    inertia = felt_inertia(model, home(mechanism))
    drive = _servo(model, mechanism.driven.index(at))
    truth.pushes.append(
        torques.TwoMassDrive(
            at, drive, rotor, float(inertia[at]), effect.number("width"), truth.fine
        )
    )
    return inertia
