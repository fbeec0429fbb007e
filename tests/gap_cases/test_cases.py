"""The hidden effects are what they are called, and cases keep the contract."""

import json
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest

from benchmarks.gap import graded
from tests.gap_cases import CaseError, Effect, Stated, draw_case, make_case, settings
from tests.gap_cases.commands import (
    Bent,
    Deadband,
    Delayed,
    Dropped,
    Gain,
    Lag,
    Stage,
)
from tests.gap_cases.draw import CASE_KINDS, _overlap, is_one_spring
from tests.gap_cases.effects import KINDS, UNLISTED
from tests.gap_cases.gap import activations, half_width, measure, slope
from tests.gap_cases.logs import READINGS, Log, Noise, velocities_of
from tests.gap_cases.mechanisms import GRAVITY, Joint, Mechanism
from tests.gap_cases.places import kindred, places, twins
from tests.gap_cases.robots import WIDE, build
from tests.gap_cases.simulate import Plan, record
from tests.gap_cases.strengths import SIZERS
from tests.gap_cases.torques import (
    BoucWen,
    LuGre,
    PlaceFriction,
    TwoMassDrive,
    WarmFriction,
)
from tests.gap_cases.truth import Truth, _servo, assemble, tilted

FINE = 2.5e-4
MASS = 2.0
SILENT = Noise(np.zeros(1), np.zeros(1))


def carriage(drive: str = "motor", armature: float = 0.0) -> Mechanism:
    """A mass on a horizontal slide, without passive forces."""
    joint = Joint(
        "slider",
        "carriage",
        "slide",
        home=0.0,
        amplitude=0.2,
        inertia=MASS,
        drive=drive,
        actuator="drive",
        armature=armature,
        kp=400.0,
        kv=40.0,
    )
    bodies = (
        '<body name="carriage"><joint {slider} axis="1 0 0"/>'
        f'<geom size="0.1" mass="{MASS}"/></body>'
    )
    return Mechanism("slide", (joint,), bodies, 0.001, 0.01, 1.0)


def coast(
    effects: list[Effect],
    speed: float = 0.0,
    command: float = 0.0,
    seconds: float = 0.4,
    armature: float = 0.0,
) -> tuple[float, float]:
    """Position and speed of the carriage after a while under a constant command."""
    truth = assemble(carriage(armature=armature), effects, FINE)
    data = mujoco.MjData(truth.model)
    data.qvel[0] = speed
    step_on(truth, data, command, seconds)
    return float(data.qpos[0]), float(data.qvel[0])


def step_on(truth: Truth, data: mujoco.MjData, command: float, seconds: float) -> None:
    truth.reset(np.random.default_rng(0))
    for i in range(round(seconds / truth.fine)):
        sent = command
        for stage in truth.stages:
            sent = stage.pass_on(sent, i * truth.fine, i % 40 == 0)
        data.ctrl[0] = sent
        data.qfrc_applied[:] = 0.0
        data.xfrc_applied[:] = 0.0
        for push in truth.pushes:
            push.apply(data)
        mujoco.mj_step(truth.model, data)


def slider(name: str, **parameters: float) -> list[Effect]:
    return [Effect(name, "slider", dict(parameters))]


# Friction.


@pytest.mark.parametrize("speed", [0.01, -0.3, 2.0])
def test_bristles_slide_at_coulombs_level(speed: float) -> None:
    friction = LuGre(0, 1.5, 1.5, 1.0, inertia=MASS, fine=FINE)
    force = [friction.force(speed) for _ in range(8000)][-1]
    assert force == pytest.approx(np.copysign(1.5, speed), rel=1e-6)


def test_bristles_follow_stribecks_curve() -> None:
    for speed in (0.01, 0.1, 0.5):
        friction = LuGre(0, 2.0, 0.8, 0.1, inertia=MASS, fine=FINE)
        force = [friction.force(speed) for _ in range(8000)][-1]
        expected = 0.8 + 1.2 * np.exp(-((speed / 0.1) ** 2))
        assert force == pytest.approx(expected, rel=1e-6)


