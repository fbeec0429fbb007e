"""``python -m train.udr``: a rough policy by uniform domain randomization."""

import dataclasses
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from train._command import main, say, show_table
from train._found import FILE
from train._inputs import files_of
from train._options import (
    EngineOptions,
    OwnEffectsOptions,
    RobotOptions,
    RunOptions,
    TrainingOptions,
)

if TYPE_CHECKING:
    import numpy as np

    from easi_jax.io.report.html import Picture, Table
    from easi_jax.io.runs.folder import RunFolder
    from train._effects import Given
    from train._found import Found


@dataclasses.dataclass(frozen=True)
class Config(
    RunOptions, EngineOptions, TrainingOptions, OwnEffectsOptions, RobotOptions
):
    """Trains a policy under uniformly random physics (UDR), the rough start of EASI.

    Each episode draws the robot's parameters from their initial ranges: a factor of 3
    either way for built-in robots (go2: 2). The policy is what ``train.easi`` then
    records demonstrations with. With --found they are drawn from what train.easi found,
    so that the policy is the final one. Several seeds train side by side, one on each
    device.
    """

    out: Path = Path("results/udr")
    """Folder of the run."""
    seeds: tuple[int, ...] = (0,)
    """Seeds, each an independent training."""
    target: tuple[str, ...] = ()
    """Where the policy is evaluated: the nominal robot with parameters changed, as
    NAME*FACTOR or NAME=VALUE."""
    effects: Path | None = None
    """Effects that the model lacks (effects.yaml of train.gap): the robot gets them,
    and their parameters vary with the others."""
    target_effects: Path | None = None
    """An effects file for the target alone, instead of --effects."""
    fixed: bool = False
    """Train in the target itself, without randomization: the nominal model where no
    target is given."""
    found: Path | None = None
    """Run folder of train.easi (from logs, too): draw the physics from what it found,
    with its effects, in place of the initial range. The policy is then tested in the
    robot as identified where no target is given."""
    start_from: Path | None = None
    """Run folder of train.udr whose networks the training goes on from (fine-tuning);
    a seed that it lacks starts from its first."""
    eval_episodes: int = 100
    """Episodes of the final evaluation."""
    chunk: int | None = None
    """Iterations between checkpoints: steps of all environments (sac) or unrolls
    (ppo); about 50,000 control steps where not given."""


def run(config: Config) -> None:
    """Trains, evaluates and writes the run folder."""
    from train._effects import effect_notes
    from train._robots import (
        check_chunk,
        check_seeds,
        imitation_of,
        load_networks,
        recorded,
        save_policies,
        training_config,
    )

    check_seeds(config.seeds)
    check_chunk(config.chunk)
    import jax
    import jax.numpy as jnp
    import numpy as np

    from easi_jax.io.report.easi_report import motion_strip
    from easi_jax.io.runs.folder import RunFolder
    from easi_jax.pipeline.stages import (
        Pipeline,
        PipelineConfig,
        seed_keys,
        stage_keys,
        target_parameters,
    )
    from train._results import per_seed_json
    from train._stages import train_stage

    env, real, given, own = _robots(config)
    training = training_config(
        *(env, config.env_steps, config.algorithm, imitation_of(config))
    )
    theta = target_parameters((real or env).space, config.target)
    method = "EASI" if own else "Fixed" if config.fixed else "UDR"
    settings = PipelineConfig(training=training, eval_episodes=config.eval_episodes)
    if config.fixed:
        env, real = real or env, None
    pipe = Pipeline(env, settings, real=real)
    target = jnp.asarray(theta, jnp.float32)
    keys = stage_keys(seed_keys(list(config.seeds)))
    old = None
    if config.start_from is not None:
        old = load_networks(config.start_from, config.env, env, training, config.seeds)
    with RunFolder.open(
        config.out,
        recorded(given, config, training),
        command="train.udr",
        resume=config.resume,
        overwrite=config.overwrite,
        files=files_of(config),
    ) as folder:
        notes = effect_notes(given)
        if own:
            folder.write_json(FILE, own.content)
            physics, notes = own.distribution, [own.note, *notes]
        else:
            physics = pipe.point(target) if config.fixed else pipe.udr()
        policies = train_stage(
            *(folder, "train", pipe, keys["udr"], physics, target, config.seeds),
            *(config.chunk, old, notes),
        )
        returns, motion = jax.jit(pipe.play)(policies, target, keys["evaluate"])
        per_seed = np.asarray(returns).mean(1)
        save_policies(folder, method, policies)
        made = {
            **_settings(config, method, env.name, training),
            "target": dict(zip(pipe.real.space.names, theta.tolist(), strict=True)),
            "returns": {method: per_seed_json(config.seeds, per_seed)},
            **given.results(),
        }
        folder.write_json("results.json", made)
        pictures = motion_strip(env.mj_model, env.dt, motion[0], method, notes)
        table = _report(folder, config, method, env.name, per_seed, pictures, notes)
    show_table(table.title, table.columns, table.rows)
    say(f"report: {config.out / 'report.html'}")


