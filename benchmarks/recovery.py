"""Recovery of known Cartpole parameters, every seed shown.

    python -m benchmarks.recovery

Demonstrations of a rough controller (a linear one with exploration noise, the same for
all methods) in the nominal robot; then the search alone (`paper`, `default`) and the
search with the least-squares finish (`refine`). Two cases: all 11 parameters free, and
masses and pole length weighed; with and without sensor noise; from UDR's range and from
starts that exclude the truth. Cases run one after the other and each is written when it
is done; those not run are absent.
"""

import dataclasses
import functools
import time
from collections.abc import Callable
from typing import Any

from train._command import main, say, show_table

NOISE = (5e-4, 2e-3, 1e-2, 2e-2)  # m, rad, m/s, rad/s
WEIGHED = ("pole_length", "pole_mass", "cart_mass")
CASES: dict[str, dict[str, Any]] = {
    "weighed_noisy": {"free": False, "noise": NOISE},
    "free_clean": {"free": True, "noise": (0.0,) * 4},
    "free_noisy": {"free": True, "noise": NOISE},
    "weighed_noisy_low_start": {"free": False, "noise": NOISE, "start": (0.05, 0.5)},
    "weighed_noisy_high_start": {"free": False, "noise": NOISE, "start": (2.0, 4.0)},
    "weighed_clean": {"free": False, "noise": (0.0,) * 4},
    "paper_free_clean": {"free": True, "noise": (0.0,) * 4, "preset": "paper"},
    "paper_free_noisy": {"free": True, "noise": NOISE, "preset": "paper"},
    "paper_weighed_noisy": {"free": False, "noise": NOISE, "preset": "paper"},
}


@dataclasses.dataclass(frozen=True)
class Config:
    """Recovers known Cartpole parameters from demonstrations."""

    seeds: tuple[int, ...] = tuple(range(10))
    """Seeds of demonstrations and search."""
    cases: tuple[str, ...] = tuple(CASES)
    """Which cases to run."""
    trajectories: int = 200
    """Demonstration trajectories."""
    generations: int = 50
    """Generations of the search."""


def controller(obs: Any, key: Any) -> Any:
    """A rough stabilizer with exploration noise; action in [-1, 1]."""
    import jax
    import jax.numpy as jnp

    x, v, angle, rate = obs
    u = 3.75 * x + 1.5 * v + 7.5 * angle + 1.375 * rate
    return jnp.clip(u + 0.25 * jax.random.normal(key), -1.0, 1.0)[None]


def run(config: Config) -> None:
    """Runs the cases and writes one JSON for each."""
    from easi_jax.errors import UserError, nearest

    for name in config.cases:
        if name not in CASES:
            raise UserError(f'unknown case "{name}"{nearest(name, CASES)}')
        _case(name, config, **CASES[name])


def _case(
    name: str,
    config: Config,
    free: bool,
    noise: tuple[float, ...],
    start: tuple[float, float] | None = None,
    preset: str = "default",
) -> None:
    from benchmarks._common import write_result
    from envs import make

    env = make("cartpole")
    names = [n for n in env.space.names if free or n not in WEIGHED]
    space = env.space.select(names)
    if start is not None:
        space = space.scaled(*start)
    solve = _solver(config, env, space, noise, preset)
    rows = []
    for seed in config.seeds:
        rows.append(row := solve(seed))
        methods = [m for m in ("paper", "default", "refine") if m in row]
        short = {m: [round(100 * x, 2) for x in row[m]["one_step"]] for m in methods}
        said = f"{name} seed {seed}: {row['search_s']:.0f} s"
        say(f"{said}, one-step error [%] {short}")
    summary = {m: _summary([row[m] for row in rows]) for m in methods}
    path = write_result(
        f"recovery_{name}",
        f"python -m benchmarks.recovery --cases {name}",
        config,
        case={"free": free, "noise": noise, "start": start, "preset": preset},
        parameters=names,
        channels=env.simulator.state_names,
        summary=summary,
        seeds=rows,
    )
    show_table(
        f"{name}: |log ratio| to the truth, median (worst) over {len(rows)} seeds",
        ("parameter", *methods),
        [
            (
                n,
                *(
                    f"{summary[m]['median_abs_log_ratio'][i]:.4f} "
                    f"({summary[m]['worst_abs_log_ratio'][i]:.3f})"
                    for m in methods
                ),
            )
            for i, n in enumerate(names)
        ],
    )
    say(f"written: {path}")