def test_friction_stops_a_mass_and_holds_it() -> None:
    effects = slider("coulomb_friction", torque=3.0)
    _, speed = coast(effects, speed=1.0)
    # The bristles, straight at first, take a little more.
    assert speed == pytest.approx(1.0 - 3.0 / MASS * 0.4, abs=5e-3)
    # Below the breakaway force it creeps no further than its bristles bend.
    position, speed = coast(effects, command=2.5, seconds=1.0)
    assert abs(position) < 1e-4
    assert abs(speed) < 1e-4
    _, speed = coast(effects, command=5.0)
    assert speed == pytest.approx(2.0 / MASS * 0.4, rel=0.01)


# Forces with a closed form.


def test_forces_at_a_joint() -> None:
    assert coast(slider("viscous_damping", damping=3.0), 1.0)[1] == pytest.approx(
        np.exp(-3.0 * 0.4 / MASS), rel=1e-3
    )
    assert coast(slider("quadratic_drag", coefficient=3.0), 2.0)[1] == pytest.approx(
        2.0 / (1.0 + 3.0 * 2.0 * 0.4 / MASS), rel=1e-3
    )
    assert coast(slider("constant_force", torque=3.0))[1] == pytest.approx(0.6)
    spring = slider("joint_stiffness", stiffness=50.0, rest=0.1)
    assert coast(spring)[0] == pytest.approx(0.1 * (1.0 - np.cos(5.0 * 0.4)), rel=1e-2)
    push = [Effect("constant_force", "carriage", {"x": 3.0, "y": 1.0, "z": 2.0})]
    assert coast(push)[1] == pytest.approx(0.6)


def test_ripple_is_periodic_in_position() -> None:
    effects = slider("torque_ripple", amplitude=2.0, cycles_per_rev=7, phase=0.4)
    law = assemble(carriage(), effects, FINE).pushes[0]
    data = mujoco.MjData(assemble(carriage(), [], FINE).model)
    forces = []
    for position in (0.3, 0.3 + 2 * np.pi / 7, 0.3 + np.pi / 7):
        data.qpos[0], data.qfrc_applied[0] = position, 0.0
        law.apply(data)
        forces.append(float(data.qfrc_applied[0]))
    assert forces[0] == pytest.approx(2.0 * np.sin(7 * 0.3 + 0.4))
    assert forces[1] == pytest.approx(forces[0])
    assert forces[2] == pytest.approx(-forces[0])


def test_inertia() -> None:
    for effect in (
        Effect("armature", "slider", {"armature": 1.0}),
        Effect("payload_mass", "carriage", {"mass": 1.0}),
    ):
        assert coast([effect], command=3.0)[1] == pytest.approx(3.0 / 3.0 * 0.4)


def test_tilt_pulls_downhill() -> None:
    # Pitching about y by a positive angle lowers the +x side.
    tilt = [Effect("gravity_tilt", "", {"roll": 0.0, "pitch": 0.1})]
    assert coast(tilt)[1] == pytest.approx(GRAVITY * np.sin(0.1) * 0.4, rel=1e-6)
    gravity = tilted(0.2, -0.3)
    assert np.linalg.norm(gravity) == pytest.approx(GRAVITY)
    assert gravity[1] < 0 < -gravity[0]


def test_hysteresis_saturates_and_remembers() -> None:
    loop = BoucWen(0, 2.0, 0.05, FINE)
    data = mujoco.MjData(assemble(carriage(), [], FINE).model)

    def travel(speed: float, steps: int) -> float:
        data.qvel[0] = speed
        for _ in range(steps):
            data.qfrc_applied[0] = 0.0
            loop.apply(data)
        return float(data.qfrc_applied[0])

    assert travel(0.5, 4000) == pytest.approx(-2.0, rel=1e-3)
    assert travel(0.0, 1000) == pytest.approx(-2.0, rel=1e-3)
    assert travel(-0.5, 4000) == pytest.approx(2.0, rel=1e-3)


