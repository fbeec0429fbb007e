"""Searches that minimize the error of open-loop predictions of the logs."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp

from easi_jax.baselines.task import Budget, Identified, Task
from easi_jax.data.segments import Segments, windows
from easi_jax.devices.mesh import sharded_map
from easi_jax.devices.runtime import fast_loops
from easi_jax.estimation.pieces import effective_noise
from easi_jax.model.distribution import gaussian
from easi_jax.search.easi import pick
from easi_jax.search.evolution import make_strategy
from easi_jax.simulation import open_loop

GENERATIONS = 60  # that a search needs at least, to get anywhere
_LOST = 1e6  # cost of a simulation that is no longer finite
_ELITE = 0.01  # share of a random search that says how sure it is


@dataclass(frozen=True)
class PairedCmaEs:
    """CMA-ES on the mean squared error of replayed logs.

    The recipe of PACE (Bjelonic et al., 2025): logged commands are replayed
    from logged states by a population of simulations, and CMA-ES minimizes the squared
    error. There the population is thousands on a GPU and the error that of joint
    positions; here the budget decides and errors of positions and velocities count
    in units of their motion. CMA-ES: N. Hansen, arXiv:1604.00772, by evosax. PACE
    restarts nothing, and neither does this.
    """

    population: int = 64
    """Individuals of a generation."""
    pieces: int | None = None
    """Logged pieces that each replays, the same in all generations; not given: as many
    as the budget pays for in `GENERATIONS`, drawn anew from all of them in each."""
    horizon: int = 25
    """Control steps of a piece."""

    def fit(
        self, task: Task, demonstrations: Segments, budget: Budget, key: jax.Array
    ) -> Identified:
        """The last mean and covariance of the strategy."""
        pieces = some_pieces(task, demonstrations, self.horizon, self.pieces)
        piece = self.population * pieces.horizon
        count = affordable(budget, GENERATIONS * piece, pieces, self.pieces)
        each = piece * count
        rounds = budget.rounds(each)
        cost = paired_cost(task, pieces, count)
        mean, cov = minimized(task, cost, self.population, rounds, key)
        return Identified(gaussian(task.space, mean, cov), task.space, rounds * each)


@dataclass(frozen=True)
class RandomSearch:
    """Uniform draws from where a search starts; the best by the same error.

    Bergstra and Bengio, JMLR 13, 2012: what any search has to beat. Where the budget
    does not pay for all pieces, the best percent, found on some, are judged on all.
    """

    pieces: int | None = None
    """Logged pieces that each individual replays, the same for all; not given: as many
    as the budget pays for with as many individuals as CMA-ES has."""
    horizon: int = 25
    """Control steps of a piece."""

    def fit(
        self, task: Task, demonstrations: Segments, budget: Budget, key: jax.Array
    ) -> Identified:
        """The best individual, with the spread of the best percent."""
        pieces = some_pieces(task, demonstrations, self.horizon, self.pieces)
        piece = pieces.horizon
        some = affordable(
            budget, GENERATIONS * PairedCmaEs.population * piece, pieces, self.pieces
        )
        count = budget.rounds(some * piece)
        if some < pieces.count:  # the last round is paid for, too
            count = max(2, int(count / (1 + _ELITE * pieces.count / some)))
        kept = max(2, round(_ELITE * count))
        units = jax.random.uniform(key, (count, task.space.size))
        first, all_of = (
            jax.jit(paired_cost(task, pieces, n), compiler_options=fast_loops())
            for n in (some, pieces.count)
        )
        best = units[jnp.argsort(first(units, key))[:kept]]
        simulated = count * some * piece
        if some < pieces.count:
            best = best[jnp.argsort(all_of(best, key))]
            simulated += kept * pieces.count * piece
        cov = jnp.cov(best, rowvar=False).reshape(task.space.size, task.space.size)
        return Identified(gaussian(task.space, best[0], cov), task.space, simulated)


def some_pieces(
    task: Task, demonstrations: Segments, horizon: int, count: int | None = None
) -> Segments:
    """At most ``count`` pieces at even distances, all of them where not given, of at
    most a trajectory's length."""
    steps = min(horizon, demonstrations.weight.shape[1])
    found = windows(demonstrations, steps, steps, task.simulator.past_steps)
    return found.spread(count) if count and count < found.count else found


