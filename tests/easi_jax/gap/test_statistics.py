"""Fits, noise floors and whitening on problems whose answers are known."""

import contextlib
import copy
from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import mujoco
import numpy as np
import pytest

from easi_jax.data.cleaning import rows_of, true_readings
from easi_jax.data.recording import Run, physics_steps
from easi_jax.data.scales import scales_of
from easi_jax.data.sensor_channels import Sensors
from easi_jax.data.windows import fitted_velocity, lead_rows
from easi_jax.errors import UserError
from easi_jax.estimation.starts import Starts, floor
from easi_jax.gap import gap_metric as measure
from easi_jax.gap.analysis import Chosen, WindowsOf
from easi_jax.gap.batched_least_squares import (
    Bounds,
    Fitted,
    bounds_of,
    least_squares,
    lockstep,
    window_weights,
)
from easi_jax.gap.candidates import places, ripples
from easi_jax.gap.decisions import DECIDE
from easi_jax.gap.discretization_error import error_of_steps, within_a_step
from easi_jax.gap.effect_search import EffectSearch
from easi_jax.gap.effect_set import Candidate, Model
from easi_jax.gap.effect_vector import Layout
from easi_jax.gap.forward_selection import Selector
from easi_jax.gap.model_comparison import (
    advantage,
    are_twins,
    better,
    certainty,
    confidence,
    cost,
    probability,
    rank,
    simplest,
)
from easi_jax.gap.predictor import BLOCK, Predictor
from easi_jax.gap.screening import as_sine, shortlist
from easi_jax.gap.sensor_faults import reading_faults
from easi_jax.gap.table import Place
from easi_jax.gap.whitening import Residuals, make_residuals, row_groups
from easi_jax.gap.window_set import window_set
from easi_jax.gap.window_starts import window_starts
from easi_jax.model.effect_catalog import EFFECTS
from easi_jax.model.effect_numbers import EffectEntry
from easi_jax.model.joint_space import Configuration
from easi_jax.model.parameters import ParameterSpace

PENDULUM = """
<mujoco>
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <body name="rod">
      <joint name="hinge" axis="0 -1 0" damping="0.05"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.5" size="0.02" mass="0.6"/>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="hinge"/></actuator>
</mujoco>
"""
NOISE, DT = 2e-3, 0.01


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(PENDULUM)


def recording(model: mujoco.MjModel, seed: int, noise: float = NOISE) -> Run:
    rng = np.random.default_rng(seed)
    d = mujoco.MjData(model)
    t = DT * np.arange(800)
    ctrl = 0.8 * np.sin(2.1 * t + seed) + 0.6 * np.sin(4.7 * t)
    q = []
    for u in ctrl:
        q.append(d.qpos.copy())
        d.ctrl[:] = u
        for _ in range(5):
            mujoco.mj_step(model, d)
    qpos = np.array(q) + noise * rng.normal(size=(len(t), 1))
    c = Configuration.of(model)
    return Run(
        f"run{seed}",
        "made",
        DT,
        t,
        qpos,
        fitted_velocity(qpos, DT, c),
        False,
        ctrl[:, None],
        c,
    )


@pytest.fixture(scope="module")
def runs(model: mujoco.MjModel) -> list[Run]:
    return [recording(model, seed) for seed in (1, 2)]


@pytest.fixture(scope="module")
def predictor(model: mujoco.MjModel, runs: list[Run]) -> Predictor:
    windows = window_set(model, runs, 0.2, 0.1)
    assert windows is not None
    layout = Layout(model, places(model, scales_of(model, runs)))
    return Predictor(model, ParameterSpace(()), layout, windows, DT)


@pytest.fixture(scope="module")
def starts(model: mujoco.MjModel, predictor: Predictor, runs: list[Run]) -> Starts:
    """Of a perfect model's windows, solved for."""
    scales = scales_of(model, runs)
    return window_starts(model, predictor, runs, scales, np.array([NOISE]))


def test_floor_and_whitening_of_a_perfect_model(
    predictor: Predictor, starts: Starts
) -> None:
    x, lead = predictor.neutral, lead_rows(DT)
    still = np.zeros((len(predictor.windows), predictor.size))
    moved, errors = starts.solve(x, still)
    got = measure.squares(errors[:, lead + 1 :]).mean(0)
    rng = np.random.default_rng(0)
    drawn = floor(starts, x, moved, 20, np.zeros(1), rng)[:, lead + 1 :].mean((0, 1))
    np.testing.assert_allclose(np.sqrt(got), np.sqrt(drawn), rtol=0.06)
    due = starts.expected()[:, lead + 1 :].mean((0, 1))
    np.testing.assert_allclose(np.sqrt(drawn), np.sqrt(due), rtol=0.03)
    np.testing.assert_allclose(starts.measured_noise(errors), NOISE, rtol=0.06)
    r = make_residuals(starts, lead, np.zeros(1), np.array([0.5]))
    white = r.whitened(r.grouped(errors[None]))[0]
    # Of the start's two numbers nothing is left in the errors.
    free = 1 - 2 / white.shape[1]
    assert np.mean(white**2) == pytest.approx(free, rel=0.1)
    assert r.gap(white) == pytest.approx(np.sqrt(r.floor.mean()), rel=0.15)


