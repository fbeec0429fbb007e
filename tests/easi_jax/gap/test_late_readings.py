"""Predictions of readings that come late, against MuJoCo C."""

from collections.abc import Callable
from dataclasses import replace

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from easi_jax.data.recording import Run
from easi_jax.data.scales import scales_of
from easi_jax.data.windows import fitted_velocity
from easi_jax.gap.candidates import places
from easi_jax.gap.effect_vector import Layout
from easi_jax.gap.predictor import Predictor, _later
from easi_jax.gap.window_set import window_set
from easi_jax.model.joint_space import Configuration
from easi_jax.model.parameters import ParameterSpace

# A second joint, which the first moves, or none.
ARM = """
<mujoco>
  <option timestep="0.001" integrator="implicitfast"/>
  <worldbody>
    <body>
      <joint name="a" axis="0 -1 0" damping="0.3"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.4" size="0.02" mass="0.6"/>
      {}
    </body>
  </worldbody>
  <actuator><motor name="m" joint="a"/></actuator>
</mujoco>
"""
SECOND = """
<body pos="0 0 -0.4">
  <joint name="b" axis="0 -1 0" damping="0.01"/>
  <geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.02" mass="0.3"/>
</body>
"""
DT, STEPS, LATE = 0.01, 10, 0.034


def recorded(m: mujoco.MjModel, late: tuple[float, ...]) -> Run:
    """Angles as sensors tell them that are late by whole physics steps."""
    d, c = mujoco.MjData(m), Configuration.of(m)
    t = DT * np.arange(300)
    ctrl = np.stack([2 * np.sin(7 * t) + np.sin(3.1 * t)], 1)[:, : m.nu]
    q = [d.qpos.copy()]
    for u in ctrl:
        d.ctrl[:] = u
        for _ in range(STEPS):
            mujoco.mj_step(m, d)
            q.append(d.qpos.copy())
    path = np.array(q)
    row = STEPS * np.arange(len(t))[:, None] - np.round(
        np.array(late) / m.opt.timestep
    ).astype(int)
    qpos = path[np.maximum(row, 0), np.arange(m.nv)]
    return Run("r", "made", DT, t, qpos, fitted_velocity(qpos, DT, c), False, ctrl, c)


Vector = Callable[[str, str, float], np.ndarray]


def predictor(m: mujoco.MjModel, run: Run) -> tuple[Predictor, Vector]:
    """Predictions, and the vector of one effect of a size."""
    found = places(m, scales_of(m, [run]))
    layout = Layout(m, found)
    windows = window_set(m, [run], 0.2, 0.1)
    assert windows is not None
    p = Predictor(m, ParameterSpace(()), layout, windows, DT)

    def vector(effect: str, at: str, value: float) -> np.ndarray:
        place = next(q for q in found if (q.effect, q.at) == (effect, at))
        x = p.neutral.copy()
        x[layout.where(place)[0]] = value
        return x

    return p, vector


def rms(error: np.ndarray) -> np.ndarray:
    return np.sqrt(np.mean(np.square(error, dtype=float), axis=(1, 2)))


@pytest.mark.parametrize("joint", [pytest.param("a", marks=pytest.mark.slow), "b"])
def test_one_late_sensor_of_two_is_predicted(joint: str) -> None:
    m = mujoco.MjModel.from_xml_string(ARM.format(SECOND))
    p, _ = predictor(m, recorded(m, (0.0, 0.0)))
    plain = rms(p.errors(p.neutral[None]))[0]  # of fitted start velocities
    run = recorded(m, (LATE, 0.0) if joint == "a" else (0.0, LATE))
    p, vector = predictor(m, run)
    right = vector("sensor_delay", joint, LATE)
    ignored, known = rms(p.errors(np.stack([p.neutral, right])))
    assert (ignored > 5 * plain).all()
    assert (known < 1.1 * plain).all()


def test_lateness_buys_no_quieter_readings() -> None:
    """Between two rows noise would be less, so a sensor that is late by half a row, as
    seen from the others, would predict better than one that is right."""
    m = mujoco.MjModel.from_xml_string(ARM.format(SECOND))
    run, noise = recorded(m, (0.0, 0.02)), 2e-3
    read = noise * np.random.default_rng(0).normal(size=run.qpos.shape)
    p, vector = predictor(m, replace(run, qpos=run.qpos + read))
    late = [vector("sensor_delay", "b", x) for x in (0.02, 0.025)]
    errors = p.errors(np.stack(late))[:, p.windows.led].astype(float)
    # Second differences along rows are of readings alone.
    rough = np.diff(errors[..., 0], 2, axis=-1).std((1, 2)) / np.sqrt(6.0)
    np.testing.assert_allclose(rough, noise, rtol=0.1)


@pytest.mark.parametrize("share", [0.0, 0.5, 0.999])
def test_what_is_simulated_goes_on_between_rows_and_beyond_them(share: float) -> None:
    """As a joint does at 8 rad/s, whose acceleration makes 6 mrad in the last row."""
    row = np.arange(30.0)[:, None]
    found = _later(jnp.sin(8 * DT * row), jnp.array([share]))
    off = np.abs(np.asarray(found) - np.sin(8 * DT * (row + share)))
    assert off.max() < 6e-4 and off[1:-2].max() < 3e-5


def test_lateness_buys_no_shorter_prediction() -> None:
    """With one joint, late readings and late commands are the same thing."""
    m = mujoco.MjModel.from_xml_string(ARM.format(""))
    run = recorded(m, (0.0,))
    m.body_mass[1] *= 1.5  # a wrong model, with nothing late
    m.body_inertia[1] *= 1.5
    p, vector = predictor(m, run)
    each = [
        vector("sensor_delay", "a", LATE),
        vector("actuator_delay", "m", LATE),
    ]
    errors = p.errors(np.stack([p.neutral, *each]))
    plain, sensor, command = rms(errors[:, p.windows.led])[:, 0]
    assert sensor == pytest.approx(command, rel=1e-3)
    assert sensor > 0.7 * plain


def test_predictions_know_the_rows_that_they_are_about() -> None:
    m = mujoco.MjModel.from_xml_string(ARM.format(SECOND))
    p, vector = predictor(m, recorded(m, (0.0, LATE)))
    w = p.windows
    both = [p.rows(x, w) for x in (p.neutral, vector("sensor_delay", "b", LATE))]
    plain, late = both
    steps = np.arange(p.steps + 1)
    np.testing.assert_array_equal(plain.readings[..., 0], w.row[:, None] + steps)
    np.testing.assert_array_equal(plain.readings[..., 1], plain.readings[..., 0])
    np.testing.assert_array_equal(plain.commands, plain.readings[:, :-1, 0])
    rows = round(LATE / DT)
    # The late joint starts from the window's row, what is simulated before it.
    led = w.led
    np.testing.assert_array_equal(
        late.readings[led][..., 1], plain.readings[led][..., 1]
    )
    assert (plain.readings - late.readings)[led][..., 0].min() == rows
    assert (plain.commands - late.commands)[led].min() == rows
    first = ~led
    assert first.any()
    # Compared are the first rows that are not before what is simulated.
    assert (late.readings - plain.readings)[first][..., 1].min() == rows + 1
    np.testing.assert_array_equal(late.commands[first], plain.commands[first])
