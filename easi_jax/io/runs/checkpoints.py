"""Checkpoints of any pytree of arrays: never half written, never silently wrong.

A checkpoint is a folder ``step_000000000012`` with orbax's files under ``state`` and
``meta.json`` beside it: format, configuration, path, shape and dtype of each leaf,
and a digest of each file. It appears by one rename, when all of it is on the disk.

orbax's ``CheckpointManager`` (0.12.8) was tried in place of this. New steps survive
signal 9 with both (12 of 12 kills), but there a step that is written again has to be
deleted first: 11 of 12 kills then left nothing to go on from, here none of 12. It does
not sync its descriptions and its last rename to the disk, leaves what a failed write
has begun, and cannot hold digests of files in the commit that writes them.
"""

import contextlib
import logging
import os
import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from easi_jax.devices import distributed
from easi_jax.errors import UserError, engine_calls
from easi_jax.io.files import digest_of, os_reason, read_json, to_json

FORMAT = 1
KEEP = 2

T = TypeVar("T")


class Restored(NamedTuple):
    """A checkpoint read back.

    Attributes:
        state: the pytree, bit-equal to what was saved.
        step: the step it was saved at.
        notes: one line for each newer checkpoint that was unusable, and why.
    """

    state: Any
    step: int
    notes: tuple[str, ...]


class _UnusableError(Exception):
    """Why a checkpoint cannot be read."""


def save(folder: Path, step: int, state: Any, *, config_hash: str) -> Path:
    """Writes ``state`` as the checkpoint of ``step``; keeps the newest ``KEEP``.

    Of several processes of one run, the leader alone writes; each must call this.

    Args:
        folder: where the checkpoints of one stage live; made if missing.
        step: counts up; an older checkpoint of the same step is replaced.
        state: pytree of arrays, Python numbers and typed PRNG keys.
        config_hash: see ``easi_jax.io.runs.folder.config_hash``.

    Raises:
        UserError: it cannot be written; the earlier ones are as they were.
        EngineError: a simulation failed, so that the state is worth nothing.
    """
    final = _named(folder, step)
    raw = distributed.local(_raw_keys(state))
    if not distributed.leader():
        return final
    names, leaves = _named_leaves(jax.device_get(raw))
    engine_calls.check()
    types = _leaf_types(state)
    kinds = jax.tree.leaves(jax.eval_shape(lambda: _raw_keys(state)))
    arrays = {
        n: np.asarray(x, k.dtype) for n, x, k in zip(names, leaves, kinds, strict=True)
    }
    temp, last = folder / f".writing-{os.getpid()}", _aside(folder, step)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        _remove_leftovers(folder)
        temp.mkdir()
        # orbax cannot store arrays without elements; the target has their shape.
        _orbax_save(temp / "state", {n: x for n, x in arrays.items() if x.size})
        meta = {
            "format": FORMAT,
            "config": config_hash,
            "step": step,
            "leaves": types,
            "files": _digests(temp / "state"),
        }
        (temp / "meta.json").write_text(to_json(meta), encoding="utf-8")
        _sync(temp)
        if final.exists():
            final.rename(last)
        temp.rename(final)
        _sync_folder(folder)
    except (OSError, ValueError, RuntimeError) as error:
        if last.exists() and not final.exists():
            with contextlib.suppress(OSError):
                last.rename(final)
        shutil.rmtree(temp, ignore_errors=True)
        kept = steps(folder)
        good = f"the one of step {kept[-1]} is kept" if kept else "none is kept yet"
        reason = os_reason(error) if isinstance(error, OSError) else _reason(error)
        raise UserError(
            f"cannot write checkpoint {final}: {reason}; {good}: free the disk, then "
            "go on with --resume"
        ) from error
    _remove_leftovers(folder)
    for old in steps(folder)[:-KEEP]:
        shutil.rmtree(_named(folder, old), ignore_errors=True)
    return final


def steps(folder: Path) -> list[int]:
    """Steps that have a checkpoint, ascending; empty where there is none."""
    found = os.listdir(folder) if folder.is_dir() else []
    named = (re.fullmatch(r"(?:step_|\.old-)([0-9]+)", name) for name in found)
    return sorted({int(match[1]) for match in named if match})


