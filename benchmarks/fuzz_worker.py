"""Runs cases of ``benchmarks.fuzz`` one by one, and watches what they do."""

import contextlib
import os
import random
import shutil
import sys
import time
import traceback
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from benchmarks.fuzz_mutations import Case, mutation
from benchmarks.fuzz_readers import READERS, SECRET, Reader

DRAWN = 0.25  # of the cases of a reader that hypothesis can draw for
_FORBIDDEN = (
    *("pickle.find_class", "os.system", "os.exec", "os.posix_spawn", "os.fork"),
    *("subprocess.Popen", "socket.connect", "ctypes.dlopen"),
)
_CHANGES = ("os.mkdir", "os.rename", "os.remove", "os.rmdir", "os.symlink", "os.link")
_WRITES = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND


class Watch:
    """What Python does while a case is read, by its audit events.

    Attributes:
        folder: that may be written to; None while nobody watches.
        seen: forbidden events.
    """

    def __init__(self) -> None:
        self.folder: Path | None = None
        self.names: tuple[str, ...] = ()
        self.seen: list[str] = []
        sys.addaudithook(self._event)

    @contextlib.contextmanager
    def on(self, folder: Path, names: tuple[str, ...]) -> Iterator[None]:
        """Watches; in ``folder`` files of these names may be written, with a dot
        before and more behind, as temporary ones have."""
        self.seen, self.folder, self.names = [], folder, names
        try:
            yield
        finally:
            self.folder = None

    def _event(self, event: str, args: tuple[Any, ...]) -> None:
        if self.folder is None:
            return
        if event in _FORBIDDEN:
            self.seen.append(f"{event} {args[:2]}"[:200])
        elif event in _CHANGES or (event == "open" and int(args[2] or 0) & _WRITES):
            self._written(event, args[0])

    def _written(self, event: str, path: Any) -> None:
        if isinstance(path, int) or self.folder is None:
            return
        real = Path(os.path.realpath(os.fsdecode(path)))
        names = tuple(name.lstrip(".") for name in self.names)
        if real.parent == self.folder and real.name.lstrip(".").startswith(names):
            return
        if event == "os.mkdir" and real.is_dir():
            return  # as mkdir(exist_ok=True) asks
        self.seen.append(f"{event} {real}"[:200])


def cases(reader: Reader, count: int, seed: int, canary: Path, outside: Path) -> Any:
    """``count`` cases of a reader: special ones (half of them at most), drawn ones, and
    mutations of good files.

    The same for the same arguments.
    """
    done = 0
    good, rng = reader.good(), random.Random(f"{seed} {reader.name}")
    special = reader.special(canary, outside) if reader.special else []
    for case in rng.sample(special, min(len(special), count // 2)):
        done += 1
        yield "special", case
    if reader.drawn is not None:
        wanted = round(DRAWN * count) if reader.name != "names in reports" else count
        for case in drawn(reader.drawn(), min(wanted, count - done), seed):
            done += 1
            yield "drawn", case
    while done < count:
        done += 1
        yield "mutated", mutation(rng, rng.choice(good))


def drawn(strategy: Any, count: int, seed: int) -> list[Case]:
    """``count`` examples of a hypothesis strategy, or as many as there are."""
    import hypothesis

    found: list[Case] = []
    if count < 1:
        return found

    @hypothesis.seed(seed)
    @hypothesis.settings(
        max_examples=count,
        database=None,
        deadline=None,
        suppress_health_check=list(hypothesis.HealthCheck),  # pyright: ignore
        phases=[hypothesis.Phase.generate],
    )
    @hypothesis.given(strategy)
    def collect(case: Case) -> None:
        found.append(case)

    collect()
    return found[:count]


Job = tuple[str, int, int]  # reader, cases in all, cases that are done


def work(connection: Any, jobs: Sequence[Job], seed: int, place: str) -> None:
    """Reads the cases of each job after those that are done; tells how each ended.

    Sends ``(reader, index, kind, outcome, text, seconds)`` with outcome ``accepted``,
    ``refused`` or ``failed``, seconds of the processor; ``(reader, None, ...)`` when
    there are no more; None at the end.
    """
    watch = Watch()
    base = Path(place).resolve()
    outside, here = base / "outside", base / "here"
    for folder in (outside, here):
        folder.mkdir(exist_ok=True)
    (outside / SECRET).write_text("nobody reads this")
    os.chdir(here)
    try:
        for name, count, skip in jobs:
            reader = next(r for r in READERS if r.name == name)
            for told in _told(reader, count, seed, skip, base, watch):
                connection.send((name, *told))
            connection.send((name, None, "", "", "", 0.0))
        connection.send(None)
    except BrokenPipeError:
        return  # who listened has gone


def _told(
    reader: Reader, count: int, seed: int, skip: int, base: Path, watch: Watch
) -> Iterator[tuple[int, str, str, str, float]]:
    outside, here, canary = base / "outside", base / "here", base / "canary"
    for files in reader.good():
        # Imports and compiles what it needs, unwatched.
        outcome, text = _outcome(reader, Case(files), base / "warm", outside, None)
        if outcome != "accepted":
            raise RuntimeError(f"{reader.name}: a good file: {text}")
    for i, (kind, case) in enumerate(cases(reader, count, seed, canary, outside)):
        if i < skip:
            continue
        begin, known = time.process_time(), _listing(outside, here)
        outcome, text = _outcome(reader, case, base / f"case{i}", outside, watch)
        if canary.exists():
            outcome, text = "failed", "something was unpickled"
            canary.rmdir()
        elif watch.seen:
            outcome, text = "failed", "; ".join(watch.seen[:3])
        elif _listing(outside, here) != known:
            outcome, text = "failed", "a file outside of the folder changed"
        yield i, kind, outcome, text, time.process_time() - begin


def _listing(*folders: Path) -> list[tuple[str, int, int]]:
    found = []
    for folder in folders:
        for path in sorted(folder.rglob("*")):
            s = path.lstat()
            found.append((str(path), s.st_size, s.st_mtime_ns))
    return found


def _outcome(
    reader: Reader, case: Case, folder: Path, outside: Path, watch: Watch | None
) -> tuple[str, str]:
    from easi_jax.errors import UserError

    folder.mkdir()
    try:
        case.write(folder, outside)
        if reader.prepare is not None:
            reader.prepare(folder)
        watched = contextlib.nullcontext()
        if watch is not None:
            watched = watch.on(folder, reader.writes)
        with watched:
            reader.read(folder)
    except UserError as error:
        return ("refused", "") if str(error).strip() else ("failed", "no message")
    except Exception:
        return "failed", traceback.format_exc(limit=-6)
    finally:
        shutil.rmtree(folder)
    return "accepted", ""