def test_a_start_that_is_off_is_no_error(predictor: Predictor, starts: Starts) -> None:
    """Whitened errors and the gap are the same from any start near by."""
    x, lead = predictor.neutral, lead_rows(DT)
    moved, errors = starts.solve(x, np.zeros((len(predictor.windows), predictor.size)))
    off = predictor.errors(x[None], None, (moved + np.array([3e-3, 0.05]))[None])
    r = make_residuals(starts, lead, np.zeros(1), np.array([0.5]))
    near, far = (r.whitened(r.grouped(e))[0] for e in (errors[None], off))
    assert np.abs(off - errors).max() > 5 * NOISE
    np.testing.assert_allclose((far**2).mean(), (near**2).mean(), rtol=0.03)
    assert r.gap(far) == pytest.approx(r.gap(near), rel=0.03)


def test_every_effect_of_the_table_moves_the_prediction(
    model: mujoco.MjModel, predictor: Predictor, runs: list[Run]
) -> None:
    base = predictor.errors(predictor.neutral[None])[0]
    found = places(model, scales_of(model, runs))
    vectors = []
    for place in found:
        x = predictor.neutral.copy()
        start = np.array(place.starts[-1])
        index = predictor.layout.where(place)
        size = np.array([c.size for c in place.columns])
        x[index] = start + 5 * size * np.array(place.fitted)
        vectors.append(x)
    moved = predictor.errors(np.array(vectors))
    for place, errors in zip(found, moved, strict=True):
        assert np.abs(errors - base).max() > 1e-5, place.key
    names = {p.effect for p in found} | {"torque_ripple"}
    elsewhere = {"contact_friction", "contact_softness", "backlash"}
    elsewhere |= {"drive_stiffness", "drive_damping", "actuator_strength"}
    assert names | elsewhere == set(EFFECTS)


def test_ripples_are_at_the_joint(model: mujoco.MjModel, runs: list[Run]) -> None:
    (place,) = ripples(model, 0, scales_of(model, runs), [7.0])
    assert place.key == "torque_ripple@hinge" and place.starts[0][1] == 7.0


def test_least_squares_finds_a_bent_valley() -> None:
    """Rosenbrock's function, and a bound that cuts its minimum off."""

    def simulate(x: np.ndarray) -> np.ndarray:
        a = 10 * (x[:, 1] - x[:, 0] ** 2)
        return np.stack([a, 1 - x[:, 0]], -1)[:, None, :]

    size = np.full(2, 1e-4)
    free = Bounds(np.full(2, -5.0), np.full(2, 5.0), size)
    tight = Bounds(np.full(2, -5.0), np.array([0.5, 5.0]), size)
    start = np.array([[-1.2, 1.0], [-0.5, 0.4]])
    one = np.ones(1)
    ends: list[None] = []
    best, cut, fixed = lockstep(
        [
            least_squares(start, [0, 1], free, one, 60),
            least_squares(start, [0, 1], tight, one, 60),
            least_squares(start, [], free, one),
        ],
        simulate,
        ended=lambda: ends.append(None),
    )
    assert len(ends) == 3
    assert best.cost < 1e-3
    np.testing.assert_allclose(cut.x, [0.5, 0.25], atol=0.02)
    np.testing.assert_array_equal(fixed.x, start[1])


def test_what_the_data_do_not_see_stays() -> None:
    def simulate(x: np.ndarray) -> np.ndarray:
        return (x[:, :1] - 2.0)[:, None, :] * np.ones((1, 3, 4))

    bounds = Bounds(np.full(2, -5.0), np.full(2, 5.0), np.full(2, 0.1))
    ask = least_squares(np.zeros((1, 2)), [0, 1], bounds, np.ones(3))
    (fit,) = lockstep([ask], simulate)
    np.testing.assert_allclose(fit.x, [2.0, 0.0], atol=1e-3)


def test_slopes_are_those_of_the_errors_and_not_of_their_rounding() -> None:
    """Predictions are of single precision, and the last move of a fit is short."""
    rng = np.random.default_rng(0)
    along, bent, noise = rng.normal(size=(3, 60, 8))

    def simulate(x: np.ndarray) -> np.ndarray:
        off = x[:, :1, None] - 0.7
        exact = 100.0 + off * along + 0.02 * off**2 * bent + 1e-3 * noise
        return exact.astype(np.float32).astype(float) - 100.0

    bounds = Bounds(np.full(1, -5.0), np.full(1, 5.0), np.full(1, 0.1))
    for start in (0.0, 0.69, 0.7002):
        ask = least_squares(np.full((1, 1), start), [0], bounds, np.ones(60))
        (fit,) = lockstep([ask], simulate)
        off = fit.slope[..., 0] - along
        assert np.sqrt(np.mean(off**2)) < 0.02, start


