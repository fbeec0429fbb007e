"""Searches on one robot: what they recover, and what memory they take.

    python -m train.udr --robot ant --seeds 0 1 --out results/udr_ant
    python -m benchmarks.robots --udr results/udr_ant

The policy of ``train.udr`` records in the nominal robot, without noise; the search
never sees that robot's parameters. ``recovery``: the search, then the least-squares
finish, from UDR's range and from ranges that exclude the truth. ``memory``: a
generation of 4,096. ``buffer``: SAC with a full replay buffer of a million transitions,
with its checkpoint. Memory does not depend on how well the policy was trained. What a
search takes is timed by ``benchmarks.engines``.
"""

import dataclasses
import sys
import time
from pathlib import Path
from typing import Any

from train._command import main, say, show_table

STARTS: dict[str, tuple[float, float] | None] = {
    "within": None,
    "low": (0.05, 0.5),
    "high": (2.0, 4.0),
}
PARTS = ("recovery", "memory", "buffer")
BUFFER = 1_000_000  # transitions


@dataclasses.dataclass(frozen=True)
class Config:
    """Recovers known parameters of a robot, and measures memory."""

    udr: Path = Path("results/udr")
    """Run folder of train.udr."""
    option: tuple[str, ...] = ()
    """Options of the built-in robot in place of those of the run."""
    part: str = "recovery"
    """What to run: recovery, memory or buffer."""
    starts: tuple[str, ...] = tuple(STARTS)
    """Where searches start: within, low, high."""
    seeds: tuple[int, ...] = (0, 1, 2, 3, 4)
    """Seeds of demonstrations and search."""
    trajectories: int = 50
    """Demonstration trajectories."""
    segments: int = 32
    """Pieces that each individual replays in a recovery."""
    pieces: int | None = None
    """Pieces that the finish of a recovery fits; as in train.easi where not given."""
    population: int = 300
    """Individuals."""
    generations: int = 50
    """Generations."""


def run(config: Config) -> None:
    """Runs the parts, each written when it is done."""
    from easi_jax.errors import UserError, nearest
    from easi_jax.io.files import read_json
    from envs import open_env
    from train._robots import check_seeds, load_policies

    check_seeds(config.seeds)
    for chosen, known in (((config.part,), PARTS), (config.starts, STARTS)):
        for name in chosen:
            if name not in known:
                raise UserError(f'unknown "{name}"{nearest(name, known)}')
    saved = load_policies(config.udr)
    env = saved["env"]
    option = config.option or read_json(config.udr / "results.json")["option"]
    if config.option:
        env = open_env(env.name, None, config.option)
    label = "_".join([env.name, *(o.replace("=", "_") for o in option)])
    if config.part == "memory":
        _memory(config, env, saved, label)
    elif config.part == "buffer":
        _buffer(config, env, label)
    else:
        for start in config.starts:
            chosen = dataclasses.replace(config, starts=(start,))
            _recovery(chosen, env, saved, label, start)


def _pipe(config: Config, env: Any, start: str = "within", **search: Any) -> Any:
    from easi_jax.pipeline.stages import Pipeline, PipelineConfig
    from easi_jax.search.config import preset

    return Pipeline(
        env,
        PipelineConfig(
            search=preset("default", **search),
            trajectories=config.trajectories,
            refine=True,
            refine_pieces=config.pieces,
        ),
        start=STARTS[start],
    )


def _demonstrations(pipe: Any, saved: Any, seeds: Any) -> Any:
    """Keys, policies and demonstrations; the run's first policy for every seed."""
    import jax
    import jax.numpy as jnp

    from easi_jax.pipeline.stages import seed_keys, stage_keys

    keys = stage_keys(seed_keys(list(seeds)))
    policies = jax.tree.map(
        lambda x: jnp.broadcast_to(x[0], (len(seeds), *x.shape[1:])), saved["policies"]
    )
    nominal = jnp.asarray(pipe.env.space.nominal, jnp.float32)
    demos = jax.jit(pipe.demonstrate)(policies, nominal, keys["demonstrate"])
    return keys, policies, jax.block_until_ready(demos)


def _first(tree: Any, i: int) -> Any:
    import jax

    return jax.tree.map(lambda x: x[i : i + 1], tree)


def peak_gib() -> float:
    """Peak resident size of this process [GiB]."""
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (2**30 if sys.platform == "darwin" else 2**20)


def _searched(pipe: Any, demos: Any, keys: Any, policies: Any) -> Any:
    """The compiled search ``f(state)``, its first state, seconds to compile."""
    import jax

    from easi_jax.devices.runtime import fast_loops

    state = pipe.search_init(keys["search"][:1], _first(demos, 0), _first(policies, 0))
    begin = time.monotonic()
    compiled = (
        jax.jit(
            lambda s, d, p: pipe.search_chunk(s, d, p, pipe.search.config.generations),
            compiler_options=fast_loops(),
        )
        .lower(state, _first(demos, 0), _first(policies, 0))
        .compile()
    )
    return compiled, state, time.monotonic() - begin


def _memory(config: Config, env: Any, saved: Any, label: str) -> None:
    import jax

    population = 4096
    pipe = _pipe(config, env, population=population, generations=1)
    keys, policies, demos = _demonstrations(pipe, saved, config.seeds[:1])
    compiled, state, _ = _searched(pipe, demos, keys, policies)
    jax.block_until_ready(compiled(state, demos, policies))
    _write_peak(config, env, f"memory_{label}", f"search, population {population}")


