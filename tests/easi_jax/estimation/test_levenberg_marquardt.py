"""The least-squares finish finds Cartpole, without noise and as well as can be."""

from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from benchmarks.recovery import controller
from benchmarks.rigs import RIGS
from easi_jax.data.segments import Segments, cut, to_device, windows
from easi_jax.devices.runtime import quick_compile
from easi_jax.estimation.identifiability import identifiability
from easi_jax.estimation.levenberg_marquardt import RefineResult, refine
from easi_jax.estimation.limits import jumps
from easi_jax.estimation.normal_equations import PairedFit
from easi_jax.estimation.polish import polish
from easi_jax.model.joint_space import Configuration
from easi_jax.model.parameters import ParameterSpace, declare
from easi_jax.simulation import rollout
from easi_jax.simulation.simulator import Simulator
from envs.cartpole import Cartpole

NOISE = jnp.array([5e-4, 2e-3, 1e-2, 2e-2])
CARTPOLE = Configuration(2, 2, (0, 1), (0, 1), ())
WEIGHED = ("pole_length", "pole_mass", "cart_mass")


@pytest.fixture(scope="module")
def space(cartpole: Cartpole) -> ParameterSpace:
    return cartpole.space.select([n for n in cartpole.space.names if n not in WEIGHED])


@pytest.fixture(scope="module")
def fit(cartpole: Cartpole, space: ParameterSpace) -> Any:
    simulator = Simulator(cartpole.mj_model, space, cartpole.dt)

    def run(unit: jax.Array, seg: Segments, noise: jax.Array, more: jax.Array) -> Any:
        paired = PairedFit(simulator, space, seg, noise)
        return refine(paired, unit, iterations=15, others=more)

    # It runs for longer than it compiles.
    compiled = jax.jit(run, compiler_options=quick_compile())

    def from_all(
        unit: jax.Array, seg: Segments, noise: jax.Array, others: Any = None
    ) -> RefineResult:
        return compiled(unit, seg, noise, unit[None] if others is None else others)

    return from_all


@pytest.fixture(scope="module")
def start(space: ParameterSpace) -> jax.Array:
    off = np.where(np.arange(space.size) % 2, 0.7, 1.3)
    return space.to_unit(jnp.asarray(off * space.nominal))


def test_recovers_the_truth_without_noise(
    fit: Any, start: jax.Array, space: ParameterSpace, trajectories: Segments
) -> None:
    out = fit(start, windows(trajectories, 10, 10), 1e-2 * NOISE)
    found = np.asarray(space.to_si(out.unit))
    ratio = dict(zip(space.names, found / space.nominal, strict=True))
    for name, r in ratio.items():
        assert r == pytest.approx(1.0, abs=1e-3), (name, ratio)
    assert out.cost[-1] < 1e-4 * out.cost[0]
    # Whole rounds of derivatives and trials, each of one step or of all ten.
    pieces, rounds = windows(trajectories, 10, 10).count, 15 + 2
    derivatives = 1 + space.size + len(NOISE)
    places = 3 * (1 + 6) + 2 * len(jumps(space)[0]) + 1
    steps = float(out.simulated) / (pieces * (derivatives + places))
    assert steps == pytest.approx(round(steps), rel=1e-6)
    assert 10 * 13 < steps <= 2 * rounds * (1 + 10) + (1 + rounds + 1) * 10


def test_is_as_good_as_the_cramer_rao_bound(
    fit: Any, start: jax.Array, space: ParameterSpace, trajectories: Segments
) -> None:
    seen = rollout.measured(trajectories, NOISE, jax.random.key(7), CARTPOLE)
    out = fit(start, windows(seen, 10, 10), NOISE)
    known = identifiability(space, np.asarray(out.hessian))
    error = np.log(np.asarray(space.to_si(out.unit)) / space.nominal)
    z = (error / known.std)[known.determined]
    assert known.determined.sum() >= 5
    assert np.abs(z).max() < 4
    # Neither far better than the bound: then the bound would be wrong.
    assert np.sqrt(np.mean(z**2)) > 0.2
    assert not (np.diff(np.asarray(out.cost, float)) > 0).any()
    assert np.abs(out.delta).max() < 6 * float(NOISE.max())


@pytest.mark.slow
def test_the_best_of_several_starts_is_the_result(
    fit: Any, start: jax.Array, trajectories: Segments
) -> None:
    seen = rollout.measured(trajectories, NOISE, jax.random.key(7), CARTPOLE)
    pieces = windows(seen, 10, 10)
    lost = start + jnp.where(jnp.arange(start.size) % 2, 3.0, -3.0)
    alone, good = fit(lost, pieces, NOISE), fit(start, pieces, NOISE)
    best = fit(lost, pieces, NOISE, start[None])
    assert alone.cost[-1] > good.cost[-1] + 20
    # But for the weak pull towards where the fit began.
    np.testing.assert_allclose(best.cost[-1], good.cost[-1], atol=2 * start.size)
    # Farther still: from `lost` itself it is the same fit, but for rounding.
    beyond = 2 * lost - start
    assert fit(beyond, pieces, NOISE).cost[-1] > good.cost[-1] + 20
    worse = fit(start, pieces, NOISE, beyond[None])
    np.testing.assert_array_equal(worse.unit, good.unit)


