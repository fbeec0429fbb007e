"""All robots, and what MuJoCo C makes of them; being listed here is being tested."""

import fnmatch
from collections.abc import Callable
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from easi_jax.simulation.simulator import Simulator
from envs import REGISTRY, load, make

EXAMPLES = Path(__file__).parents[2] / "examples"


@dataclass(frozen=True)
class Case:
    """One robot under test.

    Attributes:
        make: the environment.
        steps: control steps that are compared.
        commands: ``commands(env, rng) -> (nu,)``, held for a few steps.
        start: positions and velocities; those of a reset where None.
    """

    make: Callable[[], Any]
    steps: int
    commands: Callable[[Any, np.random.Generator], np.ndarray]
    start: tuple[tuple[float, ...], tuple[float, ...]] | None = None


def _around(center: Any, width: float) -> Callable[[Any, np.random.Generator], Any]:
    def commands(env: Any, rng: np.random.Generator) -> np.ndarray:
        middle = center(env)
        return middle + rng.uniform(-width, width, env.mj_model.nu)

    return commands


CASES = {
    # Far from its target, so that it meets its force limit.
    "cartpole": Case(
        lambda: make("cartpole"),
        60,
        lambda _, rng: rng.choice([-0.2, 0.2], 1),
        ((-0.19, 0.2), (0.0, 1.0)),
    ),
    "ant": Case(lambda: make("ant"), 60, _around(lambda e: np.zeros(8), 0.7)),
    "ballbalance": Case(
        lambda: make("ballbalance"), 12, _around(lambda e: np.zeros(3), 0.3)
    ),
    "go2": Case(
        lambda: make("go2"), 30, _around(lambda e: e.mj_model.key_ctrl[0], 0.25)
    ),
    "go2_full": Case(
        lambda: make("go2", parameters="full"),
        30,
        _around(lambda e: e.mj_model.key_ctrl[0], 0.25),
    ),
    "two_link": Case(
        lambda: load(EXAMPLES / "my_robot" / "env.py"),
        60,
        _around(lambda e: np.zeros(2), 0.3),
    ),
}
assert set(REGISTRY) <= set(CASES), "a robot is not tested"


def converged(env: Any) -> Simulator:
    """The robot with a solver that goes to the end, as C's does below."""
    m = env.mj_model.__copy__()
    m.opt.iterations = 100
    if env.simulator.engine == "mujoco":
        m.opt.ls_iterations, m.opt.tolerance = 50, 1e-14
    return env.simulator.rebuilt(m)


def spec_of(env: Any) -> mujoco.MjSpec:
    path = resources.files("envs") / "assets" / f"{env.name}.xml"
    if env.name == "two_link":
        path = EXAMPLES / "my_robot" / "model.xml"
    return mujoco.MjSpec.from_string(path.read_text())


def compiled(env: Any, values: dict[str, float]) -> tuple[mujoco.MjModel, np.ndarray]:
    """A model that MuJoCo compiled with parameters ``values``; joint speed limits."""
    spec = spec_of(env)
    limit = np.full(env.mj_model.nv, np.inf)
    for p in env.space.parameters:
        for address in p.addresses:
            kind, rest = address.split(".", 1)
            pattern, quantity = rest.rsplit(".", 1)
            objects = getattr(spec, kind + "s" if kind != "body" else "bodies")
            found = [o for o in objects if o.name and fnmatch.fnmatch(o.name, pattern)]
            assert found, address
            for o in found:
                if quantity == "speed_limit":
                    limit[env.mj_model.joint(o.name).dofadr] = values[p.name]
                else:
                    _WRITE[kind, quantity](o, values[p.name])
    m = spec.compile()
    m.opt.iterations, m.opt.ls_iterations, m.opt.tolerance = 100, 50, 1e-14
    m.opt.timestep = env.simulator.dt / env.simulator.substeps
    return m, limit


def _set_first(attribute: str) -> Callable[[Any, float], None]:
    def write(o: Any, value: float) -> None:
        old = np.array(getattr(o, attribute), float)
        if old.ndim:
            old[0] = value
            setattr(o, attribute, old)
        else:
            setattr(o, attribute, value)

    return write


def _kp(o: Any, value: float) -> None:
    gain, bias = np.array(o.gainprm), np.array(o.biasprm)
    gain[0], bias[1] = value, -value
    o.gainprm, o.biasprm = gain, bias


def _kv(o: Any, value: float) -> None:
    bias = np.array(o.biasprm)
    bias[2] = -value
    o.biasprm = bias


def _force_limit(o: Any, value: float) -> None:
    o.forcerange = [-value, value]


def _mass(o: Any, value: float) -> None:
    if o.explicitinertial:
        ratio = value / o.mass
        o.mass, o.fullinertia = value, ratio * np.array(o.fullinertia)
        return
    total = sum(g.mass for g in o.geoms)
    for g in o.geoms:
        g.mass = g.mass * value / total


def _contact_damping(o: Any, value: float) -> None:
    o.solref = [o.solref[0], -value]


def _length(o: Any, value: float) -> None:
    """Of a pole whose lower end stays where it is."""
    size, pos = np.array(o.size), np.array(o.pos)
    pos[2] += value / 2 - size[2]
    size[2] = value / 2
    o.size, o.pos = size, pos


_WRITE: dict[tuple[str, str], Callable[[Any, float], None]] = {
    ("joint", "damping"): _set_first("damping"),
    ("joint", "frictionloss"): _set_first("frictionloss"),
    ("joint", "armature"): _set_first("armature"),
    ("actuator", "kp"): _kp,
    ("actuator", "kv"): _kv,
    ("actuator", "force_limit"): _force_limit,
    ("actuator", "gear"): _set_first("gear"),
    ("body", "mass"): _mass,
    ("geom", "friction"): _set_first("friction"),
    ("geom", "contact_damping"): _contact_damping,
    ("geom", "length"): _length,
}


def c_rollout(
    env: Any, values: dict[str, float], start: tuple[Any, Any], ctrl: np.ndarray
) -> np.ndarray:
    """``(T, nq + nv)`` of MuJoCo C."""
    m, limit = compiled(env, values)
    d = mujoco.MjData(m)
    d.qpos[:], d.qvel[:] = start
    out = []
    for u in ctrl:
        d.ctrl[:] = u
        for _ in range(env.simulator.substeps):
            mujoco.mj_step(m, d)
            d.qvel[:] = np.clip(d.qvel, -limit, limit)
        out.append(np.concatenate([d.qpos, d.qvel]))
    return np.array(out)
