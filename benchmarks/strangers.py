"""Robots of others: seconds until the first simulation, and of a search.

    python -m benchmarks.strangers

``arm6_capsules``: six joints and 21 pairs of capsules that may touch, made here with a
log of its own. ``go2_in_air``: the recording of a Go2 in a stand, and the model beside
it, in ``../shared/data``; named as not run where that is missing. Each in a process of
its own with nothing cached; the engine is what ``auto`` takes. Results go to
``benchmarks/results/strangers.json``.
"""

import dataclasses
import json
import tempfile
import time
from pathlib import Path
from typing import Any

from benchmarks._common import ROOT
from train._command import main, say

STAND = ROOT.parent / "shared" / "data" / "go2_in_air"
MACHINES = ("arm6_capsules", "go2_in_air")
FIRST, SEARCH = 10, 120  # s, goals
_LIMIT = 1800  # s
# Links of the arm: length [m], radius [m], mass [kg], axis of the joint below it.
_LINKS = (
    (0.15, 0.05, 4.0, "0 0 1"),
    (0.40, 0.05, 6.0, "0 1 0"),
    (0.35, 0.04, 3.0, "0 1 0"),
    (0.10, 0.04, 1.5, "1 0 0"),
    (0.10, 0.035, 1.2, "0 1 0"),
    (0.08, 0.03, 0.5, "0 0 1"),
)
_CONTROL_STEP = 0.005  # s
_SECONDS = 20.0
_NOISE = 2e-4  # rad
_TRUTH = {"damping": 2.0, "armature": 1.6}  # times the model's


@dataclasses.dataclass(frozen=True)
class Config:
    """Times the first minutes with robots that are not the package's own."""

    machines: tuple[str, ...] = MACHINES
    """Which machines."""
    population: int = 300
    """Individuals."""
    generations: int = 50
    """Generations."""
    engine: str = "auto"
    """auto, mjx or mujoco."""
    phase: str = "all"
    """all, or a machine: print the times of this process and stop."""
    began: float = 0.0
    """When that process was started, in seconds of the epoch."""


def arm_xml() -> str:
    """MJCF of an arm with position drives; two capsules of its base and tool beside
    those of six links make 21 pairs that may touch."""
    body, above = "", 0.2
    for k, (length, radius, mass, axis) in enumerate(_LINKS):
        body += (
            f'<body name="link{k}" pos="0 0 {above}"><joint name="j{k}" axis="{axis}"/>'
            f'<geom type="capsule" size="{radius}" fromto="0 0 0 0 0 {length}" '
            f'mass="{mass}"/>'
        )
        above = length
    tool = f'<geom type="capsule" size="0.02" fromto="0 0 {above} 0.1 0 {above}"/>'
    drives = "".join(
        f'<position name="d{k}" joint="j{k}" kp="{600 / 2**k}" kv="{40 / 2**k}"/>'
        for k in range(len(_LINKS))
    )
    return (
        '<mujoco><option timestep="0.0025"/><default><joint damping="0.5" '
        'armature="0.05" frictionloss="0.1" range="-2.5 2.5" limited="true"/></default>'
        '<worldbody><geom type="capsule" size="0.06" fromto="0 0 0 0 0 0.15"/>'
        f"{body}{tool}{'</body>' * len(_LINKS)}</worldbody>"
        f"<actuator>{drives}</actuator></mujoco>"
    )


def arm_log(m: Any) -> Any:
    """20 s of sines, measured on the arm with other damping and armature."""
    import copy

    import mujoco
    import numpy as np

    from easi_jax.data.recording import Run
    from easi_jax.model.joint_space import Configuration

    real, rng = copy.copy(m), np.random.default_rng(0)
    real.dof_damping[:] *= _TRUTH["damping"]
    real.dof_armature[:] *= _TRUTH["armature"]
    d, t = mujoco.MjData(real), np.arange(0, _SECONDS, _CONTROL_STEP)
    waves = np.linspace(0.2, 0.7, m.nu) * t[:, None]
    ctrl = np.minimum(t / 2, 1)[:, None] * 0.5 * np.sin(2 * np.pi * waves)
    qpos, qvel = np.empty((len(t), m.nq)), np.empty((len(t), m.nv))
    for k, u in enumerate(ctrl):
        qpos[k] = d.qpos + _NOISE * rng.standard_normal(m.nq)
        qvel[k] = d.qvel + 20 * _NOISE * rng.standard_normal(m.nv)
        d.ctrl[:] = u
        mujoco.mj_step(real, d, nstep=round(_CONTROL_STEP / m.opt.timestep))
    return Run(
        name="sines",
        source="",
        dt=_CONTROL_STEP,
        time=t,
        qpos=qpos,
        qvel=qvel,
        qvel_measured=True,
        ctrl=ctrl,
        configuration=Configuration.of(m),
    )