def affordable(budget: Budget, piece: int, pieces: Segments, given: int | None) -> int:
    """How many of the ``pieces`` a method replays at once: all of them where a number
    was ``given``, else as many as the budget pays for where each costs ``piece``
    control steps in all."""
    paid = max(1, budget.simulated // piece)
    return min(paid, pieces.count) if given is None else pieces.count


def paid_pieces(
    task: Task,
    demonstrations: Segments,
    horizon: int,
    given: int | None,
    budget: Budget,
    times: int,
) -> Segments:
    """Pieces at even distances that a method replays throughout: as many as ``given``
    or, where not, as the budget pays for with ``times`` simulations of each."""
    every = some_pieces(task, demonstrations, horizon, given)
    count = affordable(budget, times * every.horizon, every, given)
    return some_pieces(task, demonstrations, horizon, count)


def channel_scale(task: Task, pieces: Segments) -> jax.Array:
    """RMS motion of each channel or, where that is more, its noise, ``(2 nv,)``."""
    w = pieces.weight[:, None, None]
    total = jnp.maximum(w.sum() * pieces.horizon, 1.0)
    moved = open_loop.motion(task.simulator, pieces)
    rms = jnp.sqrt((w * moved**2).sum((0, 1)) / total)
    noise = effective_noise(task.simulator, pieces, jnp.asarray(task.noise))
    return jnp.maximum(rms, noise)


def paired_cost(
    task: Task, pieces: Segments, count: int
) -> Callable[[jax.Array, jax.Array], jax.Array]:
    """``cost(population (P, n), key) -> (P,)``, pure: mean squared error of predictions
    of ``count`` pieces, drawn by the key where there are more, each channel in units of
    `channel_scale`; `_LOST` where a simulation is not finite."""
    simulator, space = task.simulator, task.space
    scale = channel_scale(task, pieces)

    def costs(population: jax.Array, pieces: Segments) -> jax.Array:
        w = pieces.weight[:, None, None]
        total = jnp.maximum(w.sum() * pieces.horizon, 1.0)

        def one(unit: jax.Array) -> jax.Array:
            error = open_loop.errors(
                simulator, simulator.model(space.to_si(unit)), pieces
            )
            value = (w * (error / scale) ** 2).sum() / (total * scale.shape[0])
            return jnp.where(jnp.isfinite(value), value, _LOST)

        return jax.lax.map(
            one, population, batch_size=max(1, simulator.batch // pieces.count)
        )

    def cost(population: jax.Array, key: jax.Array) -> jax.Array:
        return sharded_map(costs, task.mesh, population, drawn(pieces, count, key))

    return cost


def drawn(pieces: Segments, count: int, key: jax.Array) -> Segments:
    """``count`` of the pieces that count, all of them where there are no more."""
    if count >= pieces.count:
        return pieces
    return pieces.take(pick(key, pieces.weight, count))


def minimized(
    task: Task,
    cost: Callable[..., jax.Array],
    population: int,
    rounds: int,
    key: jax.Array,
    start: tuple[jax.Array, jax.Array] | None = None,
) -> tuple[jax.Array, jax.Array]:
    """CMA-ES in unit coordinates, clipped to the physical bounds.

    Args:
        cost: ``cost(population (P, n), key) -> (P,)``; a key a generation.
        start: mean and standard deviation ``(m,)``; the task's where not given.

    Returns:
        Mean and covariance at the end.
    """
    mean, std = start or (task.start_mean, task.start_std)
    strategy = make_strategy("CMA_ES", population, len(mean))
    low, high = task.space.unit_bounds
    clip = len(mean) == task.space.size

    def step(carry: Any, k: jax.Array) -> Any:
        state, _ = carry
        k_ask, k_tell = jax.random.split(k)
        raw, state = strategy.ask(k_ask, state)
        inside = jnp.clip(raw, low, high) if clip else raw
        # A gentle slope back inside: clipped individuals are not as good as they seem.
        costs = cost(inside, jax.random.fold_in(k, 1))
        costs += ((raw - inside) ** 2).sum(-1)
        state = strategy.tell(k_tell, raw, costs, state)
        return (state, strategy.moments(state, raw, costs)), None

    def run(key: jax.Array) -> Any:
        k_init, k_run = jax.random.split(key)
        first = (strategy.init(k_init, mean, std), (mean, jnp.diag(std**2)))
        (_, found), _ = jax.lax.scan(step, first, jax.random.split(k_run, rounds))
        return found

    mean, cov = jax.jit(run, compiler_options=fast_loops())(key)
    return (jnp.clip(mean, low, high) if clip else mean), cov
