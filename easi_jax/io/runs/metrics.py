"""Numbers of a run over time: JSON lines for programs, TensorBoard for eyes."""

import json
import logging
import os
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from easi_jax.errors import UserError
from easi_jax.io.files import atomic_write, number, os_reason, regular_file, to_json


class MetricsLog:
    """Appends scalars to ``metrics.jsonl`` and to ``tensorboard/STAGE``.

    A line is ``{"stage": "search", "step": 3, "time": 12.5, NAME: value, ...}``;
    ``time`` is in seconds since this process opened the log. Each line reaches the
    operating system at once, so a killed run loses none.

    Raises:
        UserError: the folder cannot be written.
    """

    def __init__(self, folder: Path) -> None:
        self._path = folder / "metrics.jsonl"
        self._boards = folder / "tensorboard"
        self._writers: dict[str, Any] = {}
        self._purge: dict[str, int] = {}
        self._start = time.monotonic()
        _drop_partial_line(self._path)
        try:
            self._file = self._path.open("ab", buffering=0)
        except OSError as error:
            raise UserError(f"cannot write {self._path}: {os_reason(error)}") from error

    def write(self, stage: str, step: int, values: Mapping[str, Any]) -> None:
        """Records scalars (or arrays of size one) of one step of a stage."""
        scalars = {
            name: float(np.asarray(item).item()) for name, item in values.items()
        }
        seconds = round(time.monotonic() - self._start, 3)
        line = {"stage": stage, "step": int(step), "time": seconds, **scalars}
        try:
            self._file.write(to_json(line, indent=None).encode())
        except OSError as error:
            raise UserError(
                f"cannot write {self._path}: {os_reason(error)}; free the disk, then "
                "go on with --resume"
            ) from error
        try:
            board = self._board(stage)
            for name, item in scalars.items():
                board.add_scalar(name, item, int(step), walltime=time.time())
        except OSError as error:
            raise UserError(
                f"cannot write {self._boards}: {os_reason(error)}; free the disk, then "
                "go on with --resume"
            ) from error

    def rewind(self, stage: str, step: int) -> None:
        """Forgets what ``stage`` recorded after ``step``: a resumed run redoes it."""
        kept = [
            line
            for line in read_metrics(self._path)
            if line["stage"] != stage or line["step"] <= step
        ]
        text = "".join(to_json(line, indent=None) for line in kept)
        self._file.close()
        try:
            atomic_write(self._path, text)
        finally:
            self._file = self._path.open("ab", buffering=0)
        if stage in self._writers:
            self._writers.pop(stage).close()
        self._purge[stage] = step + 1

    def close(self) -> None:
        """Flushes and closes all files."""
        self._file.close()
        for writer in self._writers.values():
            writer.close()

    def _board(self, stage: str) -> Any:
        if stage not in self._writers:
            from tensorboardX import SummaryWriter

            # A NaN is drawn as one; no need to say so among the progress lines.
            logging.getLogger("tensorboardX").setLevel(logging.ERROR)
            purge = self._purge.pop(stage, None)
            self._writers[stage] = SummaryWriter(
                str(self._boards / stage), purge_step=purge
            )
        return self._writers[stage]


def read_metrics(path: Path, stage: str | None = None) -> list[dict[str, Any]]:
    """Lines of a ``metrics.jsonl``, of one stage or all; a cut-short end is left out.

    Raises:
        UserError: the file cannot be read or holds something else.
    """
    try:
        if not path.exists():
            return []
        regular_file(path)
        raw = path.read_bytes()
    except OSError as error:
        raise UserError(f"cannot read {path}: {os_reason(error)}") from error
    lines = []
    for index, text in enumerate(raw.split(b"\n")[:-1], start=1):
        try:
            line = json.loads(text)
            values = {
                name: item if name in ("stage", "step") else number(item)
                for name, item in line.items()
            }
            if not (isinstance(values["step"], int) and "stage" in values):
                raise ValueError("no step or no stage")
            if stage is None or values["stage"] == stage:
                lines.append(values)
        except (
            *(ValueError, KeyError, TypeError, AttributeError, RecursionError),
        ) as error:
            raise UserError(
                f"{path}, line {index}: not a metrics line; remove it or start the "
                "run anew with --overwrite"
            ) from error
    return lines


def _drop_partial_line(path: Path) -> None:
    """A process killed while writing may leave half a line behind."""
    if not path.exists():
        return
    try:
        regular_file(path)
        with path.open("rb+") as file:
            content = file.read()
            file.truncate(content.rfind(b"\n") + 1)
            os.fsync(file.fileno())
    except OSError as error:
        raise UserError(f"cannot write {path}: {os_reason(error)}") from error
