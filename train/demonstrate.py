"""``python -m train.demonstrate``: motion to imitate, as a log."""

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Any

from train._command import main, say, show_table
from train._inputs import files_of
from train._options import EngineOptions, RunOptions

if TYPE_CHECKING:
    import numpy as np

    from easi_jax.data.recording import Run
    from easi_jax.io.report.html import Table
    from easi_jax.io.runs.folder import RunFolder

LOG = "demonstrations.npz"  # in the folder of a run
_TRAINED_BEYOND = (
    0.1  # m/s, that an expert is trained beyond the speeds it is asked for
)


@dataclasses.dataclass(frozen=True)
class Config(RunOptions, EngineOptions):
    """Makes demonstrations for --algorithm ess_infogail: the log of a Go2 that walks by
    a clock, at several speeds, with noise on its actions; or of any policy.

    For each gait an expert is trained, which sees a clock and is paid for keeping its
    feet to it. Who imitates the log sees neither. With --policy RUN nothing is trained:
    that policy acts in its own robot.
    """

    out: Path = Path("results/demonstrations")
    """Folder of the run; the log in it is demonstrations.npz."""
    gaits: tuple[str, ...] = ("trot",)
    """Gaits to demonstrate: trot, pace, bound; each labels its runs."""
    speeds: tuple[float, ...] = (0.4, 0.8, 1.2, 1.6)
    """Speeds forward [m/s]."""
    episodes: int = 100
    """Episodes of 4 s for each gait and speed; of a policy, in all."""
    shares: tuple[float, ...] = ()
    """Share of these episodes that each gait has (as real recordings have more of one
    than of another); all of them where not given."""
    noise: float = 0.1
    """Standard deviation of the noise on actions (of a range from -1 to 1)."""
    env_steps: int = 5_000_000
    """Control steps of an expert's training."""
    seed: int = 0
    """Of trainings and recordings."""
    policy: Path | None = None
    """Run folder with a policy (train.udr, train.easi) that demonstrates in place of
    experts."""
    method: str | None = None
    """Which of its policies: UDR, Fixed, EASI or Oracle."""
    env: Path | None = None
    """The environment file that --policy was trained with, where it has one."""
    chunk: int | None = None
    """Unrolls between checkpoints; about 50,000 control steps where not given."""


def run(config: Config) -> None:
    """Trains experts where none is given, records, writes."""
    from easi_jax.errors import UserError
    from easi_jax.io.logs.reader import write_log
    from easi_jax.io.runs.folder import RunFolder
    from train._robots import check_chunk, check_seeds

    check_seeds((config.seed,))
    check_chunk(config.chunk)
    _check(config)
    played = None if config.policy is None else _loaded(config)
    with RunFolder.open(
        config.out,
        config,
        command="train.demonstrate",
        resume=config.resume,
        overwrite=config.overwrite,
        files=files_of(config),
    ) as folder:
        if played is not None:
            env, policy = played
            runs = _recorded(config, env, policy, [None], config.episodes, "")
            if not runs:
                raise UserError(
                    f"{config.policy}: every episode ended before its time; give a "
                    "policy that was trained for longer"
                )
            table = _summary(runs)
        else:
            from envs import make

            env, runs = make("go2"), []
            for gait in config.gaits:
                runs += _gait(folder, config, gait)
            table = _gaits(config, runs)
        write_log(config.out / LOG, env.mj_model, runs)
        rows = {"runs": len(runs), "steps": sum(len(r) for r in runs)}
        folder.write_json("results.json", rows)
        _report(folder, table)
    show_table(table.title, table.columns, table.rows)
    say(f"demonstrations: {config.out / LOG}")
    say(f"report: {config.out / 'report.html'}")