@pytest.mark.slow
def test_what_is_as_good_as_zero_comes_back_though_little_is_known(
    cartpole: Cartpole, fit: Any, space: ParameterSpace, trajectories: Segments
) -> None:
    """Errors of the model drown most information; the prior must not hold it back."""
    pieces = windows(trajectories, 25, 25)
    simulator = Simulator(cartpole.mj_model, space, cartpole.dt)
    i = space.index("cart_kv")
    low = space.nominal.copy()
    low[i] *= 1e-3
    paired = PairedFit(simulator, space, pieces, NOISE, misfit=30 * NOISE)
    run = jax.jit(lambda u: refine(paired, u, robust=0))
    out = run(space.to_unit(jnp.asarray(low)))
    assert float(space.to_si(out.unit)[i]) == pytest.approx(space.nominal[i], rel=0.1)


@pytest.mark.parametrize(
    "depth",
    [
        6.0,
        pytest.param(14.0, marks=pytest.mark.slow),
        pytest.param(20.0, marks=pytest.mark.slow),
    ],
)
def test_a_value_lost_near_zero_comes_back(
    fit: Any,
    start: jax.Array,
    space: ParameterSpace,
    trajectories: Segments,
    depth: float,
) -> None:
    """Its slope is next to nothing there, and the steps of all others count on its."""
    pieces = windows(
        rollout.measured(trajectories, NOISE, jax.random.key(7), CARTPOLE), 10, 10
    )
    i = space.names.index("pole_friction")
    lost = start.at[i].add(-depth / space.log_width[i])
    good, found = fit(start, pieces, NOISE), fit(lost, pieces, NOISE)
    np.testing.assert_allclose(found.cost[-1], good.cost[-1], atol=0.5)
    off = np.asarray(found.unit - good.unit) * space.log_width
    assert abs(off[i]) < 0.3, dict(zip(space.names, off.round(3), strict=True))


@pytest.mark.slow
@pytest.mark.parametrize("met", [True, False])
def test_a_limit_that_was_not_met_is_not_known(met: bool) -> None:
    """Noise digs a dip into the edge of the plateau, where a fit from below stops; the
    last steps find it to be none."""
    rig = RIGS["cartpole"]()
    space = rig.simulator.space
    i = space.names.index("cart_force_limit")
    theta = jnp.asarray(space.nominal, jnp.float32)
    theta = theta.at[i].mul(0.25 if met else 1.0)
    clean = jax.jit(lambda k: rig.record(rig.simulator, theta, k, 16, 1.0))(
        jax.random.key(0)
    )
    seen = rollout.measured(
        clean, jnp.asarray(rig.noise), jax.random.key(9), rig.simulator.configuration
    )
    pieces = windows(seen, 25, 26)
    start = space.to_unit(theta).at[i].add(-0.5)
    paired = PairedFit(rig.simulator, space, pieces, jnp.asarray(rig.noise))

    def run(u: jax.Array) -> RefineResult:
        fit = refine(paired, u, robust=0, iterations=15)
        return polish(paired, fit.unit, starts=fit.delta)

    out = jax.jit(run)(start)
    off = float(out.unit[i] - space.to_unit(theta)[i]) * float(space.log_width[i])
    if met:
        assert abs(off) < 0.01
        assert out.hessian[i, i] > 1e4
    else:
        # Not farther than a plateau is entered beyond its edge.
        assert abs(off) < 0.4 * float(space.log_width[i])
        assert out.hessian[i, i] < 1.0


@pytest.mark.slow
def test_a_limit_that_nothing_meets_is_found_from_a_narrow_start(
    cartpole: Cartpole, space: ParameterSpace, trajectories: Segments
) -> None:
    """The cart's speed limit, three times too high: no simulation reaches it."""
    far = space.scaled(2.0, 4.0)
    simulator = Simulator(cartpole.mj_model, far, cartpole.dt)
    pieces = windows(trajectories, 25, 25)
    speed = np.abs(np.asarray(trajectories.next_qvel)[..., 0])
    assert 0.55 < speed.max() <= 0.6 + 1e-6
    i = far.index("cart_speed_limit")
    wrong = far.nominal.copy()
    wrong[i] *= 3.0
    run = jax.jit(lambda u: refine(PairedFit(simulator, far, pieces, NOISE), u))
    out = run(far.to_unit(jnp.asarray(wrong)))
    assert float(far.to_si(out.unit)[i]) == pytest.approx(far.nominal[i], rel=0.02)


