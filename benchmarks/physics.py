"""Physics steps per second of every robot: MJX as a search runs it, and native MuJoCo.

    python -m benchmarks.physics

Each individual of the population is a model of its own; both sides use all cores, in
turns. ``variants`` are ways to run a physics step that were tried.
"""

import dataclasses
import time
from collections.abc import Callable
from typing import Any

from train._command import main, say, show_table

GOALS = {"cartpole": 4.0, "ant": 1.0, "ballbalance": 0.8, "go2": 0.8}
STEPS = {"cartpole": 200, "ant": 50, "ballbalance": 5, "go2": 25}  # control steps


@dataclasses.dataclass(frozen=True)
class Config:
    """Times the physics of every robot."""

    robots: tuple[str, ...] = tuple(GOALS)
    """Which robots."""
    population: int = 300
    """Individuals."""
    repeats: int = 5
    """Timings; the median is reported, all are written."""
    variants: bool = True
    """Time the ways to run a step that were tried, too."""


def native_rates(env: Any, population: int, steps: int, repeats: int) -> list[float]:
    """Physics steps per second of ``mujoco.rollout`` on all cores, from a reset."""
    import jax
    import mujoco
    import numpy as np
    from mujoco import rollout

    from easi_jax.devices import runtime

    m, n = env.mj_model, population
    held = env.simulator.substeps
    first = env.reset(env.model(), jax.random.key(0)).physics
    size = mujoco.mj_stateSize(m, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    start = np.zeros((n, size))
    start[:, 1 : 1 + m.nq] = np.asarray(first.qpos)
    start[:, 1 + m.nq : 1 + m.nq + m.nv] = np.asarray(first.qvel)
    ctrl = np.repeat(random_commands(env, n, steps), held, axis=1)
    threads = runtime.cores()
    out = []
    with rollout.Rollout(nthread=threads) as pool:
        datas = [mujoco.MjData(m) for _ in range(threads)]
        for _ in range(repeats + 1):
            begin = time.monotonic()
            pool.rollout([m] * n, datas, start, ctrl)
            out.append(n * steps * held / (time.monotonic() - begin))
    return out[1:]


def search_rates(
    env: Any,
    population: int,
    steps: int,
    repeats: int,
    step: Callable[..., Any] | None = None,
    fast: bool = True,
    sensing: bool = False,
) -> tuple[list[float], float]:
    """Physics steps per second of a population, each individual its own model.

    Args:
        step: one physics step in place of the package's, ``(model, state, ctrl)``.
        fast: with `easi_jax.devices.runtime.fast_loops`.
        sensing: read what controllers need, such as contact forces; the replay of
            measured motion does not.

    Returns:
        Rates, and the seconds that tracing and compiling took.
    """
    import jax
    import jax.numpy as jnp

    from easi_jax.devices.mesh import make_mesh, sharded_map
    from easi_jax.devices.runtime import fast_loops
    from easi_jax.simulation import step as physics

    simulator, n = env.simulator, population
    ctrl = jnp.asarray(random_commands(env, n, steps), jnp.float32)
    unit = jax.random.uniform(jax.random.key(1), (n, env.space.size))
    first = env.reset(env.model(), jax.random.key(0)).physics

    def control_step(model: Any, state: Any, u: Any) -> Any:
        if step is None:
            return simulator.step(model, state, u)
        once = step

        def inner(s: Any, _: None) -> Any:
            return once(model, s, u), None

        return jax.lax.scan(inner, state, None, length=simulator.substeps)[0]

    def local(items: Any) -> Any:
        def one(u: Any, c: Any) -> Any:
            model = simulator.model(env.space.to_si(u))
            if not sensing:
                model = simulator.without_sense(model)

            def advance(s: Any, a: Any) -> Any:
                s = control_step(model, s, a)
                return s, (s.qpos, s.qvel)

            state = physics.at_rest(model, first.qpos, first.qvel)
            return jax.lax.scan(advance, state, c)[1]

        return jax.vmap(one)(*items)

    options = fast_loops() if fast else None
    begin = time.monotonic()
    run = jax.jit(
        lambda u, c: sharded_map(local, make_mesh(), (u, c)), compiler_options=options
    )
    run = run.lower(unit, ctrl).compile()
    compiled = time.monotonic() - begin
    out = []
    for _ in range(repeats + 1):
        begin = time.monotonic()
        jax.block_until_ready(run(unit, ctrl))
        seconds = time.monotonic() - begin
        out.append(n * steps * simulator.substeps / seconds)
    return out[1:], compiled


def random_commands(env: Any, count: int, steps: int) -> Any:
    """Random commands ``(count, steps, nu)`` in a half of the actuators' range."""
    import numpy as np

    low, high = env.mj_model.actuator_ctrlrange.T
    rng = np.random.default_rng(0)
    middle, half = (low + high) / 2, (high - low) / 4
    return middle + half * rng.uniform(-1, 1, (count, steps, len(low)))


def _variants() -> dict[str, tuple[Callable[..., Any] | None, bool, bool]]:
    """Label: physics step (None: the package's), newer loop emitters, sensing."""
    from mujoco import mjx

    from easi_jax.simulation import step as physics

    def plain_mjx(model: Any, state: Any, ctrl: Any) -> Any:
        d = mjx.step(model.mjx, physics.data_at(model, state, ctrl))
        return dataclasses.replace(
            state, qpos=d.qpos, qvel=d.qvel, warmstart=d.qacc_warmstart
        )

    return {
        "with contact forces read, for controllers": (None, True, True),
        "older loop emitters": (None, False, False),
        "solver on plain arrays": (physics.substep, True, False),
        "solver on plain arrays, older loop emitters": (physics.substep, False, False),
        "mjx.step": (plain_mjx, False, False),
    }


def run(config: Config) -> None:
    """Times the robots one after the other; each is written when it is done."""
    import numpy as np

    from benchmarks._common import write_result
    from easi_jax.errors import UserError, nearest
    from envs import make

    for name in config.robots:
        if name not in GOALS:
            raise UserError(f'unknown robot "{name}"{nearest(name, GOALS)}')
    for name in config.robots:
        env, n, steps = make(name), config.population, STEPS[name]
        native = native_rates(env, n, steps, config.repeats)
        ours, compiled = search_rates(env, n, steps, config.repeats)
        native += native_rates(env, n, steps, config.repeats)
        ratio = float(np.median(ours) / np.median(native))
        rows = [("as the search runs it", f"{np.median(ours):,.0f}", f"{ratio:.2f}")]
        tried = {}
        for label, (step, fast, sensing) in _variants().items():
            if not config.variants or (sensing and not env.simulator.base.sense):
                continue
            rates, seconds = search_rates(env, n, steps, 2, step, fast, sensing)
            tried[label] = {"steps_per_s": rates, "compile_s": seconds}
            share = np.median(rates) / np.median(native)
            rows.append((label, f"{np.median(rates):,.0f}", f"{share:.2f}"))
        path = write_result(
            f"physics_{name}",
            f"python -m benchmarks.physics --robots {name}",
            config,
            native_steps_per_s=native,
            search_steps_per_s=ours,
            compile_s=compiled,
            ratio=ratio,
            ratio_goal=GOALS[name],
            variants=tried,
        )
        rows.append(("native MuJoCo, all cores", f"{np.median(native):,.0f}", "1"))
        show_table(
            f"{name}: physics steps per second", ("step", "per second", "ratio"), rows
        )
        say(f"written: {path}")


if __name__ == "__main__":
    main(Config, run, name="benchmarks.physics")
