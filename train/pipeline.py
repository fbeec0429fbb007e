"""``python -m train.pipeline``: UDR, search and retraining as one compiled program."""

import dataclasses
import time
from pathlib import Path

from train._command import main, say, show_table


@dataclasses.dataclass(frozen=True)
class Config:
    """Runs UDR training, demonstrations, search, final training and evaluation as ONE
    compiled program.

    The same functions as train.udr and train.easi, composed into one jit: no transfer
    to the host in between, and nothing to see until it ends. For long runs that show
    progress and keep what is done on the way, take the two commands.
    """

    robot: str = "cartpole"
    """Built-in robot."""
    option: tuple[str, ...] = ()
    """Options of the built-in robot, NAME=VALUE: for go2 parameters=full (25 instead of
    8), torque_speed=true."""
    env: Path | None = None
    """An environment of your own, a Python file, in place of --robot (template:
    examples/my_robot/env.py)."""
    out: Path = Path("results/pipeline")
    """Folder of the run."""
    target: tuple[str, ...] | None = None
    """The pseudo-real robot: parameters that differ from the nominal ones, as
    NAME*FACTOR or NAME=VALUE; not given: half of what the paper's Fig. 6 changes, such
    as cart_kp*0.5 for cartpole."""
    effects: Path | None = None
    """Effects that the model lacks (effects.yaml of train.gap): the robot gets them,
    and their parameters vary with the others."""
    target_effects: Path | None = None
    """An effects file for the pseudo-real robot alone: it has these effects whether
    --effects names them or not (without --target, nothing else differs)."""
    seeds: tuple[int, ...] = (0,)
    """Seeds, each an independent chain."""
    env_steps: int | None = None
    """Control steps of each training; the robot's preset where not given."""
    algorithm: str | None = None
    """sac or ppo; the robot's own where not given."""
    preset: str = "default"
    """Search settings: default or paper."""
    strategy: str | None = None
    """Evolution strategy: mu_lambda, CMA_ES, ..."""
    generations: int | None = None
    """Generations of the search (preset: 50)."""
    population: int | None = None
    """Individuals in a generation (preset: 300)."""
    set: tuple[str, ...] = ()
    """Further search settings, NAME=VALUE."""
    start: tuple[float, float] | None = None
    """Where the search starts, as factors on the nominal values."""
    refine: bool = True
    """Finish with least squares on the paired data."""
    restarts: int | None = None
    """More starts of the least-squares finish, drawn from the search's spread; the best
    fit counts. Not given: 2 for noisy data, none for clean ones and larger robots."""
    warm_start: bool = False
    """Final training goes on from the networks of the UDR policy in place of new ones:
    it gets further where a training of its length has not settled."""
    trajectories: int = 200
    """Demonstration trajectories."""
    noise: tuple[float, ...] = ()
    """Sensor noise of the demonstrations (positions, then velocities, SI)."""
    eval_episodes: int = 100
    """Episodes of the final evaluation."""
    resume: bool = False
    """Go on with the run in the folder: from its start where the program had not ended,
    since it keeps nothing on its way."""
    overwrite: bool = False
    """Delete the run in the folder first."""
    distributed: bool = False
    """One of several processes (srun, mpirun, Kubernetes) whose devices share the
    work."""


