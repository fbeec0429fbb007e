"""How long the physics of MJX takes to compile on a CPU.

    python -m benchmarks.compile_times

A replay of 50 control steps by 128 simulations of an arm is compiled with the options
of a search and without the cache; arms differ in joints, in capsules that the hand may
touch, and in effects of each joint. Three minutes or so on two cores. Times are of
the processor, tracing included, so that other work on the machine does not count. The
fit to them has the constants of `easi_jax.simulation.compile_time`. Written to
``results/compile_times.json``, shown by `benchmarks.summary`.
"""

import dataclasses
import time
from pathlib import Path
from typing import Any

from benchmarks._common import RESULTS, command_of, write_result
from benchmarks._page import table
from train._command import main, say

# Joints, pairs of capsules, effects.
CASES = (
    *((1, 0, 0), (2, 0, 0), (1, 2, 0), (2, 4, 0), (2, 0, 2), (4, 0, 0)),
    *((4, 4, 0), (4, 0, 2), (6, 0, 0), (6, 4, 0), (12, 0, 0), (12, 4, 0)),
)
_STEPS, _BATCH = 50, 128
_EFFECTS = ("drag.j", "lag.a")


@dataclasses.dataclass(frozen=True)
class Config:
    """Compiles arms of several sizes."""

    results: Path = RESULTS
    """Folder of compile_times.json."""


def run(config: Config) -> None:
    """Compiles, fits and writes."""
    import jax

    from easi_jax.devices import runtime
    from easi_jax.simulation.compile_time import Size, fitted

    runtime.prepare()
    jax.config.update("jax_enable_compilation_cache", False)
    rows = []
    for joints, pairs, effects in CASES:
        size, seconds = compiled(joints, pairs, effects)
        row = {**dataclasses.asdict(size), "effects": effects}
        rows.append({**row, "seconds": round(seconds, 2)})
        say(f"{rows[-1]}")
    sizes = [Size(r["joints"], r["pairs"]) for r in rows]
    constants = fitted(sizes, [r["seconds"] for r in rows])
    command = command_of("benchmarks.compile_times", config)
    path = write_result(
        *("compile_times", command, config, config.results),
        rows=rows,
        constants=constants,
    )
    say(f"{constants}; written: {path}")


def compiled(joints: int, pairs: int, effects: int) -> tuple[Any, float]:
    """An arm's size, and how long its replay took to compile [s of one core]."""
    import jax
    import jax.numpy as jnp

    from easi_jax.devices import runtime
    from easi_jax.model.parameters import ParameterSpace, declare
    from easi_jax.simulation.compile_time import size_of
    from easi_jax.simulation.simulator import Simulator

    m = arm(joints, pairs)
    names = [f"j{j}" for j in range(joints)]
    space = ParameterSpace(
        tuple(declare(m, name, f"joint.{name}.damping") for name in names)
    )
    fixed = {f"effect.{e}{j}": 0.01 for e in _EFFECTS[:effects] for j in range(joints)}
    simulator = Simulator(m, space, 0.02, fixed=fixed)

    def replay(theta: Any, qpos: Any, qvel: Any, ctrl: Any) -> Any:
        model = simulator.model(theta)

        def step(state: Any, u: Any) -> Any:
            state = simulator.step(model, state, u)
            return state, state.qpos

        return jax.lax.scan(step, simulator.start(qpos, qvel, model), ctrl)[1]

    options = runtime.fast_loops() | runtime.quick_compile()
    state = jnp.zeros((_BATCH, joints))
    ctrl = jnp.zeros((_BATCH, _STEPS, joints))
    begin = time.process_time()
    program = jax.jit(jax.vmap(replay), compiler_options=options)
    program.lower(state, state, state, ctrl).compile()
    return size_of(simulator), time.process_time() - begin


def arm(joints: int, pairs: int) -> Any:
    """A chain of servo joints with dry friction, whose hand may touch posts."""
    import mujoco

    links = "".join(
        f'<body name="b{j}" pos="0 0 0.2"><joint name="j{j}" damping="1" '
        f'axis="{j % 2} {1 - j % 2} 0" frictionloss="0.1"/><geom type="capsule" '
        'size="0.03" fromto="0 0 0 0 0 0.2" contype="0" conaffinity="0"/>'
        for j in range(joints)
    )
    hand = '<geom type="capsule" size="0.02" fromto="0 0 0.2 0 0 0.25"/>'
    posts = "".join(
        f'<geom type="capsule" size="0.02" fromto="1 {k} 0 1 {k} 1"/>'
        for k in range(pairs)
    )
    drives = "".join(
        f'<position name="a{j}" joint="j{j}" kp="20" kv="1"/>' for j in range(joints)
    )
    return mujoco.MjModel.from_xml_string(
        '<mujoco><option timestep="0.004" integrator="implicitfast"/><worldbody>'
        f"{posts}{links}{hand}{'</body>' * joints}</worldbody>"
        f"<actuator>{drives}</actuator></mujoco>"
    )


def paragraphs(result: dict[str, Any]) -> list[str]:
    """The table as on the page of results."""
    from easi_jax.simulation.compile_time import Size, expected_of

    rows = [
        {**r, "told": expected_of(Size(r["joints"], r["pairs"]))}
        for r in result["rows"]
    ]
    columns = {
        "joints": "{joints}",
        "pairs that may touch": "{pairs}",
        "effects": "{effects}",
        "compiled in [s]": "{seconds:.1f}",
        "told before [s]": "{told:.0f}",
    }
    return [
        f"`{result['command']}`: a replay of arms by MJX, seconds of one core; what a "
        "command says beforehand is the fit.",
        table(rows, columns),
    ]


if __name__ == "__main__":
    main(Config, run, name="benchmarks.compile_times")