def test_outliers_weigh_less() -> None:
    residual = np.ones((20, 5))
    residual[3] = 50.0
    weight = window_weights(residual)
    assert weight[3] < 0.1 and (np.delete(weight, 3) == 1).all()


def test_advantage_is_in_standard_errors() -> None:
    a = np.array([1.0, 2.0, 3.0, 4.0])
    assert advantage(a, a + np.array([0.9, 1.0, 1.1, 1.0])) > 10
    assert advantage(a, a) == 0
    assert advantage(a + 0.5, a) < -10


def test_groups_average_all_steps() -> None:
    for rows, start in ((22, 11), (16, 11), (49, 11), (261, 61)):
        g = row_groups(rows, start)
        assert len(g) <= 18
        assert not ((g[:, :start] > 0).any(1) & (g[:, start:] > 0).any(1)).any()
        np.testing.assert_allclose(g.sum(1), 1.0)
        assert ((g > 0).sum(0) == 1).all()


def test_intervals_hold_the_gap() -> None:
    rng = np.random.default_rng(0)
    square = rng.chisquare(3, (60, 2))
    scale = np.array([2.0, np.inf])
    low, high = measure.interval(square, scale)
    gap = float(measure.gap(square.mean(0), scale))
    assert low < gap < high
    assert gap == pytest.approx(np.sqrt(square[:, 0].mean()) / 2)


@pytest.mark.parametrize("lag", [0.0, 0.024])
def test_late_velocities_are_noticed(lag: float, model: mujoco.MjModel) -> None:
    run = recording(model, 3, noise=1e-4)
    true = fitted_velocity(run.qpos, DT, run.configuration)[:, 0]
    late = np.interp(run.time - lag, run.time, true)
    read = replace(run, qvel=late[:, None], qvel_measured=True)
    found = reading_faults(model, [read])
    if lag:
        (fault,) = found
        assert (fault.effect, fault.at) == ("sensor_delay", "qvel.hinge")
        assert fault.columns["late"] == pytest.approx(lag, abs=0.003)
        assert fault.std["late"] < 0.002 and fault.confidence > 0.9
    else:
        assert found == []


def test_velocities_with_an_offset_are_noticed(model: mujoco.MjModel) -> None:
    """They are named, and taken off where the file of effects is given."""
    run = recording(model, 3, noise=1e-4)
    true = fitted_velocity(run.qpos, DT, run.configuration)
    read = replace(run, qvel=true + 0.2, qvel_measured=True)
    (fault,) = reading_faults(model, [read])
    assert (fault.effect, fault.at) == ("sensor_bias", "qvel.hinge")
    value, std, unit = fault.parameters["bias"]
    assert value == pytest.approx(0.2, abs=0.01) and std < 0.01 and unit == "rad/s"
    assert fault.confidence > 0.9
    entry = EffectEntry(fault.effect, fault.at, "sensor", fault.columns, fault.std)
    (right,) = true_readings(model, [read], [entry])
    np.testing.assert_allclose(right.qvel, true + 0.2 - value)
    np.testing.assert_array_equal(right.qpos, read.qpos)
    assert reading_faults(model, [right]) == []


def test_stiffness_is_told_with_its_rest(
    model: mujoco.MjModel, runs: list[Run]
) -> None:
    place = next(
        p
        for p in places(model, scales_of(model, runs))
        if p.effect == "joint_stiffness"
    )
    told = place.row.told(
        {"stiffness": (2.0, 0.1, "N m/rad"), "rest": (0.5, 0.0, "N m")}
    )
    assert told["rest"][0] == pytest.approx(0.25) and told["rest"][2] == "rad"


