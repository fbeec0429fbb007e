"""The folder of one run: config, versions, metrics, checkpoints, results."""

import fcntl
import hashlib
import json
import os
import shutil
from collections.abc import Iterable, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from easi_jax.devices import distributed
from easi_jax.errors import UserError
from easi_jax.io.files import (
    atomic_write,
    digest_of,
    os_reason,
    read_json,
    to_json,
    to_plain,
)
from easi_jax.io.runs.metrics import MetricsLog
from easi_jax.io.runs.schemas import CONFIG, checked
from easi_jax.io.runs.versions import versions
from easi_jax.simulation import engine

FORMAT = 1
# Where and how a run is started; these do not change what it computes.
VOLATILE = ("out", "resume", "overwrite", "distributed", "allow_assets")

_CONFIG = "config.json"
_ENGINE = "engine.json"
_FILES = "files.json"  # digests of what the run reads
_LOCK = ".lock"


class RunFolder:
    """One run's files, locked against a second process; use ``open`` and ``with``.

    Of several processes of one run (`easi_jax.devices.distributed`) the leader alone
    touches the folder; the others know of it what the leader tells them.

    Attributes:
        path: the folder.
        config: the configuration as JSON holds it, without the volatile fields.
        config_hash: hex digest of ``config``, which checkpoints carry.
        resumed: True where the folder held this run before.
        checkpoints: folder for ``easi_jax.io.runs.checkpoints``.
    """

    def __init__(self, path: Path, config: dict[str, Any], lock: int, resumed: bool):
        self.path = path
        self.config = config
        self.config_hash = config_hash(config)
        self.resumed = resumed
        self.checkpoints = path / "checkpoints"
        self._lock = lock
        self._metrics: MetricsLog | None = None

    @classmethod
    def open(
        cls,
        path: str | os.PathLike[str],
        config: Any,
        *,
        command: str = "",
        resume: bool = False,
        overwrite: bool = False,
        files: Iterable[Path] = (),
    ) -> Self:
        """Starts a run in ``path``, or goes on with the one that is there.

        An empty or missing folder starts a run, with ``resume`` as well. A folder
        that holds a run is left untouched unless ``resume`` (same configuration
        but for ``VOLATILE``) or ``overwrite`` (everything in it is deleted) says
        what to do.

        Args:
            path: the folder.
            config: dataclass or mapping, written to ``config.json``.
            command: such as ``train.easi``; a run of another command is refused.
            resume: go on with the run that is there.
            overwrite: delete the run that is there.
            files: that the run reads: it does not go on with others in their places.

        Raises:
            UserError: the folder is in use, not writable, holds something else, a
                run and no word what to do with it, or a run of another
                configuration, or of files that have changed since. Nothing is changed
                then.
        """
        if resume and overwrite:
            raise UserError("--resume and --overwrite exclude each other: choose one")
        folder = Path(path)
        plain = {k: v for k, v in _as_mapping(config).items() if k not in VOLATILE}
        opened: list[Self] = []

        def begin() -> bool:
            read = {os.fspath(p): digest_of(p) for p in files if os.path.isfile(p)}
            begun = cls._begun(folder, plain, command, resume, overwrite, read)
            opened.append(begun)
            return opened[0].resumed

        resumed = distributed.from_leader(begin)
        return opened[0] if opened else cls(folder, plain, -1, resumed)

    @classmethod
    def _begun(
        cls,
        folder: Path,
        plain: dict[str, Any],
        command: str,
        resume: bool,
        overwrite: bool,
        files: dict[str, str],
    ) -> Self:
        _refuse_foreign(folder)
        lock = _acquire(folder)
        try:
            known = (folder / _CONFIG).exists()
            if known and not (resume or overwrite):
                raise UserError(
                    f"{folder} already holds a run: --resume goes on with it, "
                    "--overwrite deletes it, or choose another --out"
                )
            if known and resume:
                _check_same(folder, command, plain, files)
            elif known:
                _clear(folder)
            resumed = known and resume
            run = cls(folder, plain, lock, resumed)
            if not resumed:
                head = {"format": FORMAT, "command": command, "config": plain}
                run.write_json(_CONFIG, head)  # first: from now on it holds a run
                if files:
                    run.write_json(_FILES, files)
            if not (folder / "versions.json").exists():
                run.write_json("versions.json", versions())
            if not (folder / _ENGINE).exists():
                engine.recorded(run._write_engine)
        except BaseException:
            _release(lock)
            raise
        return run

    def _write_engine(self, name: str, why: str) -> None:
        self.write_json(_ENGINE, {"engine": name, "why": why})

    def write_json(self, name: str, value: Any) -> Path:
        """Writes ``value`` as JSON into the folder, atomically."""
        return self.write(name, to_json(value))

    def write(self, name: str, data: str | bytes) -> Path:
        """Writes text or bytes into the folder, atomically; name may hold ``/``."""
        path = self.path / name
        atomic_write(path, data)
        return path

    def log(self, stage: str, step: int, values: Mapping[str, Any]) -> None:
        """Records scalars of one step of a stage (see ``MetricsLog``)."""
        if distributed.leader():
            self._log().write(stage, step, values)

    def rewind(self, stage: str, step: int) -> None:
        """Forgets metrics of ``stage`` after ``step``, where a checkpoint resumed."""
        if distributed.leader():
            self._log().rewind(stage, step)

    def close(self) -> None:
        """Closes the metrics and lets go of the folder; may be called twice."""
        if self._metrics is not None:
            self._metrics.close()
            self._metrics = None
        if self._lock >= 0:
            _release(self._lock)
            self._lock = -1

    def _log(self) -> MetricsLog:
        if self._metrics is None:
            self._metrics = MetricsLog(self.path)
        return self._metrics

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