def restore(
    folder: Path, target: Any, *, config_hash: str | None = None
) -> Restored | None:
    """Reads the newest good checkpoint; None where there is none at all.

    Of several processes of one run, the leader alone reads, and tells the others.

    Args:
        folder: as given to ``save``.
        target: the state's structure, such as ``jax.eval_shape(lambda: state)``.
            Leaves that carry a sharding are put there, others on the default device.
        config_hash: where given, a checkpoint of another configuration is refused.

    Raises:
        UserError: there are checkpoints, and each is cut short, damaged, of another
            format, another configuration or other shapes.
    """
    found = distributed.from_leader(lambda: _newest(folder, target, config_hash))
    if found is None:
        return None
    values, step, notes = found
    names, _ = _named_leaves(jax.eval_shape(_raw_keys, target))
    wanted, structure = jax.tree.flatten(target)
    placed = [_place(values[n], w) for n, w in zip(names, wanted, strict=True)]
    return Restored(jax.tree.unflatten(structure, placed), step, notes)


def _newest(
    folder: Path, target: Any, config_hash: str | None
) -> tuple[dict[str, np.ndarray], int, tuple[str, ...]] | None:
    notes = []
    for step in reversed(steps(folder)):
        path = _folder_of(folder, step)
        try:
            values = _read(path, target, config_hash)
        except _UnusableError as error:
            notes.append(f"checkpoint {path} is unusable: {error}")
        else:
            return values, step, tuple(notes)
    if not notes:
        return None
    raise UserError(
        f"{notes[0]}; start anew with --overwrite, or use the version and settings "
        "that wrote it"
    )


def _read(path: Path, target: Any, config_hash: str | None) -> dict[str, np.ndarray]:
    """Arrays by the names of `_named_leaves`, keys as their integers."""
    try:
        meta = read_json(path / "meta.json")
        form, config = meta["format"], meta["config"]
        if form != FORMAT:
            raise _UnusableError(f"format {form}, this version reads {FORMAT}")
        if config_hash is not None and config != config_hash:
            raise _UnusableError("written with another configuration")
        _check_leaves(meta["leaves"], _leaf_types(target))
        if _digests(path / "state") != meta["files"]:
            raise _UnusableError("cut short or damaged")
    except (UserError, LookupError, TypeError, AttributeError, OSError) as error:
        raise _UnusableError("cut short or damaged") from error
    names, leaves = _named_leaves(jax.eval_shape(_raw_keys, target))
    values = {n: np.empty(x.shape, x.dtype) for n, x in zip(names, leaves, strict=True)}
    stored = {n: x for n, x in values.items() if x.size}
    values |= _orbax_restore(path / "state", stored)
    for name, value in stored.items():
        found = values[name]
        if (found.shape, found.dtype) != (value.shape, value.dtype):
            raise _UnusableError("not what its description says")
    return values


def _checkpointer() -> Any:
    """orbax waits for the other processes unless told that the leader is alone."""
    import orbax.checkpoint as ocp

    if distributed.count() == 1:
        return ocp.StandardCheckpointer()
    alone = ocp.options.MultiprocessingOptions(
        primary_host=0, active_processes={0}, barrier_sync_key_prefix="leader"
    )
    return ocp.StandardCheckpointer(multiprocessing_options=alone)


def _orbax_save(path: Path, arrays: dict[str, np.ndarray]) -> None:
    with _quiet(), _checkpointer() as checkpointer:
        checkpointer.save(path.absolute(), arrays)


def _orbax_restore(path: Path, target: dict[str, np.ndarray]) -> dict[str, Any]:
    with _quiet(), _checkpointer() as checkpointer:
        try:
            return checkpointer.restore(path.absolute(), target)
        # The digests fit, so the files were edited, and orbax may raise anything.
        except Exception as error:
            raise _UnusableError(f"damaged ({_reason(error)})") from error