def test_a_mass_at_its_joints_may_move_away() -> None:
    """MuJoCo leaves out what couples a body whose mass sits at its joints."""
    xml = """
<mujoco>
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <body name="cart">
      <joint name="x" type="slide" axis="1 0 0"/>
      <joint name="turn" axis="0 1 0"/>
      <geom type="sphere" size="0.1" mass="1"/>
    </body>
  </worldbody>
  <actuator><motor name="m" joint="x"/></actuator>
</mujoco>"""
    m = mujoco.MjModel.from_xml_string(xml)
    t = DT * np.arange(120)
    ctrl = np.stack([3 * np.sin(6 * t)], 1)
    c = Configuration.of(m)
    spec = mujoco.MjSpec.from_string(xml)
    body = spec.body("cart")
    body.explicitinertial, body.mass = True, 1.0
    body.ipos, body.inertia = np.array([0, 0, 0.2]), m.body_inertia[1]
    moved = spec.compile()
    d = mujoco.MjData(moved)
    q = []
    for u in ctrl:
        q.append(d.qpos.copy())
        d.ctrl[:] = u
        for _ in range(5):
            mujoco.mj_step(moved, d)
    qpos = np.array(q)
    assert np.ptp(qpos[:, 1]) > 0.1, "the turn is coupled"
    run = Run("r", "made", DT, t, qpos, fitted_velocity(qpos, DT, c), False, ctrl, c)
    found = places(m, scales_of(m, [run]))
    layout = Layout(m, found)
    windows = window_set(m, [run], 0.2, 0.03)
    assert windows is not None
    predictor = Predictor(m, ParameterSpace(()), layout, windows, DT)
    x = predictor.neutral.copy()
    com = next(p for p in found if p.effect == "com_offset")
    x[layout.where(com)] = [0, 0, 0.2]
    error = predictor.errors(np.stack([predictor.neutral, x]))
    wrong, right = np.sqrt(np.mean(error**2, (1, 2, 3)))
    assert right < 0.03 * wrong


def test_a_stuck_joint_is_not_left_out() -> None:
    noise = np.array([1e-3, 1e-3, np.inf])
    names = ("a", "b", "c")
    scale = np.array([np.inf, np.inf, np.inf])
    still = np.array([2e-3, 1e-3, np.inf])
    told: dict[str, str] = dict.fromkeys(names, "still")
    given = names, names, ("rad",) * 3, scale, told, still
    found = measure.Channels(*given, np.array([4e-3, 2e-3, 0.0]))
    moved = np.array([[0.1, 1e-3, 0.1]] * 20)
    some = measure.with_moving(found, moved, noise)
    assert some.scale.tolist() == [2e-3, np.inf, np.inf]
    assert list(some.ignored) == ["b", "c"]
    assert measure.with_moving(found, 0 * moved, noise) is found
    quieter = np.array([1e-3, 2e-4, np.inf])  # than it was thought to be
    some = measure.with_moving(found, 0 * moved, quieter)
    assert some.scale.tolist() == [np.inf, 1e-3, np.inf]


def test_a_run_that_the_others_contradict_is_told() -> None:
    rng = np.random.default_rng(0)
    run = np.repeat(np.arange(4), 10)
    square = rng.uniform(0.5, 1.5, (40, 1))
    scale = np.ones(1)
    assert measure.odd_runs(square, scale, run, 1.0) == {}
    square[run == 2] *= 25.0
    ((odd, times),) = measure.odd_runs(square, scale, run, 1.0).items()
    assert odd == 2 and times == pytest.approx(5.0, rel=0.2)
    two = square[20:], scale, run[20:]
    assert measure.odd_runs(*two, 0.3) == {}, "one of two: which?"
    assert measure.odd_runs(square[:10], scale, run[:10], 1.0) == {}


@pytest.mark.parametrize("bad", [0, 1])
def test_of_two_runs_that_contradict_the_one_that_is_not_followed_is_told(
    bad: int,
) -> None:
    rng = np.random.default_rng(0)
    run, scale = np.repeat([0, 1], 10), np.ones(1)
    square = rng.uniform(0.5, 1.5, (20, 1))
    assert measure.odd_runs(square, scale, run, 1.0) == {}
    square[run == bad] *= 100.0
    ((odd, times),) = measure.odd_runs(square, scale, run, 1.0).items()
    assert odd == bad and times == pytest.approx(10.0, rel=0.2)
    # A model that misses both says nothing of either.
    assert measure.odd_runs(square, scale, run, 0.3) == {}


def test_what_is_not_finite_loses(model: mujoco.MjModel, runs: list[Run]) -> None:
    """Physics in single precision fails now and then; the command must not."""
    layout = Layout(model, places(model, scales_of(model, runs)))
    windows = window_set(model, runs, 0.2, 0.03)
    assert windows is not None
    predictor = Predictor(model, ParameterSpace(()), layout, windows, DT)
    bounds = bounds_of(ParameterSpace(()), layout)
    count = len(windows)
    selector = Selector(predictor, bounds, np.arange(count) % 5)
    residual = np.ones((count, 4))
    residual[3, 2] = np.nan
    fit = Fitted(predictor.neutral, np.array([0]), residual, residual[..., None], 1.0)
    lost = selector.model([], fit)
    assert lost.loss.shape == lost.gap.shape == (5,)
    assert np.isinf(lost.loss).all() and np.isinf(lost.gap).all()


