"""The loop closed: what a hidden effect costs, and what finding it brings back.

    python -m benchmarks.loop --effect friction
    python -m benchmarks.loop --effect delay
    python -m benchmarks.loop --robot go2 --seeds 0 1 2
    python -m train.udr --robot go2 --env-steps 5000000 --out results/go2_udr
    python -m benchmarks.loop --robot go2 --start-from results/go2_udr --seeds 0 1 2
    python -m benchmarks.loop --robot go2 --effect delay --start-from results/go2_udr \
        --seeds 0 1 2

The target has an effect that no training knows of. UDR policies act in it; from their
noisy logs ``train.gap`` finds what the model lacks; ``train.easi`` then searches and
trains with what was found, and without it. Oracle trains in the target itself. All
seeds are paired, and the commands are those that a user has.

On Go2 no search follows: policies are trained with what was found, as long as without
it. With ``--start-from`` one trained policy acts in the target, and each training goes
on from it, for processors; without it each starts from nothing, for a GPU.
"""

import dataclasses
from pathlib import Path
from typing import Any

from train._command import main, say

# Of the target alone: on Cartpole the largest that an Oracle still balances with.
HIDDEN = {
    "cartpole": {
        "friction": """effects:
- {effect: coulomb_friction, at: cart, kind: joint, columns: {coulomb: 1.2}}
""",
        "delay": """effects:
- {effect: actuator_delay, at: cart, kind: actuator, columns: {delay: 0.05}}
""",
    },
    "go2": {
        "friction": """effects:
- {effect: coulomb_friction, at: RR_calf, kind: joint, columns: {coulomb: 4.0}}
- {effect: coulomb_friction, at: RR_thigh, kind: joint, columns: {coulomb: 4.0}}
""",
        "delay": """effects:
- {effect: actuator_delay, at: RR_calf, kind: actuator, columns: {delay: 0.04}}
- {effect: actuator_delay, at: RR_thigh, kind: actuator, columns: {delay: 0.04}}
""",
    },
}
# Standard deviations of a reading [m, rad], of a free joint's six, then of the others.
NOISE = {"cartpole": (2e-4, 5e-4), "go2": (*[2e-4] * 3, *[5e-4] * 3, *[2e-4] * 12)}
EPISODES = {"cartpole": 2, "go2": 6}  # of each policy, as logs
POLICIES = {"cartpole": 5, "go2": 1}  # at most, that are logged
STEPS = {"go2": 1_000_000}  # of each training that goes on


@dataclasses.dataclass(frozen=True)
class Config:
    """Trains before and after the gap workflow, in a target with a hidden effect."""

    robot: str = "cartpole"
    """cartpole or go2."""
    effect: str = "friction"
    """friction or delay."""
    start_from: Path | None = None
    """Run folder of train.udr that Go2's trainings go on from."""
    seeds: tuple[int, ...] = (0, 1, 2, 3, 4)
    """Seeds, paired over methods."""
    folder: Path = Path("results/loop")
    """Where the runs are kept; finished ones are not run again."""


def run(config: Config) -> None:
    """Runs the chain with and without the gap workflow."""
    from benchmarks._common import command_of, show_returns, write_result
    from easi_jax.errors import UserError, nearest
    from easi_jax.io.files import atomic_write

    for flag, word, known in (
        ("robot", config.robot, HIDDEN),
        ("effect", config.effect, HIDDEN.get(config.robot, {})),
    ):
        if word not in known:
            which = " or ".join(known)
            raise UserError(f"--{flag} {word}: {which}{nearest(word, known)}")
    if config.start_from is not None and config.robot not in STEPS:
        raise UserError("--start-from goes with --robot go2")
    folder = config.folder / config.effect
    if config.robot != "cartpole":
        folder = config.folder / f"{config.robot}_{config.effect}"
    hidden = folder / "hidden.yaml"
    atomic_write(hidden, HIDDEN[config.robot][config.effect])
    if config.robot not in STEPS:
        told, returns = _searched(config, folder, hidden)
    else:
        told, returns = _trained(config, folder, hidden)
    path = write_result(
        f"loop_{config.robot}_{config.effect}",
        command_of("benchmarks.loop", config),
        config,
        hidden=HIDDEN[config.robot][config.effect],
        noise=NOISE[config.robot],
        found={k: told[k] for k in ("verdict", "effects", "refitted", "gap")},
        returns=returns,
    )
    show_returns(f"{config.robot}, hidden {config.effect}", returns)
    say(f"written: {path}")


def _once(module: Any, out: Path, told: str, **options: Any) -> Path:
    """The run folder of a command that was not run there before."""
    if not (out / "results.json").exists():
        say(f"== {told}")
        module.run(module.Config(out=out, overwrite=True, **options))
    return out


