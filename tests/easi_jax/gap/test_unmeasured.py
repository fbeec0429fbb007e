"""What is said of the data and of candidates where a joint has no reading."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from easi_jax.data.recording import Run
from easi_jax.data.scales import scales_of
from easi_jax.data.unmeasured import start_spread
from easi_jax.data.windows import fitted_velocity
from easi_jax.gap.candidates import places
from easi_jax.gap.excitation_coverage import coverage_notes
from easi_jax.gap.sensor_faults import reading_faults
from easi_jax.model.contact_pairs import never_near
from easi_jax.model.joint_space import Configuration
from easi_jax.simulation.logged import Logged

DT = 0.01
XML = """<mujoco><compiler angle="radian"/><option timestep="0.005"/><worldbody>
<geom name="floor" type="plane" size="5 5 .1" pos="0 0 -2"/>
<body name="a" pos="0 0 1"><joint name="near" axis="0 1 0"/>
  <geom name="upper" type="capsule" fromto="0 0 0 0 0 -.3" size=".02"/>
  <body name="b" pos="0 0 -.3"><joint name="far" axis="0 1 0"/>
    <geom name="lower" type="capsule" fromto="0 0 0 0 0 -.3" size=".02"/>
    <site name="tip"/></body></body></worldbody>
<actuator><motor name="m" joint="near"/><motor name="n" joint="far"/></actuator>
<sensor><jointpos name="encoder" joint="near"/><gyro name="gyro" site="tip"/></sensor>
</mujoco>"""


@pytest.fixture(scope="module")
def m() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(XML)


@pytest.fixture(scope="module")
def seen(m) -> Run:
    """Both joints turn one way, the second one late; sensors are off."""
    c, t = Configuration.of(m), DT * np.arange(400)
    qpos = np.outer(t, [1.0, 1.5]) + 0.1 * np.sin(9 * t)[:, None]
    qvel = fitted_velocity(qpos, DT, c)
    qvel[:, 1] = np.interp(t - 0.05, t, qvel[:, 1])
    ctrl = np.random.default_rng(0).normal(size=(400, 2))
    speed = qvel.sum(1, keepdims=True) * np.array([[0.0, 1.0, 0.0]])
    sensors = {"encoder": qpos[:, :1] + 0.2, "gyro": speed + 1.0}
    return Run("r", "r.csv", DT, t, qpos, qvel, True, ctrl, c, sensors)


@pytest.fixture(scope="module")
def blind(m, seen) -> Run:
    """The same without the second joint."""
    qpos, hidden = seen.qpos.copy(), np.array([False, True])
    qpos[:, 1] = 0.0
    return replace(seen, qpos=qpos, hidden=hidden)


def test_scales_of_what_is_hidden_are_how_far_it_may_be(m, seen, blind):
    known, scales = scales_of(m, [seen]), scales_of(m, [blind])
    spread = start_spread(m, [blind])
    assert scales.hidden == (False, True) and known.hidden == (False, False)
    assert [scales.position[1], scales.speed[1]] == [spread[1], spread[3]]
    assert scales.span[1] == 2 * spread[1]
    assert scales.position[0] == pytest.approx(known.position[0])
    assert np.isfinite(scales.torque).all() and (scales.torque > 0).all()


def test_no_candidate_is_a_reading_that_nobody_took(m, seen, blind):
    def readings(run):
        found = places(m, scales_of(m, [run]))
        return {(p.effect, p.at) for p in found if p.effect.startswith("sensor_")}

    both = {"sensor_bias", "sensor_delay"}
    assert readings(seen) == {(e, j) for e in both for j in ("near", "far")}
    assert readings(blind) == {(e, "near") for e in both}


def test_nothing_is_said_of_readings_that_nobody_took(m, seen, blind):
    assert {f.at for f in reading_faults(m, [seen])} >= {"encoder", "gyro", "qvel.far"}
    assert {f.at for f in reading_faults(m, [blind])} == {"encoder"}


def test_no_excitation_is_asked_of_what_is_hidden(m, seen, blind):
    for run, joints in ((seen, {"near", "far"}), (blind, {"near"})):
        said = " ".join(coverage_notes(m, [run], [run]))
        assert {j for j in ("near", "far") if f"move joint {j} in" in said} == joints


def test_commands_made_from_a_hidden_joint_are_not_seen(m, seen):
    rng = np.random.default_rng(1)
    qpos = seen.qpos + 1e-2 * rng.normal(size=seen.qpos.shape)
    run = replace(seen, qpos=qpos, ctrl=-5.0 * qpos[:, ::-1])
    closed = [n for n in coverage_notes(m, [run], [run]) if "closed loop" in n]
    assert closed[0].startswith("commands of m, n follow")
    part = replace(run, hidden=np.array([False, True]))
    closed = [n for n in coverage_notes(m, [part], [part]) if "closed loop" in n]
    assert closed[0].startswith("commands of n follow")


def test_pairs_that_a_hidden_joint_may_bring_together_stay(m, seen, blind):
    known, unknown = Logged.of([seen]), Logged.of([blind])
    assert known.hidden is not None and not known.hidden.any()
    pair = tuple(sorted(m.geom(g).id for g in ("floor", "lower")))
    other = tuple(sorted(m.geom(g).id for g in ("floor", "upper")))
    assert {pair, other} <= never_near(m, known.qpos, None, known.hidden)
    apart = never_near(m, unknown.qpos, None, unknown.hidden)
    assert other in apart and pair not in apart
