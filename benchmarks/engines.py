"""Physics steps per second of every robot by each engine, and the time to the first.

    python -m benchmarks.engines
    python -m benchmarks.engines --robots ant go2 --populations 4096 16384 \\
        --programs mjx mjx.step warp --kinds replay

Every individual is a model of its own. Beside the engines of the package stands
``mujoco.rollout`` on all cores in the same run, with as many different models: before
and after them, so that what else the machine does is seen. Each timing is a line of
``benchmarks/results/engines.jsonl``, with versions and device, and is not done again
there. `easi_jax.simulation.engine` chooses by these figures.
"""

import dataclasses
import threading
import time
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from benchmarks._common import RESULTS, markdown_table
from benchmarks._page import met
from train._command import main, say

ROBOTS = ("cartpole", "ant", "ballbalance", "go2")
PROGRAMS = ("rollout", "mjx", "mujoco", "mjx.step", "warp")
KINDS = ("replay", "policy", "search")
STEPS = {"cartpole": 200, "ant": 50, "ballbalance": 5, "go2": 25}  # control steps
# What `auto` shall reach: of mujoco.rollout's steps, and seconds of a search.
RATIOS = {"cartpole": 5.0, "ant": 0.9, "ballbalance": 0.9, "go2": 0.9}
SECONDS = {"ant": 40, "ballbalance": 120, "go2": 110}
GENERATIONS = 50
INDIVIDUALS = 300  # of a search
SEARCHED = {
    "ballbalance": 50
}  # control steps that an individual is searched by; or 200
_HIDDEN = 64  # units of each of a policy's two layers, as SAC and PPO train them here
# What Warp makes room for: Ant and Go2 touch the floor with a foot or two bodies more.
_CONTACTS, _ROWS = 24, 160  # of a simulation
_tracing = threading.Lock()  # side by side it ended in a segmentation fault


@dataclasses.dataclass(frozen=True)
class Config:
    """Times the engines on every robot."""

    robots: tuple[str, ...] = ROBOTS
    """Which robots."""
    programs: tuple[str, ...] = ("rollout", "mjx", "mujoco")
    """What simulates: rollout (mujoco.rollout), mjx and mujoco (this package), mjx.step
    (as it stands), warp (its step on MuJoCo Warp, on an NVIDIA GPU)."""
    kinds: tuple[str, ...] = KINDS
    """replay: recorded commands, as a search replays a log; policy: a network acts on
    what the robot observes, as in training; search: 50 generations, by their seconds.
    """
    populations: tuple[int, ...] = (300,)
    """Individuals."""
    repeats: int = 5
    """Timings; the median is reported, all are written."""
    at_once: int = 1
    """Programs that are compiled side by side; with more than one, the time that a
    program took to compile means little."""
    out: Path = RESULTS / "engines.jsonl"
    """Where a line for each is added."""


@dataclasses.dataclass(frozen=True)
class _Cell:
    robot: str
    program: str
    kind: str
    population: int


def run(config: Config) -> None:
    """Compiles and times all that has no line yet."""
    import jax
    import numpy as np

    from benchmarks._cells import add_row, read_rows
    from easi_jax.errors import UserError, nearest
    from easi_jax.io.runs.versions import versions

    for given, known in (
        (config.robots, ROBOTS),
        (config.programs, PROGRAMS),
        (config.kinds, KINDS),
    ):
        for name in given:
            if name not in known:
                raise UserError(f'unknown "{name}"{nearest(name, known)}')
    where = {"device": jax.devices()[0].device_kind, "devices": jax.device_count()}

    def named(cell: Any) -> dict[str, Any]:
        return {**where, **dataclasses.asdict(cell)}

    done = [
        {k: r[k] for k in named(_Cell("", "", "", 0))} for r in read_rows(config.out)
    ]
    for robot in config.robots:
        cells = [
            cell
            for kind in config.kinds
            for n in ((INDIVIDUALS,) if kind == "search" else config.populations)
            for program in config.programs
            if named(cell := _Cell(robot, program, kind, n)) not in done
            and (program in ("mjx", "mujoco") or kind == "replay")
        ]
        compiled, automatic = [], _automatic(robot) if cells else ""
        with ThreadPoolExecutor(config.at_once) as pool:
            for cell in (c for c in cells if c.program != "rollout"):
                make, steps = _program(cell)
                compiled.append((cell, steps, pool.submit(_compiled, make)))
        natives = [c for c in cells if c.program == "rollout"]
        rates: dict[_Cell, list[float]] = {c: native_rates(c, config) for c in natives}
        figures: dict[_Cell, dict[str, float]] = {c: {} for c in natives}
        for cell, steps, ready in compiled:
            call, figures[cell] = ready.result()
            seconds, again = [], config.repeats * (cell.kind != "search")
            for _ in range(again + 1):
                begin = time.monotonic()
                jax.block_until_ready(call())
                seconds.append(time.monotonic() - begin)
            figures[cell]["first_call_s"] = seconds[0]
            measured = seconds[1:] or seconds
            rates[cell] = [cell.population * steps / s for s in measured]
        for cell in natives:
            rates[cell] += native_rates(cell, config)
        for cell, measured in rates.items():
            row = {**named(cell), "auto": automatic}
            row |= {"steps_per_s": measured, **figures[cell]}
            add_row(config.out, {**row, "versions": versions()})
            say(
                f"{cell.robot}, {cell.program}, {cell.kind}, {cell.population:,}: "
                f"{np.median(measured):,.0f} physics steps/s {figures[cell]}"
            )