def _robots(config: Config) -> "tuple[Any, Any, Given, Found | None]":
    """The robot that is trained, the one that stands for the real one (None where it is
    the first), their effects, and what a run found."""
    from easi_jax.errors import UserError
    from envs import open_env
    from train._effects import read_given, robots
    from train._found import found_robot

    for flag, value in (("--fixed", config.fixed), ("--effects", config.effects)):
        if value and config.found:
            raise UserError(
                f"{flag} goes without --found: the run says what the robot is"
            )
    given = read_given(config)
    nominal = open_env(config.robot, config.env, config.option)
    env, real = robots(nominal, given)
    if config.found is None:
        return env, real, given, None
    own = found_robot(config.found, nominal)
    return own.env, real, replace(given, effects=own.given.effects), own


def _settings(config: Config, method: str, robot: str, training: Any) -> dict[str, Any]:
    """What ``results.json`` says of how a policy was made."""
    from easi_jax.rl.presets import algorithm_of

    return {
        "robot": robot,
        "env": None if config.env is None else str(config.env),
        "option": list(config.option),
        "seeds": list(config.seeds),
        "env_steps": training.env_steps,
        "algorithm": algorithm_of(training),
        "methods": [method],
    }


def _report(
    folder: "RunFolder",
    config: Config,
    method: str,
    robot: str,
    returns: "np.ndarray",
    pictures: "list[Picture]",
    notes: list[str],
) -> "Table":
    """Writes the report; the table of ``returns`` in the target, one a seed."""
    import numpy as np

    from easi_jax.io.report.figures import returns_by_step
    from easi_jax.io.report.html import Picture, Report, Table, write_report
    from easi_jax.io.runs.versions import versions
    from train._stages import training_curve

    steps, curve = training_curve(folder.path, "train", config.seeds)
    if steps:
        svg = returns_by_step({method: (steps, curve)})
        folder.write("figures/returns.svg", svg)
        picture = Picture(
            "Return by training step",
            svg,
            f"Return of the {method} policy in the target by training step",
            "Deterministic policy in the target, every seed and their median.",
        )
        pictures = [*pictures, picture]
    rows = [(s, f"{r:.1f}") for s, r in zip(config.seeds, returns, strict=True)]
    title = f"{method} on {robot}: return in the target"
    table = Table(title, ("seed", "return"), rows)
    how = "in the target itself" if config.fixed else "under uniform randomization"
    how = f"under what {config.found} found" if config.found else how
    write_report(
        folder.path / "report.html",
        Report(
            title=f"{method} on {robot}",
            headline=[
                f"The policy trained {how} returns "
                f"{np.median(returns):.1f} in the target (median of "
                f"{len(config.seeds)} seed{'s' if len(config.seeds) > 1 else ''}, "
                f"{config.eval_episodes} episodes each)."
            ],
            command="python -m train.udr",
            tables=[table],
            pictures=pictures,
            notes=notes,
            config=folder.config,
            versions=versions(),
        ),
    )
    return table


if __name__ == "__main__":
    main(Config, run, name="train.udr")
