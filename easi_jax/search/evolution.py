"""Evolution strategies by name, over evosax, and EASI's own (mu/mu_I, lambda).

A strategy minimizes in the unit cube of a `ParameterSpace`. Its state is a pytree;
`ask`, `tell` and `moments` are pure.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from evosax.algorithms import algorithms
from evosax.algorithms.distribution_based.base import DistributionBasedAlgorithm
from evosax.algorithms.distribution_based.simple_es import SimpleES

from easi_jax.errors import UserError, nearest

MU_LAMBDA = "mu_lambda"
_LEFT_OUT = {
    "PersistentES": "unrolls truncated inner problems, which a simulation is not",
    "NoiseReuseES": "unrolls truncated inner problems, which a simulation is not",
    "SV_CMA_ES": "keeps several populations apart; with a search's one it is CMA_ES",
    "SV_Open_ES": "keeps several populations apart; with a search's one it is Open_ES",
}
_UNKNOWN = 1e6  # cost of individuals not yet evaluated; inf would spread as NaN


class _MuLambda(SimpleES):
    """SimpleES with the spread measured about the mean of choice.

    About the *old* mean a moving population keeps the spread it needs to get there;
    about the *new* one, as in EASI's reference, it collapses on the way.
    """

    about_new_mean = False

    def _tell(self, key, population, fitness, state, params):  # type: ignore[no-untyped-def]
        new = super()._tell(key, population, fitness, state, params)
        about = new.mean if self.about_new_mean else state.mean
        # Negative weights may leave a variance below zero, which has no root.
        var = jnp.maximum(jnp.dot(fitness, (population - about) ** 2), 0.0)
        std = (1 - params.c_std) * state.std + params.c_std * jnp.sqrt(var)
        if not self.about_new_mean:
            # A discriminator that lags behind a moving mean feeds a spread that
            # grows without end; twice the start is enough to get anywhere.
            std = jnp.minimum(std, 2.0 * params.std_init)
        return new.replace(std=std)


class Strategy(NamedTuple):
    """``init(key, mean, std) -> state``, ``ask(key, state) -> (population, state)``,
    ``tell(key, population, cost, state) -> state`` and
    ``moments(state, population, cost) -> (mean (n,), covariance (n, n))``.

    Populations are ``(N, n)`` in unit coordinates, costs ``(N,)``, lower is better.
    """

    name: str
    init: Callable[..., Any]
    ask: Callable[..., Any]
    tell: Callable[..., Any]
    moments: Callable[..., tuple[jax.Array, jax.Array]]


def names() -> tuple[str, ...]:
    """Every strategy that `make_strategy` accepts."""
    return (MU_LAMBDA, *(n for n in algorithms if n not in _LEFT_OUT))


def recombination_weights(
    population_size: int, elites: int, positive: bool = True
) -> jax.Array:
    """w_i ~ ln(0.5 (lambda + 1)) - ln i over the best ``elites``, summing to one.

    (mu/mu_I, lambda)-ES as in EASI's reference: w_1 = 0.0341 and mu_eff = 78.0 for
    lambda = 300, mu = 150. Those of the worse half of all, which are negative, are zero
    where ``positive``.
    """
    rank = jnp.arange(1, population_size + 1)
    w = jnp.log(0.5 * (population_size + 1)) - jnp.log(rank)
    w = jnp.where(rank <= elites, jnp.maximum(w, 0.0) if positive else w, 0.0)
    return w / w.sum()


def _algorithm(
    name: str,
    population_size: int,
    size: int,
    elite_ratio: float,
    spread_about: str,
    positive: bool,
) -> tuple[Any, Any]:
    """evosax's object and its parameters; arguments as in `make_strategy`."""
    blank = jnp.zeros(size)
    es: Any
    if name == MU_LAMBDA:
        es = _MuLambda(population_size, blank)
        es.about_new_mean = spread_about == "new_mean"
        es.elite_ratio = elite_ratio
        weights = recombination_weights(population_size, es.num_elites, positive)
        base = es.default_params.replace(weights=weights, c_std=1.0)
    elif name == "RandomSearch":
        es = algorithms[name](
            population_size, blank, sampling_fn=lambda k: jax.random.uniform(k, (size,))
        )
        base = es.default_params
    else:
        es = algorithms[name](population_size, blank)
        base = es.default_params
        if name == "LM_MA_ES":  # a rate, made for far more parameters than individuals
            base = base.replace(c_c=jnp.minimum(base.c_c, 1.0))
    return es, base