def config_hash(config: Any) -> str:
    """Sixteen hex digits that name a configuration, volatile fields left out."""
    plain = {k: v for k, v in _as_mapping(config).items() if k not in VOLATILE}
    text = json.dumps(plain, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def read_config(folder: Path) -> dict[str, Any]:
    """Configuration of a run, for commands that build on it.

    Raises:
        UserError: the folder holds no run, or one of another format.
    """
    if not (folder / _CONFIG).exists():
        raise UserError(f"{folder} holds no run ({_CONFIG} is missing)")
    return _read_head(folder)["config"]


def engine_of(folder: Path) -> tuple[str, str] | None:
    """The engine that the run in a folder simulates with, and why; None where it does
    not say.

    Raises:
        UserError: a file that says something else.
    """
    path = folder / _ENGINE
    if not path.is_file():
        return None
    found = read_json(path)
    name = found.get("engine") if isinstance(found, dict) else None
    if name not in engine.CHOICES:
        raise UserError(f"{path} names no engine: --overwrite deletes the run")
    return str(name), str(found.get("why", ""))


def _as_mapping(config: Any) -> dict[str, Any]:
    plain = to_plain(config)
    if not isinstance(plain, dict):
        raise TypeError("a configuration is a dataclass or a mapping")
    return plain


def _read_head(folder: Path) -> dict[str, Any]:
    path = folder / _CONFIG
    head = read_json(path)
    if not isinstance(head, dict) or head.get("format") != FORMAT:
        raise UserError(
            f"{path} is of another format than this version writes "
            f"({FORMAT}): --overwrite deletes the run, or choose another --out"
        )
    return checked(head, CONFIG, f"{path} is not a run's configuration")


def has_changed(folder: Path, path: Path) -> bool:
    """Whether a file that the run in a folder read is another now, as far as it says.

    Raises:
        UserError: what it says cannot be read.
    """
    was = _digests(folder).get(os.fspath(path))
    return was is not None and os.path.isfile(path) and was != digest_of(path)


def _digests(folder: Path) -> dict[str, str]:
    """Of the files that a run read, by their paths; none where it does not say."""
    path = folder / _FILES
    return checked(read_json(path), {"*": str}, str(path)) if path.exists() else {}


def _check_same(
    folder: Path, command: str, config: dict[str, Any], files: dict[str, str]
) -> None:
    head = _read_head(folder)
    if head["command"] != command:
        raise UserError(
            f"{folder} holds a run of {head['command']}, not of {command}: choose "
            "another --out"
        )
    old = head["config"]
    names = [k for k in {**old, **config} if old.get(k) != config.get(k)]
    if names:
        name = names[0]
        more = f" (and {len(names) - 1} more)" if len(names) > 1 else ""
        raise UserError(
            f"{folder} holds a run with {_differs(name, old, config)}{more}: resume "
            "with the same settings, or choose another --out"
        )
    begun = _digests(folder)
    changed = [name for name, now in files.items() if begun.get(name, now) != now]
    if changed:
        raise UserError(
            f"{changed[0]} has changed since {folder} was begun: put the file back, or "
            "start anew with --overwrite or another --out"
        )


def _differs(name: str, old: dict[str, Any], new: dict[str, Any]) -> str:
    was, now = old.get(name), new.get(name)
    if isinstance(was, dict) and isinstance(now, dict):
        inner = next(k for k in {**was, **now} if was.get(k) != now.get(k))
        return f"{name}.{_differs(inner, was, now)}"
    return f"{name} = {json.dumps(was)}, not {json.dumps(now)}"


def _refuse_foreign(folder: Path) -> None:
    """Keeps a mistyped --out from mixing a run into somebody's files."""
    try:
        names = [item.name for item in folder.iterdir()] if folder.exists() else []
    except OSError as error:
        raise UserError(
            f"cannot use {folder} as output folder: {os_reason(error)}; choose "
            "another --out"
        ) from error
    if _CONFIG not in names and any(not name.startswith(".") for name in names):
        raise UserError(f"{folder} is not empty and holds no run: choose another --out")


def _acquire(folder: Path) -> int:
    """An exclusive lock that ends with the process, however it ends."""
    created = not folder.exists()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        handle = os.open(folder / _LOCK, os.O_RDWR | os.O_CREAT, 0o666)
    except OSError as error:
        if created and folder.is_dir():
            folder.rmdir()
        raise UserError(
            f"cannot write into {folder}: {os_reason(error)}; choose another --out"
        ) from error
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        os.close(handle)
        raise UserError(
            f"another run is writing into {folder}: wait for it, or choose another "
            "--out"
        ) from error
    except OSError as error:
        os.close(handle)
        raise UserError(
            f"{folder} cannot be locked: {os_reason(error)}; choose an --out on "
            "another disk"
        ) from error
    return handle


def _release(handle: int) -> None:
    fcntl.flock(handle, fcntl.LOCK_UN)
    os.close(handle)


def _clear(folder: Path) -> None:
    keep = (_LOCK, _CONFIG)  # the config last: cut short, it is still a run
    try:
        for item in folder.iterdir():
            if item.name in keep:
                continue
            if item.is_dir() and not item.is_symlink():
                shutil.rmtree(item)
            else:
                item.unlink()
        (folder / _CONFIG).unlink()
    except OSError as error:
        raise UserError(
            f"cannot clear {folder}: {os_reason(error)}; choose another --out"
        ) from error