def _searched(
    config: Config, folder: Path, hidden: Path
) -> tuple[dict[str, Any], dict[str, Any]]:
    """What was found, and returns by method: UDR, then a search and its training."""
    from easi_jax.io.files import read_json
    from train import easi, udr

    def train(name: str, effects: Path | None) -> Path:
        out, told = folder / f"udr_{name}", f"UDR {name} the effect"
        given = {"effects": effects, "target_effects": hidden}
        return _once(udr, out, told, seeds=config.seeds, **given)

    def identify(name: str) -> Path:
        out, told = folder / f"easi_{name}", f"EASI {name} the effect"
        given = {"udr": folder / f"udr_{name}", "target_effects": hidden}
        return _once(easi, out, told, oracle=name == "without", **given)

    first = train("without", None)
    found, told = _asked(config.robot, first, hidden, folder)
    second = train("with", found)
    runs = {
        "UDR": (first, "UDR"),
        "EASI": (identify("without"), "EASI"),
        "UDR, effects found": (second, "UDR"),
        "EASI, effects found": (identify("with"), "EASI"),
        "Oracle": (identify("without"), "Oracle"),
    }
    return told, {
        method: read_json(out / "results.json")["returns"][name]
        for method, (out, name) in runs.items()
    }


def _trained(
    config: Config, folder: Path, hidden: Path
) -> tuple[dict[str, Any], dict[str, Any]]:
    """The same without a search, from nothing or on from one trained policy."""
    from easi_jax.io.files import read_json
    from train import udr

    start = config.start_from
    steps = None if start is None else STEPS[config.robot]

    def train(method: str, name: str, effects: Path | None, fixed: bool) -> Path:
        return _once(
            *(udr, folder / f"udr_{name}", method),
            robot=config.robot,
            seeds=config.seeds,
            effects=effects,
            target_effects=hidden,
            fixed=fixed,
            start_from=start,
            env_steps=steps,
        )

    runs = {"UDR": train("UDR", "without", None, False)}
    found, told = _asked(config.robot, start or runs["UDR"], hidden, folder)
    more = "UDR, effects found"
    runs[more] = train(more, "with", found, False)
    runs["Oracle"] = train("Oracle", "oracle", hidden, True)
    returns = {}
    for method, out in runs.items():
        (returns[method],) = read_json(out / "results.json")["returns"].values()
    return told, returns


def _asked(
    robot: str, policies: Path, hidden: Path, folder: Path
) -> tuple[Path, dict[str, Any]]:
    """Logs the policies in the target and asks what the model lacks.

    Returns:
        The effects file, and ``gap.json``.

    Raises:
        UserError: nothing was named.
    """
    from easi_jax.errors import UserError
    from easi_jax.io.files import read_json
    from train import gap

    logs = _recorded(robot, policies, hidden, folder / "logs")
    found = folder / "gap" / "effects.yaml"
    if not found.exists():
        say("== what does the model lack?")
        gap.run(
            gap.Config(model=robot, data=tuple(logs), out=found.parent, overwrite=True)
        )
    told = read_json(found.parent / "gap.json")
    if not told["effects"]:
        raise UserError(f"train.gap named no effect: see {found.parent}/report.html")
    return found, told


def _recorded(robot: str, run_folder: Path, hidden: Path, folder: Path) -> list[Path]:
    """Logs of the policies in the target, with noise."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    from easi_jax.io.files import atomic_write
    from easi_jax.rl.networks import act
    from easi_jax.simulation.rollout import collect, measured
    from train import udr
    from train._effects import read_given, robots
    from train._robots import load_udr

    saved = load_udr(run_folder)
    given = read_given(udr.Config(robot=robot, target_effects=hidden))
    _, env = robots(saved["env"], given)
    nv = env.mj_model.nv
    noise = jnp.array(
        [*NOISE[robot], *[0.0] * nv]
    )  # of positions; no velocities are logged

    @jax.jit
    def episodes(policy: Any, key: Any) -> Any:
        run, sensors = jax.random.split(key)
        trajectories = collect(
            env,
            env.model(),
            lambda obs, k: act(policy, obs, k, False),
            run,
            EPISODES[robot],
            env.episode_length,
        )
        return measured(trajectories, noise, sensors, env.simulator.configuration)

    joints = [env.mj_model.joint(j) for j in range(env.mj_model.njnt)]
    columns = [
        f"qpos.{j.name}" + f".{i}" * (len(j.qpos0) > 1)
        for j in joints
        for i in range(len(j.qpos0))
    ]
    drives = [env.mj_model.actuator(i).name for i in range(env.mj_model.nu)]
    head = ["time", *columns, *(f"ctrl.{a}" for a in drives)]
    out = []
    for i, seed in enumerate(saved["seeds"][: POLICIES[robot]]):
        policy = jax.tree.map(lambda x, i=i: x[i], saved["policies"])
        logs = jax.tree.map(np.asarray, episodes(policy, jax.random.key(seed)))
        for k in range(EPISODES[robot]):
            alive = int(logs.weight[k].sum())
            rows = np.c_[
                env.dt * np.arange(alive), logs.qpos[k, :alive], logs.ctrl[k, :alive, 0]
            ]
            lines = [",".join(head), *(",".join(f"{x:.7g}" for x in r) for r in rows)]
            path = folder / f"seed{seed}_{k}.csv"
            atomic_write(path, "\n".join(lines) + "\n")
            out.append(path)
    return out


if __name__ == "__main__":
    main(Config, run, name="benchmarks.loop")