def make_strategy(
    name: str,
    population_size: int,
    size: int,
    elite_ratio: float = 0.5,
    spread_about: str = "old_mean",
    positive: bool = True,
) -> Strategy:
    """The strategy ``name`` for ``size`` parameters.

    Args:
        name: ``mu_lambda`` or a name of evosax's registry (``CMA_ES``,
            ``Sep_CMA_ES``, ``SNES``, ...).
        elite_ratio: mu / lambda, for ``mu_lambda``.
        spread_about: ``old_mean`` or ``new_mean``, for ``mu_lambda``.
        positive: no weight is negative, for ``mu_lambda``.

    Raises:
        UserError: unknown name, or one that cannot search here, with the reason.
    """
    if name in _LEFT_OUT:
        raise UserError(f"strategy {name} {_LEFT_OUT[name]}; take CMA_ES or mu_lambda")
    if name not in names():
        raise UserError(f'unknown strategy "{name}"{nearest(name, names())}')
    if spread_about not in ("old_mean", "new_mean"):
        raise UserError(f'spread_about is "{spread_about}": old_mean or new_mean')
    es, base = _algorithm(
        name, population_size, size, elite_ratio, spread_about, positive
    )
    population_based = not isinstance(es, DistributionBasedAlgorithm)

    def params_of(std: jax.Array) -> Any:
        # One scalar step size serves strategies that take no vector.
        if not hasattr(base, "std_init"):
            return base
        return base.replace(std_init=std if name == MU_LAMBDA else jnp.mean(std))

    def init(key: jax.Array, mean: jax.Array, std: jax.Array) -> Any:
        params = params_of(std)
        if population_based:
            z = jax.random.normal(key, (population_size, size))
            start = jnp.clip(mean + std * z, 0.0, 1.0)
            unknown = jnp.full((population_size,), _UNKNOWN)
            state = es.init(key, start, unknown, params)
        else:
            state = es.init(key, mean, params)
        return _strong(state), params

    def ask(key: jax.Array, state: Any) -> tuple[jax.Array, Any]:
        inner, params = state
        population, inner = es.ask(key, inner, params)
        return population, (_strong(inner), params)

    def tell(key: jax.Array, population: jax.Array, cost: jax.Array, state: Any) -> Any:
        inner, params = state
        inner, _ = es.tell(key, population, cost, inner, params)
        return _strong(inner), params

    def moments(
        state: Any, population: jax.Array, cost: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        inner, _ = state
        order = jnp.argsort(cost)
        w = recombination_weights(population_size, max(1, population_size // 2))
        elite = population[order]
        mean = getattr(inner, "mean", None)
        if mean is None or mean.shape != (size,):
            mean = w @ elite
        std, cov = getattr(inner, "std", None), getattr(inner, "C", None)
        if cov is not None and cov.shape == (size, size):
            return mean, jnp.square(jnp.asarray(std)) * cov
        if name == MU_LAMBDA:
            return mean, jnp.diag(jnp.square(inner.std))
        centered = elite - w @ elite
        return mean, (w[:, None] * centered).T @ centered

    return Strategy(name, init, ask, tell, moments)


def _strong(tree: Any) -> Any:
    """Arrays throughout, none weakly typed, so that a scan can carry the state."""
    return jax.tree.map(lambda x: jnp.asarray(x, jnp.result_type(x)), tree)