def test_laws_that_no_table_has() -> None:
    """A spring that stiffens, damping one way, friction by place and by warmth."""
    spring = assemble(carriage(), slider("cubic_spring", stiffness=5.0), FINE).pushes[0]
    damper = slider("one_way_damping", damping=3.0)
    data = mujoco.MjData(assemble(carriage(), [], FINE).model)
    for position in (0.3, -0.6):
        data.qpos[0], data.qfrc_applied[0] = position, 0.0
        spring.apply(data)
        assert data.qfrc_applied[0] == pytest.approx(-5.0 * position**3)
    assert coast(damper, 1.0)[1] == pytest.approx(np.exp(-3.0 * 0.4 / MASS), rel=1e-3)
    assert coast(damper, -1.0)[1] == pytest.approx(-1.0)
    np.testing.assert_allclose(
        passed(Bent(0, 0.5), np.array([-2.0, 0.0, 1.0])), [-4.0, 0.0, 1.5]
    )

    def force(friction: LuGre, position: float, speed: float = 0.5) -> float:
        data.qpos[0], data.qvel[0] = position, speed
        for _ in range(4000):
            data.qfrc_applied[0] = 0.0
            friction.apply(data)
        return float(data.qfrc_applied[0])

    by_place = PlaceFriction(0, 2.0, 3.0, MASS, FINE)
    for position in (0.0, np.pi / 6, -np.pi / 6):
        level = 2.0 * (1.0 + 0.9 * np.sin(3.0 * position))
        assert force(by_place, position) == pytest.approx(-level, rel=1e-3)
    warm = WarmFriction(0, 2.0, 0.25, MASS, FINE)  # 1 s of travel is two distances
    level = 2.0 * (0.4 + 0.6 * np.exp(-2.0))
    assert force(warm, 0.0) == pytest.approx(-level, rel=1e-2)
    warm.reset(np.random.default_rng(0))
    assert warm.travel == 0.0


# A payload against a model that was compiled with the mass.


@pytest.mark.parametrize("mass", [0.4, -0.2])
def test_payload_is_a_point_at_the_center_of_mass(mass: float) -> None:
    machine = build("arm2", np.random.default_rng(3), Stated())
    truth = assemble(machine, [Effect("payload_mass", "fore", {"mass": mass})], FINE)
    spec = mujoco.MjSpec.from_string(machine.xml())
    body = spec.body("fore")
    plain = assemble(machine, [], FINE).model.body("fore")
    if mass > 0:
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_SPHERE,
            size=[1e-3, 0, 0],
            pos=plain.ipos,
            mass=mass,
            contype=0,
            conaffinity=0,
        )
    else:
        body.explicitinertial = True
        body.mass = float(plain.mass[0]) + mass
        body.ipos, body.iquat, body.inertia = plain.ipos, plain.iquat, plain.inertia
    compiled = spec.compile()
    compiled.opt.timestep = FINE
    states = []
    for model in (truth.model, compiled):
        data = mujoco.MjData(model)
        data.qpos[:] = 0.7, -0.4
        mujoco.mj_step(model, data, nstep=1200)
        states.append(np.concatenate([data.qpos, data.qvel]))
    np.testing.assert_allclose(states[0], states[1], rtol=1e-4, atol=1e-5)


# Paths of commands.


def passed(stage: Stage, sent: np.ndarray) -> list:
    stage.reset(np.random.default_rng(1))
    return [stage.pass_on(float(x), i * FINE, True) for i, x in enumerate(sent)]


def test_delay_shifts_by_fine_steps() -> None:
    sent = np.arange(50.0)
    late = passed(Delayed(0, 13 * FINE, FINE), sent)
    np.testing.assert_array_equal(late[13:], sent[:-13])
    assert passed(Delayed(0, 0.0, FINE), sent) == sent.tolist()


def test_lag_has_a_first_order_step_response() -> None:
    stage = Lag(0, 0.03, FINE)
    response = passed(stage, np.concatenate([[0.0], np.ones(400)]))
    after = FINE * np.arange(401)
    np.testing.assert_allclose(response, 1.0 - np.exp(-after / 0.03), atol=1e-12)


