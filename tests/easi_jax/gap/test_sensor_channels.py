"""Named sensors as channels: what is compared, and predictions beside MuJoCo C."""

from collections.abc import Callable
from dataclasses import replace

import mujoco
import numpy as np
import pytest

from easi_jax.data.cleaning import rows_of
from easi_jax.data.noise import without_held
from easi_jax.data.recording import Run
from easi_jax.data.scales import scales_of
from easi_jax.data.sensor_channels import Sensors, measured_sensors
from easi_jax.data.windows import fitted_velocity
from easi_jax.gap import gap_metric
from easi_jax.gap.analysis import Analysis
from easi_jax.gap.candidates import places
from easi_jax.gap.effect_vector import Layout
from easi_jax.gap.predictor import Predictor
from easi_jax.gap.result import Outcome
from easi_jax.gap.sensor_faults import ReadingFault, without_faults
from easi_jax.gap.window_set import window_set
from easi_jax.model.joint_space import Configuration
from easi_jax.model.parameters import ParameterSpace
from easi_jax.simulation import engine

ARM = """
<mujoco>
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <body>
      <joint name="a" axis="0 -1 0" damping="0.3"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.4" size="0.02" mass="0.6"/>
      <site name="tip" pos="0 0 -0.4"/>
    </body>
  </worldbody>
  <actuator><position name="m" joint="a" kp="8" kv="0.4"/></actuator>
  <sensor>
    <gyro name="gyro" site="tip"/>
    <jointactuatorfrc name="torque" joint="a"/>
    <accelerometer name="acc" site="tip"/>
    <framequat name="turn" objtype="site" objname="tip"/>
    <user name="pad" dim="2"/>
    <rangefinder name="beam" site="tip"/>
  </sensor>
</mujoco>
"""
DT, STEPS, ROWS = 0.01, 5, 400
NOISE = {"gyro": 0.01, "torque": 0.01, "acc": 0.05, "turn": 1e-3}


@pytest.fixture(scope="module")
def arm() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(ARM)


