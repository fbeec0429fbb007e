"""Recordings of a real machine under its controller."""

from dataclasses import dataclass

import mujoco
import numpy as np

from tests.gap_cases.effects import CaseError
from tests.gap_cases.excitation import LEAD, reference
from tests.gap_cases.logs import Log, Noise
from tests.gap_cases.mechanisms import Mechanism
from tests.gap_cases.truth import Truth, felt_inertia, home

_NONE = mujoco.mjtDyn.mjDYN_NONE.value


@dataclass(frozen=True)
class Plan:
    """What one run does: its length, excitation and own seed."""

    duration: float
    shape: str
    seed: int
    begins: float


class Controller:
    """Turns readings into commands, once per control step.

    Servos take the reference as it is. Motors get a PD controller with the owner's
    gravity compensation, or, in open loop, a torque that would hold the reference.
    """

    def __init__(self, mechanism: Mechanism, goal: np.ndarray) -> None:
        self.mechanism, self.goal = mechanism, goal
        self.speed = np.gradient(goal, mechanism.control_step, axis=0)
        self.model = mujoco.MjModel.from_xml_string(mechanism.xml())
        self.data = mujoco.MjData(self.model)
        self.inertia = felt_inertia(self.model, home(mechanism))
        self.before: np.ndarray | None = None
        self.velocity = np.zeros(self.model.nq)
        self.bandwidth = 7.0 * max(1.0, mechanism.speed)
        self.motors = any(
            mechanism.joints[j].drive == "motor" for j in mechanism.driven
        )

    def command(self, row: int, reading: np.ndarray) -> np.ndarray:
        """Commands (nu,) from the readings (nq,) at a control step."""
        step = self.mechanism.control_step
        if self.before is not None:
            change = (reading - self.before) / step - self.velocity
            self.velocity = self.velocity + step / (step + 0.02) * change
        self.before = reading
        if self.motors:
            self.data.qpos[:] = self.goal_pose(row) if self.open else reading
            self.data.qvel[:] = 0.0
            mujoco.mj_forward(self.model, self.data)
        return np.array(
            [
                self._one(column, joint, row, reading)
                for column, joint in enumerate(self.mechanism.driven)
            ]
        )

    @property
    def open(self) -> bool:
        return self.mechanism.open_loop

    def goal_pose(self, row: int) -> np.ndarray:
        pose = home(self.mechanism)
        pose[list(self.mechanism.driven)] = self.goal[row]
        return pose

    def _one(self, column: int, at: int, row: int, reading: np.ndarray) -> float:
        joint = self.mechanism.joints[at]
        goal, speed = self.goal[row, column], self.speed[row, column]
        if joint.drive == "position":
            return float(goal)
        error = goal - reading[at]
        if joint.drive == "velocity":
            return float(speed + 2.0 * error)
        hold = self.data.qfrc_bias[at]
        if self.open:
            return float(hold / joint.gear)
        omega = self.bandwidth
        wanted = omega**2 * error + 1.6 * omega * (speed - self.velocity[at])
        return float((hold + self.inertia[at] * wanted) / joint.gear)


def record(truth: Truth, plan: Plan, noise: Noise) -> Log:
    """One run of the machine; raises CaseError if it leaves what is sensible."""
    mechanism, model = truth.mechanism, truth.model
    rng = np.random.default_rng(plan.seed)
    noise_rng, reset_rng = rng.spawn(2)
    parts = round(mechanism.control_step / truth.fine)
    lead = round(LEAD / mechanism.control_step)
    rows = lead + round(plan.duration / mechanism.control_step) + 1
    time = mechanism.control_step * (np.arange(rows) - lead)
    joints = mechanism.joints
    amplitudes = np.array([joints[j].amplitude for j in mechanism.driven])
    goal = reference(rng, plan.shape, time, amplitudes, mechanism.speed)
    goal += home(mechanism)[list(mechanism.driven)]
    controller = Controller(mechanism, goal)

    data = mujoco.MjData(model)
    data.qpos[:] = home(mechanism)
    data.qpos[list(mechanism.driven)] = goal[0]
    for i, joint in enumerate(joints):
        if not joint.actuator and joint.kind == "hinge":
            data.qpos[i] += joint.amplitude * rng.uniform(-1.0, 1.0)
    truth.reset(reset_rng)
    past = np.tile(data.qpos, (int(truth.late.max(initial=0)) + 1, 1))
    past_speed = np.zeros_like(past)
    record_of = {
        name: np.zeros((rows, size))
        for name, size in (
            ("qpos", model.nq),
            ("qvel", model.nq),
            ("ctrl", model.nu),
            ("force", model.nu),
            ("qacc", model.nv),
            ("reading", model.nq),
        )
    }
    simple = not truth.stages and not truth.pushes and len(past) == 1
    columns = np.arange(model.nq)
    moment = 0
    for row in range(rows):
        late = (moment - truth.late) % len(past)
        position = past[late, columns] + truth.bias
        reading = noise.read(noise_rng, position)
        command = controller.command(row, reading)
        record_of["qpos"][row] = position
        record_of["qvel"][row] = past_speed[late, columns]
        record_of["reading"][row] = reading
        record_of["ctrl"][row] = command
        if row == 0 and model.na:
            data.act[:] = command[model.actuator_dyntype != _NONE]
        if simple:
            data.ctrl[:] = command
            mujoco.mj_step(model, data, nstep=parts)
            past[0], past_speed[0] = data.qpos, data.qvel
        else:
            for part in range(parts):
                _advance(truth, data, command, time[row] + part * truth.fine, part == 0)
                moment += 1
                slot = moment % len(past)
                past[slot], past_speed[slot] = data.qpos, data.qvel
        record_of["force"][row] = data.actuator_force
        record_of["qacc"][row] = data.qacc
    _check(mechanism, record_of["qpos"])
    kept = {name: values[lead:] for name, values in record_of.items()}
    shake = noise_rng.standard_normal(kept["qvel"].shape) * 20.0 * noise.total
    return Log(
        time=np.round(time[lead:] + plan.begins, 6),
        qpos=kept["reading"],
        qvel=kept["qvel"] + shake,
        ctrl=kept["ctrl"],
        true_qpos=kept["qpos"],
        true_qvel=kept["qvel"],
        force=kept["force"],
        qacc=kept["qacc"],
    )


def _advance(
    truth: Truth, data: mujoco.MjData, command: np.ndarray, time: float, fresh: bool
) -> None:
    """One fine step under a command."""
    data.ctrl[:] = command
    for stage in truth.stages:
        sent = float(data.ctrl[stage.at])
        data.ctrl[stage.at] = stage.pass_on(sent, time, fresh)
    if truth.pushes:
        data.qfrc_applied[:] = 0.0
        data.xfrc_applied[:] = 0.0
        for push in truth.pushes:
            push.apply(data)
    mujoco.mj_step(truth.model, data)


def _check(mechanism: Mechanism, qpos: np.ndarray) -> None:
    """Finite, and away from the limits."""
    if not np.isfinite(qpos).all():
        raise CaseError("the motion is not finite")
    for joint, column in zip(mechanism.joints, qpos.T, strict=True):
        free = max(6.0 * joint.amplitude, 2.8 if joint.kind == "hinge" else 0.0)
        reach = joint.reach if joint.reach else free
        if np.abs(column - joint.home).max() > 0.95 * reach:
            raise CaseError(f"{joint.name} strays from its range")
