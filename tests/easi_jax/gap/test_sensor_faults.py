"""Named sensors that are late or off, beside the positions of the same log."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from easi_jax.data.recording import Run
from easi_jax.data.windows import fitted_velocity
from easi_jax.gap.sensor_faults import ReadingFault, reading_faults
from easi_jax.model.joint_space import Configuration

ARM = """
<mujoco>
  <option timestep="0.002"/>
  <worldbody>
    <body>
      <joint name="a" axis="0 1 0"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.4" size="0.02"/>
      <site name="tip" pos="0 0 -0.4"/>
      <body pos="0 0 -0.4">
        <joint name="b" type="slide" axis="0 0 1"/>
        <geom size="0.03"/>
      </body>
    </body>
  </worldbody>
  <sensor>
    <jointpos name="encoder" joint="a"/>
    <jointvel name="tacho" joint="b"/>
    <gyro name="gyro" site="tip"/>
    <framepos name="tracker" objtype="site" objname="tip"/>
    <framequat name="pose" objtype="site" objname="tip"/>
    <accelerometer name="imu" site="tip"/>
    <clock name="clock"/>
  </sensor>
</mujoco>
"""
DT = 0.01
M = mujoco.MjModel.from_xml_string(ARM)


def recorded(noise: float = 1e-3, late: float = 0.0, rows: int = 800) -> Run:
    """What a perfect machine's sensors say, all of them ``late`` [s]."""
    c, d = Configuration.of(M), mujoco.MjData(M)
    t = DT * np.arange(rows)

    def at(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        q = np.stack([np.sin(3 * t) + 0.3 * np.sin(7 * t), 0.1 * np.cos(5 * t)], 1)
        v = np.stack([3 * np.cos(3 * t) + 2.1 * np.cos(7 * t), -0.5 * np.sin(5 * t)], 1)
        return q, v

    read = []
    for q, v in zip(*at(t - late), strict=True):
        d.qpos, d.qvel = q, v
        mujoco.mj_forward(M, d)
        read.append(d.sensordata.copy())
    rng = np.random.default_rng(0)
    data = np.array(read) + noise * rng.normal(size=(rows, M.nsensordata))
    sensors = {}
    for i in range(M.nsensor):
        first = M.sensor_adr[i]
        sensors[M.sensor(i).name] = data[:, first : first + M.sensor_dim[i]]
    qpos = at(t)[0] + 1e-4 * rng.normal(size=(rows, 2))
    qvel = fitted_velocity(qpos, DT, c)
    ctrl = np.zeros((rows, 0))
    return Run("r", "made", DT, t, qpos, qvel, False, ctrl, c, sensors)


def off(run: Run, name: str, by: object) -> Run:
    return replace(run, sensors={**run.sensors, name: run.sensors[name] + by})


def only(faults: list[ReadingFault]) -> ReadingFault:
    (fault,) = faults
    return fault


@pytest.mark.parametrize("noise", [0.0, 1e-3, 0.05])
def test_right_readings_are_not_blamed(noise: float) -> None:
    assert reading_faults(M, [recorded(noise)]) == []


def test_readings_taken_a_physics_step_ago_are_not_late() -> None:
    assert reading_faults(M, [recorded(late=M.opt.timestep)]) == []


def test_an_encoder_that_is_off() -> None:
    fault = only(reading_faults(M, [off(recorded(), "encoder", 0.05)]))
    assert (fault.effect, fault.at) == ("sensor_bias", "encoder")
    value, std, unit = fault.parameters["bias"]
    assert value == pytest.approx(0.05, abs=1e-3) and std < 1e-3 and unit == "rad"
    assert fault.confidence > 0.9


def test_a_tracker_that_is_off_may_be_the_models_geometry() -> None:
    run = off(recorded(), "tracker", np.array([0.0, 0.1, 0.0]))
    fault = only(reading_faults(M, [run]))
    assert (fault.effect, fault.at) == ("sensor_bias", "tracker")
    assert list(fault.columns) == ["bias.0", "bias.1", "bias.2"]
    assert fault.columns["bias.1"] == pytest.approx(0.1, abs=1e-3)
    assert fault.confidence <= 0.5


@pytest.mark.parametrize("late", [0.02, 0.034])
def test_late_sensors(late: float) -> None:
    faults = {f.at: f for f in reading_faults(M, [recorded(late=late)])}
    assert set(faults) == {"encoder", "tacho", "gyro", "tracker"}
    for fault in faults.values():
        assert fault.effect == "sensor_delay"
        assert fault.columns["late"] == pytest.approx(late, abs=2e-3)
        assert fault.confidence > 0.9


def test_late_and_off_in_two_runs_one_of_which_lacks_rows() -> None:
    one, two = (off(recorded(late=0.03), "encoder", -0.2) for _ in range(2))
    holes = two.sensors["encoder"].copy()
    holes[::3] = np.nan
    two = replace(two, sensors={"encoder": holes})
    one = replace(one, sensors={"encoder": one.sensors["encoder"]})
    late, bias = reading_faults(M, [one, two])
    assert late.columns["late"] == pytest.approx(0.03, abs=2e-3)
    assert bias.columns["bias"] == pytest.approx(-0.2, abs=5e-3)


def test_too_few_rows_say_nothing() -> None:
    assert reading_faults(M, [off(recorded(rows=15), "encoder", 0.5)]) == []
    empty = off(recorded(), "encoder", np.nan)
    assert reading_faults(M, [empty]) == []