def test_deadband_gain_drift_and_drops() -> None:
    sent = np.array([-0.3, -0.1, 0.0, 0.1, 0.3])
    zeroed = passed(Deadband(0, 0.2, subtractive=False), sent)
    np.testing.assert_allclose(zeroed, [-0.3, 0.0, 0.0, 0.0, 0.3])
    subtractive = passed(Deadband(0, 0.2, subtractive=True), sent)
    np.testing.assert_allclose(subtractive, [-0.1, 0.0, 0.0, 0.0, 0.1], atol=1e-15)
    np.testing.assert_allclose(passed(Gain(0, 0.8), sent), 0.8 * sent)
    drifting = passed(Gain(0, 1.0, drift=0.5, duration=4 * FINE), np.ones(5))
    np.testing.assert_allclose(drifting, np.linspace(1.0, 1.5, 5))
    numbers = np.arange(4000.0)
    kept = np.diff(passed(Dropped(0, 0.25), numbers)) > 0
    assert kept.mean() == pytest.approx(0.75, abs=0.03)


def test_saturation_limits_the_force() -> None:
    limited = [Effect("actuator_saturation", "drive", {"limit": 1.5})]
    assert coast(limited, command=40.0)[1] == pytest.approx(1.5 / MASS * 0.4)
    assert coast(limited, command=1.0)[1] == pytest.approx(1.0 / MASS * 0.4)


# Play.


def test_teeth_touch_after_the_play() -> None:
    drive = TwoMassDrive(0, lambda data: 0.0, 0.5, MASS, width=0.04, fine=FINE)
    twist = np.linspace(-0.05, 0.05, 2001)
    torque = np.array([drive.contact(float(x), 0.0) for x in twist])
    free = twist[torque == 0.0]
    assert np.ptp(free) == pytest.approx(0.04, abs=2e-4)
    assert (torque * twist >= 0).all()


def test_rotor_travels_the_play_before_a_held_load() -> None:
    pushes = [5.0]
    drive = TwoMassDrive(0, lambda data: pushes[0], 0.5, MASS, width=0.04, fine=FINE)
    data = mujoco.MjData(assemble(carriage(), [], FINE).model)
    rests = []
    for pushes[0] in (5.0, -5.0):
        for _ in range(8000):
            data.qfrc_applied[0] = 0.0
            drive.apply(data)
        assert data.qfrc_applied[0] == pytest.approx(pushes[0], rel=1e-3)
        assert drive.angle is not None
        rests.append(drive.angle)
    bend = 2 * 5.0 / drive.stiffness
    assert rests[0] - rests[1] == pytest.approx(0.04 + bend, rel=1e-3)


def test_a_drive_without_play_is_the_armature() -> None:
    def reach(*effects: Effect) -> tuple[float, float]:
        return coast(list(effects), command=4.0, armature=0.6)

    def play(width: float) -> Effect:
        return Effect("backlash", "slider", {"width": width, "rotor_share": 0.6})

    np.testing.assert_allclose(reach(play(0.0)), reach(), rtol=5e-3)
    # Momentum is shared as before, and the load stays behind by its share of the play.
    expected = reach()[0] - 0.02 * 0.36 / (MASS + 0.6)
    assert reach(play(0.04))[0] == pytest.approx(expected, abs=5e-5)


@pytest.mark.parametrize("drive", ["motor", "position", "velocity"])
def test_the_drive_of_a_rotor_is_mujocos_actuator(drive: str) -> None:
    model = assemble(carriage(drive), [], FINE).model
    data = mujoco.MjData(model)
    data.qpos[0], data.qvel[0], data.ctrl[0] = 0.3, -0.8, 0.7
    mujoco.mj_forward(model, data)
    expected = float(data.qfrc_actuator[0])
    torque = _servo(model, 0)
    assert torque(data) == pytest.approx(expected)
    mujoco.mj_forward(model, data)
    assert data.qfrc_actuator[0] == 0.0


@pytest.mark.parametrize(
    ("name", "drive", "expected"),
    [
        ("drive_stiffness", "position", 0.7 * 400.0 * 0.4 + 40.0 * 0.8),
        ("drive_damping", "position", 400.0 * 0.4 + 0.7 * 40.0 * 0.8),
        ("actuator_strength", "position", 0.7 * (400.0 * 0.4 + 40.0 * 0.8)),
        ("drive_damping", "velocity", 0.7 * 40.0 * (0.7 + 0.8)),
    ],
)
def test_a_drive_with_other_gains(name: str, drive: str, expected: float) -> None:
    machine = carriage(drive)
    effect = Effect(name, "drive", {"factor": 0.7})
    assert places(machine, name) == ["drive"] and twins(machine, effect) == []
    data = mujoco.MjData(model := assemble(machine, [effect], FINE).model)
    data.qpos[0], data.qvel[0], data.ctrl[0] = 0.3, -0.8, 0.7
    mujoco.mj_forward(model, data)
    assert data.qfrc_actuator[0] == pytest.approx(expected)


