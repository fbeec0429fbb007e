"""Options of ``train.gap``."""

import dataclasses
from pathlib import Path

from train._options import BaseOptions, EngineOptions, OwnEffectsOptions

_HORIZON = 0.2  # s


@dataclasses.dataclass(frozen=True)
class Config(EngineOptions, OwnEffectsOptions, BaseOptions):
    """Finds where a simulation and measured logs disagree, and names what is missing.

    The model predicts short windows of the logs from starts that are fitted to the rows
    around them. Every known physical effect (dry friction, delay, backlash, a payload,
    ...) at every place of the model is then fitted together with the model's own
    parameters, and kept where it predicts data that no fit has seen. Writes gap.json,
    model.xml (the model with the effects), effects.yaml (for --effects of the other
    commands) and report.html.
    """

    model: str = ""
    """Required: MuJoCo model (MJCF), or the name of a built-in robot."""
    allow_assets: tuple[Path, ...] = ()
    """Files, or folders with all below them, that the model may read besides those in
    its own folder (meshes, textures, includes)."""
    data: tuple[Path, ...] = ()
    """Required: measured logs (CSV, NPZ or Parquet)."""
    out: Path = Path("results/gap")
    """Folder for the results."""
    held_out: tuple[Path, ...] = ()
    """Logs kept out of every fit; not given: whole runs with a quarter of the rows, of
    a single run 30 % in three blocks."""
    horizon: float = _HORIZON
    """Over what the gap is reported [s], at least 10 control steps; which effects are
    named does not depend on it."""
    parameters: Path | None = None
    """What may be refitted in the model (see train.parameters); not given: damping,
    friction and stiffness that the model states, each within a factor of 5."""
    mapping: Path | None = None
    """Mapping file (YAML) for logs with foreign column names."""
    retrain: str | None = None
    """Robot with a task (built-in, or a Python file as --env takes it) whose policy is
    then trained with what was found and without it, both tested in the repaired model.
    """
    retrain_steps: int | None = None
    """Control steps of each of both trainings; the robot's preset where not given."""
    retrain_seeds: tuple[int, ...] = (0,)
    """Seeds of the trainings."""
    resume: bool = False
    """Go on with the analysis in the folder."""
    overwrite: bool = False
    """Delete the results in the folder first."""
