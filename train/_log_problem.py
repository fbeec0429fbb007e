"""What ``train.easi --data`` is asked: model, parameters, logs, all checked."""

import dataclasses
import math
import os
from pathlib import Path
from typing import Any

from train._effects import found_in, read_given

HORIZON = 0.2  # s, of the error that is reported; pieces are no longer
_ABOVE_NOISE = 30.0  # RMS motion over a piece in units of its noise
_FEW_ROWS = 30  # of a run say little of its noise
FINISH = 0.5  # s, of pieces in the least-squares finish


@dataclasses.dataclass(frozen=True)
class Problem:
    """A machine and its measured motion.

    Attributes:
        name: of the model.
        simulator: with the parameters, at the logs' control step.
        fit, held: runs.
        held_name: which data are held out.
        noise: standard deviations of positions and velocities, ``(2 nv,)``.
        measured: velocities that were measured and can be trusted, ``(nv,)`` bool.
        piece: control steps of a piece in the search.
        steps: control steps of the open-loop error that is reported.
        horizon: the same in seconds.
        notes: what the user should know of the data.
    """

    name: str
    simulator: Any
    fit: list[Any]
    held: list[Any]
    held_name: str
    noise: Any
    measured: Any
    piece: int
    steps: int
    horizon: float
    notes: list[str]


def read_problem(config: Any) -> Problem:
    """Reads and checks everything; nothing is written yet.

    Raises:
        UserError: whatever is wrong with the files or the options.
    """
    import numpy as np

    from easi_jax.data.cleaning import true_readings, trusted_velocity
    from easi_jax.errors import UserError
    from easi_jax.estimation.pieces import visible_steps
    from easi_jax.model.found_effects import joined
    from easi_jax.simulation.simulator import Simulator

    name, mj_model, space = _model_and_space(config)
    found = found_in(read_given(config).effects, str(config.effects))
    space, fixed = joined(mj_model, space, found)
    if config.start is not None:
        space = space.scaled(*config.start)
    horizon = HORIZON if config.horizon is None else config.horizon
    if not (math.isfinite(horizon) and horizon > 0):
        raise UserError(f"--horizon is {horizon:g}: give seconds above 0")
    measured_runs = read_runs(config, mj_model, horizon)
    fit, held, noise = measured_runs.fit, measured_runs.held, measured_runs.noise
    held_name, notes = measured_runs.held_name, measured_runs.notes
    fit, held = (true_readings(mj_model, r, found.entries) for r in (fit, held))
    notes += [
        f"{e.effect}@{e.at}: taken out of the logs' readings"
        for e in found.entries
        if e.of_readings
    ]
    nv = mj_model.nv
    if config.noise:
        noise = np.asarray(config.noise, float)
    if noise.shape != (2 * nv,) or not np.all(np.isfinite(noise) & (noise >= 0)):
        raise UserError(
            f"--noise is {list(config.noise)}: {name} needs {2 * nv} numbers, 0 or "
            "more: positions, then velocities"
        )
    simulator = Simulator(mj_model, space, fit[0].dt, fixed=fixed)
    measured = np.array([run.qvel_measured for run in fit]).all() & np.all(
        [(trusted_velocity(run) == run.qvel).all(0) for run in fit], axis=0
    )
    if any(run.qvel_measured for run in fit) and not measured.all():
        joints = [n for n, m in zip(simulator.state_names[nv:], measured, strict=True)]
        doubted = [n for n, m in zip(joints, measured, strict=True) if not m]
        notes.append(
            f"{', '.join(doubted)}: not the derivative of the positions (filtered or "
            "late?), so velocities are taken from the positions"
        )
    steps = max(1, round(horizon / simulator.dt))
    _check_lengths(fit, held, steps, simulator.dt)
    piece = steps
    if config.horizon is None:
        piece = visible_steps(fit, noise, steps, _ABOVE_NOISE)
    return Problem(
        name,
        simulator,
        fit,
        held,
        held_name,
        noise,
        measured,
        piece,
        steps,
        steps * simulator.dt,
        notes,
    )


