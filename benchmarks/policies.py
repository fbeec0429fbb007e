"""Learning curves of trained policies, and what they reach, from their run folders.

    python -m train.udr --robot ant --seeds 0 1 --out results/ant_udr
    python -m train.udr --robot ant --seeds 0 1 --fixed --out results/ant_fixed
    python -m benchmarks.policies --runs results/ant_udr
    python -m benchmarks.policies --runs results/ant_fixed

Writes one file for a robot and the ways it was trained: curves, minutes on this machine
(of uninterrupted runs), the return in the nominal robot and, for go2, the speed reached
at commands from -1 to 1.5 m/s.
"""

import dataclasses
import datetime
from pathlib import Path
from typing import Any

from train._command import main, say, show_table

COMMANDS = (-1.0, -0.5, 0.0, 0.5, 1.0, 1.5)  # m/s
GOAL_MINUTES = {"ballbalance": 30, "ant": 30, "go2": 90}
TRACKING_EPISODES = 16


@dataclasses.dataclass(frozen=True)
class Config:
    """Collects trained policies of one robot."""

    runs: tuple[Path, ...] = ()
    """Run folders of train.udr, all of one robot."""


def run(config: Config) -> None:
    """Reads the folders and writes the robot's file."""
    from benchmarks._common import command_of, write_result
    from easi_jax.errors import UserError
    from easi_jax.io.files import read_json
    from easi_jax.io.runs.metrics import read_metrics
    from train._robots import load_policies

    if not config.runs:
        raise UserError("--runs is empty: give run folders of train.udr")
    found, robots = [], set()
    for folder in config.runs:
        saved = load_policies(folder)
        env = saved["env"]
        if saved["method"] not in ("UDR", "Fixed"):
            raise UserError(f"{folder} holds no run of train.udr")
        robots.add(env.name)
        lines = read_metrics(folder / "metrics.jsonl", "train")
        versions = read_json(folder / "versions.json")
        # The whole command: compiling, training, the final evaluation.
        begin = datetime.datetime.fromisoformat(versions["started"]).timestamp()
        seconds = (folder / "results.json").stat().st_mtime - begin
        result = read_json(folder / "results.json")
        method = saved["method"]
        nominal = dict(zip(env.space.names, env.space.nominal.tolist(), strict=True))
        if result["target"] != nominal:
            raise UserError(f"{folder} was tested in another target than the nominal")
        row = {
            "method": method,
            "algorithm": result["algorithm"],
            "env_steps": result["env_steps"],
            "seeds": list(saved["seeds"]),
            "target": result["target"],
            "minutes": seconds / 60,
            "versions": versions,
            "settings": dataclasses.asdict(saved["training"]),
            "returns": result["returns"][method],
            "curve": [
                {k: v for k, v in line.items() if k == "step" or "return" in k}
                for line in lines
                if "return" in line
            ],
        }
        if env.name == "go2":
            row["tracking"] = _tracking(saved)
        found.append(row)
    if len(robots) > 1:
        raise UserError(f"--runs are of several robots: {', '.join(sorted(robots))}")
    (robot,) = robots
    methods = "_".join(sorted({r["method"].lower() for r in found}))
    path = write_result(
        f"policies_{robot}_{methods}",
        command_of("benchmarks.policies", config),
        config,
        robot=robot,
        goal_minutes=GOAL_MINUTES.get(robot),
        runs=found,
    )
    show_table(
        f"Policies on {robot}",
        ("trained", "algorithm", "steps", "minutes", "return of each seed"),
        [
            (
                r["method"],
                r["algorithm"],
                f"{r['env_steps']:,}",
                f"{r['minutes']:.0f}",
                ", ".join(f"{x:.1f}" for x in r["returns"].values()),
            )
            for r in found
        ],
    )
    say(f"written: {path}")


def _tracking(saved: Any) -> dict[str, Any]:
    """Mean forward speed [m/s] over the last two seconds and falls, at each forward
    command, by seed; the other commands are zero."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    from easi_jax.rl.networks import act
    from envs.frames import matrix

    env = saved["env"]
    model = env.model()

    @jax.jit
    def speeds(policy: Any, forward: jax.Array, keys: jax.Array) -> jax.Array:
        def one(command: jax.Array, key: jax.Array) -> jax.Array:
            k_reset, k_run = jax.random.split(key)
            first = env.reset(model, k_reset)
            wanted = jnp.array([1.0, 0.0, 0.0]) * command
            memory = first.memory._replace(command=wanted)
            obs = env.observe(first.physics, memory)
            first = dataclasses.replace(first, memory=memory, obs=obs)

            def step(state: Any, k: jax.Array) -> Any:
                state = env.step(model, state, act(policy, state.obs, k, True))
                p = state.physics
                forward = (matrix(p.qpos[3:7]).T @ p.qvel[:3])[0]
                return state, (forward, state.terminated)

            keys = jax.random.split(k_run, env.episode_length)
            _, (speed, fallen) = jax.lax.scan(step, first, keys)
            return jnp.where(fallen.max() > 0, jnp.nan, speed[-100:].mean())

        return jax.vmap(one)(forward, keys)

    forward = jnp.repeat(jnp.asarray(COMMANDS), TRACKING_EPISODES)
    keys = jax.random.split(jax.random.key(0), forward.shape[0])
    reached, fallen = [], []
    for i in range(len(saved["seeds"])):
        policy = jax.tree.map(lambda x, i=i: x[i], saved["policies"])
        v = np.asarray(speeds(policy, forward, keys))
        v = v.reshape(len(COMMANDS), TRACKING_EPISODES)
        fallen.append(np.isnan(v).sum(1).tolist())
        stood = ~np.isnan(v)
        mean = np.where(stood, v, 0).sum(1) / np.maximum(stood.sum(1), 1)
        seen = zip(mean, stood.sum(1), strict=True)
        reached.append([float(x) if n else None for x, n in seen])
    return {"commands": COMMANDS, "speed": reached, "fallen": fallen}


if __name__ == "__main__":
    main(Config, run, name="benchmarks.policies")
