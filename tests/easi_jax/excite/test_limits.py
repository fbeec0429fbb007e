"""Limits hold when commands are played again, by another loop, in other models."""

import mujoco
import numpy as np
import pytest

from easi_jax.errors import UserError
from easi_jax.excite import candidates, drives
from easi_jax.excite.play import play

ARM = """
<mujoco>
  <compiler angle="radian"/>
  <option timestep="0.002" integrator="implicitfast"/>
  <default><geom contype="0" conaffinity="0"/></default>
  <worldbody>
    <body name="upper">
      <joint name="shoulder" axis="0 -1 0" range="-1.5 1.2" damping="0.2"/>
      <geom type="capsule" fromto="0 0 0 0 0 {z}0.3" size="0.02" mass="0.8"/>
      <body name="fore" pos="0 0 {z}0.3">
        <joint name="elbow" axis="0 -1 0" range="{low} 2.4" damping="0.1"/>
        <geom type="capsule" fromto="0 0 0 0 0 {z}0.3" size="0.02" mass="0.4"/>
      </body>
    </body>
  </worldbody>
  <actuator>{drives}</actuator>
</mujoco>
"""
MOTORS = (
    '<motor name="a" joint="shoulder" gear="2" ctrlrange="-3 3"/>'
    '<motor name="b" joint="elbow" forcerange="-0.7 0.7"/>'
)
SERVOS = (
    '<position name="a" joint="shoulder" kp="60" kv="5" ctrlrange="-1 1"/>'
    '<position name="b" joint="elbow" kp="20" kv="1.5" forcerange="-4 4"/>'
)
DT, SECONDS, MARGIN = 0.01, 5.0, 0.1
RECIPES = [
    candidates.Recipe("multisine", 0.5, 5.0, 1.0),
    candidates.Recipe("pulses", 0.3, 1.0, 1.0),
    candidates.Recipe("steps", 0.3, 1.0, 0.4),
]


def built(drive: str, down: bool = True, mass: float = 1.0) -> mujoco.MjModel:
    # Servos: an elbow that cannot stretch further than it does at rest.
    low = "0" if drive == SERVOS else "-2.4"
    text = ARM.replace("{z}", "-" if down else "").replace("{low}", low)
    spec = mujoco.MjSpec.from_string(text.replace("{drives}", drive))
    for geom in spec.geoms:
        geom.mass *= mass
    return spec.compile()


def bench_of(m: mujoco.MjModel, way: str = "auto", speed: float = np.inf) -> tuple:
    limits = drives.limits_of(m, MARGIN, np.full(m.nv, 1.0), np.full(m.nv, speed))
    rows = round(SECONDS / DT) + 1
    return limits, candidates.make_bench(m, limits, DT, rows, way)[0]


@pytest.mark.parametrize("drive", [MOTORS, SERVOS])
def test_limits_hold_in_every_physics_step(drive: str) -> None:
    m = built(drive)
    _, bench = bench_of(m, speed=6.0)
    assert bench.feedback is None
    most = np.full(m.nu, np.inf)
    tests = candidates.make_tests(bench, RECIPES, most, SECONDS, 1)
    assert len(tests) == len(RECIPES)
    span = m.jnt_range[:, 1] - m.jnt_range[:, 0]
    low, high = m.jnt_range[:, 0] + 0.1 * span, m.jnt_range[:, 1] - 0.1 * span
    for test in tests:
        sent = bench.hold + test.signal
        moved = 0.0
        for mass, friction in ((1.0, 1.0), (0.8, 0.8), (1.2, 0.8)):
            again = built(drive, mass=mass)
            again.dof_damping *= friction
            again.actuator_forcelimited[:] = 0
            d = mujoco.MjData(again)
            d.qpos[:] = bench.start
            for u in sent:
                d.ctrl[:] = u
                for _ in range(5):
                    mujoco.mj_step(again, d)
                    # The last digit: limits are looked at once per control step.
                    assert (d.qpos > low - 0.01).all()
                    assert (d.qpos < high + 0.01).all()
                    assert (np.abs(d.qvel) < 6.3).all()
                    moved = max(moved, float(np.abs(d.qpos - bench.start).max()))
                limited = m.actuator_forcelimited == 1
                bound = m.actuator_forcerange[limited, 1]
                assert (np.abs(d.actuator_force[limited]) <= bound + 1e-6).all()
        limited = m.actuator_ctrllimited == 1
        assert (np.abs(sent[:, limited]) <= m.actuator_ctrlrange[limited, 1]).all()
        # Scaled down no more than needed.
        assert moved > 0.05


def test_the_user_may_ask_for_less() -> None:
    m = built(SERVOS)
    _, bench = bench_of(m)
    tests = candidates.make_tests(
        bench, RECIPES[:1], np.array([0.05, 0.02]), SECONDS, 0
    )
    assert (tests[0].amplitude <= [0.05, 0.02]).all()
    assert (tests[0].amplitude > [0.03, 0.01]).all()


