"""The loop closed: what a hidden effect costs, and what finding it brings back.

    python -m benchmarks.loop --effect friction
    python -m benchmarks.loop --effect delay

The target has an effect that no training knows of. UDR policies act in it; from their
noisy logs ``train.gap`` finds what the model lacks; ``train.easi`` then searches and
trains with what was found, and without it. Oracle trains in the target itself. All
seeds are paired, and the commands are those that a user has.
"""

import dataclasses
from pathlib import Path
from typing import Any

from train._command import main, say, show_table

# Of the target alone: the largest that an Oracle still balances with.
HIDDEN = {
    "friction": """effects:
- {effect: coulomb_friction, at: cart, kind: joint, columns: {coulomb: 1.2}}
""",
    "delay": """effects:
- {effect: actuator_delay, at: cart, kind: actuator, columns: {delay: 0.05}}
""",
}
NOISE = (2e-4, 5e-4)  # m, rad: standard deviation of a reading
EPISODES = 2  # of each seed's policy, as logs


@dataclasses.dataclass(frozen=True)
class Config:
    """Trains before and after the gap workflow, in a target with a hidden effect."""

    effect: str = "friction"
    """friction or delay."""
    seeds: tuple[int, ...] = (0, 1, 2, 3, 4)
    """Seeds, paired over methods."""
    folder: Path = Path("results/loop")
    """Where the runs are kept; finished ones are not run again."""


def run(config: Config) -> None:
    """Runs the chain with and without the gap workflow."""
    import numpy as np

    from benchmarks._common import command_of, write_result
    from easi_jax.errors import UserError, nearest
    from easi_jax.io.files import atomic_write, read_json
    from train import easi, gap, udr

    if config.effect not in HIDDEN:
        hint = nearest(config.effect, HIDDEN)
        raise UserError(f'--effect {config.effect}: "friction" or "delay"{hint}')
    folder = config.folder / config.effect
    hidden = folder / "hidden.yaml"
    atomic_write(hidden, HIDDEN[config.effect])
    found = folder / "gap" / "effects.yaml"

    def train(name: str, effects: Path | None) -> Path:
        out = folder / f"udr_{name}"
        if not (out / "results.json").exists():
            say(f"== UDR {name} the effect")
            udr.run(
                udr.Config(
                    out=out,
                    seeds=config.seeds,
                    effects=effects,
                    target_effects=hidden,
                    overwrite=True,
                )
            )
        return out

    def identify(name: str) -> Path:
        out = folder / f"easi_{name}"
        if not (out / "results.json").exists():
            say(f"== EASI {name} the effect")
            easi.run(
                easi.Config(
                    udr=folder / f"udr_{name}",
                    out=out,
                    target_effects=hidden,
                    oracle=name == "without",
                    overwrite=True,
                )
            )
        return out

    first = train("without", None)
    logs = _recorded(first, hidden, folder / "logs")
    if not found.exists():
        say("== what does the model lack?")
        gap.run(
            gap.Config(
                model="cartpole", data=tuple(logs), out=found.parent, overwrite=True
            )
        )
    told = read_json(found.parent / "gap.json")
    if not told["effects"]:
        raise UserError(f"train.gap named no effect: see {found.parent}/report.html")
    second = train("with", found)
    runs = {"without": identify("without"), "with": identify("with")}
    returns = {
        "UDR": read_json(first / "results.json")["returns"]["UDR"],
        "EASI": read_json(runs["without"] / "results.json")["returns"]["EASI"],
        "UDR, effects found": read_json(second / "results.json")["returns"]["UDR"],
        "EASI, effects found": read_json(runs["with"] / "results.json")["returns"][
            "EASI"
        ],
        "Oracle": read_json(runs["without"] / "results.json")["returns"]["Oracle"],
    }
    path = write_result(
        f"loop_cartpole_{config.effect}",
        command_of("benchmarks.loop", config),
        config,
        hidden=HIDDEN[config.effect],
        noise=NOISE,
        found={k: told[k] for k in ("verdict", "effects", "refitted", "gap")},
        returns=returns,
    )
    show_table(
        f"hidden {config.effect}: return in the target",
        ("method", "mean", *(f"seed {s}" for s in config.seeds)),
        [
            (m, f"{np.mean([*v.values()]):.1f}", *(f"{x:.1f}" for x in v.values()))
            for m, v in returns.items()
        ],
    )
    say(f"written: {path}")


def _recorded(run_folder: Path, hidden: Path, folder: Path) -> list[Path]:
    """Logs of the policies in the target, with noise."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    from easi_jax.io.files import atomic_write
    from easi_jax.rl.networks import act
    from easi_jax.rollout import collect, measured
    from train import udr
    from train._effects import read_given, robots
    from train._robots import load_udr

    saved = load_udr(run_folder)
    given = read_given(udr.Config(target_effects=hidden))
    _, env = robots(saved["env"], given)
    nv = env.mj_model.nv
    noise = jnp.array([*NOISE, *[0.0] * nv])  # of positions; no velocities are logged

    @jax.jit
    def episodes(policy: Any, key: Any) -> Any:
        run, sensors = jax.random.split(key)
        trajectories = collect(
            env,
            env.model(),
            lambda obs, k: act(policy, obs, k, False),
            run,
            EPISODES,
            env.episode_length,
        )
        return measured(trajectories, noise, sensors)

    joints = [env.mj_model.joint(j).name for j in range(env.mj_model.njnt)]
    drives = [env.mj_model.actuator(i).name for i in range(env.mj_model.nu)]
    head = ["time", *(f"qpos.{j}" for j in joints), *(f"ctrl.{a}" for a in drives)]
    out = []
    for i, seed in enumerate(saved["seeds"]):
        policy = jax.tree.map(lambda x, i=i: x[i], saved["policies"])
        logs = jax.tree.map(np.asarray, episodes(policy, jax.random.key(seed)))
        for k in range(EPISODES):
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