def test_some_blocks_are_whitened_as_among_all(predictor: Predictor) -> None:
    count = len(predictor.windows)
    bounds = bounds_of(ParameterSpace(()), predictor.layout)
    selector = Selector(predictor, bounds, np.arange(count) % 5)
    rng = np.random.default_rng(0)
    groups = row_groups(predictor.steps + 1, 11)
    root = rng.normal(size=(count, len(groups), len(groups)))
    selector.residuals = Residuals(
        *(groups, root, root, np.zeros(count)),
        np.ones(root.shape[:2], bool),
    )
    selector.steps = rng.normal(size=(count, predictor.steps + 1, 1))
    selector.moved = 1e-3 * rng.normal(size=(count, predictor.size))
    assert count % BLOCK  # the last block is not full
    x = np.append(predictor.neutral, 0.3)[None]
    some = selector.blocks[[0, -1]]
    at = selector.windows_of(some)
    assert len(at) == BLOCK + count % BLOCK and at[-1] == count - 1
    np.testing.assert_allclose(
        selector.simulate(x, some), selector.simulate(x)[:, at], rtol=1e-6, atol=1e-9
    )


def test_the_error_of_steps_is_what_smaller_ones_take_away(
    model: mujoco.MjModel, runs: list[Run]
) -> None:
    windows = window_set(model, runs, 0.2, 0.03)
    assert windows is not None
    error, fast = error_of_steps(model, windows, DT)
    own, fine = copy.deepcopy(model), copy.deepcopy(model)
    parts = physics_steps(DT, model.opt.timestep)
    own.opt.timestep, fine.opt.timestep = DT / parts, DT / (8 * parts)
    at = 7
    ends = []
    for m in (own, fine):
        d = mujoco.MjData(m)
        d.qpos = windows.start_qpos[at]
        d.qvel = fitted_velocity(runs[windows.run[at]].qpos, DT, runs[0].configuration)[
            windows.row[at]
        ]
        for u in windows.ctrl[at]:
            d.ctrl = u
            mujoco.mj_step(m, d, round(DT / m.opt.timestep))
        ends.append(np.array([d.qpos, d.qvel]))
    assert np.abs(error[at, -1]).max() > 1e-6 and np.abs(fast[at, -1]).max() > 1e-5
    both = np.array([error[at, -1], fast[at, -1]])
    np.testing.assert_allclose(both, ends[0] - ends[1], atol=1e-12)


def test_shifts_shorter_than_a_physics_step(
    model: mujoco.MjModel, runs: list[Run]
) -> None:
    every = {p.effect: p for p in places(model, scales_of(model, runs))}
    delay, step = every["actuator_delay"], 0.002
    assert within_a_step(delay, 0.7 * step / delay.columns[0].of, step)
    assert not within_a_step(delay, 0.8 * step / delay.columns[0].of, step)
    assert not within_a_step(every["viscous_damping"], 1e-4, step)


def test_rare_effects_have_to_help_by_either_measure(
    model: mujoco.MjModel, runs: list[Run]
) -> None:
    every = places(model, scales_of(model, runs))
    found = {p.effect: p for p in every if p.kind == "joint"}

    def fitted(loss: float, gap: float, *names: str) -> Model:
        n = len(names)
        fit = Fitted(np.zeros(n), np.arange(n), np.zeros(1), np.zeros(1), loss)
        even = 1 + 1e-3 * np.arange(10)
        return Model([found[name] for name in names], fit, loss * even, gap * even)

    base = fitted(10.0, 10.0, "coulomb_friction")
    for name, usual in (("viscous_damping", True), ("quadratic_drag", False)):
        both = ("coulomb_friction", name)
        assert better(fitted(6.0, 9.8, *both), base, 0.1) == usual, name
        assert better(fitted(6.0, 6.0, *both), base, 0.1), name
        assert not better(fitted(6.0, 10.2, *both), base, 0.1), name
        assert not better(fitted(9.9, 9.9, *both), base, 0.1), name
    # A gap of sqrt(10) is 3.16.
    both = ("coulomb_friction", "viscous_damping")
    small, large = fitted(9.8, 9.0, *both), fitted(9.0, 8.0, *both)
    assert better(small, base, 2.0) and not better(small, base, 3.0)
    assert better(large, base, 3.0)


def test_what_acts_in_few_windows_is_judged_in_those(
    model: mujoco.MjModel, runs: list[Run]
) -> None:
    limit = next(
        p
        for p in places(model, scales_of(model, runs))
        if p.effect == "actuator_saturation"
    )

    def fitted(at: tuple[int, ...], size: float, *names: Place) -> Model:
        residual = np.ones((40, 5))
        residual[list(at)] *= np.sqrt(size * (1 + 0.1 * np.arange(len(at))))[:, None]
        windows = np.tile((residual**2).mean(1), (2, 1))
        blocks = windows.reshape(2, 10, 4).mean(-1)
        fit = Fitted(np.zeros(1), np.arange(1), residual, np.zeros(1), 1.0)
        return Model([*names], fit, *blocks, windows=windows)

    for at, enough in (((5, 6, 7), True), ((6, 7), False)):
        base, mended = fitted(at, 30.0), fitted(at, 1.0, limit)
        assert advantage(mended.loss, base.loss) < 1.7, "one block of ten"
        assert better(mended, base, 0.1) == enough
    base, worse = fitted((5, 6, 7), 30.0), fitted((9, 10, 11), 20.0, limit)
    assert not better(worse, base, 0.1), "mends some windows and spoils others"