def test_a_joint_at_its_end_starts_in_the_middle() -> None:
    m = built(SERVOS)
    limits, bench = bench_of(m)
    assert bench.start[1] == pytest.approx(1.2)
    _, notes = drives.start_pose(m, limits)
    assert len(notes) == 1 and '"elbow"' in notes[0]


def test_the_hold_balances_gravity() -> None:
    m = built(SERVOS)
    _, bench = bench_of(m)
    d = mujoco.MjData(m)
    d.qpos[:], d.ctrl[:] = bench.start, bench.hold
    mujoco.mj_forward(m, d)
    np.testing.assert_allclose(d.qacc, 0.0, atol=1e-6)


def test_an_arm_that_would_fall_gets_a_feed_forward() -> None:
    m = built(MOTORS.replace("0.7", "2"), down=False)
    _, bench = bench_of(m)
    assert bench.feedback is not None and (bench.feedback.kp > 0).all()
    (test,) = candidates.make_tests(bench, RECIPES[:1], np.full(2, np.inf), SECONDS, 0)
    q = np.concatenate([x.qpos for x in test.motions])
    assert np.ptp(q, 0).min() > 0.1
    assert (q > m.jnt_range[:, 0]).all() and (q < m.jnt_range[:, 1]).all()
    # What is sent in all is in the log that is judged, and in its range.
    assert np.abs(test.run.ctrl - bench.hold - test.signal).max() > 0.01
    assert np.abs(test.run.ctrl[:, 0]).max() <= 3.0


def test_feed_forward_is_for_motors() -> None:
    with pytest.raises(UserError, match="for motors"):
        bench_of(built(SERVOS), "feed-forward")


def test_a_drive_that_nothing_is_known_of() -> None:
    drive = '<general name="a" joint="elbow" gainprm="3" dyntype="filter" dynprm="1"/>'
    m = built(drive)
    _, bench = bench_of(m)
    with pytest.raises(UserError, match="--amplitude a=NUMBER"):
        candidates.make_tests(bench, RECIPES[:1], np.array([np.inf]), SECONDS, 0)


def test_the_seed_decides() -> None:
    time = np.arange(501) * DT
    servo, motor = np.array([True, False]), np.array([False, True])
    for recipe in RECIPES:
        one, same, other = (
            candidates.raw_signal(recipe, seed, time, servo, motor)
            for seed in (1, 1, 2)
        )
        np.testing.assert_array_equal(one, same)
        assert np.abs(one - other).max() > 0.1
        np.testing.assert_array_equal(one[time < 0.99], 0.0)


def test_play_may_reach_its_ends() -> None:
    """A joint without a drive and with hardly a way to go has no limit to keep."""
    text = ARM.replace("{z}", "-").replace("{low}", "-2.4").replace("{drives}", MOTORS)
    body = '<body name="fore" pos="0 0 -0.3">'
    play = '<joint name="play" axis="0 -1 0" range="-0.04 0.04"/>'
    m = mujoco.MjModel.from_xml_string(text.replace(body, body + play))
    limits, _ = bench_of(m)
    free = np.isinf(limits.low) & np.isinf(limits.high)
    assert np.flatnonzero(free).tolist() == [m.joint("play").dofadr[0]]


def test_a_joint_that_others_swing_keeps_its_own_command() -> None:
    """Nearly without damping, an elbow is swung out of its limits by the shoulder; its
    own command made ever smaller would not help."""
    m = built('<motor name="a" joint="shoulder"/><motor name="b" joint="elbow"/>')
    m.dof_damping[:] = 0.05, 0.02  # N m s/rad
    _, bench = bench_of(m)
    tests = candidates.make_tests(
        *(bench, candidates.recipes(1 / DT, SECONDS)[:3], np.full(2, np.inf)),
        *(SECONDS, 0),
    )
    assert len(tests) == 3
    for test in tests:
        assert test.amplitude[0] > 0.3
        assert test.amplitude[1] > 0.05 * test.amplitude[0]


@pytest.mark.parametrize("kind", ["filter", "filterexact"])
def test_a_filtered_drive_holds_its_start(kind: str) -> None:
    """Commands would begin with a jump from zero otherwise, on a real machine."""
    servo = '<position name="{}" joint="{}" kp="{}" kv="5" timeconst="0.05"/>'
    plain = servo.replace(' timeconst="0.05"', "")
    pairs = ("a", "shoulder", 60), ("b", "elbow", 20)
    slow, fast = (
        built("".join(text.format(*pair) for pair in pairs)) for text in (servo, plain)
    )
    for a in range(slow.nu):
        slow.actuator_dyntype[a] = getattr(mujoco.mjtDyn, f"mjDYN_{kind.upper()}")
    limits = drives.limits_of(slow, 0.0, np.ones(2), np.full(2, np.inf))
    start = np.array([0.5, 0.8])
    hold = drives.hold_command(slow, start, limits)
    np.testing.assert_allclose(hold, drives.hold_command(fast, start, limits))
    assert np.abs(hold).min() > 0.1
    motion = play(slow, start, np.tile(hold, (50, 1)), DT)
    np.testing.assert_allclose(motion.qpos, np.tile(start, (50, 1)), atol=1e-3)