def recorded(m: mujoco.MjModel, early: bool = False, seed: int = 0) -> Run:
    """Exact motion under commands that jump; sensors at rows, or as the step before
    left them."""
    d, c, rng = mujoco.MjData(m), Configuration.of(m), np.random.default_rng(seed)
    ctrl = np.repeat(rng.uniform(-0.6, 0.6, (ROWS // 4, 1)), 4, 0)
    rows = []
    for u in ctrl:
        d.ctrl[:] = u
        if not early:
            mujoco.mj_forward(m, d)
        rows.append((d.qpos.copy(), d.qvel.copy(), d.sensordata.copy()))
        mujoco.mj_step(m, d, STEPS)
    q, v, read = (np.array(x) for x in zip(*rows, strict=True))
    sensors = {
        m.sensor(i).name: read[:, m.sensor_adr[i] :][:, : m.sensor_dim[i]]
        for i in range(m.nsensor)
    }
    return Run("r", "made", DT, DT * np.arange(ROWS), q, v, True, ctrl, c, sensors)


def test_what_is_compared_and_why_the_rest_is_not(arm: mujoco.MjModel) -> None:
    run = recorded(arm)
    found, ignored = measured_sensors(arm, [run])
    assert "no simulation predicts" in ignored["sensor.pad.0"]
    assert ignored.keys() == {"sensor.pad.0", "sensor.pad.1"}
    names = [n.channel for n in found]
    assert names[:5] == [
        *(f"sensor.gyro.{k}" for k in range(3)),
        "sensor.torque",
        names[4],
    ]
    units = {n.sensor: n.unit for n in found}
    assert units == {
        **{"gyro": "rad/s", "torque": "N m", "acc": "m/s^2", "turn": "", "beam": "m"}
    }
    here, left = found.simulated_by("mjx")
    assert list(left) == ["sensor.beam"] and len(here) == len(found) - 1
    assert found.simulated_by("mujoco") == (found, {})
    gaps = run.sensors["acc"].copy()
    gaps[7] = np.nan
    few = np.full_like(run.sensors["beam"], np.nan)
    few[:3] = 1.0
    some = {k: v for k, v in run.sensors.items() if k != "torque"}
    some |= {"acc": gaps, "beam": few}
    other = replace(run, name="other", sensors=some)
    found, ignored = measured_sensors(arm, [run, other])
    assert ignored["sensor.torque"] == "not recorded in other"
    assert ignored["sensor.beam"] == f"3 readings in the {ROWS} rows of other"
    acc = [i for i, n in enumerate(found) if n.sensor == "acc"]
    assert len(acc) == 3 and not found.known(other)[7, acc].any()
    np.testing.assert_allclose(found.readings(other)[7, acc], gaps[[6, 8]].mean(0))
    assert np.isnan(found.read(other)[7, acc]).all()
    assert found.known(other).sum() == found.known(run).sum() - 3
    # A recording that was cut, at a leap or for blocks, is judged as a whole.
    parts = [replace(rows_of(other, 0, 8), name="1", part_of="other"), other]
    parts[1] = replace(rows_of(other, 8, ROWS), name="2", part_of="other")
    whole, _ = measured_sensors(arm, [run, *parts])
    assert [n.channel for n in whole] == [n.channel for n in found]
    nothing = {**run.sensors, "turn": np.full((ROWS, 4), np.nan)}
    parts[0] = replace(parts[0], sensors={k: v[:8] for k, v in nothing.items()})
    whole, _ = measured_sensors(arm, [run, *parts])
    turn = [i for i, n in enumerate(whole) if n.sensor == "turn"]
    assert not whole.readings(parts[0])[:, turn].any()
    assert not whole.known(parts[0])[:, turn].any()
    # What was read in held-out rows alone has no noise to go by.
    _, ignored = measured_sensors(arm, [run, *parts], parts[:1])
    assert ignored["sensor.turn.0"].startswith("hardly any readings in the data")


def test_readings_of_an_orientation_have_one_sign(arm: mujoco.MjModel) -> None:
    run = recorded(arm)
    found, _ = measured_sensors(arm, [run])
    turned = run.sensors["turn"] * np.where(np.arange(ROWS) % 3, 1, -1)[:, None]
    flipped = replace(run, sensors={**run.sensors, "turn": turned})
    a, b = found.readings(run), found.readings(flipped)
    np.testing.assert_allclose(np.abs(a), np.abs(b))
    (part,) = found.orientations
    assert np.abs(np.diff(b[:, part], axis=0)).max() < 0.1
    turned[np.arange(ROWS) % 4 != 0] = np.nan
    turned[::8] *= -1.0
    slow = found.readings(replace(run, sensors={**run.sensors, "turn": turned}))
    assert np.abs(np.diff(slow[:, part], axis=0)).max() < 0.1


def predicted(m: mujoco.MjModel, run: Run, name: str, stepped: bool = False):
    """Errors from exact starts, ``(W, H + 1, c)``, and the sensors."""
    found, _ = measured_sensors(m, [run])
    drag = [p for p in places(m, scales_of(m, [run])) if p.effect == "quadratic_drag"]
    layout = Layout(m, [p for p in drag if p.kind == "joint"])
    windows = window_set(m, [run], 0.1, 0.0, 0, found)
    assert windows is not None
    with engine.using(name):
        p = Predictor(m, ParameterSpace(()), layout, windows, DT, sensors=found)
    x = p.neutral + (1e-12 if stepped else 0.0)
    start = windows.speed.shape[1] // 2
    moved = np.zeros((len(windows), p.size))
    moved[:, m.nv :] = run.qvel[windows.row] - windows.speed[:, start]
    return p, lambda: p.errors(x[None], None, moved[None])[0]


@pytest.mark.parametrize(
    ("name", "stepped"),
    [
        ("mujoco", False),
        ("mujoco", True),
        pytest.param("mjx", False, marks=pytest.mark.slow),
    ],
)
def test_predicted_readings_are_those_of_mujoco(
    arm: mujoco.MjModel, name: str, stepped: bool
) -> None:
    run = recorded(arm)
    p, errors = predicted(arm, run, name, stepped)
    size = np.concatenate([run.qpos.std(0), p.sensors.readings(run).std(0)])
    size = np.maximum(size, 1e-3)
    got = errors()
    assert got.shape[-1] == p.channels == 1 + len(p.sensors)
    assert np.abs(got / size).max() < 2e-3
    gaps = {k: v.copy() for k, v in run.sensors.items()}
    gaps["gyro"][::3] = gaps["acc"][7:99] = np.nan
    other, missing = predicted(arm, replace(run, sensors=gaps), name, stepped)
    there = other.read > 0
    assert 0.6 < there.mean() < 0.97 and not missing()[~there].any()
    np.testing.assert_allclose(missing()[there], got[there], atol=1e-4)
    p.early[:] = True
    assert np.abs(errors() / size)[..., 1:].max() > 0.1  # torques, a command late
    late = recorded(arm, early=True)
    p, errors = predicted(arm, late, name, stepped)
    p.early[:] = True
    got = errors()
    assert np.abs(got / size).max() < 2e-3
    assert not got[:, 0, 1:].any(), "nothing is known of the step before a window"
    assert p.of_positions().errors(p.neutral[None]).shape[-1] == arm.nv


def test_faults_are_taken_out_of_readings(arm: mujoco.MjModel) -> None:
    run = recorded(arm)
    gyro = run.sensors["gyro"]
    late = np.vstack([gyro[:1], gyro[:1], gyro[:-2]])
    bias = np.array([0.0, 0.2, 0.0])
    wrong = replace(run, sensors={**run.sensors, "gyro": late + bias})
    none = {"columns": {}, "std": {}, "parameters": {}, "confidence": 1.0}
    columns = {f"bias.{k}": x for k, x in enumerate(bias)}
    faults = [
        ReadingFault("sensor_delay", "gyro", **{**none, "columns": {"late": 2 * DT}}),
        ReadingFault("sensor_bias", "gyro", **{**none, "columns": columns}),
    ]
    (right,) = without_faults([wrong], faults)
    np.testing.assert_allclose(right.sensors["gyro"][:-2], gyro[:-2], atol=1e-12)
    gaps = late + bias
    gaps[[4, 50, 51]] = np.nan
    wrong = replace(run, sensors={**run.sensors, "gyro": gaps})
    (right,) = without_faults([wrong], faults)
    gone = np.flatnonzero(np.isnan(right.sensors["gyro"]).any(1))
    assert gone.tolist() == [2, 48, 49]
    there = np.setdiff1d(np.arange(ROWS - 2), gone)
    np.testing.assert_allclose(right.sensors["gyro"][there], gyro[there], atol=1e-12)
    np.testing.assert_array_equal(right.sensors["acc"], run.sensors["acc"])


def noisy(run: Run, seed: int, gain: float = 1.0) -> Run:
    """With noise; torques are read as ``gain`` times what they are."""
    rng = np.random.default_rng(seed)
    sensors = {
        k: run.sensors[k] * (gain if k == "torque" else 1.0)
        + size * rng.normal(size=run.sensors[k].shape)
        for k, size in NOISE.items()
    }
    qpos = run.qpos + 3e-4 * rng.normal(size=run.qpos.shape)
    qvel = fitted_velocity(qpos, run.dt, run.configuration)
    return replace(run, qpos=qpos, qvel=qvel, qvel_measured=False, sensors=sensors)


def slow(run: Run) -> Run:
    """Sensors that are slower than the rows, held or not, and one that misses rows."""
    sensors = {k: v.copy() for k, v in run.sensors.items()}
    sensors["gyro"][np.random.default_rng(1).uniform(size=ROWS) < 0.2] = np.nan
    sensors["acc"][np.arange(ROWS) % 5 != 2] = np.nan
    row = np.arange(ROWS)
    sensors["turn"] = sensors["turn"][row - row % 3]
    return replace(run, sensors=sensors)


def ended(
    arm: mujoco.MjModel,
    monkeypatch: pytest.MonkeyPatch,
    gain: float,
    read: Callable[[Run], Run] = lambda run: run,
) -> Outcome:
    """The analysis without any effect to try; torques are read ``gain`` times."""
    monkeypatch.setattr("easi_jax.gap.effect_search.places", lambda *_: [])
    monkeypatch.setattr("easi_jax.gap.effect_search.ripples", lambda *_: [])
    runs = [read(noisy(recorded(arm, seed=k), k, gain)) for k in range(3)]
    noise = np.array([3e-4, 1.0])
    with engine.using("mujoco"):
        given = arm, ParameterSpace(()), runs[:2], runs[2:], noise, 0.2
        return Analysis(*given).run()


@pytest.mark.slow
def test_sensors_are_part_of_the_gap_beside_their_floor(
    arm: mujoco.MjModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A right model is at its floor."""
    right = ended(arm, monkeypatch, 1.0)
    assert right.verdict == "no_gap"
    names = right.channels.names
    compared = {n for n, s in zip(names, right.channels.scale, strict=True) if s < 1e9}
    assert compared >= {"a", "sensor.gyro.1", "sensor.torque", "sensor.acc.0"}
    assert "sensor.gyro.0" not in compared  # does not turn that way
    assert 0.9 < right.refit.gap / right.floor < 1.1


@pytest.mark.slow
def test_slow_sensors_and_gaps_are_at_the_same_floor(
    arm: mujoco.MjModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    right = ended(arm, monkeypatch, 1.0, lambda run: without_held(slow(run)))
    assert right.verdict == "no_gap"
    names = right.channels.names
    compared = [n for n, s in zip(names, right.channels.scale, strict=True) if s < 1e9]
    assert {"a", "sensor.gyro.1", "sensor.acc.0", "sensor.turn.2"} <= set(compared)
    at = [names.index(n) for n in compared]
    ratio = right.refit.si[at] / right.floor_si[at]
    assert (np.abs(ratio - 1.0) < 0.15).all(), dict(zip(compared, ratio, strict=True))
    assert right.refit.gap / right.floor == pytest.approx(1.0, abs=0.1)


@pytest.mark.slow
@pytest.mark.xfail(
    raises=AssertionError,
    strict=True,
    reason="through the fitted starts a wrong torque opens its joint as well",
)
def test_torques_that_are_read_wrong_are_open_alone(
    arm: mujoco.MjModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    right, wrong = (ended(arm, monkeypatch, gain) for gain in (1.0, 1.1))
    assert wrong.verdict == "unexplained"
    names = right.channels.names
    told = dict(zip(names, wrong.open_refit.is_open[:-1], strict=True))
    assert told["sensor.torque"] and not told["a"] and not told["sensor.gyro.1"]
    np.testing.assert_allclose(wrong.refit.si[0], right.refit.si[0], rtol=0.1)


def test_noise_of_no_sensors_is_none(arm: mujoco.MjModel) -> None:
    none, run = Sensors(), recorded(arm)
    assert none.readings(run).shape == (ROWS, 0)
    assert all(x.shape == (0,) for x in (*none.noise([run]), none.finest([run])))
    kept = gap_metric.channels(arm, [run], np.array([1e-4]), 20)
    assert kept.names == ("a",)
