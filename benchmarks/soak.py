"""Does a process that searches for long hold its memory?

    python -m benchmarks.soak

Many small searches on Cartpole in one process, each with demonstrations and a key of
its own, from data to the estimate on the host, by programs that are compiled once.
About two minutes on two cores; written to ``benchmarks/results/soak.json``.
"""

import dataclasses
import gc
import time
from pathlib import Path
from typing import Any

from benchmarks._common import RESULTS, command_of, wander, write_result
from train._command import main, progress, say


@dataclasses.dataclass(frozen=True)
class Config:
    """Searches many times in one process and watches its memory."""

    searches: int = 2000
    """How many."""
    warm_up: int = 200
    """Searches before memory counts."""
    generations: int = 3
    """Of each search."""
    folder: Path = RESULTS
    """Where the figures go."""


def run(config: Config) -> None:
    """Searches, and writes the memory after each twentieth of them."""
    from easi_jax.errors import UserError

    if not 0 < config.warm_up < config.searches:
        raise UserError("--warm-up must lie between 0 and --searches")
    search = ready(config.generations)
    every = max(1, config.searches // 20)
    begin, megabytes, finite = time.monotonic(), {}, 0
    with progress("searches", config.searches) as shown:
        for k in range(config.searches):
            finite += search(k)
            if k + 1 == config.warm_up or (k + 1) % every == 0:
                megabytes[k + 1] = resident()
            shown.advance(1)
    first, last = megabytes[config.warm_up], megabytes[config.searches]
    path = write_result(
        "soak",
        command_of("benchmarks.soak", config),
        config,
        config.folder,
        seconds=time.monotonic() - begin,
        finite=finite,
        megabytes=megabytes,
        growth_megabytes=last - first,
    )
    say(
        f"{config.searches} searches, {finite} with finite results: memory "
        f"{first:.0f} MB after {config.warm_up}, {last:.0f} MB at the end"
    )
    say(f"written: {path}")


def ready(generations: int) -> Any:
    """A function that searches with a seed; whether all that it found is finite."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    from easi_jax.data.segments import windows
    from easi_jax.estimation.normal_equations import PairedFit
    from easi_jax.estimation.posterior import estimate
    from easi_jax.search.config import preset
    from easi_jax.search.easi import Search, SearchData
    from easi_jax.simulation.rollout import collect, measured
    from envs import make

    env = make("cartpole")
    settings = preset(
        "default",
        generations=generations,
        population=32,
        segments=16,
        horizon=8,
        real_batch=64,
        discriminator_updates=2,
    )
    search = Search(env.simulator, settings)
    noise = jnp.full(2 * env.mj_model.nv, 1e-3)

    @jax.jit
    def one(key: jax.Array) -> Any:
        theta, play, sensors, begin = jax.random.split(key, 4)
        target = env.space.to_si(jax.random.uniform(theta, (env.space.size,)))
        demos = collect(env, env.model(target), wander(env), play, 4, 60)
        demos = measured(demos, noise, sensors, env.simulator.configuration)
        data = SearchData(windows(demos, 8, 8), noise, ())
        state, info = search.run(search.init(begin, data), data, generations)
        pieces = PairedFit(env.simulator, env.space, data.segments, noise)
        found = estimate(pieces, state.result_mean, state.result_cov, refined=False)
        return found, info

    def numbers(seed: int) -> bool:
        found, _ = jax.device_get(one(jax.random.key(seed)))
        return bool(
            np.isfinite(found.distribution.mean).all()
            and np.isfinite(found.distribution.factor).all()
        )

    return numbers


def resident() -> float:
    """Memory of this process [MB], after what Python no longer needs is gone."""
    gc.collect()
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmRSS:"):
            return int(line.split()[1]) / 1024
    raise RuntimeError("no VmRSS in /proc/self/status")


if __name__ == "__main__":
    main(Config, run, name="benchmarks.soak")