def _machine(name: str, folder: Path) -> tuple[Any, Any, Any]:
    """Model, parameters and log as an owner reads them from files."""
    import easi_jax
    from easi_jax.io.logs.reader import write_log
    from easi_jax.model.parameter_proposal import own_space

    if name == "go2_in_air":
        m = easi_jax.read_model(STAND / "model.xml")
        return m, own_space(m), easi_jax.read_log(STAND / "chirp.csv", m)
    (folder / "arm.xml").write_text(arm_xml())
    m = easi_jax.read_model(folder / "arm.xml")
    write_log(folder / "sines.csv", m, arm_log(m))
    return m, own_space(m), easi_jax.read_log(folder / "sines.csv", m)


def _times(config: Config) -> dict[str, Any]:
    """Seconds since the process was started, until the first simulation; of a search,
    its compilation included."""
    import jax
    import numpy as np

    import easi_jax
    from easi_jax.data.segments import cut
    from easi_jax.model.contact_pairs import pair_ids
    from easi_jax.simulation import engine
    from easi_jax.simulation.open_loop import predict
    from easi_jax.simulation.simulator import Simulator

    with tempfile.TemporaryDirectory() as folder:
        m, space, log = _machine(config.phase, Path(folder))
    run = log.runs[0]
    with engine.using(config.engine):
        simulator = Simulator(m, space, run.dt)
        piece = cut(run.qpos, run.qvel, run.ctrl, 40, len(run.qpos))
        assert piece is not None  # a log is longer
        predicted = jax.jit(lambda s: predict(simulator, simulator.base, s))(piece)
        finite = bool(np.isfinite(predicted[0]).all())
    first = time.time() - config.began
    begin = time.monotonic()
    found = easi_jax.search_parameters(
        *(m, space, log),
        generations=config.generations,
        population=config.population,
        engine=config.engine,
    )
    return {
        "joints": m.njnt,
        "pairs": len(pair_ids(m)),
        "parameters": space.size,
        "engine": simulator.engine,
        "finite": finite and bool(np.isfinite(found.mean).all()),
        "first_simulation_s": first,
        "search_s": time.monotonic() - begin,
    }


def run(config: Config) -> None:
    """Times each machine in a process of its own."""
    from benchmarks._common import command_of, first_start, write_result
    from easi_jax.errors import UserError, nearest

    for name in config.machines:
        if name not in MACHINES:
            raise UserError(f'unknown machine "{name}"{nearest(name, MACHINES)}')
    if config.phase != "all":
        say(json.dumps(_times(config)))
        return
    found: dict[str, Any] = {}
    for name in config.machines:
        if name == "go2_in_air" and not STAND.is_dir():
            say(f"{name}: not run, its recording is missing")
            continue
        with tempfile.TemporaryDirectory() as cache:
            given = ["--phase", name, "--began", str(time.time())]
            for key in ("population", "generations", "engine"):
                given += [f"--{key}", str(getattr(config, key))]
            words = ("-m", "benchmarks.strangers", *given)
            printed = first_start(words, Path(cache), _LIMIT)[1]
        found[name] = json.loads(printed.strip().splitlines()[-1])
        say(f"{name}: {found[name]}")
    path = write_result(
        "strangers",
        command_of("benchmarks.strangers", config),
        config,
        goals={"first_simulation_s": FIRST, "search_s": SEARCH},
        machines=found,
    )
    say(f"written: {path}")


def paragraphs(r: Any) -> list[str]:
    """What the page of results says of it."""
    from benchmarks._page import met, table

    def judged(key: str) -> Any:
        most = r["goals"][key]
        return lambda x: f"{x[key]:.1f} s ({most} s, {met(x[key] < most)})"

    columns = {
        "machine": "{name}",
        "joints": "{joints}",
        "pairs that may touch": "{pairs}",
        "parameters": "{parameters}",
        "engine": "{engine}",
        "until the first simulation": judged("first_simulation_s"),
        "search of 50 x 300, compilation included": judged("search_s"),
    }
    rows = [{"name": name, **x} for name, x in r["machines"].items()]
    said = "robots that are not the package's own, in fresh processes with cold caches:"
    return [f"`{r['command']}`, {said}", table(rows, columns)]


if __name__ == "__main__":
    main(Config, run, name="benchmarks.strangers")
