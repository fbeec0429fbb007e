"""Named sensors in the fit of parameters."""

from dataclasses import replace
from typing import Any

import chex
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from easi_jax.data.cleaning import rows_of
from easi_jax.data.measured import MeasuredRuns
from easi_jax.data.recording import Run
from easi_jax.data.segments import to_device
from easi_jax.data.sensor_channels import NO_SENSORS, Sensors
from easi_jax.estimation import from_runs, weights
from easi_jax.estimation.contradictions import held_apart
from easi_jax.estimation.normal_equations import PairedFit
from easi_jax.estimation.pieces import segments_from_runs
from easi_jax.estimation.problem import Problem, problem_of
from easi_jax.estimation.relative import seed_results
from easi_jax.model.distribution import covariance
from easi_jax.model.joint_space import Configuration
from easi_jax.model.parameters import ParameterSpace, declare
from easi_jax.search.config import SearchConfig
from easi_jax.search.easi import Search
from easi_jax.simulation import engine, open_loop

_DT, _ROWS = 0.01, 300
_NOISE = np.array([2e-4, 2e-3])  # rad, rad/s
_TORQUE, _RATE = 0.02, 0.01  # N m, rad/s
# All that moves the joint may be twice as strong where it is twice as heavy.
_XML = """<mujoco><option timestep="0.005" integrator="implicitfast"/>
  <worldbody><body name="rod"><joint name="j" axis="0 1 0" damping="0.06"/>
    <geom type="capsule" size="0.02" fromto="0 0 0 0 0 -0.3" mass="0.5"/>
    <site name="s" pos="0 0 -.3"/></body></worldbody>
  <actuator><motor name="a" joint="j" gear="2"/></actuator>
  <sensor><jointactuatorfrc name="torque" joint="j"/><gyro name="rate" site="s"/>
    <framequat name="turn" objtype="site" objname="s"/><clock name="time"/></sensor>
</mujoco>"""
_PLACES = {
    "mass": ("body.rod.mass", 0.5),
    "damping": ("joint.j.damping", 0.06),
    "gear": ("actuator.a.gear", 2.0),
}