def test_a_step_from_a_small_sine_leads_to_the_right_phase() -> None:
    """Least squares in a sine's amplitude and phase is linear in its two shares."""
    angle = np.linspace(0.0, 5.0, 50)
    wanted = 0.8 * np.sin(angle + 2.2)
    start = np.array([0.05, 0.0])
    slope = np.stack([np.sin(angle), 0.05 * np.cos(angle)], 1)
    step = np.linalg.lstsq(slope, wanted - 0.05 * np.sin(angle), rcond=None)[0]
    np.testing.assert_allclose(as_sine(start, start + step), [0.8, 2.2], rtol=1e-6)


def test_a_bias_may_be_as_large_as_the_motion(
    model: mujoco.MjModel, runs: list[Run]
) -> None:
    s = scales_of(model, runs)
    for p in places(model, s):
        if p.effect == "sensor_bias":
            (column,) = p.columns
            assert column.high == -column.low >= s.position[column.index[0]]


def test_of_many_windows_those_that_are_wanted_are_cut(
    model: mujoco.MjModel, runs: list[Run]
) -> None:
    """An hour of logs would fill the memory otherwise."""
    cut = WindowsOf(model, 0.1, Sensors())
    few, every = cut.some(runs, 0.2), cut.all(runs, 0.2)
    assert few is not None and every is not None and len(few) < len(every)
    begins = list(zip(every.run, every.row, strict=True))
    same = [begins.index(of) for of in zip(few.run, few.row, strict=True)]
    assert {0, len(every) - 1} <= set(same)
    for name in few.__dataclass_fields__:
        wanted = getattr(every, name)[same]
        np.testing.assert_array_equal(getattr(few, name), wanted)
    assert cut.some([rows_of(run, 0, 15) for run in runs], 0.2) is None


def of_loss(loss: np.ndarray) -> Model:
    fit = Fitted(np.zeros(0), np.arange(0), np.zeros(1), np.zeros(1), 0.0)
    return Model([], fit, loss, loss)


def test_what_costs_much_to_take_out_is_sure() -> None:
    sure = [confidence(lost, 0.0) for lost in (0.0, 0.01, 0.1, 1.0, 10.0)]
    assert sure == sorted(sure) and sure[0] == 0.0
    assert sure[1] < 0.1 and sure[2] < 0.5 < sure[3] and 0.9 < sure[-1] < 1.0
    assert confidence(3.0, 1.0) == pytest.approx(0.5 * confidence(3.0, 0.0))
    # Three times the cost that is as often wrong as right.
    assert confidence(0.6, 0.0, even=0.2, steep=2.0) == pytest.approx(0.9)


def test_an_effect_is_missed_as_in_the_windows_that_show_it_most() -> None:
    """Light damping shows in long windows, which say all that they say alone; where
    feet slip, or the rest is no machine, a length has no say."""
    rng, damping = (
        np.random.default_rng(0),
        Place("viscous_damping", "j", "joint", (), ()),
    )

    class Length:
        """Windows of one length, in which errors grow so much without the effect."""

        def __init__(self, times: float, steps: int, sticks: bool = False) -> None:
            self.times, self.steps, self.sticks = times, steps, sticks
            self.mine = of_loss(10.0 + rng.random(10))
            self.mine.places = [damping]

        def as_before(self) -> contextlib.AbstractContextManager[None]:
            return contextlib.nullcontext()

        def again(self, _: Model) -> Model:
            if self.times == np.inf:
                raise UserError("most predictions are not finite")
            return self.mine

        def without(self, model: Model, gone: list[Place], possible: bool) -> Model:
            assert model is self.mine and gone == [damping] and not possible
            return of_loss(self.times * self.mine.loss)

    short, long, lost = Length(1.5, 5), Length(4.0, 50), Length(1.0, 50)
    slips, blows_up = Length(9.0, 20, sticks=True), Length(np.inf, 50)
    lost.mine.loss = np.full(10, np.inf)
    for at, others, most in (
        (short, [long, slips, lost, blows_up], long),
        (long, [short, slips], long),
        (slips, [short, Length(20.0, 50)], slips),
    ):
        lengths = SimpleNamespace(at=at, lengths=[at, *others])
        found = EffectSearch.missed(cast(EffectSearch, lengths), at.mine)
        less = most.without(most.mine, [damping], possible=False)
        (key, (lost, _)) = found.popitem()
        assert (key, lost) == (damping.key, cost(most.mine, less)) and not found
        assert lost == pytest.approx(0.5 * np.log(most.times), rel=0.1)