def run(config: Config) -> None:
    """Compiles, runs and reports."""
    from train._effects import effect_notes, read_given, robots, target_name
    from train._pseudo_real import steps_of
    from train._robots import (
        check_seeds,
        save_policies,
        search_config,
        target_of,
        training_config,
    )

    check_seeds(config.seeds)
    import jax
    import jax.numpy as jnp
    import numpy as np

    from easi_jax.devices import distributed
    from easi_jax.errors import UserError
    from easi_jax.io.runs import checkpoints
    from easi_jax.io.runs.folder import RunFolder
    from easi_jax.pipeline.stages import (
        Pipeline,
        PipelineConfig,
        seed_keys,
        stage_keys,
        target_parameters,
    )
    from envs import open_env
    from train._pseudo_real import held_out_errors
    from train._results import write_pseudo_real
    from train._stages import as_read_back, found_check, search_rows, training_rows

    given = read_given(config)
    env, real = robots(open_env(config.robot, config.env, config.option), given)
    changes = target_of(env, config.target, given)
    theta = target_parameters((real or env).space, changes)
    noisy = any(x > 0 for x in config.noise)
    search = search_config(
        config.preset,
        config.set,
        env.name,
        strategy=config.strategy,
        generations=config.generations,
        population=config.population,
        horizon=steps_of(None, env.dt, noisy) if config.preset != "paper" else None,
    )
    pipe = Pipeline(
        env,
        PipelineConfig(
            search=search,
            training=training_config(env, config.env_steps, config.algorithm),
            trajectories=config.trajectories,
            noise=config.noise,
            refine=config.refine,
            restarts=config.restarts,
            warm_start=config.warm_start,
            eval_episodes=config.eval_episodes,
        ),
        start=config.start,
        real=real,
    )
    target, keys = jnp.asarray(theta, jnp.float32), seed_keys(list(config.seeds))
    with RunFolder.open(
        config.out,
        given.recorded(config),
        command="train.pipeline",
        resume=config.resume,
        overwrite=config.overwrite,
    ) as folder:
        place, stamp = folder.checkpoints / "program", folder.config_hash
        found = None
        if folder.resumed:
            shapes = {
                "out": jax.eval_shape(pipe.run, keys, target),
                "seconds": jax.ShapeDtypeStruct((2,), jnp.float32),
            }
            found = checkpoints.restore(place, shapes, config_hash=stamp)
            for stage in ("search", "udr", "easi"):
                folder.rewind(stage, -1)
        if found is not None:
            out, (compiling, running) = found.state["out"], found.state["seconds"]
        else:
            say("compiling one program for the whole chain ...")
            begin = time.monotonic()
            program = jax.jit(pipe.run).lower(keys, target).compile()
            compiling = time.monotonic() - begin
            say(f"compiled in {compiling:.0f} s; running ...")
            begin = time.monotonic()
            out = jax.block_until_ready(program(keys, target))
            running = time.monotonic() - begin
            out = distributed.local(out)
            seconds = jnp.array([compiling, running], jnp.float32)
            state = {"out": out, "seconds": seconds}
            checkpoints.save(place, 1, state, config_hash=stamp)
        out = as_read_back(out)
        info = jax.device_get(out["search"])
        for step, row in search_rows(config.seeds, env.space.names, pipe.space.to_si)(
            0, info
        ):
            folder.log("search", step, row)
        rows_of = training_rows(config.seeds, pipe.trainer.config.steps_per_iteration)
        curves = {}
        for stage, method in (("udr", "UDR"), ("easi", "EASI")):
            lines = rows_of(0, jax.device_get(out[f"{stage}_history"]))
            for step, row in lines:
                folder.log(stage, step, row)
            curves[method] = (
                [step for step, _ in lines],
                [[r[f"seed{s}/return"] for s in config.seeds] for _, r in lines],
            )
        if (np.asarray(info.non_finite) >= search.population).any():
            raise UserError(
                "a generation had no finite simulation: run train.udr and train.easi, "
                "which stop there and name the parameters"
            )
        found_check(config.seeds, env.space.names, out["estimate"].distribution)
        for method in ("UDR", "EASI"):
            save_policies(folder, method, out[method.lower()])
        returns = {
            m: np.asarray(out[f"{m.lower()}_returns"]).mean(1) for m in ("UDR", "EASI")
        }
        evaluate_keys = stage_keys(keys)["evaluate"]
        errors = held_out_errors(
            pipe, out["estimate"], theta, out["udr"], evaluate_keys
        )
        folder.write_json(
            "timing.json", {"compile_s": float(compiling), "run_s": float(running)}
        )
        write_pseudo_real(
            folder, pipe, out["estimate"], theta, config.seeds, returns, errors, curves,
            out["motion"][0],
            [
                f"one program: compiled in {compiling:.0f} s, ran {running:.0f} s",
                *effect_notes(given),
            ],
            {"option": list(config.option), **given.results()},
        )  # fmt: skip
    show_table(
        f"Return in the target ({target_name(changes, given)})",
        ("method", "median", *(f"seed {s}" for s in config.seeds)),
        [
            (name, f"{np.median(r):.1f}", *(f"{x:.1f}" for x in r))
            for name, r in returns.items()
        ],
    )
    say(f"compiled in {compiling:.0f} s, ran in {running:.0f} s")
    say(f"report: {config.out / 'report.html'}")


if __name__ == "__main__":
    main(Config, run, name="train.pipeline")