def _recorded(m: mujoco.MjModel, seed: int, early: bool = False) -> Run:
    """Of MuJoCo C alone. ``early``: sensors read before the command of their row."""
    rng, d = np.random.default_rng(seed), mujoco.MjData(m)
    ctrl = np.repeat(rng.uniform(-0.6, 0.6, (_ROWS // 5, 1)), 5, 0)
    q, v = np.empty((2, _ROWS, 1))
    read: dict[str, list[Any]] = {"torque": [], "rate": [], "turn": [], "time": []}

    def sense() -> None:
        for name, rows in read.items():
            rows.append(d.sensor(name).data.copy())

    for k, u in enumerate(ctrl):
        if early:
            sense()
        d.ctrl[:] = u
        mujoco.mj_forward(m, d)
        if not early:
            sense()
        q[k], v[k] = d.qpos, d.qvel
        mujoco.mj_step(m, d, 2)
    size = {"torque": _TORQUE, "rate": _RATE, "turn": 1e-3, "time": 0.0}
    sensors = {
        name: np.array(rows) + size[name] * rng.normal(size=np.shape(rows))
        for name, rows in read.items()
    }
    q += _NOISE[0] * rng.normal(size=q.shape)
    v += _NOISE[1] * rng.normal(size=v.shape)
    time, shape = _DT * np.arange(_ROWS), Configuration.of(m)
    name = f"r{seed}"
    return Run(name, name, _DT, time, q, v, True, ctrl, shape, sensors=sensors)


def _problem(early: bool = False, name: engine.Engine = "mujoco") -> Problem:
    m = mujoco.MjModel.from_xml_string(_XML)
    space = ParameterSpace(
        tuple(
            declare(m, name, address, nominal=value, initial=(value / 3, 3 * value))
            for name, (address, value) in _PLACES.items()
        )
    )
    fit, held = ([_recorded(m, seed, early)] for seed in (0, 1))
    runs = MeasuredRuns(tuple(fit), _NOISE, fit, held, "r", [])
    with engine.using(name):
        return problem_of("rod", m, space, runs)


@pytest.fixture(scope="module")
def problem() -> Problem:
    return _problem()


def test_held_out_recordings_are_cut_as_the_fitted_ones(problem: Problem) -> None:
    """Those that lack what all of these have measured are not compared."""
    m, (fit,) = problem.simulator.mj_model, problem.fit
    sensors, steps, every = problem.fitted_sensors, 15, 8
    given = problem.sensing, [fit], steps, every
    whole = segments_from_runs(*given, sensors=sensors)
    other = replace(_recorded(m, 2), source="day2.csv", name=fit.name)
    half = {
        k: np.where(np.arange(_ROWS)[:, None] < 150, v, np.nan)
        for k, v in other.sensors.items()
    }

    def apart(*held: Run) -> list[str]:
        runs = [fit], held
        found = held_apart(whole, problem.sensing, runs, steps, every, sensors)
        for one in found:
            like = jax.tree.map(lambda x: x[:1], (one.pieces, whole))
            chex.assert_trees_all_equal_shapes(*like)
        return [one.name for one in found]

    assert len(sensors) and fit.qvel_measured
    assert apart(other) == [fit.name], "a name that two files share is two recordings"
    assert apart(replace(other, source=fit.source)) == []
    assert (
        apart(replace(other, sensors={})) == apart(replace(other, sensors=half)) == []
    )
    assert apart(replace(other, qvel_measured=False)) == []
    assert apart(rows_of(other, 0, steps)) == []


def test_which_take_part_and_why_others_do_not(problem: Problem) -> None:
    names = [n.sensor for n in problem.sensors]
    assert names == ["torque", *3 * ["rate"], *4 * ["turn"]]
    assert "sensors that are fitted as well: torque, rate, turn" in problem.notes
    (why,) = (n for n in problem.notes if "sensor time is not fitted" in n)
    assert "no simulation predicts this kind of sensor (CLOCK)" in why


@pytest.mark.parametrize("name", ["mujoco", "mjx"])
def test_what_is_predicted_is_what_mujoco_reads(name: engine.Engine) -> None:
    problem = _problem(name=name)
    simulator = problem.simulator.sensing(problem.sensors)
    given = simulator, problem.fit, 5, 50
    pieces = to_device(segments_from_runs(*given, sensors=problem.sensors))
    theta = jnp.asarray(simulator.space.nominal)
    each = jax.jit(
        lambda p: open_loop.predict_sensed(simulator, simulator.model(theta), p)[2]
    )(pieces)
    m = problem.simulator.mj_model
    columns = list(problem.sensors.columns)
    for i in range(pieces.count):
        d = mujoco.MjData(m)
        d.qpos[:], d.qvel[:] = pieces.qpos[i], pieces.qvel[i]
        for k in range(5):
            d.ctrl[:] = pieces.ctrl[i, k]
            for part in range(2):
                mujoco.mj_step(m, d)
                np.testing.assert_allclose(
                    each[i, k, part], d.sensordata[columns], rtol=1e-4, atol=1e-4
                )
    moved = open_loop.motion(simulator, pieces)
    assert moved.shape == (pieces.count, 5, 2 + len(columns))


@pytest.mark.parametrize("early", [False, True])
def test_readings_of_before_their_command_are_recognised(early: bool) -> None:
    found = _problem(early).fitted_sensors
    at_end = {n.sensor for n in found if n.at_end}
    assert at_end == ({"torque"} if early else set())


def test_a_torque_says_how_strong_all_of_it_is(problem: Problem) -> None:
    """Motion shows ratios only."""
    simulator = problem.simulator.sensing(problem.sensors)
    space = simulator.space
    unit = space.to_unit(jnp.asarray(space.nominal))
    known = []
    for machine, sensors in (
        (problem.simulator, NO_SENSORS),
        (simulator, problem.sensors),
    ):
        given = machine, problem.fit, 20, 20
        pieces = to_device(segments_from_runs(*given, sensors=sensors))
        noise = np.concatenate([_NOISE, sensors.noise(problem.fit)[0]])
        paired = PairedFit(
            *(machine, space, pieces, jnp.asarray(noise)), start=jnp.asarray(_NOISE)
        )
        hessian = np.asarray(jax.jit(paired.information)(unit), float)
        known.append(np.sqrt(max(np.ones(3) @ hessian @ np.ones(3), 0.0)))
    assert known[1] > 50 * known[0] and known[1] > 50


def test_late_velocities_are_set_right_and_take_part() -> None:
    m = mujoco.MjModel.from_xml_string(_XML)
    fit, held = ([_recorded(m, seed)] for seed in (0, 1))
    late = [
        [replace(r, qvel=np.vstack([r.qvel[:1], r.qvel[:1], r.qvel[:-2]])) for r in x]
        for x in (fit, held)
    ]
    runs = MeasuredRuns(tuple(late[0]), _NOISE, late[0], late[1], "r", [])
    right = MeasuredRuns(tuple(fit), _NOISE, fit, held, "r", [])
    # Simulated velocities are half a physics step late beside their positions.
    assert problem_of("rod", m, ParameterSpace(()), right).fit[0] is fit[0]
    problem = problem_of("rod", m, ParameterSpace(()), runs)
    assert problem.measured.all()
    (note,) = [n for n in problem.notes if "velocity of j: late by" in n]
    assert abs(float(note.split(" ms")[0].split()[-1]) - 20.0) < 1.0
    np.testing.assert_array_equal(problem.noise, _NOISE)
    (run,) = problem.fit
    off = run.qvel - fit[0].qvel[: len(run)]
    assert np.std(off) < 4 * _NOISE[1]
    assert np.std(off) < 0.15 * np.std(late[0][0].qvel - fit[0].qvel)


def test_rows_without_a_reading_say_nothing(problem: Problem) -> None:
    """As if the readings that are there were all that there is: whatever stands in the
    others."""
    simulator, sensors = problem.simulator.sensing(problem.sensors), problem.sensors
    (run,) = problem.fit
    rng = np.random.default_rng(3)
    gaps = {k: np.array(v) for k, v in run.sensors.items()}
    gaps["torque"][rng.uniform(size=_ROWS) < 0.3] = np.nan
    gaps["rate"][np.arange(_ROWS) % 4 != 1] = np.nan
    machine = replace(run, sensors=gaps)
    assert sensors.known(machine).mean() < sensors.known(run).mean() == 1.0
    fits = []
    for read in (run, machine):
        given = simulator, [read], 20, 20
        pieces = to_device(segments_from_runs(*given, sensors=sensors))
        noise = jnp.asarray(np.concatenate([_NOISE, sensors.noise([read])[0]]))
        both = simulator, simulator.space, pieces, noise
        fits.append(PairedFit(*both, start=jnp.asarray(_NOISE)))
    whole, some = fits
    torque = [i + 2 for i, n in enumerate(sensors) if n.sensor == "torque"]
    told = np.asarray(some.noise)[torque] / np.asarray(whole.noise)[torque]
    np.testing.assert_allclose(told, 1.0, atol=0.2)
    some = replace(some, noise=whole.noise)
    unit = jnp.asarray(simulator.space.to_unit(jnp.array([0.4, 0.05, 2.2])))
    mask = weights.readings(some.segments, len(noise))
    assert float(mask[..., 2].mean()) == pytest.approx(0.7, abs=0.06)
    still = whole.unmoved
    expected = whole.normal(unit, still, whole.weight * mask)
    got = some.normal(unit, still, some.weight)
    for name in ("hessian", "gradients", "costs", "start_step"):
        a, b = getattr(got, name), getattr(expected, name)
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-4 * np.abs(b).max())
    assert not np.asarray(got.residuals)[np.asarray(mask) == 0].any()


@pytest.mark.parametrize("rows", [101, 102])
def test_each_row_of_a_log_counts_once(problem: Problem, rows: int) -> None:
    """As the start of a piece or as one of its steps; less at a run's ends."""
    (run,) = problem.fit
    problem = replace(problem, fit=[rows_of(run, 0, rows)])
    config = SearchConfig(source="replay", horizon=problem.piece, population=4)
    search = Search(problem.simulator, config)
    finish = from_runs._Finish(problem, search, True, 0, lambda _: None)
    pieces = finish.whole
    starts = np.asarray(pieces.qpos)[:, 0]
    first = [int(np.abs(run.qpos[:rows, 0] - q).argmin()) for q in starts]
    counted = np.zeros(rows)
    for at, weight in zip(first, np.asarray(pieces.weight), strict=True):
        counted[at : at + pieces.horizon + 1] += weight
    half = (pieces.horizon + 1) // 2
    inner = counted[half : first[-1] + half]
    assert len(inner) > half and (inner == 1.0).all()
    assert (counted[:half] == 0.5).all() and counted.max() == 1.0


@pytest.mark.slow
def test_the_finish_finds_all_of_it(problem: Problem) -> None:
    """Though a gyro reads half a radian a second too much."""
    space = problem.simulator.space
    (run,) = problem.fit
    wrong = {**run.sensors, "rate": np.asarray(run.sensors["rate"]) + 0.5}
    problem = replace(problem, fit=[replace(run, sensors=wrong)])
    config = SearchConfig(source="replay", horizon=problem.piece, population=4)
    search = Search(problem.simulator, config)
    finish = from_runs.ready_finish(problem, search)
    truth = space.to_unit(jnp.asarray(space.nominal))
    mean = truth + jnp.array([0.2, 0.25, 0.15])
    ((found,), notes) = finish(mean[None], 0.01 * jnp.eye(3)[None])
    off = np.asarray(found.distribution.mean - truth, float)
    std = np.sqrt(np.diag(covariance(found.distribution)))
    assert (np.abs(off) < 3.5 * std).all(), (off, std)
    assert (std < 0.02).all(), std
    assert not any("before the command" in n for n in notes(0))
    # A mass that is taken for known is held in a fit of the same readings.
    (told,) = seed_results(problem.sensing, space, [found])
    assert told.relative is None and set(told.flags) == {"determined"}
    rate = [i for i, n in enumerate(problem.sensors) if n.sensor == "rate"]
    torque = [i for i, n in enumerate(problem.sensors) if n.sensor == "torque"]
    misfit = np.asarray(found.misfit)[:, 2:].T
    assert misfit[rate].max() > 0.4 and misfit[torque].max() < _TORQUE


@pytest.mark.slow
def test_values_beside_a_known_mass_are_of_the_same_readings(problem: Problem) -> None:
    """A gyro tells no scale: one mass is taken as known, and the fit made again."""
    some = tuple(n for n in problem.sensors if n.sensor == "rate")
    problem = replace(problem, sensors=Sensors(some))
    space = problem.simulator.space
    config = SearchConfig(source="replay", horizon=problem.piece, population=4)
    finish = from_runs.ready_finish(problem, Search(problem.simulator, config))
    truth = space.to_unit(jnp.asarray(space.nominal))
    ((found,), _) = finish((truth + 0.2)[None], 0.01 * jnp.eye(3)[None])
    (told,) = seed_results(problem.sensing, space, [found])
    assert told.relative is not None and list(told.relative.taken) == ["mass"]
    np.testing.assert_allclose(told.relative.mean, space.nominal, rtol=0.05)