def test_twins_predict_the_same() -> None:
    rng = np.random.default_rng(0)
    one, led = of_loss(np.ones(10)), np.arange(20) > 1
    one.fit = replace(one.fit, residual=rng.normal(size=(20, 30)))
    for size, same in ((0.05, True), (0.2, False)):
        moved = one.fit.residual + size * rng.normal(size=(20, 30))
        other = of_loss(np.ones(10))
        other.fit = replace(other.fit, residual=moved)
        assert are_twins(one, other, led) == same
        # Where a run begins, a late command may be told from a late reading.
        moved[:2] += 1.0
        assert are_twins(one, other, led) == same
        # Where all windows begin runs, there are no others to go by.
        assert not are_twins(one, other, np.zeros(20, bool))
        # A limit acts in few windows, and is no twin of what does nothing there.
        moved[2] += 1.0
        assert not are_twins(one, other, led)


def test_certainty_is_in_standard_errors_between_blocks() -> None:
    """Of logarithms, so that a block with most of the error counts like the others."""
    loss = np.array([1.0, 2.0, 100.0, 5.0])
    times = np.exp([0.1, 0.2, 0.3, 0.4])
    model, less = of_loss(loss), of_loss(loss * times)
    of_the_mean = np.std([0.1, 0.2, 0.3, 0.4], ddof=1) / 2
    assert certainty(model, less) == pytest.approx(0.25 / of_the_mean)
    assert certainty(less, model) == pytest.approx(-0.25 / of_the_mean)


def test_the_cost_is_what_is_open_without_an_effect_by_what_is_open_with_it() -> None:
    """Far beyond the noise a difference of log densities: of Gaussian numbers whose
    spread is twice as wide, log 2 each."""
    loss = np.random.default_rng(0).uniform(1.0, 2.0, 10)
    far = 1e4 * loss
    assert cost(of_loss(far), of_loss(4 * far)) == pytest.approx(np.log(2), rel=1e-3)
    # What closes all of a gap of two floors is likely; a right model's loss is a little
    # less than 1.
    right = of_loss(np.full(10, 0.9))
    costs = [cost(right, of_loss(np.full(10, x**2))) for x in (0.9, 1.0, 1.25, 2, 3)]
    assert costs == sorted(costs) and costs[:2] == [0.0, 0.0]
    sure = [confidence(c, 0.0) for c in costs]
    assert sure[2] < 0.75 and 0.8 < sure[3] < 0.9 and sure[3] < sure[4] < 0.95
    # What is not open may be of any cause.
    within = cost(right, of_loss(np.full(10, 1.25**2)), 1.25)
    assert confidence(within, 0.0) < DECIDE.probable
    # A force limit that one block of ten meets costs as much as that one says.
    met = np.where(np.arange(10) == 3, 1e4, loss)
    assert cost(of_loss(loss), of_loss(met)) > 2.0


def test_of_twins_the_one_of_a_usual_size_comes_first(
    model: mujoco.MjModel, runs: list[Run]
) -> None:
    found = {p.effect: p for p in places(model, scales_of(model, runs))}
    gain, tilt = found["actuator_gain"], found["gravity_tilt"]
    assert [gain.unlikely(np.array([v])) for v in (0.3, 0.7, 3.0)] == [1, 0, 1]
    assert [tilt.unlikely(np.array([v, 0.1])) for v in (0.1, -0.3)] == [1, 2]
    fit = Fitted(np.zeros(1), np.arange(1), np.zeros(1), np.zeros(1), 1.0)
    even = np.ones(10)
    weak = Model([gain], fit, even, even, unlikely=gain.unlikely(np.array([0.3])))
    heavy = Model([found["payload_mass"]], fit, 1.05 * even, even)
    assert rank(heavy) < rank(weak) < rank(replace(heavy, loss=1.2 * even))


def test_of_names_that_do_as_well_what_most_machines_have_is_likelier(
    model: mujoco.MjModel, runs: list[Run]
) -> None:
    """Half a standard error for each reason: Phi(0.5) beside an ordinary effect, Phi(1)
    beside a rare one."""
    found = {p.effect: p for p in places(model, scales_of(model, runs))}
    fit = Fitted(np.zeros(1), np.arange(1), np.zeros(1), np.zeros(1), 1.0)

    def alike(name: str) -> Model:
        place = found[name]
        unlikely = place.unlikely(np.ones(len(place.columns)))
        return Model([place], fit, np.ones(10), np.ones(10), unlikely=unlikely)

    names = "coulomb_friction", "actuator_gain", "quadratic_drag"
    common, ordinary, rare = map(alike, names)
    assert rank(common) < rank(ordinary) < rank(rare)
    # By as much, whatever else is in a model.
    for beside in (-2, 0, 2):
        more = [replace(x, unlikely=x.unlikely + beside) for x in (common, ordinary)]
        assert rank(more[1]) / rank(more[0]) == pytest.approx(1.1)
    assert probability(common, ordinary) == pytest.approx(0.69, abs=0.01)
    assert probability(ordinary, rare) == pytest.approx(0.69, abs=0.01)
    assert probability(common, rare) == pytest.approx(0.84, abs=0.01)
    assert probability(common, alike("armature")) == 0.5


