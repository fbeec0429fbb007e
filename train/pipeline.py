"""``python -m train.pipeline``: UDR, search and retraining as one compiled program."""

import dataclasses
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from train._command import main, say
from train._inputs import files_of
from train._options import (
    ChainOptions,
    EngineOptions,
    RobotOptions,
    RunOptions,
    SearchOptions,
    TargetOptions,
    TrainingOptions,
)

if TYPE_CHECKING:
    from easi_jax.io.runs.folder import RunFolder
    from easi_jax.model.results import Curve
    from train._chain import Setup

# Trainings of the program: their metrics, and whose they are.
_METHODS = {"udr": "UDR", "easi": "EASI"}


@dataclasses.dataclass(frozen=True)
class Config(
    RunOptions,
    EngineOptions,
    ChainOptions,
    SearchOptions,
    TrainingOptions,
    TargetOptions,
    RobotOptions,
):
    """Runs UDR training, demonstrations, search, final training and evaluation as ONE
    compiled program.

    The chain of train.udr and train.easi, composed into one jit: no transfer to the
    host in between, and nothing to see until it ends. For long runs that show progress
    and keep what is done on the way, take the two commands.
    """

    out: Path = Path("results/pipeline")
    """Folder of the run."""
    seeds: tuple[int, ...] = (0,)
    """Seeds, each an independent chain."""
    resume: bool = False
    """Go on with the run in the folder: from its start where the program had not ended,
    since it keeps nothing on its way."""


def run(config: Config) -> None:
    """Compiles, runs and reports."""
    from train._robots import (
        check_seeds,
        imitation_of,
        recorded,
        training_config,
    )

    check_seeds(config.seeds)
    from easi_jax.io.runs.folder import RunFolder
    from envs import open_env
    from train._chain import ready, write_and_show
    from train._effects import effect_notes, read_given, robots

    given = read_given(config)
    env = open_env(config.robot, config.env, config.option)
    training = training_config(
        robots(env, given)[0],
        config.env_steps,
        config.algorithm,
        imitation_of(config),
    )
    setup = ready(config, env, given, training, config.seeds, config.option)
    with RunFolder.open(
        config.out,
        recorded(given, config, training),
        command="train.pipeline",
        resume=config.resume,
        overwrite=config.overwrite,
        files=files_of(config),
    ) as folder:
        out, (compiling, running) = _outcome(folder, setup)
        curves = _told(folder, setup, out)
        folder.write_json("timing.json", {"compile_s": compiling, "run_s": running})
        notes = [
            f"one program: compiled in {compiling:.0f} s, ran {running:.0f} s",
            *effect_notes(given),
        ]
        write_and_show(folder, "train.pipeline", setup, out, _METHODS, curves, notes)
    say(f"compiled in {compiling:.0f} s, ran in {running:.0f} s")
    say(f"report: {config.out / 'report.html'}")


def _outcome(folder: "RunFolder", setup: "Setup") -> tuple[Any, tuple[float, float]]:
    """What the program returned, now or before the run was resumed, and the seconds
    that it compiled and ran."""
    import jax
    import jax.numpy as jnp

    from easi_jax.devices import distributed
    from easi_jax.io.runs import checkpoints
    from easi_jax.pipeline.stages import seed_keys
    from train._stages import as_read_back

    target = jnp.asarray(setup.theta, jnp.float32)
    keys, whole = seed_keys(list(setup.seeds)), setup.pipe.run
    place, stamp = folder.checkpoints / "program", folder.config_hash
    if folder.resumed:
        shapes = {
            "out": jax.eval_shape(whole, keys, target),
            "seconds": jax.ShapeDtypeStruct((2,), jnp.float32),
        }
        found = checkpoints.restore(place, shapes, config_hash=stamp)
        for stage in ("search", *_METHODS):
            folder.rewind(stage, -1)
        if found is not None:
            compiling, running = map(float, found.state["seconds"])
            return as_read_back(found.state["out"]), (compiling, running)
    say("compiling one program for the whole chain ...")
    begin = time.monotonic()
    program = jax.jit(whole).lower(keys, target).compile()
    compiling = time.monotonic() - begin
    say(f"compiled in {compiling:.0f} s; running ...")
    begin = time.monotonic()
    out = jax.block_until_ready(program(keys, target))
    running = time.monotonic() - begin
    out = distributed.local(out)
    seconds = jnp.array([compiling, running], jnp.float32)
    checkpoints.save(place, 1, {"out": out, "seconds": seconds}, config_hash=stamp)
    return as_read_back(out), (compiling, running)


def _told(folder: "RunFolder", setup: "Setup", out: Any) -> "dict[str, Curve]":
    """Writes the metrics of all stages; returns the trainings by method.

    Raises:
        UserError: the search came to nothing.
    """
    import jax
    import numpy as np

    from easi_jax.errors import UserError
    from train._stages import found_check, search_rows, training_rows

    pipe, seeds = setup.pipe, setup.seeds
    info, names = jax.device_get(out["search"]), pipe.env.space.names
    for step, row in search_rows(seeds, names, pipe.space.to_si)(0, info):
        folder.log("search", step, row)
    rows_of = training_rows(seeds, pipe.trainer.config.steps_per_iteration)
    curves = {}
    for stage, method in _METHODS.items():
        lines = rows_of(0, jax.device_get(out[f"{stage}_history"]))
        for step, row in lines:
            folder.log(stage, step, row)
        returns = [[r[f"seed{s}/return"] for s in seeds] for _, r in lines]
        curves[method] = ([step for step, _ in lines], returns)
    if (np.asarray(info.non_finite) >= pipe.config.search.population).any():
        raise UserError(
            "a generation had no finite simulation: run train.udr and train.easi, "
            "which stop there and name the parameters"
        )
    found_check(seeds, names, out["estimate"])
    return curves


if __name__ == "__main__":
    main(Config, run, name="train.pipeline")