def test_more_damping_of_a_drive_is_the_joints() -> None:
    machine = carriage("position")
    more = Effect("drive_damping", "drive", {"factor": 1.4})
    assert twins(machine, more) == ["viscous_damping@slider"]
    dragging = Effect("viscous_damping", "slider")
    assert twins(machine, dragging) == ["drive_damping@drive"]


# Readings.


def test_readings_are_late_and_offset() -> None:
    plan = Plan(2.0, "multisine", seed=4, begins=0.0)
    plain, late, offset = (
        record(assemble(carriage("position"), effects, FINE), plan, SILENT)
        for effects in (
            [],
            slider("sensor_delay", delay=0.02),
            slider("sensor_bias", bias=0.01),
        )
    )
    np.testing.assert_allclose(late.qpos[2:], plain.qpos[:-2], atol=1e-12)
    np.testing.assert_allclose(late.qvel[2:], plain.qvel[:-2], atol=1e-12)
    np.testing.assert_allclose(offset.qpos, plain.qpos + 0.01, atol=1e-12)


def test_a_late_command_shifts_the_response() -> None:
    plan = Plan(2.0, "multisine", seed=4, begins=0.0)
    machine = carriage("position")
    late = [Effect("actuator_delay", "drive", {"delay": 0.02})]
    plain, shifted = (
        record(assemble(machine, effects, FINE), plan, SILENT) for effects in ([], late)
    )
    np.testing.assert_allclose(shifted.qpos[2:], plain.qpos[:-2], atol=1e-9)


def test_encoder_noise_and_grain() -> None:
    noise = Noise(np.array([1e-3]), np.array([4e-3]))
    error = noise.read(np.random.default_rng(0), np.linspace(0, 1, 20000)[:, None])
    np.testing.assert_allclose(error / 4e-3, np.round(error / 4e-3), atol=1e-9)
    spread = (error[:, 0] - np.linspace(0, 1, 20000)).std()
    assert spread == pytest.approx(float(noise.total[0]), rel=0.03)


def test_late_and_filtered_velocities() -> None:
    time = 0.01 * np.arange(400)
    speed = np.sin(3.0 * time)[:, None]
    still = np.zeros_like(speed)
    log = Log(time, still, speed + 0.1, still, still, speed, still, still)
    assert velocities_of(log, "positions", 0.0) is None
    assert velocities_of(log, "velocities", 0.0) is log.qvel
    late = velocities_of(log, "late velocities", 0.02)
    assert late is not None
    np.testing.assert_allclose(late[2:], speed[:-2] + 0.1, atol=1e-12)
    filtered = velocities_of(log, "filtered velocities", 0.02)
    assert filtered is not None
    # First order: a sine comes smaller and later.
    size, lag = 1 / np.hypot(1.0, 3.0 * 0.02), np.arctan(3.0 * 0.02) / 3.0
    expected = size * np.sin(3.0 * (time - lag)) + 0.1
    np.testing.assert_allclose(filtered[100:, 0], expected[100:], atol=0.02)
    assert len(READINGS) == 4


# The gap.


def test_velocity_of_a_quadratic_is_exact() -> None:
    assert [half_width(dt) for dt in (0.02, 0.01, 0.005)] == [2, 2, 4]
    time = 0.005 * np.arange(-4, 5)
    assert slope(3.0 + 2.0 * time + 5.0 * time**2, 0.005) == pytest.approx(2.0)