def _check(config: Config) -> None:
    """Refuses options that cannot work."""
    from easi_jax.errors import UserError, nearest
    from envs.go2_expert import GAITS

    for gait in config.gaits:
        if gait not in GAITS:
            raise UserError(
                f"--gaits {gait}: known are {', '.join(GAITS)}{nearest(gait, GAITS)}"
            )
    if not config.gaits or len(set(config.gaits)) < len(config.gaits):
        raise UserError("--gaits: give at least one, each once")
    if not config.speeds or not all(0 < v <= 3 for v in config.speeds):
        raise UserError(f"--speeds {config.speeds}: give speeds above 0, at most 3 m/s")
    if len({f"{v:g}" for v in config.speeds}) < len(config.speeds):
        raise UserError("--speeds: give each once")
    if config.episodes < 2:
        raise UserError(f"--episodes is {config.episodes}: give at least 2")
    if config.shares and (
        len(config.shares) != len(config.gaits)
        or not all(0 < x <= 1 for x in config.shares)
    ):
        raise UserError("--shares: give one of each gait, above 0 and at most 1")
    if not 0 <= config.noise <= 1:
        raise UserError(f"--noise is {config.noise}: give a number from 0 to 1")
    if config.env_steps < 1:
        raise UserError(f"--env-steps is {config.env_steps}: give at least 1")
    if config.distributed:
        raise UserError("--distributed: an expert is one training; leave it out")
    fresh = Config()
    alone = ("gaits", "speeds", "shares", "env_steps")
    for name in ("method", "env") if config.policy is None else alone:
        if getattr(config, name) != getattr(fresh, name):
            flag = "--" + name.replace("_", "-")
            raise UserError(
                f"{flag} goes with --policy: give the run, too"
                if config.policy is None
                else f"{flag} is of experts, and --policy trains none: leave it out"
            )


def _loaded(config: Config) -> tuple[Any, Any]:
    """The environment and the first seed's policy of a run."""
    import jax

    from train._robots import load_policies

    assert config.policy is not None
    found = load_policies(config.policy, config.method, config.env)
    return found["env"], jax.tree.map(lambda x: x[0], found["policies"])


def _gait(folder: "RunFolder", config: Config, gait: str) -> "list[Run]":
    """Episodes of a gait's expert, which is trained first."""
    import jax

    from easi_jax.errors import UserError
    from envs.go2 import forward_only
    from envs.go2_expert import Go2Expert

    low = max(min(config.speeds) - _TRAINED_BEYOND, 0.0)
    high = max(config.speeds) + _TRAINED_BEYOND
    env = Go2Expert(gait, forward_only(f"{low}:{high}"))
    policy = jax.tree.map(lambda x: x[0], _trained(folder, config, gait, env))
    shares = config.shares or (1.0,) * len(config.gaits)
    share = shares[config.gaits.index(gait)]
    episodes = max(1, round(share * config.episodes))
    runs = _recorded(config, env, policy, config.speeds, episodes, gait)
    if not runs:
        raise UserError(
            f"the expert's {gait} falls at every speed: train it for longer "
            f"(--env-steps, {config.env_steps} here)"
        )
    return runs


def _trained(folder: "RunFolder", config: Config, gait: str, env: Any) -> Any:
    """Policies of the expert, ``(1, ...)``."""
    import jax.numpy as jnp

    from easi_jax.pipeline.stages import Pipeline, PipelineConfig, seed_keys
    from train._robots import training_config
    from train._stages import train_stage

    training = training_config(env, config.env_steps, "ppo")
    pipe = Pipeline(env, PipelineConfig(training=training))
    nominal = jnp.asarray(env.space.nominal, jnp.float32)
    keys, seeds = seed_keys([config.seed]), (config.seed,)
    at = pipe.point(nominal)
    return train_stage(folder, gait, pipe, keys, at, nominal, seeds, config.chunk)


