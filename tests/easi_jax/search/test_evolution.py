"""Every strategy by name runs here, and those for EASI do what they are for."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from easi_jax.errors import UserError
from easi_jax.search import evolution

SIZE, POPULATION = 3, 16
TARGET = jnp.array([0.2, 0.5, 0.7])


def evolve(
    name: str, generations: int, mean: Any, std: Any, population: int = 16, **more: Any
) -> tuple[Any, Any]:
    """Minimizes the squared distance to TARGET in one scan; stacked moments."""
    es = evolution.make_strategy(name, population, SIZE, **more)

    def run(key: jax.Array) -> Any:
        k_init, key = jax.random.split(key)
        state = es.init(k_init, jnp.asarray(mean), jnp.asarray(std))

        def step(state: Any, k: jax.Array) -> Any:
            k_ask, k_tell = jax.random.split(k)
            x, state = es.ask(k_ask, state)
            cost = jnp.sum((x - TARGET) ** 2, axis=-1)
            state = es.tell(k_tell, x, cost, state)
            return state, (*es.moments(state, x, cost), x)

        return jax.lax.scan(step, state, jax.random.split(key, generations))

    return jax.jit(run)(jax.random.key(0))


# evosax's own use of optax.
@pytest.mark.filterwarnings("ignore:optax.global_norm:DeprecationWarning")
@pytest.mark.parametrize("name", evolution.names())
def test_every_strategy_runs_in_a_scan(name: str) -> None:
    _, (mean, cov, x) = evolve(name, 4, jnp.full(SIZE, 0.5), jnp.full(SIZE, 0.3))
    assert x.shape == (4, POPULATION, SIZE) and mean.shape == (4, SIZE)
    assert cov.shape == (4, SIZE, SIZE)
    for leaf in (mean, cov, x):
        assert np.isfinite(leaf).all()
    np.testing.assert_allclose(cov, np.swapaxes(cov, 1, 2), atol=1e-6)
    assert np.linalg.eigvalsh(np.asarray(cov)).min() > -1e-6
    # Asked again after being told something, it does not give the same answer.
    assert not np.array_equal(x[0], x[-1])


def test_recombination_weights_of_the_reference() -> None:
    w = np.asarray(evolution.recombination_weights(300, 150), np.float64)
    assert w[0] == pytest.approx(0.0341, abs=5e-5)
    assert 1 / np.sum(w**2) == pytest.approx(78.0, abs=0.05)
    assert w.sum() == pytest.approx(1.0, abs=1e-5)
    assert (w[150:] == 0).all() and (np.diff(w[:150]) < 0).all()


def test_mu_lambda_moments_are_the_weighted_ones() -> None:
    es = evolution.make_strategy("mu_lambda", 40, SIZE, spread_about="new_mean")
    old = evolution.make_strategy("mu_lambda", 40, SIZE, spread_about="old_mean")
    rng = np.random.default_rng(0)
    x, cost = rng.normal(size=(40, SIZE)), rng.normal(size=40)
    mean, std = np.array([1.0, 0.0, -1.0]), np.array([0.5, 1.0, 2.0])
    w = np.asarray(evolution.recombination_weights(40, 20))
    best = x[np.argsort(cost)]
    center = w @ best
    for strategy, about in ((es, center), (old, mean)):
        state = strategy.init(jax.random.key(0), jnp.asarray(mean), jnp.asarray(std))
        _, state = strategy.ask(jax.random.key(1), state)
        args = jnp.asarray(x), jnp.asarray(cost)
        state = strategy.tell(jax.random.key(2), *args, state)
        got_mean, got_cov = strategy.moments(state, *args)
        np.testing.assert_allclose(got_mean, center, rtol=1e-4, atol=1e-5)
        variance = w @ (best - about) ** 2
        if about is mean:  # bounded by twice the spread at the start
            variance = np.minimum(variance, (2 * np.asarray(std)) ** 2)
        want = np.diag(variance)
        np.testing.assert_allclose(got_cov, want, rtol=1e-4, atol=1e-6)


START, STD = jnp.array([0.2, 0.5, 0.2]), jnp.full(SIZE, 0.1)  # 5 std off in one


def test_the_old_mean_keeps_the_spread_while_moving() -> None:
    spread, left = {}, {}
    for about in ("old_mean", "new_mean"):
        _, (mean, cov, _) = evolve(
            "mu_lambda", 30, START, STD, population=300, spread_about=about
        )
        spread[about] = np.sqrt(cov[2, 2, 2])
        left[about] = np.abs(mean[-1] - TARGET).max()
    assert spread["old_mean"] > 1.5 * spread["new_mean"]
    assert left["old_mean"] < 1e-3 < 0.05 < left["new_mean"]


def test_cma_es_reaches_a_far_optimum() -> None:
    _, (mean, cov, _) = evolve("CMA_ES", 60, START, STD, population=32)
    assert np.abs(mean[-1] - TARGET).max() < 1e-3
    assert np.sqrt(np.diagonal(cov[-1])).max() < 1e-2


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("CMAES", 'unknown strategy "CMAES".*did you mean "CMA_ES"'),
        ("PersistentES", "unrolls truncated inner problems"),
        ("SV_CMA_ES", "it is CMA_ES"),
    ],
)
def test_names_that_do_not_work_are_explained(name: str, told: str) -> None:
    with pytest.raises(UserError, match=told):
        evolution.make_strategy(name, 16, SIZE)


def test_spread_about_must_be_known() -> None:
    with pytest.raises(UserError, match="middle"):
        evolution.make_strategy("mu_lambda", 16, SIZE, spread_about="middle")