def test_activations_are_what_mujoco_makes_of_commands() -> None:
    machine = build("stand", np.random.default_rng(2), Stated())
    text = machine.xml()
    for joint in machine.joints:
        gains = f'kp="{joint.kp:g}" kv="{joint.kv:g}"'
        name = f'name="{joint.actuator}"'
        assert f"<position {name}" in text and gains in text
    joints = tuple(replace(j, filter=0.03) for j in machine.joints)
    m = mujoco.MjModel.from_xml_string(replace(machine, joints=joints).xml())
    assert m.na == m.nu == 12
    sent = np.random.default_rng(0).normal(size=(20, 12))
    data = mujoco.MjData(m)
    data.act[:] = sent[0]
    found = []
    for row in sent:
        found.append(data.act.copy())
        data.ctrl[:] = row
        mujoco.mj_step(m, data, nstep=3)
    mine = activations(m, sent, 3 * m.opt.timestep)
    np.testing.assert_allclose(mine, found, atol=1e-12)


def test_gap_of_a_wrong_mass_has_its_closed_form() -> None:
    """A constant force on two masses: the error is (a - b) t^2 / 2."""
    time = 0.01 * np.arange(300)
    model = assemble(carriage(), [], 1e-5).model
    model.opt.timestep = 1e-4
    position = 0.5 * (3.0 / 2.5) * (time - 1.5)[:, None] ** 2
    velocity = (3.0 / 2.5) * (time - 1.5)[:, None]
    ones = np.ones((300, 1))
    log = Log(
        time, position, velocity, 3.0 * ones, position, velocity, 3.0 * ones, ones
    )
    noise = Noise(np.array([1e-9]), np.zeros(1))
    gap = measure(model, [log], noise, np.random.default_rng(0))
    after = 0.01 * np.arange(1, 21)
    error = 0.5 * (3.0 / MASS - 3.0 / 2.5) * after**2
    expected = np.sqrt(np.mean(error**2) / position.var())
    assert gap.gap == pytest.approx(expected, rel=5e-3)


# Whole cases.


def read_case(directory: Path) -> tuple[mujoco.MjModel, list[Log], dict]:
    """A case as a stranger would read it."""
    model = mujoco.MjModel.from_xml_path(str(directory / "model.xml"))
    answer = json.loads((directory / "answer.json").read_text())
    logs = []
    for path in sorted(directory.glob("run*.csv")):
        names = path.read_text().splitlines()[0].split(",")
        table = np.loadtxt(path, delimiter=",", skiprows=1, ndmin=2)
        known = {"time"}
        known |= {f"qpos.{model.joint(i).name}" for i in range(model.njnt)}
        known |= {f"qvel.{model.joint(i).name}" for i in range(model.njnt)}
        known |= {f"ctrl.{model.actuator(i).name}" for i in range(model.nu)}
        assert set(names) <= known
        assert np.isfinite(table).all()
        columns = dict(zip(names, table.T, strict=True))
        assert np.diff(columns["time"]) == pytest.approx(
            answer["setting"]["control_step"], abs=2e-6
        )
        qpos = np.stack(
            [columns[f"qpos.{model.joint(i).name}"] for i in range(model.njnt)], axis=1
        )
        ctrl = np.stack(
            [columns[f"ctrl.{model.actuator(i).name}"] for i in range(model.nu)], axis=1
        )
        still = np.zeros_like(qpos)
        time = columns["time"]
        logs.append(Log(time, qpos, still, ctrl, qpos, still, ctrl, still))
    return model, logs, answer


def test_single_case(tmp_path: Path) -> None:
    draw_case(8, "single", tmp_path, cheap=True)
    model, logs, answer = read_case(tmp_path)
    assert 3 <= len(logs) <= 4
    assert len(answer["effects"]) == 1
    assert 3.0 <= answer["gap"]["ratio"] <= 15.0
    silent = Noise(np.full(model.nq, 1e-9), np.zeros(model.nq))
    gap = measure(model, logs, silent, np.random.default_rng(0))
    assert gap.gap == pytest.approx(answer["gap"]["before"], rel=1e-6)
    assert answer["gap"]["perfect"] <= 1.1


@pytest.mark.parametrize("mechanism", ["slide", "cartpole"])
def test_a_perfect_model_is_at_its_floor(mechanism: str, tmp_path: Path) -> None:
    case = draw_case(1, "none", tmp_path, mechanism=mechanism)
    assert 0.85 < case.gap.ratio < 1.1
    _, _, answer = read_case(tmp_path)
    assert answer["effects"] == []
    assert answer["verdicts"] == ["no_gap"]


