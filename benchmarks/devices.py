"""Whether a CPU and a GPU, or several devices, compute the same.

    JAX_NUM_CPU_DEVICES=1 JAX_PLATFORMS=cpu python -m benchmarks.devices --save one.npz
    python -m benchmarks.devices --against one.npz

Every robot is simulated from the same resets under the same commands, for random
models spread over all devices; and the Cartpole's search runs with its least-squares
finish on the same noisy logs. ``benchmarks/results/devices_*.json``, one for each pair,
hold the differences: of positions by control step, and of the results of search and
finish in their own standard deviations.
"""

import dataclasses
import re
from pathlib import Path
from typing import Any

from benchmarks._common import RESULTS
from train._command import main, say, show_table

ROBOTS = ("cartpole", "ant", "ballbalance", "go2")
STEPS = (1, 5, 20)  # control steps after which positions are compared
SHARES = (50, 99)  # percentiles
SAME = 0.5  # standard deviations of a result that another device may differ by


@dataclasses.dataclass(frozen=True)
class Config:
    """Computes, and saves or compares."""

    save: Path | None = None
    """Where the figures of this device are kept."""
    against: Path | None = None
    """Figures of another device."""
    robots: tuple[str, ...] = ROBOTS
    """Built-in robots that are simulated."""
    population: int = 64
    """Models of each robot."""
    generations: int = 30
    """Generations of the search."""
    folder: Path = RESULTS
    """Where differences go."""


def run(config: Config) -> None:
    """Computes the figures, then saves them or compares them."""
    import jax
    import numpy as np

    from benchmarks._common import command_of, write_result
    from easi_jax.errors import UserError

    if (config.save is None) == (config.against is None):
        raise UserError("give either --save FILE or --against FILE")
    kind = jax.devices()[0].device_kind
    here = f"{jax.device_count()} {kind}"
    figures = {name: moved(name, config.population) for name in config.robots}
    figures |= searched(config)
    if config.against is None:
        figures["device"] = np.array(here)
        np.savez(str(config.save), **figures)
        say(f"written: {config.save}")
        return
    with np.load(config.against, allow_pickle=False) as found:
        other = dict(found)
    rows = {}
    for name in config.robots:
        off = np.abs(figures[name] - other[name]).max(-1)
        rows[name] = [
            {f"{p} %": float(np.percentile(off[:, s - 1], p)) for p in SHARES}
            for s in STEPS
        ]
    std = np.sqrt(np.diag(figures["cov"]))
    apart = np.abs(figures["mean"] - other["mean"]) / std
    refined = np.abs(figures["refined"] - other["refined"]) / other["std"]
    pair = [re.sub(r"\W+", "_", w) for w in (str(other["device"]), here)]
    plain = dataclasses.replace(config, against=None, folder=RESULTS)
    path = write_result(
        "_".join(["devices", *pair]),
        command_of("benchmarks.devices", plain),
        plain,
        config.folder,
        device=here,
        other_device=str(other["device"]),
        control_steps=STEPS,
        positions=rows,
        search_apart_std=apart.tolist(),
        refined_apart_std=refined.tolist(),
    )
    show_table(
        f"differences of positions [m, rad], {here} beside {other['device']}",
        ("robot", *(f"after {s}, {p} %" for s in STEPS for p in SHARES)),
        [
            (n, *(f"{x:.1e}" for step in r for x in step.values()))
            for n, r in rows.items()
        ],
    )
    say(f"search: at most {apart.max():.2g} of its standard deviations apart")
    say(f"after the finish: at most {refined.max():.2g} of those then")
    say(f"written: {path}")


def moved(name: str, population: int) -> Any:
    """Positions of random models under random commands, ``(P, max(STEPS), nq)``."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    from benchmarks._common import wander
    from easi_jax.devices.mesh import make_mesh, sharded_map
    from easi_jax.simulation.rollout import policy_rollout
    from envs import make

    env, mesh = make(name), make_mesh()
    low, high = (jnp.asarray(x) for x in env.space.initial)
    act = wander(env)

    def one(key: jax.Array) -> jax.Array:
        k_model, k_run = jax.random.split(key)
        theta = jax.random.uniform(k_model, low.shape, minval=low, maxval=high)

        seg = policy_rollout(env, env.model(theta), act, k_run, max(STEPS) + 1)
        return seg.qpos[1:]

    keys = jax.random.split(jax.random.key(0), population)
    return np.asarray(jax.jit(lambda k: sharded_map(jax.vmap(one), mesh, k))(keys))


def searched(config: Config) -> dict[str, Any]:
    """A search's mean and covariance, its refined mean and standard deviations there;
    unit coordinates."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    from benchmarks.recovery import NOISE, controller
    from easi_jax.data.segments import windows
    from easi_jax.estimation.normal_equations import PairedFit
    from easi_jax.estimation.pieces import finish_pieces
    from easi_jax.estimation.posterior import estimate
    from easi_jax.model.distribution import covariance
    from easi_jax.search.config import preset
    from easi_jax.search.easi import Search, SearchData
    from easi_jax.simulation.rollout import collect, measured
    from envs import make

    env = make("cartpole")
    simulator = env.simulator.rebuilt(space=env.space.scaled(0.3, 0.9))
    search = Search(
        simulator, preset("default", generations=config.generations, horizon=8)
    )
    noise = jnp.asarray(NOISE)

    @jax.jit
    def find(key: jax.Array) -> tuple[jax.Array, jax.Array, Any]:
        demos = collect(env, env.model(), controller, key, 50, env.episode_length)
        demos = measured(
            demos, noise, jax.random.fold_in(key, 1), env.simulator.configuration
        )
        data = SearchData(windows(demos, 8, 8), noise, ())
        state, _ = search.run(search.init(key, data), data, config.generations)
        mean, cov = state.result_mean, state.result_cov
        pieces = finish_pieces(simulator, demos)
        fit = estimate(
            PairedFit(simulator, search.space, pieces, noise), mean, cov, True
        )
        return mean, cov, fit.distribution

    mean, cov, found = jax.device_get(find(jax.random.key(0)))
    std = np.sqrt(np.diag(covariance(found)))
    return {"mean": mean, "cov": cov, "refined": np.asarray(found.mean), "std": std}


if __name__ == "__main__":
    main(Config, run, name="benchmarks.devices")
