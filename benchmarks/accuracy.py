"""How exact a robot's physics is: Newton steps of the solver beside the time step.

    python -m benchmarks.accuracy

A population of random models from a reset under random commands; difference of the
positions after 0.1 and 0.2 s to the same time step with a converged solver, and of that
to a quarter of the time step.
"""

import dataclasses
from typing import Any

from train._command import main, say, show_table

ROBOTS = ("ant", "ballbalance", "go2")
TIMES = (0.1, 0.2)  # s
CONVERGED = 30
SHARES = (50, 90, 99)  # percentiles


@dataclasses.dataclass(frozen=True)
class Config:
    """Compares a robot's solver and time step with finer ones."""

    robots: tuple[str, ...] = ROBOTS
    """Which robots."""
    steps: tuple[int, ...] = (3, 4, 5, 6, 8)
    """Newton steps to compare."""
    population: int = 160
    """Models."""
    settle: float = 0.5
    """Seconds of motion before the comparison starts."""


def run(config: Config) -> None:
    """Writes one file a robot."""
    from benchmarks._common import command_of, write_result
    from envs import make

    for name in config.robots:
        env, chosen = make(name), dataclasses.replace(config, robots=(name,))
        found = _compare(env, config)
        path = write_result(
            f"accuracy_{name}",
            command_of("benchmarks.accuracy", chosen),
            chosen,
            used=int(env.mj_model.opt.iterations),
            times_s=TIMES,
            percentiles=SHARES,
            difference=found,
        )
        show_table(
            f"{name}: difference of positions [m, rad] after {TIMES[-1]} s",
            ("compared", *(f"{s} %" for s in SHARES)),
            [(k, *(f"{x:.1e}" for x in v[-1])) for k, v in found.items()],
        )
        say(f"written: {path}")


def _compare(env: Any, config: Config) -> dict[str, list[list[float]]]:
    import jax
    import jax.numpy as jnp
    import numpy as np

    from benchmarks.engines import random_commands
    from easi_jax.simulation.simulator import Simulator

    count = max(1, round(TIMES[-1] / env.dt))
    before = max(1, round(config.settle / env.dt))
    ctrl = random_commands(env, config.population, before + count)
    ctrl = jnp.asarray(ctrl, jnp.float32)
    unit = jax.random.uniform(jax.random.key(1), (config.population, env.space.size))
    theta = env.space.to_si(unit)
    reset = jax.random.split(jax.random.key(0), config.population)

    def simulator(iterations: int, finer: int = 1) -> Simulator:
        m = env.mj_model.__copy__()
        m.opt.iterations = iterations
        m.opt.timestep = env.dt / (env.simulator.substeps * finer)
        return env.simulator.rebuilt(m)

    def positions(simulator: Simulator, first: Any, ctrl: jax.Array) -> Any:
        def one(t: jax.Array, state: Any, u: jax.Array) -> Any:
            model = simulator.model(t)

            def advance(s: Any, a: jax.Array) -> Any:
                s = simulator.step(model, s, a)
                return s, s.qpos

            return jax.lax.scan(advance, state, u)

        return jax.jit(jax.vmap(one))(theta, first, ctrl)

    first = jax.vmap(lambda k: env.reset(env.model(), k).physics)(reset)
    first, _ = positions(env.simulator, first, ctrl[:, :before])
    ctrl = ctrl[:, before:]
    rows = [max(1, round(t / env.dt)) - 1 for t in TIMES]
    exact = np.asarray(positions(simulator(CONVERGED), first, ctrl)[1])

    def difference(other: Any) -> list[list[float]]:
        apart = np.abs(np.asarray(other) - exact).max(-1)[:, rows]
        return np.percentile(apart, SHARES, axis=0).T.tolist()

    found = {}
    for steps in config.steps:
        found[f"{steps} Newton steps"] = difference(
            positions(simulator(steps), first, ctrl)[1]
        )
        say(f"{env.name}: {steps} Newton steps {found[f'{steps} Newton steps'][-1]}")
    finer = positions(simulator(CONVERGED, 4), first, ctrl)[1]
    found["a quarter of the time step"] = difference(finer)
    return found


if __name__ == "__main__":
    main(Config, run, name="benchmarks.accuracy")
