"""EASI as a method among others."""

from dataclasses import dataclass, field, replace

import jax
import numpy as np

from easi_jax.baselines.task import Budget, Identified, Task
from easi_jax.data.segments import Segments, windows
from easi_jax.devices.runtime import fast_loops
from easi_jax.estimation.posterior import Estimate, finish
from easi_jax.search.config import SearchConfig
from easi_jax.search.easi import Search, SearchData


@dataclass(frozen=True)
class Easi:
    """The adversarial search (EASI, NeurIPS 2024), of either preset.

    Settings and their sources: `easi_jax.search.config.SearchConfig`.
    """

    search: SearchConfig = field(default_factory=SearchConfig)
    """The search; its generations are cut to the budget."""
    refine: bool = False
    """Finish with least squares on the paired data. What that simulates comes on top of
    the budget, and is counted."""
    restarts: int | None = None
    """More starts of it, as in `easi_jax.pipeline.stages.PipelineConfig`."""
    refine_horizon: int | None = None
    """Control steps of a piece there, as in
    `easi_jax.estimation.pieces.finish_pieces`."""
    refine_pieces: int | None = None
    """Pieces at most, as there."""

    def fit(
        self, task: Task, demonstrations: Segments, budget: Budget, key: jax.Array
    ) -> Identified:
        """The result of the search, refined where asked."""
        c = self.search
        replays = c.source == "replay"
        horizon = c.horizon if replays else 1
        past = task.simulator.past_steps
        pieces = windows(demonstrations, horizon, max(1, horizon // 2), past)
        steps = min(c.segments, pieces.count) * horizon if replays else c.rollout_steps
        rounds = min(c.generations, budget.rounds(c.population * steps))
        search = Search(
            task.simulator,
            replace(c, generations=rounds),
            env=task.env,
            act=task.act,
            mesh=task.mesh,
        )
        noise, noisy = task.noise, bool(np.any(np.asarray(task.noise) > 0))

        def found(key: jax.Array, policy: object) -> tuple[jax.Array, ...]:
            data = SearchData(pieces, noise, policy)
            state, info = search.run(search.init(key, data), data, rounds)
            return state.result_mean, state.result_cov, info.mean, info.std

        mean, cov, *trace = jax.jit(found, compiler_options=fast_loops())(
            key, task.policy
        )

        def result(mean: jax.Array, cov: jax.Array, runs: Segments) -> Estimate:
            return finish(
                task.simulator,
                search.space,
                mean,
                cov,
                runs,
                noise,
                noisy,
                self.refine,
                c.informed_spread,
                task.mesh,
                self.restarts,
                self.refine_horizon,
                self.refine_pieces,
            )

        out = jax.jit(result)(mean, cov, demonstrations)
        simulated = rounds * c.population * steps + round(float(out.simulated))
        return Identified(
            out.distribution, search.space, simulated, trace=(trace[0], trace[1])
        )
