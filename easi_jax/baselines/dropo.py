"""DROPO: the distribution under which logged next states are likeliest."""

from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp

from easi_jax.baselines.replay_cma_es import (
    GENERATIONS,
    affordable,
    drawn,
    minimized,
    some_pieces,
)
from easi_jax.baselines.task import Budget, Identified, Task
from easi_jax.data.segments import Segments
from easi_jax.devices.mesh import sharded_map
from easi_jax.estimation.pieces import effective_noise
from easi_jax.model.distribution import gaussian
from easi_jax.simulation import open_loop

_LEAST = -4.0  # log of the smallest spread, in initial ranges
_FAR = 1e8


@dataclass(frozen=True)
class Dropo:
    """DROPO (Tiboni et al., Robotics and Autonomous Systems 166, 2023).

    For each logged transition K models are drawn from a Gaussian with diagonal
    covariance; the next states that they predict are fitted by a Gaussian of their own,
    widened by epsilon, whose likelihood of the logged next state is maximized by CMA-ES
    over means and standard deviations. As published: K = 10, epsilon = 1e-5 on the
    diagonal of standardized states, one set of transitions, no policy. Here epsilon is
    not below the sensors' noise.
    """

    population: int = 20
    """Individuals of a generation of CMA-ES."""
    samples: int = 10
    """K: models drawn for each individual."""
    transitions: int | None = None
    """Logged transitions that each predicts, the same in all generations as published;
    not given: as many as the budget pays for in `GENERATIONS`, drawn anew from all of
    them in each."""
    horizon: int = 1
    """Control steps of a transition."""
    epsilon: float = 1e-5
    """Added to the variance of what is predicted, in units of the motion."""

    def fit(
        self, task: Task, demonstrations: Segments, budget: Budget, key: jax.Array
    ) -> Identified:
        """The Gaussian that CMA-ES ends at."""
        n = task.space.size
        pieces = some_pieces(task, demonstrations, self.horizon, self.transitions)
        piece = self.population * self.samples * pieces.horizon
        count = affordable(budget, GENERATIONS * piece, pieces, self.transitions)
        each = piece * count
        rounds = budget.rounds(each)
        k_draw, k_run = jax.random.split(key)
        # The same draws for everybody: differences are then the individuals' own.
        draws = jax.random.normal(k_draw, (self.samples, n))
        start = (
            jnp.r_[task.start_mean, jnp.log(task.start_std)],
            jnp.r_[task.start_std, jnp.full(n, 1.0)],
        )
        mean, _ = minimized(
            task,
            self._cost(task, pieces, count, draws),
            self.population,
            rounds,
            k_run,
            start,
        )
        low, high = task.space.unit_bounds
        center, log_std = jnp.clip(mean[:n], low, high), _bounded(mean[n:])
        cov = jnp.diag(jnp.exp(2 * log_std))
        return Identified(gaussian(task.space, center, cov), task.space, rounds * each)

    def _cost(
        self, task: Task, pieces: Segments, count: int, draws: jax.Array
    ) -> Callable[[jax.Array, jax.Array], jax.Array]:
        """Negative log likelihood per transition of individuals ``(P, 2 n)``."""
        simulator, space, n = task.simulator, task.space, task.space.size
        low, high = space.unit_bounds
        moved = open_loop.motion(simulator, pieces)[:, -1]
        w = pieces.weight / jnp.maximum(pieces.weight.sum(), 1.0)
        rms = jnp.sqrt(w @ moved**2)
        noise = effective_noise(simulator, pieces, jnp.asarray(task.noise))
        scale = jnp.maximum(rms, noise)
        least = jnp.diag(jnp.maximum(self.epsilon, (noise / scale) ** 2))

        def costs(some: jax.Array, pieces: Segments) -> jax.Array:
            w = pieces.weight / jnp.maximum(pieces.weight.sum(), 1.0)

            def one(item: jax.Array) -> jax.Array:
                z = item[:n] + jnp.exp(_bounded(item[n:])) * draws

                def errors(unit: jax.Array) -> jax.Array:
                    model = simulator.model(space.to_si(jnp.clip(unit, low, high)))
                    return open_loop.errors(simulator, model, pieces)[:, -1] / scale

                got = jax.lax.map(
                    errors, z, batch_size=max(1, simulator.batch // pieces.count)
                )
                mid = got.mean(0)
                apart = got - mid
                cov = jnp.einsum("kmi,kmj->mij", apart, apart) / (len(draws) - 1)
                root = jnp.linalg.cholesky(cov + least)
                white = jax.scipy.linalg.solve_triangular(
                    root, mid[..., None], lower=True
                )[..., 0]
                half_log = jnp.log(jnp.diagonal(root, axis1=1, axis2=2)).sum(-1)
                value = w @ (0.5 * (white**2).sum(-1) + half_log)
                return jnp.where(jnp.isfinite(value), value, _FAR)

            return jax.lax.map(one, some)

        def cost(x: jax.Array, key: jax.Array) -> jax.Array:
            outside = (jnp.clip(x[:, :n], low, high) - x[:, :n]) ** 2
            some = drawn(pieces, count, key)
            return sharded_map(costs, task.mesh, x, some) + outside.sum(-1)

        return cost


def _bounded(log_std: jax.Array) -> jax.Array:
    return jnp.clip(log_std, _LEAST, 0.0)
