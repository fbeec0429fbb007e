"""How long the physics of MJX takes to compile on a CPU, and what it gains then.

    python -m benchmarks.compile_times

A replay of 50 control steps by as many simulations as a search runs at once is compiled
with its options and without the cache.
Arms differ in joints, in capsules that the hand may touch, and in effects of each
joint; bodies differ in shape, in how they are guided, and in what they lie on. Then the
program runs, and beside it native MuJoCo the same replay. Ten minutes or so on two
cores. Times are of the processor, tracing included, so that other work on the machine
does not count. The fit to them has the constants of
`easi_jax.simulation.compile_time`. Written to ``results/compile_times.json``, shown by
`benchmarks.summary`.
"""

import dataclasses
import time
from pathlib import Path
from typing import Any

from benchmarks._common import RESULTS, command_of, write_result
from benchmarks._page import table
from train._command import main, say

# Joints, pairs of capsules, effects.
ARMS = (
    *((1, 0, 0), (2, 0, 0), (1, 2, 0), (2, 4, 0), (2, 0, 2), (4, 0, 0)),
    *((4, 4, 0), (4, 0, 2), (6, 0, 0), (6, 4, 0)),
)
# How a body is guided, its shape, what it lies on.
BODIES = (
    *(("upright", "box", "plane"), ("upright", "box", "box")),
    *(("upright", "mesh", "box"), ("in a plane", "sphere", "plane")),
    *(("in a plane", "cylinder", "plane"), ("in a plane", "mesh", "plane")),
    *(("in a plane", "sphere", "box"), ("in a plane", "box", "box")),
    *(("free", "sphere", "plane"), ("free", "capsule", "plane")),
    ("free", "box", "plane"),
)
_STEPS, _PHYSICS_STEPS = 50, 5
_NATIVE = 128  # simulations
_RUN = 1.0  # s of the processor that runs are repeated for
_EFFECTS = ("drag.j", "lag.a")
_GUIDES = {
    "upright": '<joint name="z" type="slide" axis="0 0 1"/>',
    "in a plane": '<joint name="x" type="slide" axis="1 0 0"/><joint name="z" '
    'type="slide" axis="0 0 1"/><joint name="r" axis="0 1 0"/>',
    "free": '<freejoint name="f"/>',
}
_SHAPES = {
    "sphere": 'type="sphere" size="0.1"',
    "capsule": 'type="capsule" size="0.05 0.05"',
    "cylinder": 'type="cylinder" size="0.1 0.1"',
    "box": 'type="box" size="0.1 0.1 0.1"',
    "mesh": 'type="mesh" mesh="pyramid"',
}
_FLOORS = {
    "plane": 'type="plane" size="2 2 1"',
    "box": 'type="box" size="2 2 0.1" pos="0 0 -0.1"',
}


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
    for joints, pairs, effects in ARMS:
        rows.append(measured("arm", arm(joints, pairs), effects))
    for guide, shape, floor in BODIES:
        m = body(guide, shape, floor)
        rows.append(measured(f"{shape} on a {floor}, {guide}", m))
    constants = fitted([Size(**r["size"]) for r in rows], [r["seconds"] for r in rows])
    command = command_of("benchmarks.compile_times", config)
    path = write_result(
        *("compile_times", command, config, config.results),
        rows=rows,
        constants=constants,
    )
    say(f"{constants}; written: {path}")


def measured(robot: str, m: Any, effects: int = 0) -> dict[str, Any]:
    """A row: what is simulated, its size, seconds to compile, and microseconds of a
    physics step by each engine; all times of one core."""
    from easi_jax.simulation.compile_time import size_of

    size = dataclasses.asdict(size_of(m))
    row: dict[str, Any] = {"robot": robot, "size": size, "effects": effects}
    for engine in ("mjx", "mujoco"):
        seconds, each = replayed(m, effects, engine)
        if engine == "mjx":
            row["seconds"] = round(seconds, 2)
        row[engine] = float(f"{each * 1e6:.3g}")
    say(f"{row}")
    return row


def replayed(m: Any, effects: int, engine: Any) -> tuple[float, float]:
    """How long a replay took to compile, and then each physics step [s of one core]."""
    import jax
    import jax.numpy as jnp

    from easi_jax.devices import runtime
    from easi_jax.model.parameters import ParameterSpace, declare
    from easi_jax.simulation.simulator import Simulator

    names = [m.joint(j).name for j in range(m.njnt)]
    vary = names if m.nu else []
    space = ParameterSpace(
        tuple(declare(m, name, f"joint.{name}.damping") for name in vary)
    )
    fixed = {f"effect.{e}{j}": 0.01 for e in _EFFECTS[:effects] for j in range(m.nu)}
    dt = _PHYSICS_STEPS * m.opt.timestep
    simulator = Simulator(m, space, dt, fixed=fixed, engine=engine)

    def replay(theta: Any, qpos: Any, qvel: Any, ctrl: Any) -> Any:
        model = simulator.model(theta)

        def step(state: Any, u: Any) -> Any:
            state = simulator.step(model, state, u)
            return state, state.qpos

        first = simulator.start(qpos, qvel, model)
        at_once = simulator.replay(model, first, ctrl)
        return at_once[0] if at_once else jax.lax.scan(step, first, ctrl)[1]

    options = runtime.fast_loops() | runtime.quick_compile()
    n = simulator.batch if engine == "mjx" else _NATIVE
    given = (
        jnp.ones((n, len(vary))),
        jnp.tile(jnp.asarray(m.qpos0), (n, 1)),
        0.5 * jax.random.normal(jax.random.key(0), (n, m.nv)),
        jax.random.normal(jax.random.key(1), (n, _STEPS, m.nu)),
    )
    begin = time.process_time()
    program = jax.jit(jax.vmap(replay), compiler_options=options)
    program = program.lower(*given).compile()
    ready, runs, spent = time.process_time(), 0, 0.0
    while spent < _RUN:
        program(*given).block_until_ready()
        runs, spent = runs + 1, time.process_time() - ready
    each = spent / (runs * n * _STEPS * _PHYSICS_STEPS)
    return ready - begin, each


def body(guide: str, shape: str, floor: str) -> Any:
    """A body on a floor."""
    import mujoco

    pyramid = "-.1 -.1 -.1 .1 -.1 -.1 0 .1 -.1 0 0 .1"
    return mujoco.MjModel.from_xml_string(
        '<mujoco><option timestep="0.004" integrator="implicitfast"/><asset>'
        f'<mesh name="pyramid" vertex="{pyramid}"/></asset><worldbody>'
        f'<geom {_FLOORS[floor]}/><body pos="0 0 0.11">{_GUIDES[guide]}'
        f"<geom {_SHAPES[shape]}/></body></worldbody></mujoco>"
    )


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

    rows = [{**r, "told": expected_of(Size(**r["size"]))} for r in result["rows"]]
    columns = {
        "robot": "{robot}",
        "degrees of freedom": "{size[joints]}",
        "contacts with planes, others": "{size[on_planes]}, {size[others]}",
        "effects": "{effects}",
        "compiled in [s]": "{seconds:.1f}",
        "told before [s]": "{told:.0f}",
        "a step by `mjx`, `mujoco` [us]": "{mjx:.2g}, {mujoco:.2g}",
    }
    return [
        f"`{result['command']}`: a replay by MJX, seconds of one core; what a command "
        "says beforehand is the fit. Contacts are those that MJX computes at every "
        "step. A step is one of a simulation, microseconds of one core.",
        table(rows, columns),
    ]


if __name__ == "__main__":
    main(Config, run, name="benchmarks.compile_times")