def test_a_coarse_model_is_off_by_its_own_steps(tmp_path: Path) -> None:
    case = draw_case(0, "none", tmp_path, cheap=True, coarse=True)
    answer = json.loads((tmp_path / "answer.json").read_text())
    assert 1.3 < case.gap.ratio < 4.0 and not case.effects
    setting = answer["setting"]
    assert setting["timestep"] == setting["drawn_timestep"] > setting["truth_step"]


def test_wrong_own_numbers_stay_within_their_factors(tmp_path: Path) -> None:
    draw_case(0, "wrong_own", tmp_path, mechanism="pendulum")
    answer = read_case(tmp_path)[2]
    factors = [own["truth"] / own["model"] for own in answer["own"].values()]
    assert factors
    assert all(0.39 < factor < 2.51 for factor in factors)
    assert 3.0 <= answer["gap"]["ratio"] <= 15.0


def test_the_same_seed_gives_the_same_case(tmp_path: Path) -> None:
    for name in ("a", "b"):
        draw_case(0, "single", tmp_path / name, cheap=True)
    files = sorted(path.name for path in (tmp_path / "a").iterdir())
    assert {"model.xml", "answer.json", "run1.csv"} <= set(files)
    for name in files:
        first = (tmp_path / "a" / name).read_bytes()
        assert first == (tmp_path / "b" / name).read_bytes()


def test_a_given_strength_is_kept(tmp_path: Path) -> None:
    make_case(5, "slide", [Effect("payload_mass", "carriage", {"mass": 0.8})], tmp_path)
    answer = read_case(tmp_path)[2]
    assert answer["effects"][0]["parameters"] == {"mass": 0.8}
    assert "armature@slider" in answer["effects"][0]["twins"]


def test_names_are_checked(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="unknown effect"):
        make_case(0, "slide", [Effect("friction", "slider")], tmp_path)
    with pytest.raises(ValueError, match="unknown kind"):
        draw_case(0, "triple", tmp_path)
    with pytest.raises(CaseError, match="cannot be seen"):
        draw_case(0, "single", tmp_path, effect="contact_softness", mechanism="slide")
    assert len(CASE_KINDS) == 8


def test_a_mixed_case_has_one_effect_that_no_table_has(tmp_path: Path) -> None:
    draw_case(1, "mixed", tmp_path, cheap=True)
    answer = read_case(tmp_path)[2]
    known, unknown = answer["effects"]
    assert known["kind"] != "outside" == unknown["kind"]
    assert answer["verdicts"][0] == "unexplained"


def test_every_effect_has_a_place_and_a_strength() -> None:
    stated = Stated(armature=True)
    machines = [build(name, np.random.default_rng(0), stated) for name in WIDE]
    for effect in (*KINDS, *UNLISTED):
        assert effect in SIZERS
        assert any(places(machine, effect) for machine in machines)
    for machine in machines:
        model = mujoco.MjModel.from_xml_string(machine.xml())
        assert model.nq == len(machine.joints)
        assert model.nu == len(machine.driven)


def test_like_joints_have_an_effect_alike() -> None:
    machine = build("stand", np.random.default_rng(0), Stated())
    tied = Effect("coulomb_friction", "*_calf", {"torque": 0.2})
    late = Effect("actuator_delay", "*_hip_position", {"delay": 0.01})
    truth = assemble(machine, [tied, late], FINE)
    frictions = [p for p in truth.pushes if isinstance(p, LuGre)]
    assert [p.at for p in frictions] == [2, 5, 8, 11]
    assert [stage.at for stage in truth.stages] == [0, 3, 6, 9]
    one = Effect("coulomb_friction", "RL_calf")
    assert _overlap(tied, one) and _overlap(one, tied) and not _overlap(tied, late)
    more = Effect("drive_damping", "*_hip_position", {"factor": 1.4})
    assert twins(machine, more) == ["viscous_damping@*_hip"]


def test_effects_in_another_law() -> None:
    spring = Effect("coupling_spring", "shoulder", {"other": "elbow"})
    both = ["joint_stiffness@shoulder", "joint_stiffness@elbow"]
    assert kindred(spring) == both
    assert kindred(Effect("coulomb_friction", "a")) == ["stribeck_friction@a"]
    assert kindred(Effect("actuator_delay", "a")) == []


