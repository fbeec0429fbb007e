"""The posterior of a neural network that has seen many simulations."""

import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from easi_jax.baselines.replay_cma_es import paid_pieces
from easi_jax.baselines.task import Budget, Identified, Task
from easi_jax.data.segments import Segments
from easi_jax.devices.mesh import sharded_map
from easi_jax.devices.runtime import fast_loops
from easi_jax.errors import UserError
from easi_jax.model.distribution import gaussian
from easi_jax.simulation import open_loop
from easi_jax.simulation.simulator import Simulator

_ENOUGH = 1500  # simulations that a flow of a dozen parameters needs
_LEAST = 100  # simulations that are worth training on
_PROCESS = Path(__file__).with_name("_npe_process.py")


@dataclass(frozen=True)
class NeuralPosterior:
    """Neural posterior estimation with BayesSim's summary, trained by ``sbi``.

    Papamakarios and Murray, NeurIPS 2016; Greenberg et al., ICML 2019 (one round);
    summary of a trajectory: Ramos et al., BayesSim, RSS 2019 (`summary`). A flow learns
    p(parameters | summary) from simulations under draws of the prior, and is asked for
    the summary of the logs. As published but for two things: simulations replay logged
    commands from logged states, as all methods here can, in place of a policy; and the
    prior is a Gaussian with the mean and spread of where a search starts, which has no
    edge where the truth lies outside. Sensor noise is added to what is simulated.

    The network is trained in a process of its own: torch and jax do not share one well.
    """

    pieces: int | None = None
    """Logged pieces that each simulation replays; not given: as many as the budget pays
    for with 1,500 simulations."""
    horizon: int = 25
    """Control steps of a piece."""
    density: str = "maf"
    """Density estimator, by its name in sbi."""
    samples: int = 10_000
    """Of the posterior, for its mean and covariance."""
    time_limit: float = 3600.0
    """Of the training [s]."""

    def fit(
        self, task: Task, demonstrations: Segments, budget: Budget, key: jax.Array
    ) -> Identified:
        """Mean and covariance of the posterior.

        Raises:
            UserError: sbi is missing, hardly a simulation is finite, or training takes
                longer than it may.
        """
        if find_spec("sbi") is None:
            raise UserError("sbi is missing: pip install easi-jax[peers]")
        chosen = demonstrations, self.horizon, self.pieces
        pieces = paid_pieces(task, *chosen, budget, _ENOUGH)
        each = pieces.count * pieces.horizon
        count = _LEAST * budget.rounds(_LEAST * each)
        k_draw, k_noise, k_train = jax.random.split(key, 3)
        z = jax.random.normal(k_draw, (count, task.space.size))
        low, high = task.space.unit_bounds
        units = jnp.clip(task.start_mean + task.start_std * z, low, high)
        simulate = jax.jit(simulated(task, pieces), compiler_options=fast_loops())
        found = np.asarray(simulate(units, jax.random.split(k_noise, count)))
        states = pieces.next_qpos, pieces.next_qvel
        zero = jnp.zeros((*states[1].shape[:2], 2 * task.simulator.mj_model.nv))
        observed = np.asarray(summary(task.simulator, pieces, *states, zero))
        good = np.isfinite(found).all(1)
        if good.sum() < _LEAST:
            raise UserError(
                f"of {count} simulations {good.sum()} stayed finite: too few for NPE"
            )
        told = np.ptp(found[good], axis=0) > 0
        mean, cov = self._trained(
            units=np.asarray(units)[good],
            summaries=found[good][:, told],
            observed=observed[told],
            prior_mean=np.asarray(task.start_mean),
            prior_std=np.asarray(task.start_std),
            seed=np.asarray(jax.random.bits(k_train)),
            density=self.density,
            samples=self.samples,
        )
        distribution = gaussian(
            task.space, jnp.clip(jnp.asarray(mean), low, high), jnp.asarray(cov)
        )
        return Identified(distribution, task.space, count * each)

    def _trained(self, **given: object) -> tuple[np.ndarray, np.ndarray]:
        """Mean and covariance, from a process that has torch."""
        with tempfile.TemporaryDirectory() as folder:
            source, target = Path(folder, "in.npz"), Path(folder, "out.npz")
            np.savez(source, **given)  # type: ignore[arg-type]
            # -P: the folder of this module is no place to import from.
            words = [sys.executable, "-P", str(_PROCESS), str(source), str(target)]
            try:
                done = subprocess.run(
                    words,
                    cwd=folder,
                    timeout=self.time_limit,
                    capture_output=True,
                    text=True,
                )
            except subprocess.TimeoutExpired:
                raise UserError(
                    f"sbi was not done within {self.time_limit:g} s: raise time_limit, "
                    "or give a smaller budget"
                ) from None
            if done.returncode:
                last = done.stderr.strip().splitlines()[-1:] or ["no message"]
                raise RuntimeError(f"sbi failed: {last[0]}")
            with np.load(target) as out:
                return out["mean"].astype(np.float32), out["cov"].astype(np.float32)


def simulated(
    task: Task, pieces: Segments
) -> Callable[[jax.Array, jax.Array], jax.Array]:
    """``f(units (P, n), keys (P,)) -> (P, F)``, pure: summaries of noisy replays."""
    simulator, space = task.simulator, task.space
    noise = jnp.asarray(task.noise)

    def summaries(given: tuple[jax.Array, jax.Array], pieces: Segments) -> jax.Array:
        def one(item: tuple[jax.Array, jax.Array]) -> jax.Array:
            unit, key = item
            model = simulator.model(space.to_si(unit))
            qpos, qvel = open_loop.predict(simulator, model, pieces)
            z = jax.random.normal(key, (*qvel.shape[:2], len(noise)))
            return summary(simulator, pieces, qpos, qvel, noise * z)

        size = max(1, simulator.batch // pieces.count)
        return jax.lax.map(one, given, batch_size=size)

    return lambda units, keys: sharded_map(summaries, task.mesh, (units, keys), pieces)


def summary(
    simulator: Simulator,
    pieces: Segments,
    qpos: jax.Array,
    qvel: jax.Array,
    noise: jax.Array,
) -> jax.Array:
    """BayesSim's summary of trajectories, ``(2 nv nu + 4 nv,)``.

    With d the change of a state in a step and a the command of that step: the mean of
    every product d_i a_j, the mean and the variance of d (Ramos et al., RSS 2019,
    section IV.A), over all steps of all pieces that count.

    Args:
        pieces: starts and commands.
        qpos, qvel: states after each step, ``(M, H, nq)``, ``(M, H, nv)``.
        noise: added to them, tangent vectors ``(M, H, 2 nv)``.
    """
    before = (
        jnp.concatenate([pieces.qpos[:, None], qpos[:, :-1]], 1),
        jnp.concatenate([pieces.qvel[:, None], qvel[:, :-1]], 1),
    )
    difference = jax.vmap(jax.vmap(simulator.difference))
    moved = difference(*before, qpos, qvel)
    # The start has its noise already.
    moved = moved + noise - jnp.pad(noise[:, :-1], ((0, 0), (1, 0), (0, 0)))
    w = jnp.broadcast_to(pieces.weight[:, None], moved.shape[:2])
    w = w / jnp.maximum(w.sum(), 1e-9)
    product = jnp.einsum("mh,mhi,mhj->ij", w, moved, pieces.ctrl)
    mean = jnp.einsum("mh,mhi->i", w, moved)
    variance = jnp.einsum("mh,mhi->i", w, (moved - mean) ** 2)
    return jnp.concatenate([product.reshape(-1), mean, variance])
