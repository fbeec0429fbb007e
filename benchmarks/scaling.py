"""How the cost of a search and of training grows, one quantity at a time.

    python -m benchmarks.scaling
    python -m benchmarks.scaling --robot go2 --generations 2 --seeds 1 2 4
    python -m benchmarks.scaling --robot go2 --every-part --only parameters

Seconds of a generation by population, horizon and number of parameters, and of training
by seeds that one program holds; compiled before, the least of three timings. Each is a
line of ``benchmarks/results/scaling.jsonl``, with versions and device, and is not timed
again there.
"""

import dataclasses
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from benchmarks._common import RESULTS, wander
from train._command import main, say

FEWEST = 4  # parameters
WHAT = ("parameters", "population", "horizon", "seeds")
_REACH = 0.01  # m, centers of mass to each side
_FROM_ZERO = {"damping": 0.5, "density": 2.0}  # N m s/rad, kg/m^3


@dataclasses.dataclass(frozen=True)
class Config:
    """Times a robot's search and training over sizes."""

    robot: str = "cartpole"
    """Built-in robot."""
    option: tuple[str, ...] = ()
    """Options of the robot, NAME=VALUE."""
    every_part: bool = False
    """Search what every joint, drive and body of the robot has, not its own list."""
    only: tuple[str, ...] = WHAT
    """What grows."""
    populations: tuple[int, ...] = (300, 1024, 4096, 16384)
    """Individuals."""
    horizons: tuple[int, ...] = (1, 4, 16, 64)
    """Control steps of a replayed piece."""
    seeds: tuple[int, ...] = (1, 4, 16, 32)
    """Seeds that are trained in one program."""
    generations: int = 5
    """Generations timed."""
    iterations: int = 20
    """Iterations of training timed."""
    devices: int | None = None
    """Devices to spread over; all where not given."""
    out: Path = RESULTS / "scaling.jsonl"
    """Where a line for each size is added."""


