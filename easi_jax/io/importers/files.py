"""From foreign files to log files: all of them, or none."""

import os
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import mujoco

from easi_jax.errors import UserError
from easi_jax.io.files import os_reason
from easi_jax.io.importers.lerobot import is_lerobot, read_lerobot
from easi_jax.io.importers.minari import FILE, read_minari
from easi_jax.io.importers.pace import read_pace
from easi_jax.io.importers.ros import read_ros
from easi_jax.io.importers.streams import Recording, Selection
from easi_jax.io.importers.table import to_table
from easi_jax.io.logs.mapping import LogMapping
from easi_jax.io.logs.reader import read_logs
from easi_jax.io.logs.tables import write_table

Extension = Literal["csv", "parquet", "npz"]
_KINDS = (
    "MCAP (.mcap), rosbag2 (folder or .db3), LeRobot (folder), Minari (folder or "
    ".hdf5) and PACE (.pt) are read"
)


@dataclass(frozen=True)
class Imported:
    """A log that was written.

    Attributes:
        path: the log.
        rows: how many it has.
        runs: how many runs a reader makes of it.
        notes: what a user should know of it.
    """

    path: Path
    rows: int
    runs: int
    notes: tuple[str, ...]


def import_recordings(
    paths: Sequence[Path],
    mj_model: mujoco.MjModel,
    out: Path,
    *,
    mapping: LogMapping | None = None,
    selection: Selection | None = None,
    unmeasured: Sequence[str] = (),
    slack: float = 0.0,
    allow_nan: bool = False,
    extension: Extension = "csv",
    overwrite: bool = False,
) -> list[Imported]:
    """Writes a log for each recording or episode in ``paths`` into folder ``out``.

    Logs are written elsewhere first, read back as the other commands will, and only
    then put in place, so that ``out`` gets all of them or is left as it was.

    Args:
        paths: files and folders, told apart by what they are.
        mj_model: the machine; its names and ranges are what logs are checked against.
        out: folder; made if it is not there.
        mapping: names and units that differ.
        selection: what is read of each recording.
        unmeasured: joints without a sensor, by name or pattern; ``all``: whatever a
            recording lacks.
        slack: a command counts for a row if sent no later than this after it, s.
        allow_nan: keep rows with non-finite positions or commands.
        extension: of the logs.
        overwrite: replace logs of the same names.

    Raises:
        UserError: a recording that cannot be used, or a log that is there already.
    """
    mapping, selection = mapping or LogMapping(), selection or Selection()
    done: dict[Path, Imported] = {}
    with _staging(out) as staged:
        for path in paths:
            for recording in _recordings(path, selection):
                target = out / f"{recording.name}.{extension}"
                if target in done:
                    raise UserError(
                        f"{recording.path}: another recording becomes {target} too; "
                        "import it into another folder"
                    )
                if target.exists() and not overwrite:
                    raise UserError(
                        f"{target} is there already: choose another --out, or replace "
                        "it with --overwrite"
                    )
                table, notes = to_table(
                    recording,
                    mapping,
                    mj_model,
                    unmeasured=unmeasured,
                    slack=slack,
                    allow_nan=allow_nan,
                )
                temporary = Path(staged) / target.name
                write_table(temporary, table)
                runs, more = _read_back(temporary, target, mj_model, unmeasured)
                done[target] = Imported(
                    target, len(table["time"]), runs, (*notes, *more)
                )
        _put_in_place(Path(staged), list(done))
    return list(done.values())


def _recordings(path: Path, selection: Selection) -> Iterator[Recording]:
    """The recordings in ``path``, read by its kind."""
    suffix = path.suffix.lower()
    if not path.exists():
        raise UserError(f"{path}: no such file or folder")
    if path.is_dir():
        if (path / "metadata.yaml").is_file():
            yield read_ros(path, selection)
        elif is_lerobot(path):
            yield from read_lerobot(path, selection)
        elif (path / "data" / FILE).is_file() or (path / FILE).is_file():
            yield from read_minari(path, selection)
        else:
            raise UserError(f"{path}: no recording of a known kind in it; {_KINDS}")
    elif suffix in (".mcap", ".db3"):
        yield read_ros(path, selection)
    elif suffix in (".hdf5", ".h5"):
        yield from read_minari(path, selection)
    elif suffix in (".pt", ".pth"):
        yield read_pace(path, selection)
    elif suffix == ".bag":
        raise UserError(
            f"{path}: a ROS 1 bag; convert it first: "
            "rosbags-convert --src IN.bag --dst OUT"
        )
    else:
        raise UserError(f"{path}: not a recording of a known kind; {_KINDS}")


def _staging(out: Path) -> tempfile.TemporaryDirectory[str]:
    """A folder for what is not whole yet, on the file system of ``out``."""
    place = out.absolute()
    while not place.exists():
        place = place.parent
    try:
        if not place.is_dir():
            raise UserError(f"{out}: {place} is a file, not a folder")
        return tempfile.TemporaryDirectory(prefix=".import-", dir=place)
    except OSError as error:
        raise UserError(f"cannot write to {out}: {os_reason(error)}") from None


def _read_back(
    temporary: Path,
    target: Path,
    mj_model: mujoco.MjModel,
    unmeasured: Sequence[str],
) -> tuple[int, list[str]]:
    """Number of runs, and the notes of the reader that other commands use."""
    try:
        log = read_logs(temporary, mj_model, None, unmeasured)
    except UserError as error:
        raise UserError(str(error).replace(str(temporary), str(target))) from None
    return len(log.runs), [n.removeprefix(f"{temporary}: ") for n in log.notes]


def _put_in_place(staged: Path, targets: list[Path]) -> None:
    """Moves all of ``targets`` out of ``staged``; if one cannot be moved, all are as
    they were before."""
    old, done = staged / "before", list[Path]()
    try:
        old.mkdir()
        for target in targets:
            target.parent.mkdir(parents=True, exist_ok=True)
            if target.exists():  # stays there until it is replaced
                shutil.copy2(target, old / target.name)
            done.append(target)
            os.replace(staged / target.name, target)
    except BaseException as error:
        for target in done:
            if (old / target.name).exists():
                os.replace(old / target.name, target)
            else:
                target.unlink(missing_ok=True)
        if not isinstance(error, OSError):
            raise
        raise UserError(f"cannot write {targets[0].parent}: {os_reason(error)}") from (
            error
        )