def _solver(
    config: Config, env: Any, space: Any, noise: tuple[float, ...], preset: str
) -> Callable[[int], dict[str, Any]]:
    """From a seed to its row."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    from easi_jax.data.segments import windows
    from easi_jax.devices.runtime import fast_loops
    from easi_jax.estimation import posterior
    from easi_jax.search.config import preset as make_preset
    from easi_jax.search.easi import Search, SearchData
    from easi_jax.simulation.rollout import collect, measured
    from easi_jax.simulation.simulator import Simulator

    simulator, noisy = Simulator(env.mj_model, space, env.dt), any(noise)
    # Noise is of positions and velocities.
    unlike = {"observation_inputs": not noisy}
    changes = unlike if preset == "paper" else {"horizon": 8 if noisy else 1}
    settings = make_preset(preset, generations=config.generations, **changes)
    acts = lambda _, obs, key: controller(obs, key)  # noqa: E731
    search = Search(simulator, settings, env=env, act=acts)
    deviation, nominal = jnp.asarray(noise), env.model()

    def trajectories(key: jax.Array, count: int, as_searched: bool = False) -> Any:
        given = env, nominal, controller, key, count, env.episode_length
        crosses = as_searched and search.config.crosses_resets
        sees = as_searched and search.config.observation_inputs
        return collect(*given, auto_reset=crosses, sees=sees)

    @jax.jit
    def demonstrate(key: jax.Array) -> Any:
        k_run, k_noise = jax.random.split(key)
        runs = trajectories(k_run, config.trajectories, as_searched=True)
        return measured(runs, deviation, k_noise, simulator.configuration)

    @functools.partial(jax.jit, compiler_options=fast_loops())
    def find(key: jax.Array, demos: Any) -> Any:
        h = search.config.horizon if preset == "default" else 1
        data = SearchData(windows(demos, h, max(1, h // 2)), deviation, ())
        state, info = search.run(search.init(key, data), data, config.generations)
        return state.result_mean, state.result_cov, info.non_finite.sum()

    @jax.jit
    def finish(mean: jax.Array, cov: jax.Array, demos: Any) -> Any:
        given = simulator, search.space, mean, cov, demos, deviation, noisy
        return posterior.finish(*given, refined=True)

    @jax.jit
    def errors(mean: jax.Array, key: jax.Array) -> Any:
        return _errors(env, simulator, search.space.to_si(mean), trajectories(key, 20))

    def solve(seed: int) -> dict[str, Any]:
        key = jax.random.key(seed)
        demos = demonstrate(jax.random.fold_in(key, 0))
        begin = time.monotonic()
        mean, cov, lost = jax.block_until_ready(find(jax.random.fold_in(key, 1), demos))
        took = time.monotonic() - begin
        found = {preset: mean}
        row: dict[str, Any] = {"seed": seed, "search_s": took, "non_finite": int(lost)}
        if preset == "default":
            begin = time.monotonic()
            fit = jax.block_until_ready(finish(mean, cov, demos))
            row["refine_s"] = time.monotonic() - begin
            found["refine"] = fit.distribution.mean
            row |= _known(search.space, fit.hessian)
        for method, unit in found.items():
            si = np.asarray(search.space.to_si(unit))
            one, long = errors(unit, jax.random.key(10_000 + seed))
            row[method] = {
                "log_ratio": np.log(np.maximum(si, 1e-30) / space.nominal).tolist(),
                "one_step": np.asarray(one).tolist(),
                "open_loop_0.2s": np.asarray(long).tolist(),
            }
        return row

    return solve


def _errors(env: Any, simulator: Any, theta: Any, fresh: Any) -> tuple[Any, ...]:
    """Of predictions of one step and of ten, with parameters ``theta (n,)``."""
    from easi_jax.data.segments import windows
    from easi_jax.pipeline.held_out import errors_by_step

    model, limit = simulator.model(theta), env.model().speed_limit
    return tuple(
        errors_by_step(simulator, model, windows(fresh, h, h), limit)[-1]
        for h in (1, 10)
    )


def _known(space: Any, hessian: Any) -> dict[str, Any]:
    """What the data determine."""
    import numpy as np

    from easi_jax.estimation.identifiability import describe, identifiability

    ident = identifiability(space, np.asarray(hessian))
    return {
        "rank": ident.rank,
        "cramer_rao_std": ident.std.tolist(),
        "determined": ident.determined.tolist(),
        "undetermined": [describe(d) for d in ident.undetermined],
    }


def _summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Of one method, over all seeds."""
    import numpy as np

    off = np.abs([r["log_ratio"] for r in rows])
    return {
        "median_one_step": np.median([r["one_step"] for r in rows], 0).tolist(),
        "median_open_loop": np.median([r["open_loop_0.2s"] for r in rows], 0).tolist(),
        "median_abs_log_ratio": np.median(off, 0).tolist(),
        "worst_abs_log_ratio": np.max(off, 0).tolist(),
    }


if __name__ == "__main__":
    main(Config, run, name="benchmarks.recovery")
