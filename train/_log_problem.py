"""What ``train.easi --data`` is asked: model, parameters, logs, all checked."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from train._effects import found_in, read_given

if TYPE_CHECKING:
    from easi_jax.data.measured import MeasuredRuns
    from easi_jax.estimation.problem import Problem

Held = tuple[Sequence[Path], Path | None]


def read_problem(config: Any) -> "Problem":
    """Reads and checks everything; nothing is written yet.

    Raises:
        UserError: whatever is wrong with the files or the options.
    """
    from easi_jax.estimation.problem import checked_horizon, problem_of

    name, mj_model, space = model_and_space(config)
    found = found_in(read_given(config).effects, str(config.effects))
    runs = read_runs(config, mj_model, checked_horizon(config.horizon))
    return problem_of(
        name,
        mj_model,
        space,
        runs,
        found=found,
        start=config.start,
        noise=config.noise,
        horizon=config.horizon,
    )


def read_runs(config: Any, mj_model: Any, horizon: float) -> "MeasuredRuns":
    """Reads ``config.data`` and ``config.held_out``.

    Raises:
        UserError: whatever is wrong with the files, or nothing is left to fit.
    """
    from easi_jax.data.measured import measured_runs
    from easi_jax.errors import UserError
    from easi_jax.io.logs.reader import read_logs

    # Not Path.resolve: it fails where links lead in a circle.
    kept_out = {os.path.realpath(p) for p in config.held_out}
    fit_files = [p for p in config.data if os.path.realpath(p) not in kept_out]
    if not fit_files:
        raise UserError("--held-out names all of --data: leave a log to fit")
    how, held_files = (config.mapping, config.unmeasured), list(config.held_out)
    log = read_logs(fit_files, mj_model, *how, held_files)
    held = None
    if held_files:
        held = read_logs(held_files, mj_model, *how, fit_files)
    return measured_runs(mj_model, log, held, horizon)


def model_and_space(config: Any) -> tuple[str, Any, Any]:
    from easi_jax.errors import UserError
    from easi_jax.io.models.parameter_file import read_parameter_file
    from easi_jax.model.parameters import ParameterSpace

    if config.model is None:
        if config.robot is None:
            raise UserError(
                "--data needs --model M.xml and --parameters P.yaml, or --robot NAME "
                "for a built-in robot"
            )
        from envs import make
        from envs.robot import model_file

        env = make(config.robot)
        space, mj_model = env.space, env.mj_model
        if config.held_base:
            mj_model = load_model(model_file(env.name), (), held_of(config), True)
        if config.parameters is not None:
            space = read_parameter_file(config.parameters, mj_model)
        return env.name, mj_model, space
    if config.robot is not None:
        raise UserError("--model and --robot exclude each other: choose one")
    if config.parameters is None and config.effects is None:
        raise UserError(
            "--model needs --parameters P.yaml (or --effects E.yaml): say what may "
            "vary in the model (see docs/your_own_robot.md)"
        )
    mj_model = load_model(config.model, config.allow_assets, held_of(config), True)
    if config.parameters is None:
        return config.model.stem, mj_model, ParameterSpace(())
    space = read_parameter_file(config.parameters, mj_model)
    return config.model.stem, mj_model, space


def held_of(config: Any) -> "Held | None":
    """Logs and mapping that say where a held base was; None where it was not held."""
    return (config.data, config.mapping) if config.held_base else None


def load_model(
    path: Path,
    allowed: tuple[Path, ...] = (),
    held: "Held | None" = None,
    logged: bool = False,
) -> Any:
    """The MuJoCo model in ``path``; ``allowed`` are places outside of its folder that
    it may read, ``held`` is as `held_of` gives it, ``logged`` whether logs are read
    next. What the user should know is said.

    Raises:
        UserError: as `easi_jax.io.models.mjcf.read_machine`.
    """
    from easi_jax.io.logs.reader import first_pose
    from easi_jax.io.models.completed import base_joint, own_pose
    from easi_jax.io.models.mjcf import read_machine
    from train._command import say

    def pose(m: Any) -> Any:
        logs, mapping = held or ((), None)
        found, of = first_pose(logs, m, mapping), "first in the logs"
        joint = base_joint(m)
        if found is None:
            found = own_pose(m, joint)
            of = f"of the {'first key frame' if m.nkey else 'model'}"
        at, turn = (" ".join(f"{x:.4g}" for x in v) for v in (found[:3], found[3:]))
        tell(
            f'{path}: the base "{m.joint(joint).name}" is held at the pose {of}: '
            f"{at} m, quaternion {turn}"
        )
        return found

    def tell(text: str) -> None:
        say(f"note: {text}")

    return read_machine(path, allowed, tell, pose if held else None, logged)