def test_a_force_on_a_body_is_rarer_than_one_at_a_joint(
    model: mujoco.MjModel, runs: list[Run]
) -> None:
    """A pendulum that is too heavy is not pulled down."""
    every = places(model, scales_of(model, runs))
    forces = {p.kind: p.rarity for p in every if p.effect == "constant_force"}
    assert forces["body"] > forces["joint"] == 0


def test_beside_a_law_the_rivals_of_effects_are_offered_again() -> None:
    mine = Place("actuator_lag", "motor", "actuator", (), ())
    other = Place("actuator_delay", "motor", "actuator", (), ())
    model, rival = of_loss(np.ones(10)), of_loss(np.ones(10))
    model.places, rival.places = [mine], [other]
    chosen = Chosen(model, model, {mine.key: [rival]}, [])
    assert chosen.names == {mine.key, other.key}


def test_what_is_contained_comes_first_where_nearly_as_good(
    model: mujoco.MjModel, runs: list[Run]
) -> None:
    every = places(model, scales_of(model, runs))
    found = {p.effect: p for p in every if p.kind == "joint"}

    def fitted(loss: float, *names: str) -> Model:
        n = len(names)
        fit = Fitted(np.zeros(n), np.arange(n), np.zeros(1), np.zeros(1), loss)
        even = np.full(10, loss) + 1e-3 * np.arange(10)
        return Model([found[name] for name in names], fit, even, even)

    base = fitted(10.0, "coulomb_friction")
    best = fitted(1.0, "joint_stiffness", "viscous_damping")
    near = fitted(2.0, "constant_force", "viscous_damping")
    far = fitted(6.0, "constant_force", "viscous_damping")
    assert simplest([best, near], base) is near
    assert simplest([best, far], base) is best


def test_confidence_weighs_both_measures(
    model: mujoco.MjModel, runs: list[Run]
) -> None:
    every = places(model, scales_of(model, runs))
    found = {p.effect: p for p in every if p.kind == "joint"}
    rng = np.random.default_rng(0)
    scatter = 1 + 0.1 * rng.normal(size=10)

    def fitted(loss: float, gap: float, name: str) -> Model:
        fit = Fitted(np.zeros(1), np.arange(1), np.zeros(1), np.zeros(1), loss)
        return Model([found[name]], fit, loss * scatter, gap * scatter)

    mine = fitted(1.0, 1.0, "coulomb_friction")
    same = probability(mine, fitted(1.0, 1.0, "viscous_damping"))
    assert same == pytest.approx(0.5, abs=0.01)
    assert probability(mine, fitted(2.0, 2.0, "viscous_damping")) > 0.99
    assert probability(mine, fitted(0.5, 0.5, "viscous_damping")) < 0.01
    mixed = probability(mine, fitted(0.9, 1.1, "viscous_damping"))
    assert 0.3 < mixed < 0.7
    # What contains the effect is little of a rival, and none by being as good.
    assert probability(mine, fitted(0.5, 0.5, "stribeck_friction")) == 0.5
    assert probability(mine, fitted(1.0, 1.0, "stribeck_friction")) > 0.8


def test_special_cases_of_the_promising_are_tried(
    model: mujoco.MjModel, runs: list[Run]
) -> None:
    every = [p for p in places(model, scales_of(model, runs)) if p.kind != "model"]
    keys = {p.effect: p for p in every if p.at == "hinge"}
    order = [keys.pop("stribeck_friction"), *keys.values()]
    last = [p for p in order if p.effect != "coulomb_friction"]
    last.append(keys["coulomb_friction"])
    screened = [(10.0 + i, Candidate(p, p.starts[0])) for i, p in enumerate(last)]
    names = [c.place.effect for c in shortlist(screened)]
    assert names[0] == "stribeck_friction" and names[-1] == "coulomb_friction"
    assert len(names) < len(last)
    rough = [c.place.effect for c in shortlist(screened, sticks=True)]
    assert set(names) < set(rough), "where promises are rough, more are tried"
    assert "coulomb_friction" not in [
        c.place.effect for c in shortlist([s for s in screened if s[0] > 10.0])
    ]