def _is_key(leaf: Any) -> bool:
    kind = getattr(leaf, "dtype", None)
    return kind is not None and jnp.issubdtype(kind, jax.dtypes.prng_key)


def _raw_keys(tree: T) -> T:
    """The tree with typed PRNG keys as their integers."""
    return jax.tree.map(lambda x: jax.random.key_data(x) if _is_key(x) else x, tree)


def _key_impl(target: Any) -> Any:
    """Generator of a key that may have a shape only; jax tells it while tracing."""
    found = []
    jax.eval_shape(lambda key: found.append(jax.random.key_impl(key)), target)
    return found[0]


def _place(value: np.ndarray, target: Any) -> Any:
    array = jnp.asarray(value)
    if _is_key(target):
        array = jax.random.wrap_key_data(array, impl=_key_impl(target))
    sharding = getattr(target, "sharding", None)
    return array if sharding is None else jax.device_put(array, sharding)


def _named_leaves(tree: Any) -> tuple[list[str], list[Any]]:
    """Leaves with a name each that is unique and says where it sits."""
    found = jax.tree_util.tree_leaves_with_path(tree)
    names = [
        f"{i:04d}-{jax.tree_util.keystr(path, simple=True, separator='.')}"
        for i, (path, _) in enumerate(found)
    ]
    return names, [leaf for _, leaf in found]


def _leaf_types(tree: Any) -> list[list[Any]]:
    """Path, shape and dtype of each leaf, as JSON holds them."""
    names, leaves = _named_leaves(jax.eval_shape(lambda: tree))
    return [
        [n, list(x.shape), str(x.dtype)] for n, x in zip(names, leaves, strict=True)
    ]


def _check_leaves(found: list[list[Any]], wanted: list[list[Any]]) -> None:
    for old, new in zip(found, wanted, strict=False):
        if old != new:
            raise _UnusableError(
                f"{old[0]} is {old[2]}{old[1]}, needed is {new[0]} {new[2]}{new[1]}"
            )
    if len(found) != len(wanted):
        raise _UnusableError(f"{len(found)} arrays, needed are {len(wanted)}")


def _digests(folder: Path) -> dict[str, str]:
    """SHA-256 of each file: orbax's own format lets damage pass.

    Raises:
        _UnusableError: something that orbax does not write, such as a link.
        OSError: a file cannot be read.
    """
    digests = {}
    for path in sorted(p for p in folder.rglob("*") if not p.is_dir()):
        if path.is_symlink() or not path.is_file():
            raise _UnusableError(f"{path.name} is no file")
        digests[path.relative_to(folder).as_posix()] = digest_of(path)
    return digests


def _sync(folder: Path) -> None:
    for path in folder.rglob("*"):
        if path.is_file():
            with path.open("rb") as file:
                os.fsync(file.fileno())
    _sync_folder(folder)


def _sync_folder(folder: Path) -> None:
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _named(folder: Path, step: int) -> Path:
    return folder / f"step_{step:012d}"


def _aside(folder: Path, step: int) -> Path:
    """Where a step lies while another of the same number takes its place."""
    return folder / f".old-{step:012d}"


def _folder_of(folder: Path, step: int) -> Path:
    """Where a step lies; aside, where a process was killed between two renames."""
    final, last = _named(folder, step), _aside(folder, step)
    return last if last.exists() and not final.exists() else final


def _remove_leftovers(folder: Path) -> None:
    """Removes what a killed process left; the run's lock says that it is gone."""
    for step in steps(folder):
        if (place := _folder_of(folder, step)) != _named(folder, step):
            place.rename(_named(folder, step))
    for pattern in (".writing-*", ".old-*"):
        for path in folder.glob(pattern):
            shutil.rmtree(path, ignore_errors=True)


def _reason(error: Exception) -> str:
    """The operating system's words where tensorstore passes them on."""
    text = str(error).strip() or type(error).__name__
    system = re.search(r"([^:]+) \[os_error_code", text)
    return system[1].strip() if system else text.splitlines()[0][:200]


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """orbax logs a failure three times over before it raises it."""
    logger = logging.getLogger("absl")
    level = logger.level
    logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        logger.setLevel(level)