def test_what_is_right_of_a_name() -> None:
    """By the contract: another law of what is there where it takes half of the gap, a
    law that was found where one acts, late velocities besides."""
    gap = {"before": 1.0, "refit": 1.0, "after": 0.1, "floor": 0.1}
    hidden = {
        **{"effect": "hysteresis", "at": "elbow", "kind": "outside"},
        **{"twins": [], "kindred": ["coulomb_friction@elbow"], "parameters": {}},
    }
    answer = {
        **{"kind": "outside", "mechanism": "arm2", "effects": [hidden]},
        **{"verdicts": ["unexplained"], "setting": {}, "gap": {"floor": 0.1}},
        **{"laws": ["elbow"], "readings": ["sensor_delay@qvel.elbow"]},
    }

    def named(effect: str, at: str, explains: float, after: float = 0.5) -> dict:
        return {
            **{"effect": effect, "at": at, "explains": explains, "confidence": 0.5},
            **{"removal_cost": 1.0, "removal_sure": 2.0, "rival_odds": 0.1},
            **{"gap_after": after, "outcome": "converged", "parameters": {}},
            "indistinguishable": [],
        }

    cases = (0.4, 0.8, False), (0.6, 0.6, True), (0.3, 0.5, True)
    for share, after, there in cases:
        effects = [
            named("coulomb_friction", "elbow", share, after),
            named("found_law", "elbow", 0.1),
            named("found_law", "shoulder", 0.1),
            named("viscous_damping", "elbow", 0.9),
            named("sensor_delay", "qvel.elbow", 0.0),
        ]
        told = {"effects": effects, "verdict": "unexplained", "gap": gap}
        row = graded(told | {"unexplained_share": 0.0}, answer)
        assert row["there"] == [there, True, False, False] and row["right"]
        assert row["readings"] == ["sensor_delay@qvel.elbow"]
        assert len(row["named"]) == len(row["removal_sure"]) == 4


@pytest.mark.parametrize(("kind", "seed"), [("real", 0), ("single", 3)])
def test_a_wide_case(kind: str, seed: int, tmp_path: Path) -> None:
    case = draw_case(seed, kind, tmp_path, cheap=True, wide=True)
    _, _, answer = read_case(tmp_path)
    assert answer["setting"]["reading"] in READINGS and answer["gap"]["ratio"] > 3.0
    outside = [e for e in answer["effects"] if e["kind"] == "outside"]
    assert bool(outside) == bool(answer["laws"]) == (kind == "real")
    late = case.reading in ("late velocities", "filtered velocities")
    assert bool(answer["readings"]) == late


def test_a_spring_and_what_moves_its_rest_are_one() -> None:
    machine, spring = carriage(), Effect("joint_stiffness", "slider")
    for one in (Effect("constant_force", "carriage"), Effect("gravity_tilt", "")):
        assert is_one_spring(machine, spring, one)
        assert is_one_spring(machine, one, spring)
    assert not is_one_spring(machine, spring, Effect("coulomb_friction", "slider"))


def test_twins_of_a_slide() -> None:
    machine = carriage()
    force = twins(machine, Effect("constant_force", "slider"))
    assert force == ["constant_force@carriage", "gravity_tilt@"]
    late = twins(machine, Effect("actuator_delay", "drive"))
    assert late == ["sensor_delay@slider"]
    assert twins(machine, Effect("viscous_damping", "slider")) == []


def test_a_machine_that_would_have_to_stand_still_is_drawn_anew(monkeypatch):
    monkeypatch.setattr(settings, "_needed", lambda *_: np.inf)
    monkeypatch.setattr(settings, "record", lambda *_: None)
    with pytest.raises(CaseError, match="hardly moves"):
        settings.settle(carriage(), np.random.default_rng(0))


def test_a_strength_that_holds_every_joint_still_is_no_case() -> None:
    model = assemble(carriage(), [], 1e-5).model
    none = np.zeros((300, 1))
    log = Log(0.01 * np.arange(300), *[none] * 7)
    noise = Noise(np.array([1e-4]), np.zeros(1))
    with pytest.raises(CaseError, match="no joint moves"):
        measure(model, [log], noise, np.random.default_rng(0))
