"""What ``train.gap`` is asked: model, logs, what may be refitted, all checked."""

import dataclasses
import math
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import mujoco
    import numpy as np

    from easi_jax.data.recording import Run
    from easi_jax.gap.sensor_faults import ReadingFault
    from easi_jax.model.parameters import ParameterSpace
    from envs.robot import Robot
    from train._gap_config import Config
    from train._log_problem import Held


@dataclasses.dataclass(frozen=True)
class GivenModel:
    """What --model names.

    Attributes:
        name: of the model.
        path: of its MJCF; None for a built-in robot.
        mj_model: compiled.
        env: the built-in robot; None for a file.
    """

    name: str
    path: Path | None
    mj_model: "mujoco.MjModel"
    env: "Robot | None"

    @property
    def source(self) -> Path:
        """The file that the model is from."""
        from envs.robot import model_file

        return self.path or model_file(self.name)

    @property
    def fixed(self) -> dict[str, float]:
        """What a built-in robot has and MJCF cannot say, by address."""
        return {} if self.env is None else beyond_mjcf(self.env.space)


@dataclasses.dataclass(frozen=True)
class GapProblem:
    """A model and its measured motion.

    Attributes:
        model: as --model names it.
        space: its own parameters that may be refitted.
        fit, held: runs.
        held_name, held_names: which data are held out.
        noise: of positions and velocities, ``(2 nv,)``.
        readings: that are late or off (`readings.ReadingFault`).
        notes: what the user should know of the data.
    """

    model: GivenModel
    space: "ParameterSpace"
    fit: "list[Run]"
    held: "list[Run]"
    held_name: str
    held_names: list[str]
    noise: "np.ndarray"
    readings: "list[ReadingFault]"
    notes: list[str]

    @property
    def fixed(self) -> dict[str, float]:
        """What the model has and MJCF cannot say, where no parameter sets it."""
        from easi_jax.model.found_effects import set_by_none

        return set_by_none(self.model.mj_model, self.space.addresses, self.model.fixed)


def read_gap_problem(config: "Config") -> GapProblem:
    """Reads and checks everything; nothing is written yet.

    Raises:
        UserError: whatever is wrong with the files or the options.
    """
    from easi_jax.errors import UserError
    from easi_jax.gap.excitation_coverage import coverage_notes
    from easi_jax.gap.sensor_faults import reading_faults, without_faults
    from easi_jax.io.models.parameter_file import read_parameter_file
    from easi_jax.model.own_effects_check import check_own_effects
    from easi_jax.model.parameter_proposal import own_space
    from train._log_problem import held_of, read_runs

    if not (math.isfinite(config.horizon) and config.horizon > 0):
        raise UserError(f"--horizon is {config.horizon:g}: give seconds above 0")
    model = read_model(config.model, config.allow_assets, held_of(config), True)
    mj_model = model.mj_model
    check_own_effects(mj_model)
    space = (
        own_space(mj_model)
        if config.parameters is None
        else read_parameter_file(config.parameters, mj_model)
    )
    runs = read_runs(config, mj_model, config.horizon)
    faults = reading_faults(mj_model, runs.recorded)
    return GapProblem(
        model,
        space,
        without_faults(runs.fit, faults),
        without_faults(runs.held, faults),
        runs.held_name,
        [run.name for run in runs.held],
        runs.noise,
        faults,
        [*runs.notes, *coverage_notes(mj_model, runs.fit, runs.held)],
    )


def beyond_mjcf(space: "ParameterSpace") -> dict[str, float]:
    """Nominal values of a built-in robot's parameters that MJCF has no word for."""
    return {
        address: p.nominal
        for p in space.parameters
        for address in p.addresses
        if address.endswith(".speed_limit")
    }


def read_model(
    text: str,
    allowed: tuple[Path, ...] = (),
    held: "Held | None" = None,
    logged: bool = False,
) -> GivenModel:
    """A built-in robot by its name, or an MJCF file; see `load_model`.

    Raises:
        UserError: no such model.
    """
    from envs import REGISTRY, make
    from envs.robot import model_file
    from train._log_problem import load_model

    if text in REGISTRY:
        env = make(text)
        m = load_model(model_file(text), (), held, logged) if held else env.mj_model
        return GivenModel(text, None, m, env)
    path = Path(text)
    mj_model = load_model(path, allowed, held, logged)
    # The first of the model's names is its own.
    name = mj_model.names.split(b"\0", 1)[0].decode()
    return GivenModel(name or path.stem, path, mj_model, None)