@dataclasses.dataclass(frozen=True)
class MeasuredRuns:
    """Recordings as ``--data`` and ``--held-out`` name them, at one control step.

    Attributes:
        recorded: those not named by ``--held-out``, as they were recorded.
        noise: of their positions and velocities, ``(2 nv,)``.
        fit, held: runs.
        held_name: which data are held out.
        notes: what the user should know of the data.
    """

    recorded: tuple[Any, ...]
    noise: Any
    fit: list[Any]
    held: list[Any]
    held_name: str
    notes: list[str]


def read_runs(config: Any, mj_model: Any, horizon: float) -> MeasuredRuns:
    """Reads ``config.data`` and ``config.held_out``.

    Raises:
        UserError: whatever is wrong with the files, or nothing is left to fit.
    """
    from easi_jax.data.cleaning import split_at_resets, to_common_step, without_odd_ends
    from easi_jax.data.holdout import split_held_out
    from easi_jax.data.noise import pooled_noise
    from easi_jax.errors import UserError
    from easi_jax.io.logs.reader import read_logs

    # Not Path.resolve: it fails where links lead in a circle.
    kept_out = {os.path.realpath(p) for p in config.held_out}
    fit_files = [p for p in config.data if os.path.realpath(p) not in kept_out]
    if not fit_files:
        raise UserError("--held-out names all of --data: leave a log to fit")
    log = read_logs(fit_files, mj_model, config.mapping)
    notes = list(log.notes)
    held_log = None
    if config.held_out:
        held_log = read_logs(list(config.held_out), mj_model, config.mapping)
        notes += held_log.notes
    # Before interpolation, which would smooth the noise.
    noise = pooled_noise(log.runs)
    parts = []
    for given in (log.runs, held_log.runs if held_log else ()):
        cut, leaps = split_at_resets(given, noise)
        notes += leaps
        parts.append(cut)
    if parts[0] != list(log.runs):
        # Bad readings have no part in the noise, where there are rows enough.
        noise = pooled_noise([r for r in parts[0] if len(r) > _FEW_ROWS] or log.runs)
    runs, changed = to_common_step([*parts[0], *parts[1]])
    notes += changed
    runs, odd = without_odd_ends(runs, noise)
    notes += odd
    fit, held = runs[: len(parts[0])], runs[len(parts[0]) :]
    if held_log is None:
        fit, held, held_name = split_held_out(mj_model, fit, horizon)
    else:
        held_name = ", ".join(run.name for run in held)
    return MeasuredRuns(log.runs, noise, fit, held, held_name, notes)


def _check_lengths(fit: list[Any], held: list[Any], steps: int, dt: float) -> None:
    from easi_jax.errors import UserError

    for runs, what in ((fit, "to fit"), (held, "held out")):
        longest = max(runs, key=len)
        if len(longest) <= steps:
            raise UserError(
                f"the longest run {what} ({longest.name}) has {len(longest)} rows, too "
                f"few for a horizon of {steps} steps ({steps * dt:g} s): record more, "
                "or shorten --horizon"
            )


def _model_and_space(config: Any) -> tuple[str, Any, Any]:
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

        env = make(config.robot)
        space = env.space
        if config.parameters is not None:
            space = read_parameter_file(config.parameters, env.mj_model)
        return env.name, env.mj_model, space
    if config.robot is not None:
        raise UserError("--model and --robot exclude each other: choose one")
    if config.parameters is None and config.effects is None:
        raise UserError(
            "--model needs --parameters P.yaml (or --effects E.yaml): say what may "
            "vary in the model (see docs/your_own_robot.md)"
        )
    mj_model = load_model(config.model, config.allow_assets)
    if config.parameters is None:
        return config.model.stem, mj_model, ParameterSpace(())
    space = read_parameter_file(config.parameters, mj_model)
    return config.model.stem, mj_model, space


def load_model(path: Path, allowed: tuple[Path, ...] = ()) -> Any:
    """The MuJoCo model in ``path``; ``allowed`` are places outside of its folder that
    it may read.

    Raises:
        UserError: as `read_mjcf`; or nothing in it moves.
    """
    from easi_jax.errors import UserError
    from easi_jax.io.models.mjcf import read_mjcf

    model = read_mjcf(path, allowed)
    if model.nv == 0:
        raise UserError(f"{path}: the model has no joint, so nothing can be identified")
    return model