def _recorded(
    config: Config, env: Any, policy: Any, speeds: Any, episodes: int, label: str
) -> "list[Run]":
    """Episodes of ``policy`` with noise on its actions, those aside that fell.

    Args:
        speeds: commands [m/s]; None for the environment's own.
        label: of the runs; none where empty.
    """
    import jax
    import numpy as np

    from easi_jax.data.recording import Run
    from easi_jax.model.joint_space import Configuration
    from easi_jax.rl.demonstrations import LABELLED
    from easi_jax.rl.networks import noisy
    from easi_jax.simulation.rollout import policy_rollout
    from envs.go2 import Commanded

    def episode(key: Any, speed: Any) -> Any:
        own = env if speed is None else Commanded(env, speed)
        return policy_rollout(own, model, acts, key, env.episode_length)

    model, acts, found = env.model(), noisy(policy, config.noise), []
    play = jax.jit(jax.vmap(episode, (0, None)))
    for k, speed in enumerate(speeds):
        key = jax.random.fold_in(jax.random.key(config.seed), k)
        rows = jax.device_get(play(jax.random.split(key, episodes), speed))
        for i in np.flatnonzero(rows.weight.all(1)):
            name = f"{k}-{i}" if speed is None else f"{speed:g}-{i}"
            found.append(
                Run(
                    name=f"{label}{LABELLED}{name}" if label else name,
                    source=LOG,
                    dt=env.dt,
                    time=env.dt * np.arange(env.episode_length),
                    qpos=rows.qpos[i],
                    qvel=rows.qvel[i],
                    qvel_measured=True,
                    ctrl=rows.ctrl[i, :, 0],
                    configuration=Configuration.of(env.mj_model),
                )
            )
    return found


def _summary(runs: "list[Run]") -> "Table":
    from easi_jax.io.report.html import Table

    steps = sum(len(run) for run in runs)
    return Table("Demonstrations", ("episodes", "steps"), [(len(runs), steps)])


def _gaits(config: Config, runs: "list[Run]") -> "Table":
    """How the experts walk, beside what their clocks ask for."""
    import jax.numpy as jnp

    from easi_jax.io.report.html import Table
    from easi_jax.rl.demonstrations import LABELLED
    from envs.go2_expert import GAITS, stride
    from envs.go2_gait import gait_of, mean_gait

    rows = []
    for gait in config.gaits:
        asked = tuple((p - GAITS[gait][0]) % 1.0 for p in GAITS[gait])
        for speed in config.speeds:
            start = f"{gait}{LABELLED}{speed:g}-"
            own = [r for r in runs if r.name.startswith(start)]
            if not own:
                rows.append((gait, f"{speed:g}", "0", *["every one fell"] * 5))
                continue
            seen = mean_gait([gait_of(r.qpos, r.dt) for r in own])
            want = stride(jnp.asarray(speed))
            rows.append(
                (
                    gait,
                    f"{speed:g}",
                    str(len(own)),
                    f"{seen.speed:.2f}",
                    f"{seen.rate:.2f} ({float(want.rate):.2f})",
                    f"{seen.duty.mean():.2f} ({float(want.duty):.2f})",
                    f"{_listed(seen.phase)} ({_listed(asked)})",
                    f"{seen.height:.3f}",
                )
            )
    columns = (
        *("gait", "asked speed [m/s]", "episodes", "speed [m/s]"),
        *("strides [Hz] (clock)", "duty (clock)"),
        *("phases FL FR RL RR (clock)", "height [m]"),
    )
    return Table("Demonstrated gaits", columns, rows)


def _listed(phases: "np.ndarray | tuple[float, ...]") -> str:
    return " ".join(f"{p % 1.0:.2f}" for p in phases)


def _report(folder: "RunFolder", table: "Table") -> None:
    from easi_jax.io.report.html import Report, write_report
    from easi_jax.io.runs.versions import versions

    write_report(
        folder.path / "report.html",
        Report(
            title="Demonstrations",
            headline=["Motion for train.udr --algorithm ess_infogail to imitate."],
            command="python -m train.demonstrate",
            tables=[table],
            config=folder.config,
            versions=versions(),
        ),
    )


if __name__ == "__main__":
    main(Config, run, name="train.demonstrate")
