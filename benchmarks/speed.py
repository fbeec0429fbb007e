"""A search of Cartpole by its parts, and compile times.

python -m benchmarks.speed
"""

import dataclasses
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from train._command import main, say, show_table


@dataclasses.dataclass(frozen=True)
class Config:
    """Times a generation, the whole search and compilation."""

    population: int = 300
    """Individuals."""
    steps: int = 200
    """Control steps of a rollout."""
    generations: int = 50
    """Generations of the timed search."""
    stress: int = 10
    """Fresh processes that step a large batch under a time limit."""
    stress_batch: int = 2048
    """Simulations in such a batch."""
    phase: str = "all"
    """all, or compile: print compile times of this process and stop."""


def _search(config: Config) -> Any:
    import jax.numpy as jnp

    from benchmarks.recovery import controller
    from easi_jax.data.segments import windows
    from easi_jax.search.config import preset
    from easi_jax.search.easi import Search, SearchData
    from easi_jax.simulation.rollout import collect
    from envs import make

    env = make("cartpole")
    search = Search(
        env.simulator,
        preset(
            "default",
            population=config.population,
            segments=config.steps,
            generations=config.generations,
        ),
    )

    def data(key: Any) -> Any:
        demos = collect(env, env.model(), controller, key, 50, env.episode_length)
        return SearchData(windows(demos, 1, 1), jnp.zeros(4), ())

    return env, search, data


def _whole(search: Any, config: Config) -> Any:
    """All generations as one program."""
    import jax

    from easi_jax.devices.runtime import fast_loops

    return jax.jit(
        lambda s, d: search.run(s, d, config.generations),
        compiler_options=fast_loops(),
    )


def _simulated(search: Any, config: Config, state: Any, data: Any, key: Any) -> Any:
    """What one generation simulates and nothing else; the last positions."""
    import jax

    unit = jax.random.uniform(key, (config.population, search.space.size))
    theta, center = search.space.to_si(unit), search.space.to_si(state.mean)
    return search._replay(data, theta, center, key)[2].next_qpos[..., -1, :]


def _compile(config: Config) -> dict[str, float]:
    import jax

    begin = time.monotonic()
    _, search, data = _search(config)
    d = jax.jit(data)(jax.random.key(0))
    state = search.init(jax.random.key(0), d)
    ready = time.monotonic()
    lowered = _whole(search, config).lower(state, d)
    traced = time.monotonic()
    lowered.compile()
    done = time.monotonic()
    return {
        "prepare_s": ready - begin,
        "trace_s": traced - ready,
        "compile_s": done - traced,
    }


def _generations(config: Config) -> dict[str, Any]:
    """A whole search, and the same without its discriminator and strategy."""
    import jax

    from easi_jax.devices.runtime import fast_loops

    _, search, data = _search(config)
    d = jax.jit(data)(jax.random.key(0))
    state = search.init(jax.random.key(0), d)
    whole = _whole(search, config)
    only = jax.jit(
        lambda s, d: jax.lax.scan(
            lambda k, _: (
                jax.random.fold_in(k, 1),
                _simulated(search, config, s, d, k),
            ),
            jax.random.key(3),
            None,
            length=config.generations,
        )[1],
        compiler_options=fast_loops(),
    )
    times: dict[str, list[float]] = {"search_s": [], "physics_s": []}
    for name, fun in (("search_s", whole), ("physics_s", only)):
        for i in range(3):
            begin = time.monotonic()
            jax.block_until_ready(fun(state, d))
            if i:
                times[name].append(time.monotonic() - begin)
    outside = min(times["search_s"]) - min(times["physics_s"])
    return {**times, "outside_physics_per_generation_s": outside / config.generations}


def _stress(config: Config) -> list[dict[str, Any]]:
    code = (
        "import easi_jax, jax, jax.numpy as jnp; from mujoco import mjx; "
        "from envs import make; m = make('cartpole').machine.base.mjx; "
        "f = jax.jit(jax.vmap(lambda q: jax.lax.fori_loop(0, 20, "
        "lambda i, d: mjx.step(m, d), mjx.make_data(m).replace(qpos=q)).qpos)); "
        f"q = jnp.zeros(({config.stress_batch}, 2)).at[:, 1].set(0.1); "
        "[jax.block_until_ready(f(q)) for _ in range(5)]"
    )
    out = []
    for _ in range(config.stress):
        begin = time.monotonic()
        try:
            done = subprocess.run(
                [sys.executable, "-c", code], timeout=180, capture_output=True
            )
            ok = done.returncode == 0
        except subprocess.TimeoutExpired:
            ok = False
        out.append({"finished": ok, "seconds": time.monotonic() - begin})
    return out


def _compile_in(cache: str) -> dict[str, float]:
    from benchmarks._common import first_start

    words = ("-m", "benchmarks.speed", "--phase", "compile")
    printed = first_start(words, Path(cache), 600)[1]
    return json.loads(printed.strip().splitlines()[-1])


def run(config: Config) -> None:
    """Times everything in one run."""
    if config.phase == "compile":
        say(json.dumps(_compile(config)))
        return
    from benchmarks._common import write_result

    with tempfile.TemporaryDirectory() as cache:
        cold, cached = (_compile_in(cache) for _ in range(2))
    search = _generations(config)
    stress = _stress(config)
    path = write_result(
        "speed",
        "python -m benchmarks.speed",
        config,
        search=search,
        search_goal_s=60.0,
        outside_goal_s=0.25,
        compile={"cold": cold, "cached": cached},
        stress=stress,
    )
    show_table(
        "Cartpole on this machine",
        ("figure", "measured", "goal"),
        [
            ("search [s]", f"{min(search['search_s']):.1f}", "60"),
            (
                "a generation outside physics [s]",
                f"{search['outside_physics_per_generation_s']:.3f}",
                "0.25",
            ),
            ("trace + compile, cold [s]", f"{sum(cold.values()):.0f}", ""),
            ("trace + compile, cached [s]", f"{sum(cached.values()):.0f}", ""),
            (
                "large batches that finished",
                f"{sum(s['finished'] for s in stress)} of {len(stress)}",
                "all",
            ),
        ],
    )
    say(f"written: {path}")


if __name__ == "__main__":
    main(Config, run, name="benchmarks.speed")