def _buffer(config: Config, env: Any, label: str) -> None:
    import tempfile

    import jax
    import jax.numpy as jnp

    from easi_jax.io.runs import checkpoints
    from easi_jax.pipeline.stages import Pipeline, PipelineConfig, seed_keys, stage_keys
    from easi_jax.rl.config import SacConfig
    from easi_jax.rl.presets import training_preset

    preset = training_preset(env, "sac")
    assert isinstance(preset, SacConfig)
    training = dataclasses.replace(preset, env_steps=BUFFER, buffer_size=BUFFER)
    pipe = Pipeline(env, PipelineConfig(training=training))
    keys = stage_keys(seed_keys(list(config.seeds[:1])))
    wide = pipe.spread(pipe.udr(), 1)
    states = pipe.train_init(keys["udr"], wide)
    target = jnp.asarray(env.space.nominal, jnp.float32)
    count = 2 * training.random_iterations  # half of them with updates
    chunk = jax.jit(lambda s, d, t: pipe.train_chunk(s, d, t, count))
    states, _ = jax.block_until_ready(chunk(states, wide, target))
    with tempfile.TemporaryDirectory() as folder:
        checkpoints.save(Path(folder), count, states, config_hash="none")
    held = states.buffer.data.shape
    _write_peak(
        config,
        env,
        f"memory_{label}_buffer",
        f"SAC, a buffer of {held[-2]:,} transitions of {held[-1]} numbers",
    )


def _write_peak(config: Config, env: Any, name: str, what: str) -> None:
    from benchmarks._common import command_of, write_result

    peak = peak_gib()
    path = write_result(
        name,
        command_of("benchmarks.robots", config),
        config,
        robot=env.name,
        what=what,
        peak_gib=peak,
        goal_gib=8.0,
    )
    say(f"{what}: peak {peak:.2f} GiB; written: {path}")


def _row(pipe: Any, state: Any, found: Any, truth: Any, lost: int) -> dict[str, Any]:
    """What one seed found, beside the ``truth (n,)``."""
    import numpy as np

    from easi_jax.estimation.identifiability import describe, identifiability

    def error(unit: Any) -> list[float]:
        si = np.maximum(np.asarray(pipe.space.to_si(unit)), 1e-30)
        return np.log(si / truth).tolist()

    ident = identifiability(pipe.space, np.asarray(found.hessian[0]))
    cost = np.asarray(found.cost[0])
    return {
        "non_finite": lost,
        "default": {"log_ratio": error(state.result_mean[0])},
        "refine": {"log_ratio": error(found.distribution.mean[0])},
        "cost": [float(cost[0]), float(cost.min())],
        "rank": ident.rank,
        "cramer_rao_std": ident.std.tolist(),
        "determined": ident.determined.tolist(),
        "undetermined": [describe(d) for d in ident.undetermined],
    }


def _summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Over all seeds."""
    import numpy as np

    return {
        m: {
            f"{name}_abs_log_ratio": fun(
                np.abs([r[m]["log_ratio"] for r in rows]), axis=0
            ).tolist()
            for name, fun in (("median", np.median), ("worst", np.max))
        }
        for m in ("default", "refine")
    }


def _recovery(config: Config, env: Any, saved: Any, label: str, start: str) -> None:
    import jax
    import numpy as np

    from benchmarks._common import command_of, write_result

    pipe = _pipe(
        config,
        env,
        start,
        segments=config.segments,
        population=config.population,
        generations=config.generations,
    )
    keys, policies, demos = _demonstrations(pipe, saved, config.seeds)
    search, first, compile_s = _searched(pipe, demos, keys, policies)
    begin = time.monotonic()
    finish = jax.jit(pipe.estimate).lower(first, _first(demos, 0)).compile()
    finish_compile_s = time.monotonic() - begin
    truth = np.asarray(env.space.nominal)

    rows = []
    for i, seed in enumerate(config.seeds):
        demo, policy = _first(demos, i), _first(policies, i)
        state = pipe.search_init(keys["search"][i : i + 1], demo, policy)
        begin = time.monotonic()
        state, info = jax.block_until_ready(search(state, demo, policy))
        searched = time.monotonic()
        found = jax.block_until_ready(finish(state, demo))
        done = time.monotonic()
        lost = int(info.non_finite.sum())
        took = {"search_s": searched - begin, "finish_s": done - searched}
        rows.append({"seed": seed, **took, **_row(pipe, state, found, truth, lost)})
        worst = max(abs(x) for x in rows[-1]["refine"]["log_ratio"])
        say(
            f"{label} {start} seed {seed}: search {searched - begin:.0f} s, finish "
            f"{done - searched:.0f} s, rank {rows[-1]['rank']} of {pipe.space.size}, "
            f"worst |log ratio| {worst:.3f}"
        )
    summary = _summary(rows)
    path = write_result(
        f"robots_{label}_{start}",
        command_of("benchmarks.robots", config),
        config,
        robot=env.name,
        start=STARTS[start],
        parameters=pipe.space.names,
        search_compile_s=compile_s,
        finish_compile_s=finish_compile_s,
        peak_gib=peak_gib(),
        summary=summary,
        seeds=rows,
    )
    show_table(
        f"{label} {start}: |log ratio| to the truth, median (worst) of {len(rows)}",
        ("parameter", *summary),
        [
            (
                name,
                *(
                    f"{s['median_abs_log_ratio'][k]:.4f} "
                    f"({s['worst_abs_log_ratio'][k]:.3f})"
                    for s in summary.values()
                ),
            )
            for k, name in enumerate(pipe.space.names)
        ],
    )
    say(f"written: {path}")


if __name__ == "__main__":
    main(Config, run, name="benchmarks.robots")