@pytest.mark.slow
def test_a_limit_that_few_pieces_meet_is_found(
    cartpole: Cartpole, space: ParameterSpace
) -> None:
    """Where a search's fit ended: damping and friction were bent to two fast pieces,
    which then met no limit; the fit with several starts leaves them out and returns."""
    key, rest = jax.random.split(jax.random.key(75))
    truth = jax.random.uniform(key, (space.size,))
    bent = jnp.array([0.739, 0.789, 0.531, -0.362, 0.812, 0.212, 0.87, 0.86])
    simulator = Simulator(cartpole.mj_model, space, cartpole.dt)

    @jax.jit
    def record(key: jax.Array) -> Segments:
        k_run, k_noise, _ = jax.random.split(key, 3)
        model = simulator.model(space.to_si(truth))
        runs = rollout.collect(
            *(cartpole, model, controller, k_run, 50, cartpole.episode_length)
        )
        seen = rollout.measured(runs, NOISE, k_noise, simulator.configuration)
        few = jnp.append(jnp.arange(14), 43)  # the fastest of fifty among them
        return windows(jax.tree.map(lambda x: x[few], seen), 25, 26)

    @jax.jit
    def fit(pieces: Segments, start: jax.Array, others: jax.Array) -> Any:
        paired = PairedFit(simulator, space, pieces, NOISE)
        return refine(paired, start, iterations=15, others=others)

    pieces = record(rest)
    best = fit(pieces, truth, truth[None])
    out = fit(pieces, bent, bent[None])
    assert float(out.cost[-1]) == pytest.approx(float(best.cost[-1]), abs=1.0)
    limit = space.index("cart_speed_limit")
    off = (out.unit - truth)[limit] * float(space.log_width[limit])
    assert abs(float(off)) < 0.01


@pytest.mark.slow
def test_few_pieces_do_not_hold_up_the_rest(
    cartpole: Cartpole, space: ParameterSpace
) -> None:
    """Where a search ended on 200 s of noisy data, 17 standard deviations away.

    Steps that suited most starts threw some across a change of sign of a speed; with
    all or none of them taken, the fit went no further than 135 above the best.
    """
    key, rest = jax.random.split(jax.random.key(5))
    truth = jax.random.uniform(key, (space.size,))
    found = jnp.array([1.3, 0.5, 0.24, 0.27, 0.73, 0.3, 0.13, 0.13])
    simulator = Simulator(cartpole.mj_model, space, cartpole.dt)

    @jax.jit
    def fits(key: jax.Array) -> tuple[jax.Array, jax.Array]:
        k_run, k_noise, _ = jax.random.split(key, 3)
        model = simulator.model(space.to_si(truth))
        runs = rollout.collect(
            *(cartpole, model, controller, k_run, 50, cartpole.episode_length)
        )
        pieces = windows(
            rollout.measured(runs, NOISE, k_noise, simulator.configuration), 25, 26
        )
        paired = PairedFit(simulator, space, pieces, NOISE)
        fit = [refine(paired, u) for u in (truth, found)]
        return fit[0].cost[-1], fit[1].cost[-1]

    best, cost = fits(rest)
    assert cost == pytest.approx(float(best), abs=3.0)


# Two masses that swing ten times in a piece, with dry friction.
_MASSES = """
<mujoco>
  <option timestep="0.01" integrator="implicitfast"/>
  <worldbody>
    <body>
      <joint name="a" type="slide" stiffness="400" damping=".4" frictionloss="3"/>
      <geom type="box" size=".1 .1 .1" mass="1"/>
      <body>
        <joint name="b" type="slide" stiffness="900" damping=".6" frictionloss="2"/>
        <geom type="box" size=".1 .1 .1" mass="1"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="push" joint="a"/></actuator>
</mujoco>
"""

_KINDS = ("stiffness", "damping", "frictionloss")
_WRONG = (1.64, -0.45, 0.25, -2.36, 1.27, 0.19)


@pytest.mark.slow
def test_a_short_first_stage_leads_past_wrong_minima() -> None:
    """Over many swings the error has a minimum for each number of swings."""
    m = mujoco.MjModel.from_xml_string(_MASSES)
    data, rng = mujoco.MjData(m), np.random.default_rng(0)
    ctrl = np.repeat(30 * rng.normal(size=(120, 1)), 5, 0)
    qpos, qvel = np.zeros((2, 600, 2))
    for k, u in enumerate(ctrl):
        qpos[k], qvel[k], data.ctrl[:] = data.qpos, data.qvel, u
        mujoco.mj_step(m, data)
    names = [f"joint.{j}.{p}" for j in "ab" for p in _KINDS]
    space = ParameterSpace(tuple(declare(m, n, n) for n in names))
    simulator = Simulator(m, space, 0.01)
    found = cut(qpos, qvel, ctrl, 150, 30, simulator.past_steps)
    assert found is not None
    pieces = to_device(found)
    noise = jnp.array([1e-4, 1e-4, 1e-3, 1e-3])

    @jax.jit
    def run(unit: jax.Array, near: bool) -> RefineResult:
        paired = PairedFit(simulator, space, pieces, noise, free_starts=False)
        return refine(paired, unit, near=near)

    wrong = space.to_unit(jnp.asarray(space.nominal * np.exp(_WRONG)))
    errors = []
    for near in (True, False):
        out = run(wrong, near)
        ratio = np.asarray(space.to_si(out.unit)) / space.nominal
        errors.append(np.abs(np.log(ratio)).max())
    assert errors[0] > 0.5
    assert errors[1] < 1e-3
