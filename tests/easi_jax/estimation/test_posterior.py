"""The covariance of a result: single precision must not pass for knowledge."""

from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from easi_jax.data.segments import Segments
from easi_jax.estimation.identifiability import identifiability, seed_result
from easi_jax.estimation.levenberg_marquardt import RefineResult
from easi_jax.estimation.normal_equations import PairedFit
from easi_jax.estimation.pieces import finish_pieces, finish_rest
from easi_jax.estimation.posterior import _inverse, _near_zero, _posterior, _stated
from easi_jax.model.parameters import Parameter, ParameterSpace
from envs import make

PRIOR = 12.0 * np.eye(11)


def rows(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Sensitivities over 4.5 decades that two directions do not enter, and those."""
    rows = rng.normal(size=(400, 11)) * 10.0 ** rng.uniform(0, 4.5, 11)
    common = np.r_[0.0, np.ones(9), 0.0]
    trade = np.zeros(11)
    trade[[0, 1, 5, 2]] = 1.0, -1.0, -0.6, 0.33
    null = np.linalg.qr(np.stack([common, trade], 1))[0]
    return rows - rows @ null @ null.T, null


def along_what_is_shown(j: np.ndarray) -> np.ndarray:
    """Variances with all other directions held, in double precision."""
    info = j.T @ j
    size = np.sqrt(np.maximum(np.diag(info), 12.0))
    values, vectors = np.linalg.eigh(info / size[:, None] / size)
    basis = vectors[:, values > 1e-5] / size[:, None]
    return np.diag(basis @ np.linalg.inv(basis.T @ (info + PRIOR) @ basis) @ basis.T)


def test_what_no_data_determine_keeps_the_initial_spread() -> None:
    for seed in range(5):
        j, null = rows(np.random.default_rng(seed))
        # Rounded once: how single precision sums depends on the processor.
        info = (j.T @ j).astype(np.float32)
        cov, seen, shown = map(np.asarray, jax.jit(_posterior)(jnp.asarray(info)))
        np.testing.assert_allclose(null.T @ cov @ null, np.eye(2) / 12, atol=2e-3)
        assert np.abs(seen @ null).max() < 0.05
        # Nowhere surer than the exact inverse of the exact information.
        exact = np.sqrt(np.diag(np.linalg.inv(j.T @ j + PRIOR)))
        assert (np.sqrt(np.diag(cov)) > 0.97 * exact).all()
        # Those two directions are not in what is shown; the last parameter is.
        assert shown.max() < 0.1 * (np.diag(null @ null.T) / 12).max()
        np.testing.assert_allclose(shown, along_what_is_shown(j), rtol=0.05)
        np.testing.assert_allclose(shown[10], exact[10] ** 2, rtol=0.02)
        assert np.linalg.eigvalsh(cov).min() > -1e-7


def test_what_the_data_determine_is_the_inverse() -> None:
    j = np.random.default_rng(0).normal(size=(400, 11)) * 100
    info = (j.T @ j).astype(np.float32)
    cov, seen, shown = map(np.asarray, _posterior(jnp.asarray(info)))
    np.testing.assert_allclose(shown, np.diag(cov), rtol=1e-5)
    np.testing.assert_allclose(cov, np.linalg.inv(info + PRIOR), rtol=1e-3, atol=1e-11)
    np.testing.assert_allclose(seen, np.eye(11), atol=1e-4)


def test_no_data_leave_the_initial_spread() -> None:
    cov, seen, shown = _posterior(jnp.zeros((3, 3)))
    assert not shown.any()
    np.testing.assert_allclose(cov, np.eye(3) / 12, rtol=1e-6)
    np.testing.assert_allclose(seen, np.zeros((3, 3)), atol=1e-6)


@pytest.mark.parametrize(("shared", "most"), [(0.6, 0.94), (0.99, 0.965)])
def test_regions_cover_values_that_may_be_as_good_as_zero(
    shared: float, most: float
) -> None:
    """Two values known by noisy linear readings: one about as large as its standard
    deviation, which the best fit puts at zero in a sixth of the cases. The other is
    known the better the more is known of the first."""
    low = np.array([1.0, 100.0])
    space = ParameterSpace(
        tuple(
            Parameter(f"p{i}", (f"joint.j{i}.damping",), x, (x, 9 * x), (1e-9, 1e9))
            for i, x in enumerate(low)
        )
    )
    information = np.array([[1.0, shared], [shared, 1.0]]) / 1.5**2
    information *= (1 - 0.6**2) / (1 - shared**2)
    rng, count = np.random.default_rng(0), 3000
    draws = np.stack([rng.uniform(0, 0.6, count), rng.uniform(size=count)], 1)
    truth = low * 9.0**draws
    spread = np.linalg.inv(information)
    fitted = truth + rng.multivariate_normal(np.zeros(2), spread, count)
    # The best fit where the first is at its bound.
    short = 1e-6 - fitted[:, 0]
    follow = np.stack([np.ones(count), np.full(count, spread[1, 0] / spread[0, 0])], 1)
    fitted = np.where(short[:, None] > 0, fitted + short[:, None] * follow, fitted)
    unit = jnp.asarray(np.log(fitted / low) / np.log(9.0), jnp.float32)
    raised = unit.clip(0.0)

    def seen(u: jax.Array) -> jax.Array:
        slope = space.to_si(u) * space.log_width
        return slope[:, None] * slope * jnp.asarray(information, jnp.float32)

    def state(u: jax.Array, r: jax.Array) -> tuple[jax.Array, jax.Array]:
        return _near_zero(space, u, r, *_posterior(seen(r)))

    mean, cov = map(np.asarray, jax.jit(jax.vmap(state))(unit, raised))
    off = mean - draws
    assert 0.1 < (short > 0).mean() < 0.3
    inside = np.abs(off) < 1.645 * np.sqrt(cov[:, [0, 1], [0, 1]])
    assert ((inside.mean(0) > 0.87) & (inside.mean(0) < most)).all()
    # Where it is put at zero the other one has to allow for what it may be.
    apart = np.einsum("ki,kij,kj->k", off, np.linalg.inv(cov.astype(float)), off)
    assert 0.9 < (apart[short > 0] < 4.605).mean() < 0.97
    # Not so without: the logarithm of a fit to nothing is anywhere.
    naive = np.asarray(unit) - draws
    here = np.asarray(jax.vmap(lambda u: _posterior(seen(u))[0])(unit))
    assert (np.abs(naive[:, 0]) < 1.645 * np.sqrt(here[:, 0, 0])).mean() < 0.7


def test_regions_cover_what_is_hardly_known() -> None:
    """Values from the initial range, of which a log says about as much as the range:
    about the fit alone the regions would cover too few."""
    names = ("body.a.mass", "body.b.mass", "body.c.mass")
    space = ParameterSpace(
        tuple(
            Parameter(n, (f"joint.{n}.damping",), 1.0, (1.0, 1.5), (1e-9, 1e9))
            for n in names
        )
    )
    rng, count = np.random.default_rng(1), 4000
    root = rng.normal(size=(3, 3)) * 4.0
    information = root @ root.T + 4.0 * np.eye(3)
    truth = rng.uniform(size=(count, 3))
    error = rng.multivariate_normal(np.zeros(3), np.linalg.inv(information), count)
    unit = jnp.asarray(0.5 + truth + error - 0.5, jnp.float32)
    known = _posterior(jnp.asarray(information, jnp.float32))
    state = jax.vmap(lambda u: _near_zero(space, u, u, *known))
    mean, cov = map(np.asarray, state(unit))

    def covered(at: np.ndarray, within: float) -> float:
        off = at - truth
        far = np.einsum("ki,kij,kj->k", off, np.linalg.inv(cov.astype(float)), off)
        return float((far < within).mean())

    half, most = 2.366, 6.251  # quantiles of chi-squared with 3 degrees of freedom
    assert 0.45 < covered(mean, half) < 0.55
    assert 0.87 < covered(mean, most) < 0.93
    assert covered(np.asarray(unit), most) < 0.83
    assert np.abs((mean - truth).mean(0)).max() < 0.02


def test_values_known_by_their_sum_alone_stay_finite() -> None:
    """Of three weak values single precision sees two: a plain solve gives NaN."""
    rng = np.random.default_rng(3)
    for _ in range(20):
        half = rng.normal(size=(3, 2)).astype(np.float32)
        cov = jnp.asarray(half @ half.T)
        std = jnp.sqrt(jnp.diag(cov))
        x = jnp.asarray(half @ rng.normal(size=2).astype(np.float32))
        got = _inverse(cov, std) @ x
        assert np.isfinite(got).all()
        np.testing.assert_allclose(cov @ got, x, atol=2e-3 * np.abs(x).max())


def test_what_is_hardly_known_stays_within_reach() -> None:
    """By data of any condition, from any end of a fit."""
    places = [
        Parameter(n, (f"joint.{n}.damping",), 1.0, (0.3, 3.0), (1e-3, 1e3))
        for n in "abcdef"
    ]
    space, rng = ParameterSpace(tuple(places)), np.random.default_rng(0)
    low, high = (np.asarray(edge) for edge in space.unit_bounds)

    def stated(unit: jax.Array, hessian: jax.Array) -> tuple[jax.Array, jax.Array]:
        known = _posterior(hessian)
        return _near_zero(space, unit, jnp.maximum(unit, 0.0), *known)

    many = 400
    j = rng.normal(size=(many, 6, 6)) * 10.0 ** rng.uniform(-3, 2.5, (many, 6, 1))
    unit = rng.uniform(low, high, (many, 6))
    given = jnp.asarray(unit, jnp.float32), jnp.asarray(np.swapaxes(j, 1, 2) @ j)
    mean, cov = map(np.asarray, jax.jit(jax.vmap(stated))(*given))
    std = np.sqrt(np.diagonal(cov, axis1=1, axis2=2))
    assert np.isfinite(mean).all() and (std < 2.0).all()
    # What is stated lies within bounds, wherever that led.
    paired = PairedFit(cast(Any, None), space, cast(Any, None), jnp.ones(2))
    fit = RefineResult(*([jnp.zeros(6)] * len(RefineResult.__dataclass_fields__)))
    for center, spread in zip(mean[:20], cov[:20], strict=True):
        found = _stated(paired, fit, jnp.eye(6), center, spread)
        assert (found.distribution.mean >= low).all()
        assert (found.distribution.mean <= high).all()
    assert (mean > high).any() or (mean < low).any()


@pytest.mark.parametrize(
    ("share", "flag"), [(0.1, "determined"), (3.0, "not determined")]
)
def test_what_is_surely_far_below_its_range_is_determined(
    share: float, flag: str
) -> None:
    """Of friction that is not there logarithms know nothing; ``share``: its deviation
    over the low end of its initial range."""
    p = Parameter("dry", ("joint.a.frictionloss",), 1.0, (0.1, 10.0), (0.0, 1e3))
    space = ParameterSpace((p,))
    assert space.log.all()
    width, unit = float(space.log_width[0]), jnp.full(1, -2.0)
    low_end = jnp.full((1, 1), (width / share) ** 2)
    here = low_end * np.exp(2 * width * float(unit[0]))
    none = {k: jnp.zeros(1) for k in RefineResult.__dataclass_fields__}
    raised = {"raised": 0.0 * unit, "raised_hessian": low_end}
    fit = RefineResult(**{**none, "unit": unit, "hessian": here, **raised})
    paired = PairedFit(cast(Any, None), space, cast(Any, None), jnp.ones(2))
    found = _stated(paired, fit, jnp.eye(1), unit, 1e-4 * jnp.eye(1))
    told = seed_result(space, unit, 1e-4 * np.eye(1), found.hessian)
    assert told.flags == [flag]
    assert not identifiability(space, np.asarray(here)).determined.any()


@pytest.mark.parametrize(
    ("robot", "count", "steps", "singles"),
    [("cartpole", 56, 25, 1600), ("ant", 64, 15, 64 * 15)],
)
def test_pieces_of_the_finish_suit_the_robot(
    robot: str, count: int, steps: int, singles: int
) -> None:
    """A large robot's finish would take hours with every step of 200 trajectories."""
    simulator = make(robot).simulator
    model = simulator.mj_model
    shape, following = (8, 200), (8, 200, 1)
    demos = Segments(
        qpos=jnp.zeros((*shape, model.nq)),
        qvel=jnp.zeros((*shape, model.nv)),
        ctrl=jnp.zeros((*following, model.nu)),
        next_qpos=jnp.zeros((*following, model.nq)),
        next_qvel=jnp.zeros((*following, model.nv)),
        weight=jnp.ones(shape),
    )
    found = finish_pieces(simulator, demos)
    assert (found.count, found.horizon) == (count, steps)
    assert float(found.weight.sum()) == count
    told = finish_pieces(simulator, demos, 10, 7)
    assert (told.count, told.horizon) == (7, 10)
    assert finish_pieces(simulator, demos, 300).horizon == 200
    # Single transitions, as where nothing is known of what came before.
    single = jax.tree.map(lambda x: x.reshape(1600, 1, *x.shape[2:]), demos)
    assert finish_pieces(simulator, single).count == singles
    # A larger robot's noisy recording counts as a whole in the end.
    rest = finish_rest(simulator, demos, noisy=True)
    assert (rest is None) == (robot == "cartpole")
    if rest is not None:
        assert rest.horizon == steps and count < rest.count <= 10 * count
    assert finish_rest(simulator, demos, noisy=False) is None
    assert finish_rest(simulator, demos, True, 10, 7) is None