def run(config: Config) -> None:
    """Times every size that has no line yet, the smallest first."""
    import jax

    from benchmarks._cells import add_row, read_rows
    from easi_jax.devices.mesh import make_mesh
    from easi_jax.io.runs.versions import versions
    from envs import open_env

    env, mesh = open_env(config.robot, None, config.option), make_mesh(config.devices)
    space = every_part(env.mj_model) if config.every_part else env.space
    where = {
        "robot": config.robot,
        "option": [*config.option, *["every part"] * config.every_part],
        "devices": mesh.size,
        "device": jax.devices()[0].device_kind,
    }

    done = [
        (r["what"], r["size"])
        for r in read_rows(config.out)
        if {k: r[k] for k in where} == where
    ]
    names = space.names
    few = sorted({min(FEWEST, len(names)), len(names) // 2, len(names)})
    sizes = {
        "parameters": few,
        "population": config.populations,
        "horizon": config.horizons,
        "seeds": config.seeds,
    }
    for what, size in ((w, s) for w in config.only for s in sizes[w]):
        if (what, size) in done:
            continue
        if what == "seeds":
            figures = _training(config, env, mesh, size)
        elif what == "parameters":
            figures = _generation(config, env, mesh, space.select(names[:size]))
        else:
            figures = _generation(config, env, mesh, space, **{what: size})
        row = {**where, "what": what, "size": size, **figures}
        add_row(config.out, {**row, "versions": versions()})
        words = ", ".join(f"{k} {v:.4g}" for k, v in figures.items())
        say(f"{config.robot}, {what} {size}: {words}")


def every_part(mj_model: Any) -> Any:
    """Gains and force limit of every position drive, damping and armature of every
    joint, mass and center of every body, all that contacts take of named geoms, gravity
    and density of the air: 117 of a Go2."""
    from easi_jax.model.addresses import names, places
    from easi_jax.model.joint_space import joint_name, scalar_dofs
    from easi_jax.model.parameters import ParameterSpace, declare

    m = mj_model
    touching = [m.geom(i).name for *_, i in places(m, "geom.*.friction")]
    parts = {
        "actuator": (names(m, "actuator"), ("kp", "kv", "force_limit")),
        "joint": ([joint_name(m, j) for j in scalar_dofs(m)], ("damping", "armature")),
        "body": (names(m, "body"), ("mass", "com_x", "com_y", "com_z")),
        "geom": (touching, ("friction", "contact_stiffness", "contact_damping")),
        "option": ([""], ("gravity", "density")),
    }
    found = []
    for kind, (named, quantities) in parts.items():
        for quantity, name in ((q, n) for q in quantities for n in named):
            given: dict[str, Any] = {}
            if quantity in _FROM_ZERO:
                given = {"initial": (0.0, _FROM_ZERO[quantity]), "log": False}
            elif quantity.startswith("com_"):
                at = float(m.body(name).ipos["xyz".index(quantity[-1])])
                given = {"initial": (at - _REACH, at + _REACH), "log": False}
            address = ".".join(w for w in (kind, name, quantity) if w)
            found.append(declare(m, address.replace(".", "_"), address, **given))
    return ParameterSpace(tuple(found))


def least(fun: Callable[[], Any]) -> float:
    """Seconds, the least of three, after one that is not counted."""
    import jax

    seconds = []
    for _ in range(4):
        begin = time.monotonic()
        jax.block_until_ready(fun())
        seconds.append(time.monotonic() - begin)
    return min(seconds[1:])


def first_state(
    env: Any, mesh: Any = None, space: Any = None, **search: Any
) -> tuple[Any, Any, Any]:
    """A search of the preset ``default`` with changes, its first state, and its data:
    20 episodes of random actions. ``space``: searched in place of the robot's own."""
    import jax
    import jax.numpy as jnp

    from easi_jax.data.segments import windows
    from easi_jax.search.config import preset
    from easi_jax.search.easi import Search, SearchData
    from easi_jax.simulation.rollout import collect

    chosen = preset("default", **search)
    made = Search(env.simulator.rebuilt(space=space), chosen, mesh=mesh)

    def data(key: jax.Array) -> SearchData:
        demos = collect(env, env.model(), wander(env), key, 20, env.episode_length)
        pieces = windows(demos, chosen.horizon, max(1, chosen.horizon // 2))
        return SearchData(pieces, jnp.zeros(2 * env.mj_model.nv), ())

    logged = jax.jit(data)(jax.random.key(0))
    return made, made.init(jax.random.key(1), logged), logged


def _generation(
    config: Config, env: Any, mesh: Any, space: Any, **search: int
) -> dict[str, float]:
    import jax

    from easi_jax.devices.runtime import fast_loops

    n = config.generations
    made, state, logged = first_state(env, mesh, space, generations=n, **search)
    run = jax.jit(lambda s, d: made.run(s, d, n), compiler_options=fast_loops())
    seconds = least(lambda: run(state, logged)) / n
    chosen = made.config
    steps = chosen.population * chosen.segments * chosen.horizon
    state_size = env.mj_model.nq + env.mj_model.nv
    return {
        "seconds": seconds,
        "control_steps_per_s": steps / seconds,
        # What devices tell each other: every state that was simulated.
        "gathered_bytes": float(4 * steps * state_size),
    }


def _training(config: Config, env: Any, mesh: Any, seeds: int) -> dict[str, float]:
    import jax
    import jax.numpy as jnp

    from easi_jax.devices.runtime import fast_loops
    from easi_jax.pipeline.stages import Pipeline, PipelineConfig, seed_keys, stage_keys
    from train._robots import training_config

    training = training_config(env, None)
    pipe = Pipeline(env, PipelineConfig(training=training), mesh=mesh)
    dist = pipe.spread(pipe.udr(), seeds)
    target = jnp.asarray(env.space.nominal, jnp.float32)
    keys = stage_keys(seed_keys(list(range(seeds))))["udr"]
    state = jax.jit(pipe.train_init)(keys, dist)
    n = config.iterations
    run = jax.jit(
        lambda s, d: pipe.train_chunk(s, d, target, n), compiler_options=fast_loops()
    )
    trained, _ = run(state, dist)  # a replay buffer is filled first
    seconds = least(lambda: run(trained, dist)) / n
    steps = seeds * training.steps_per_iteration
    return {"seconds": seconds, "control_steps_per_s": steps / seconds}


if __name__ == "__main__":
    main(Config, run, name="benchmarks.scaling")
