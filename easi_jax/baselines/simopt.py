"""SimOpt: policies and the simulator's distribution in turns."""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp

from easi_jax.baselines.task import Budget, Identified, Task
from easi_jax.data.segments import Segments
from easi_jax.devices.mesh import sharded_map
from easi_jax.devices.runtime import fast_loops
from easi_jax.model.distribution import gaussian
from easi_jax.simulation.rollout import policy_rollout

_TEMPERATURES = (-6.0, 6.0, 200)  # log range and number, in spreads of the cost
_FAR = 1e6


@dataclass(frozen=True)
class SimOpt:
    """SimOpt (Chebotar et al., ICRA 2019, arXiv:1810.05687).

    A policy is trained under the current Gaussian and run on the real machine; the
    Gaussian then moves, by relative entropy policy search with a bound on the KL
    divergence, to models under which the same policy's trajectories look like those
    measured. Discrepancy of two trajectories: 0.5 times the L1 and 1 times the squared
    L2 distance of observations, after a Gaussian filter over time of 5 steps
    (truncated at 4 deviations); KL bound 1.0, temperature at least 0.001 (of the
    costs' spread), 3 updates for each policy. Observations are in units of their
    spread. The first policy is the one that recorded the demonstrations.
    """

    iterations: int = 3
    """Policies, the first included."""
    updates: int = 3
    """Updates of the distribution for each."""
    trajectories: int = 20
    """Real trajectories of each policy."""
    l1: float = 0.5
    l2: float = 1.0
    smoothing: float = 5.0
    """Standard deviation of the filter, in control steps; 0: none."""
    kl_bound: float = 1.0
    """Largest KL divergence of an update."""
    least_temperature: float = 1e-3

    def fit(
        self, task: Task, demonstrations: Segments, budget: Budget, key: jax.Array
    ) -> Identified:
        """The Gaussian after the last update.

        Raises:
            ValueError: the task has no environment, no training or no real machine to
                record more of.
        """
        if task.env is None or task.train is None or task.record is None:
            raise ValueError("SimOpt needs env, train and record")
        del demonstrations  # it records its own, of each of its policies
        space, steps = task.space, task.env.episode_length
        each = self.trajectories * steps
        rounds = self.iterations * self.updates
        count = budget.rounds(each * rounds)
        mean, cov = task.start_mean, jnp.diag(task.start_std**2)
        update = jax.jit(
            lambda m, c, policy, real, keys, k: self._updated(
                task, m, c, policy, real, keys, k, count
            ),
            compiler_options=fast_loops(),
        )
        policy, measured = task.policy, 0
        for i in range(self.iterations):
            k_train, k_real, k_update = jax.random.split(jax.random.fold_in(key, i), 3)
            if i:
                policy = task.train(space, gaussian(space, mean, cov), k_train)
            resets = jax.random.split(k_real, self.trajectories)
            real = task.record(policy, resets)
            measured += int(real.weight.sum())
            for k in jax.random.split(k_update, self.updates):
                mean, cov = update(mean, cov, policy, real, resets, k)
        simulated = rounds * count * each
        return Identified(gaussian(space, mean, cov), space, simulated, measured)

    def _updated(
        self,
        task: Task,
        mean: jax.Array,
        cov: jax.Array,
        policy: Any,
        real: Segments,
        resets: jax.Array,
        key: jax.Array,
        count: int,
    ) -> tuple[jax.Array, jax.Array]:
        """One step of REPS with ``count`` samples."""
        low, high = task.space.unit_bounds
        values, vectors = jnp.linalg.eigh(cov)
        root = vectors * jnp.sqrt(jnp.maximum(values, 0.0))
        z = jax.random.normal(key, (count, len(mean)))
        drawn = jnp.clip(mean + z @ root.T, low, high)
        cost = self._discrepancies(task, drawn, policy, real, resets)
        w = reps_weights(cost, self.kl_bound, self.least_temperature)
        mean = w @ drawn
        apart = drawn - mean
        return mean, (w[:, None] * apart).T @ apart + 1e-8 * jnp.eye(len(mean))

    def _discrepancies(
        self,
        task: Task,
        units: jax.Array,
        policy: Any,
        real: Segments,
        resets: jax.Array,
    ) -> jax.Array:
        """Mean distance of each model's trajectories to the real ones, ``(P,)``."""
        env, simulator = task.env, task.simulator
        act: Any = task.act_best or task.act
        kernel = self._kernel(real.weight.shape[1])
        observed, alive = _states(real)
        spread = jnp.sqrt(
            (alive[..., None] * (observed - observed.mean((0, 1))) ** 2).sum((0, 1))
            / jnp.maximum(alive.sum(), 1.0)
        )
        spread = jnp.where(spread > 1e-9, spread, 1.0)

        def costs(some: jax.Array, shared: Any) -> jax.Array:
            policy, observed, alive, resets = shared

            def one(unit: jax.Array) -> jax.Array:
                model = simulator.model(task.space.to_si(unit))

                def trajectory(key: jax.Array) -> Segments:
                    return policy_rollout(
                        env,
                        model,
                        lambda obs, k: act(policy, obs, k),
                        key,
                        alive.shape[1],
                    )

                simulated, _ = _states(jax.vmap(trajectory)(resets))
                error = (simulated - observed) / spread
                # Beyond the end of a real episode nothing is known.
                error = jnp.where(alive[..., None] > 0, error, 0.0)
                error = jnp.einsum("ts,bsc->btc", kernel, error)
                value = self.l1 * jnp.abs(error).sum() + self.l2 * (error**2).sum()
                value = value / jnp.maximum(alive.sum(), 1.0)
                return jnp.where(jnp.isfinite(value), value, _FAR)

            size = max(1, simulator.batch // resets.shape[0])
            return jax.lax.map(one, some, batch_size=size)

        return sharded_map(costs, task.mesh, units, (policy, observed, alive, resets))

    def _kernel(self, steps: int) -> jax.Array:
        """The filter as a matrix ``(T, T)`` with rows that sum to one."""
        if not self.smoothing:
            return jnp.eye(steps)
        apart = jnp.arange(steps)[:, None] - jnp.arange(steps)
        weight = jnp.exp(-0.5 * (apart / self.smoothing) ** 2)
        weight = jnp.where(jnp.abs(apart) <= 4 * self.smoothing, weight, 0.0)
        return weight / weight.sum(1, keepdims=True)


def _states(t: Segments) -> tuple[jax.Array, jax.Array]:
    """Measured states after each step ``(B, T, nq + nv)``, and which count."""
    return jnp.concatenate([t.next_qpos[:, :, 0], t.next_qvel[:, :, 0]], -1), t.weight


def reps_weights(
    cost: jax.Array, kl_bound: float, least_temperature: float
) -> jax.Array:
    """Weights ``(P,)`` of relative entropy policy search (Peters et al., AAAI 2010).

    ``w ~ exp(-cost / temperature)``, with the temperature that minimizes the dual
    ``temperature (kl_bound + log mean exp(-cost / temperature))``.
    """
    scale = jnp.maximum(jnp.std(cost), 1e-12)
    shifted = (cost - cost.min()) / scale
    low, high, number = _TEMPERATURES
    grid = jnp.exp(jnp.linspace(low, high, number))
    grid = jnp.maximum(grid, least_temperature)

    def dual(t: jax.Array) -> jax.Array:
        mean = jax.scipy.special.logsumexp(-shifted / t) - jnp.log(len(cost))
        return t * (kl_bound + mean)

    best = grid[jnp.argmin(jax.vmap(dual)(grid))]
    return jax.nn.softmax(-shifted / best)