def _automatic(robot: str) -> str:
    """The engine that ``auto`` takes here."""
    from easi_jax.simulation import engine
    from envs import make

    with engine.using("auto"):
        return make(robot).simulator.engine


def _compiled(make: Callable[[], Any]) -> tuple[Callable[[], Any], dict[str, float]]:
    """A program that is ready to run, and the seconds that this took."""
    with _tracing:
        begin = time.monotonic()
        lowered, args = make()
        traced = time.monotonic()
    program = lowered.compile()
    seconds = {"trace_s": traced - begin, "compile_s": time.monotonic() - traced}
    return (lambda: program(*args)), seconds


def native_rates(cell: _Cell, config: Config) -> list[float]:
    """Physics steps per second of ``mujoco.rollout`` on all cores, from a reset."""
    import copy

    import jax
    import mujoco
    import numpy as np
    from mujoco import rollout

    from easi_jax.devices import runtime
    from envs import make

    env, n, steps = make(cell.robot), cell.population, STEPS[cell.robot]
    m, held = env.mj_model, env.simulator.substeps
    first = env.reset(env.model(), jax.random.key(0)).physics
    size = mujoco.mj_stateSize(m, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    start = np.zeros((n, size))
    start[:, 1 : 1 + m.nq] = np.asarray(first.qpos)
    start[:, 1 + m.nq : 1 + m.nq + m.nv] = np.asarray(first.qvel)
    ctrl = np.repeat(random_commands(env, n, steps), held, axis=1)
    models, rng = [copy.copy(m) for _ in range(n)], np.random.default_rng(0)
    for one in models:
        one.dof_armature[:] *= rng.uniform(0.8, 1.2)
    threads, out = runtime.cores(), []
    with rollout.Rollout(nthread=threads) as pool:
        datas = [mujoco.MjData(m) for _ in range(threads)]
        for _ in range(config.repeats + 1):
            begin = time.monotonic()
            pool.rollout(models, datas, start, ctrl)
            out.append(n * steps * held / (time.monotonic() - begin))
    return out[1:]


def random_commands(env: Any, count: int, steps: int) -> Any:
    """Random commands ``(count, steps, nu)`` in a half of the actuators' range."""
    import numpy as np

    low, high = env.mj_model.actuator_ctrlrange.T
    rng = np.random.default_rng(0)
    middle, half = (low + high) / 2, (high - low) / 4
    return middle + half * rng.uniform(-1, 1, (count, steps, len(low)))


def _program(cell: _Cell) -> tuple[Callable[[], Any], int]:
    """What lowers the program of a cell and gives its arguments; physics steps of an
    individual."""
    import jax
    import jax.numpy as jnp

    from easi_jax.simulation import engine
    from envs import make

    with engine.using("mujoco" if cell.program == "mujoco" else "mjx"):
        env = make(cell.robot)
    n, steps = cell.population, STEPS[cell.robot]
    if cell.kind == "search":
        steps = SEARCHED.get(cell.robot, 200)
        each = GENERATIONS * steps * env.simulator.substeps
        return (lambda: _search(env, n, steps)), each
    ctrl = jnp.asarray(random_commands(env, n, steps), jnp.float32)
    unit = jax.random.uniform(jax.random.key(1), (n, env.space.size))
    first = env.reset(env.model(), jax.random.key(0)).physics
    if cell.program == "warp":
        lower = _warp(env, first)
    elif cell.program == "mjx.step":
        lower = _spread(env, _mjx_step(env, first))
    elif cell.kind == "policy":
        lower = _spread(env, _policy(env, steps))
    else:
        lower = _spread(env, _replay(env, first))
    return (lambda: lower(unit, ctrl)), steps * env.simulator.substeps


def _spread(env: Any, one: Callable[..., Any]) -> Callable[..., Any]:
    """Individuals over all devices, as many at once as a search takes."""
    import jax

    from easi_jax.devices.mesh import make_mesh, sharded_map
    from easi_jax.devices.runtime import fast_loops

    def local(items: Any) -> Any:
        return jax.lax.map(lambda x: one(*x), items, batch_size=env.simulator.batch)

    def lower(*args: Any) -> Any:
        run = jax.jit(
            lambda *a: sharded_map(local, make_mesh(), a), compiler_options=fast_loops()
        )
        return run.lower(*args), args

    return lower


def _replay(env: Any, first: Any) -> Callable[..., Any]:
    import jax.numpy as jnp

    from easi_jax.data.segments import Segments
    from easi_jax.simulation.open_loop import predict

    def one(u: Any, c: Any) -> Any:
        model = env.simulator.model(env.space.to_si(u))
        qpos, qvel = first.qpos[None], first.qvel[None]
        none = jnp.zeros(())
        piece = Segments(qpos, qvel, c[None], none, none, jnp.ones(1))
        return predict(env.simulator, model, piece)

    return one


def _policy(env: Any, steps: int) -> Callable[..., Any]:
    import jax
    import jax.numpy as jnp

    from easi_jax.simulation.rollout import policy_rollout

    sizes = (env.obs_size, _HIDDEN, _HIDDEN, env.action_size)
    keys = jax.random.split(jax.random.key(2), len(sizes) - 1)
    layers = [
        jax.random.normal(k, (a, b)) / a**0.5
        for k, a, b in zip(keys, sizes[:-1], sizes[1:], strict=True)
    ]

    def act(obs: Any, _: Any) -> Any:
        for w in layers:
            obs = jnp.tanh(obs @ w)
        return obs

    def one(u: Any, c: Any) -> Any:
        model = env.model(env.space.to_si(u))
        key = jax.random.key((1e6 * jnp.abs(c).sum()).astype(jnp.uint32))
        out = policy_rollout(env, model, act, key, steps)
        return out.next_qpos, out.next_qvel

    return one


def _search(env: Any, population: int, segments: int) -> Any:
    import jax

    from benchmarks.scaling import first_state
    from easi_jax.devices.runtime import fast_loops

    made, state, logged = first_state(
        env, generations=GENERATIONS, population=population, segments=segments
    )
    run = jax.jit(
        lambda s, d: made.run(s, d, GENERATIONS), compiler_options=fast_loops()
    )
    return run.lower(state, logged), (state, logged)


def _mjx_step(env: Any, first: Any) -> Callable[..., Any]:
    import jax
    from mujoco import mjx

    from easi_jax.simulation import step as physics

    simulator = env.simulator

    def one(u: Any, c: Any) -> Any:
        model = simulator.without_sense(simulator.model(env.space.to_si(u)))

        def inner(state: Any, ctrl: Any) -> Any:
            d = mjx.step(model.mjx, physics.data_at(model, state, ctrl))
            after = dataclasses.replace(
                state, qpos=d.qpos, qvel=d.qvel, warmstart=d.qacc_warmstart
            )
            return after, None

        def advance(state: Any, ctrl: Any) -> Any:
            held = jax.numpy.broadcast_to(ctrl, (simulator.substeps, *ctrl.shape))
            state = jax.lax.scan(inner, state, held)[0]
            return state, (state.qpos, state.qvel)

        state = physics.at_rest(model, first.qpos, first.qvel)
        return jax.lax.scan(advance, state, c)[1]

    return one


def _warp(env: Any, first: Any) -> Callable[..., Any]:
    """MuJoCo Warp through ``mjx.step``: nominal models, so it has less to do."""
    import jax
    from mujoco import mjx

    held = env.simulator.substeps

    def lower(unit: Any, ctrl: Any) -> Any:
        n = len(unit)
        m = mjx.put_model(env.mj_model, impl="warp")

        def start(_: Any) -> Any:
            d = mjx.make_data(
                env.mj_model, impl="warp", naconmax=n * _CONTACTS, njmax=_ROWS
            )
            return d.replace(qpos=first.qpos, qvel=first.qvel)

        def one(d: Any, c: Any) -> Any:
            def advance(d: Any, u: Any) -> Any:
                d = d.replace(ctrl=u)
                d = jax.lax.fori_loop(0, held, lambda _, x: mjx.step(m, x), d)
                return d, (d.qpos, d.qvel)

            return jax.lax.scan(advance, d, c)[1]

        datas = jax.jit(jax.vmap(start))(jax.numpy.arange(n))
        return jax.jit(jax.vmap(one)).lower(datas, ctrl), (datas, ctrl)

    return lower


def paragraphs(rows: Iterable[Any]) -> list[str]:
    """What the page of results says of the lines of ``engines.jsonl``."""
    import numpy as np

    by_device: dict[str, dict[_Cell, Any]] = {}
    for r in rows:
        cell = _Cell(*(r[f.name] for f in dataclasses.fields(_Cell)))
        where = f"{r['device']}, {r['versions']['runtime']['cores']} cores"
        by_device.setdefault(where, {})[cell] = r
    said = [
        "`python -m benchmarks.engines`: every individual a model of its own, beside "
        "`mujoco.rollout` on the same cores in the same run, from a reset, with random "
        "commands; float32 (`mjx`) beside float64. Medians; all timings are in the "
        "file. What `auto` takes is marked. A policy is a network that acts on "
        "observations; its steps are compared with `mujoco.rollout` without one.",
    ]
    for where, cells in by_device.items():
        beside = "rollout" if any(c.program == "rollout" for c in cells) else "mjx.step"
        table = []
        for cell, r in sorted(cells.items(), key=lambda x: _place(x[0])):
            if cell.kind == "search" or cell.program == "rollout":
                continue
            chosen = cell.program == r.get("auto", "mjx")
            rate, goal, ratio = float(np.median(r["steps_per_s"])), "", ""
            plain = dataclasses.replace(cell, program=beside, kind="replay")
            if plain in cells:
                share = rate / float(np.median(cells[plain]["steps_per_s"]))
                ratio = f"{share:.2f}"
                least = RATIOS[cell.robot]
                if chosen and beside == "rollout":
                    goal = f"{least:g}, {met(share >= least)}"
            first = sum(r[k] for k in ("trace_s", "compile_s", "first_call_s"))
            name = f"**{cell.program}** (auto)" if chosen else cell.program
            what = (cell.robot, cell.kind, f"{cell.population:,}", name)
            table.append((*what, f"{rate:,.0f}", ratio, goal, f"{first:.1f} s"))
        said += [
            f"On {where}:",
            markdown_table(
                (
                    *("robot", "what", "individuals", "engine", "physics steps/s"),
                    *(f"of {beside}", "goal", "until the first result"),
                ),
                table,
            ),
        ]
        if any(c.program == "warp" for c in cells):
            said.append(
                "Warp (MuJoCo Warp by `mjx.step`) has the same, nominal model in every "
                "simulation, and ends its contact solver at the robots' own 8 Newton "
                "steps, as it warns. The package's own solver stays: its searches end "
                "in seconds, every simulation may be another model, and it also runs "
                "on a CPU and in double precision."
            )
        found = [(c, r) for c, r in cells.items() if c.kind == "search"]
        if found:
            said += [
                f"Searches of {GENERATIONS} generations of {INDIVIDUALS}, 200 control "
                "steps (Ballbalance: 50), after compilation:",
                markdown_table(
                    ("robot", "engine", "search", "goal", "trace and compile"),
                    [
                        _searched(c, r)
                        for c, r in sorted(found, key=lambda x: _place(x[0]))
                    ],
                ),
            ]
    return said


def _place(cell: _Cell) -> tuple[Any, ...]:
    order = (ROBOTS.index(cell.robot), KINDS.index(cell.kind))
    return *order, cell.population, PROGRAMS.index(cell.program)


def _searched(cell: _Cell, r: Any) -> tuple[str, ...]:
    on_cpu = r["device"] == "cpu"
    seconds, most = r["first_call_s"], SECONDS.get(cell.robot) if on_cpu else 60
    chosen = cell.program == r.get("auto", "mjx")
    goal = f"{most} s, {met(seconds < most)}" if most and chosen else ""
    name = f"**{cell.program}** (auto)" if chosen else cell.program
    before = r["trace_s"] + r["compile_s"]
    return cell.robot, name, f"{seconds:.1f} s", goal, f"{before:.0f} s"


if __name__ == "__main__":
    main(Config, run, name="benchmarks.engines")
