"""``python -m train.import_logs``: recordings of other projects become logs."""

import dataclasses
import math
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from train._command import main, say, show_table
from train._options import BaseOptions

_SHOWN = 20


@dataclasses.dataclass(frozen=True)
class Config(BaseOptions):
    """Writes logs, as train.easi and train.gap read them, from other recordings.

    MCAP files and rosbag2 folders, LeRobot and Minari datasets, and PACE recordings
    (.pt) are told apart by what they are; each recording or episode becomes one log in
    --out. Names and units that differ from the model's are given by --mapping
    (docs/importers.md). Each log is read back before any is put in place.
    """

    recordings: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Files and folders, all with one robot and one mapping."""
    model: str
    """MuJoCo model (MJCF) of the machine, or the name of a built-in robot."""
    allow_assets: tuple[Path, ...] = ()
    """Files, or folders with all below them, that the model may read besides those in
    its own folder."""
    out: Path = Path("logs")
    """Folder for the logs."""
    mapping: Path | None = None
    """YAML file of their names and ours: joints, actuators, columns, scale, offset."""
    state: tuple[str, ...] = ()
    """Topics, features or tensors with positions, the first of which gives the rows;
    not given: the only topic of joint states, observation.state, dof_pos."""
    command: tuple[str, ...] = ()
    """Topics, features or tensors with commands; not given: the only topic that can
    be, action, actions, des_dof_pos."""
    command_field: Literal["auto", "position", "velocity", "effort"] = "auto"
    """Which field of a joint or trajectory message is the command; auto: the first
    that is not empty."""
    command_slack: float = 0.0
    """A command sent up to this long after a row counts for it [s]."""
    clock: Literal["record", "header"] = "record"
    """ROS: times at which messages were recorded, or those in their headers."""
    step: float | None = None
    """Minari: the control step [s]."""
    episodes: tuple[int, ...] = ()
    """LeRobot, Minari: numbers of the episodes; not given: all."""
    format: Literal["csv", "parquet", "npz"] = "csv"
    """Of the logs."""
    allow_nan: bool = False
    """Keep rows with positions or commands that are not finite; readers of the log
    drop them, say so, and split the run there."""
    overwrite: bool = False
    """Replace logs of the same names."""


def run(config: Config) -> None:
    """Reads, checks, writes."""
    from easi_jax.errors import UserError
    from easi_jax.io.importers import Selection, import_recordings
    from easi_jax.io.logs.mapping import read_mapping
    from train._gap_problem import read_model

    if not config.recordings:
        raise UserError("no recording given")
    step = config.step
    if step is not None and not (math.isfinite(step) and step > 0):
        raise UserError(f"--step is {step:g}: give seconds above 0")
    if not (math.isfinite(config.command_slack) and config.command_slack >= 0):
        raise UserError(f"--command-slack is {config.command_slack:g}: 0 s or more")
    held = ((), None) if config.held_base else None
    mj_model = read_model(config.model, config.allow_assets, held).mj_model
    mapping = None if config.mapping is None else read_mapping(config.mapping)
    done = import_recordings(
        config.recordings,
        mj_model,
        config.out,
        mapping=mapping,
        selection=Selection(
            state=config.state,
            command=config.command,
            field=config.command_field,
            clock=config.clock,
            step=step,
            episodes=config.episodes,
        ),
        slack=config.command_slack,
        unmeasured=config.unmeasured,
        allow_nan=config.allow_nan,
        extension=config.format,
        overwrite=config.overwrite,
    )
    _show(done)


def _show(done: list[Any]) -> None:
    places: dict[str, list[str]] = {}
    for log in done:
        for note in log.notes:
            places.setdefault(note, []).append(log.path.name)
    for note, names in places.items():
        more = f" and {len(names) - 1} more" if len(names) > 1 else ""
        say(f"note: {names[0]}{more}: {note}")
    rows = [(log.path, log.rows, log.runs) for log in done[:_SHOWN]]
    show_table("Logs", ["file", "rows", "runs"], rows)
    if len(done) > _SHOWN:
        say(f"and {len(done) - _SHOWN} more")
    say(f"written: {len(done)} logs in {done[0].path.parent}")


if __name__ == "__main__":
    main(Config, run, name="train.import_logs")
