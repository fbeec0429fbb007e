"""What all commands share: arguments, errors, progress and tables.

Imports no jax, so that ``--help`` is quick; a command's ``run`` imports what it needs.
"""

import contextlib
import errno
import io
import os
import re
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from pathlib import Path
from typing import Any, NoReturn, Protocol, TypeVar

from train import _interrupt
from train._options import EngineOptions, OwnEffectsOptions

_Config = TypeVar("_Config")

LOG_SECONDS = 10.0
_LOOK = 0.2  # s, between two looks at what compiles
_SHORT = 5.0  # s; of what compiles faster nothing is said
_LONG = 60.0  # s; beyond, it is said what compiles no physics
_HINT = "; --engine mujoco compiles none"
_NUMBER = re.compile(r"[-+]?\d|nan|-?inf|$")
_PLACE = re.compile(r",? at (?:DOF|ACTUATOR) \d+|\s*Time = .*", re.DOTALL)
USER_ERROR = 2
_LONGEST = 2000  # characters of a message
INTERRUPTED = 130
_PARTED = (
    "error: another process of this run has ended, so this one ends too; start all "
    "again with --resume, and they go on from the last checkpoint"
)
# What a user can mend: rights, names, links in circles, full or read-only disks.
_OF_SYSTEM = {
    *(errno.EACCES, errno.EPERM, errno.ENAMETOOLONG, errno.ELOOP, errno.EROFS),
    *(errno.ENOSPC, errno.EDQUOT),
}
# What gloo, NCCL and jax's coordination service say of a lost process.
_GONE = ("Gloo", "gloo", "NCCL", "Connection", "UNAVAILABLE", "DEADLINE", "ABORTED")


class Progress(Protocol):
    """A bar or, where nobody watches, a log."""

    def advance(self, n: int = 1, **fields: float | int | str) -> None:
        """``n`` steps are done; ``fields`` are the numbers worth watching.

        Raises:
            KeyboardInterrupt: where the command was told to stop.
        """
        ...

    def compile(self, work: Callable[[], Any], seconds: float | None) -> Any:
        """What ``work`` returns, whose first part is to compile.

        Args:
            work: runs beside, so that an interrupt need not wait for it.
            seconds: that its physics take to compile, about; where they are few, or
                None, it is as any other step.

        Raises:
            KeyboardInterrupt: where the command was told to stop.
        """
        ...


def main(
    config_class: type[_Config],
    run: Callable[[_Config], None],
    *,
    name: str,
    args: Sequence[str] | None = None,
) -> None:
    """Parses the arguments, calls ``run`` and turns its failures into exit statuses.

    Args:
        config_class: frozen dataclass; its docstring is the command's description and
            the docstring under each field the option's help.
        run: does the work; raises ``UserError`` for what a user can mend.
        name: such as ``train.easi``.
        args: arguments in place of ``sys.argv``, for tests.

    Raises:
        SystemExit: 2 for a mistake in arguments, files or values, 130 when
            interrupted.
    """
    import tyro

    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # names of files may be any bytes
            stream.reconfigure(errors="backslashreplace")
    try:
        words = sys.argv[1:] if args is None else args
        asked: Any = config_class
        if {"-h", "--help"} & {*words}:
            from train._help import with_help

            asked = with_help(config_class)
        config = tyro.cli(asked, prog=f"python -m {name}", args=args)
    except BrokenPipeError:
        _unheard()
    try:
        from easi_jax.devices import distributed
        from easi_jax.errors import UserError

        try:
            with _interrupt.remembered(), _about(config), _warnings_told():
                if getattr(config, "distributed", False):
                    distributed.start()
                run(config)
                distributed.stop()
        except UserError as error:
            said = f"error: {_line(str(error))}" if _heard() else ""
            _stop(said, USER_ERROR, args is None)
    except BrokenPipeError:
        _unheard()
    except BaseException as error:
        # An event loop or a callback turns the interrupt into an error of its own.
        told = isinstance(error, KeyboardInterrupt) or _interrupt.asked()
        if not told and _parted(error):
            _stop(_PARTED, 1, args is None)
        if not told and (reason := _outside(error)):
            _stop(f"error: {_line(reason)}", USER_ERROR, args is None)
        if not told or isinstance(error, SystemExit):
            _leave_others(error)
            raise
        out = getattr(config, "out", None)
        left = _left(out, hasattr(config, "resume"))
        _stop(f"interrupted{left}", INTERRUPTED, args is None)


def _outside(error: BaseException) -> str:
    """What the system, or MuJoCo, says of a file or a model; empty for what may be this
    program's own fault."""
    from easi_jax.io.files import os_reason

    if isinstance(error, OSError) and error.errno in _OF_SYSTEM:
        return ": ".join(str(x) for x in (error.filename, os_reason(error)) if x)
    engine = sys.modules.get("mujoco")
    if engine and isinstance(error, engine.FatalError):
        return f"MuJoCo cannot simulate this model: {error}"
    return ""


@contextlib.contextmanager
def _about(config: Any) -> Iterator[None]:
    """What holds while a command runs: the user's effects, the engine."""
    with contextlib.ExitStack() as all_of:
        if isinstance(config, OwnEffectsOptions):
            from easi_jax.io.models.own_effects_file import read_all
            from easi_jax.model.own_effects import registered

            all_of.enter_context(registered(read_all(config.effects_from)))
        all_of.enter_context(_engine(config))
        yield


@contextlib.contextmanager
def _engine(config: Any) -> Iterator[None]:
    """Simulators made inside are of the engine that a command, or a benchmark, was told
    to take."""
    if not isinstance(config, EngineOptions):
        yield
        return
    from easi_jax.errors import EngineError, UserError
    from easi_jax.io.runs.folder import engine_of
    from easi_jax.simulation import engine

    out = getattr(config, "out", None)
    kept = engine_of(out) if out and getattr(config, "resume", False) else None
    try:
        with engine.using(kept[0] if kept else config.engine, say):
            yield
    except EngineError as error:
        left = _left(out, hasattr(config, "resume"))
        raise UserError(f"{error}{left}") from error


@contextlib.contextmanager
def _warnings_told() -> Iterator[None]:
    """Says at the end, each once, what MuJoCo warned of, which it writes on standard
    error and to a file in the working folder otherwise. Its threads may warn, too."""
    from easi_jax.model.mujoco_warnings import warnings_to

    warned = Counter[str]()

    def count(text: str) -> None:
        warned[_PLACE.sub("", text)] += 1

    with warnings_to(count):
        yield
    for text, times in warned.items():
        say(f"note: MuJoCo warned, {times} times in all: {text}")


def _unheard() -> NoReturn:
    """The reader of our output has gone, as in ``... | head``."""
    # Else the interpreter's end writes what is left, and complains.
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    raise SystemExit(1) from None


def show_table(
    title: str, columns: Sequence[str], rows: Iterable[Sequence[object]]
) -> None:
    """Prints a result table; columns of numbers are right-aligned."""
    from rich.table import Table
    from rich.text import Text

    if not _heard():
        return
    table = Table()
    cells = [[_text(cell) for cell in row] for row in rows]
    for index, column in enumerate(columns):
        numeric = all(_NUMBER.match(row[index]) for row in cells)
        table.add_column(Text(column), justify="right" if numeric else "left")
    for row in cells:
        table.add_row(*map(Text, row))
    console = _console(sys.stdout)
    console.print(Text(title, "bold"))
    console.print(table)


def say(message: str) -> None:
    """Prints one line of result, as it is."""
    if not _heard():
        return
    _console(sys.stdout).print(message, markup=False, highlight=False, soft_wrap=True)


@contextlib.contextmanager
def progress(
    name: str, total: int, done: int = 0, patience: float = 0.0
) -> Iterator[Progress]:
    """Shows how far ``name`` is, its rate and the time left, on standard error.

    Args:
        name: of the stage, such as ``search``.
        total: steps in all.
        done: steps that an earlier process did.
        patience: nothing is shown of what takes no longer [s].
    """
    meter = Meter(total, done)
    if not _heard():
        yield _Silent()
    elif sys.stderr.isatty():
        with _bar(name, meter, patience) as shown:
            yield shown
    else:
        yield _Log(name, meter, patience)


def compiled(name: str, work: Callable[[], Any], seconds: float | None) -> Any:
    """As `Progress.compile`, of a stage that consists of nothing else."""
    if seconds is None or seconds < _SHORT:
        return work()
    with progress(name, 1) as shown:
        result = shown.compile(work, seconds)
        shown.advance()
    return result


def _beside(work: Callable[[], Any], look: Callable[[], None]) -> Any:
    """What ``work`` returns; ``look`` is called now and then until it does."""
    pool = ThreadPoolExecutor(1)
    found = pool.submit(work)
    pool.shutdown(wait=False)
    while not found.done():
        _interrupt.check()
        look()
        wait([found], _LOOK)
    return found.result()


class Meter:
    """Rate and time left; the first chunk, which compiles, is left out of both.

    Attributes:
        expected: seconds that its physics take to compile, about; None: not known.
    """

    def __init__(
        self, total: int, done: int = 0, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self.total = total
        self.done = done
        self._clock = clock
        self._begin = clock()
        self._first: tuple[int, float] | None = None
        self._last = self._begin
        self.expected: float | None = None

    def advance(self, n: int) -> None:
        """``n`` further steps are done."""
        self.done += n
        self._last = self._clock()
        if self._first is None:
            self._first = (self.done, self._last)

    @property
    def elapsed(self) -> float:
        """Seconds since the start."""
        return self._clock() - self._begin

    @property
    def rate(self) -> float | None:
        """Steps per second since the first chunk; None before there are any."""
        if self._first is None or self._last <= self._first[1]:
            return None
        return (self.done - self._first[0]) / (self._last - self._first[1])

    @property
    def left(self) -> float | None:
        """Seconds left at this rate; None while it is unknown."""
        if not self.rate:
            return None
        since = self._clock() - self._last
        return max(0.0, (self.total - self.done) / self.rate - since)

    def summary(self) -> str:
        """Such as ``20/50  3.1/s  0:10 left``."""
        count = f"{self.done}/{self.total}"
        if self.done >= self.total:
            return f"{count}  {duration(self.elapsed)} in all"
        if self._first is None and self.expected is not None:
            hint = _HINT if self.expected > _LONG else ""
            took, of = duration(self.elapsed), duration(self.expected)
            return f"{count}  compiling, {took} (physics: about {of}{hint})"
        if self.rate is None or self.left is None:
            return f"{count}  {duration(self.elapsed)} so far"
        return f"{count}  {self.rate:.3g}/s  {duration(self.left)} left"


def duration(seconds: float) -> str:
    """``0:07``, ``12:30`` or ``1:02:03``."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"


class _Silent:
    def advance(self, n: int = 1, **fields: float | int | str) -> None:
        _interrupt.check()

    def compile(self, work: Callable[[], Any], seconds: float | None) -> Any:
        return work()


class _Log:
    def __init__(self, name: str, meter: Meter, patience: float) -> None:
        self._name = name
        self._meter = meter
        self._next = patience
        self._shown = patience == 0

    def advance(self, n: int = 1, **fields: float | int | str) -> None:
        _interrupt.check()
        self._meter.advance(n)
        self._show(fields, self._meter.done >= self._meter.total and self._shown)

    def compile(self, work: Callable[[], Any], seconds: float | None) -> Any:
        if seconds is None or seconds < _SHORT or _many():
            return work()
        self._meter.expected = seconds
        return _beside(work, lambda: self._show({}, False))

    def _show(self, fields: dict[str, float | int | str], ended: bool) -> None:
        if ended or self._meter.elapsed >= self._next:
            self._shown = True
            self._next = self._meter.elapsed + LOG_SECONDS
            line = f"{self._name}  {self._meter.summary()}  {_fields(fields)}"
            print(line.rstrip(), file=sys.stderr, flush=True)


@contextlib.contextmanager
def _bar(name: str, meter: Meter, patience: float) -> Iterator[Progress]:
    from rich.progress import BarColumn, ProgressColumn, Task, TextColumn
    from rich.progress import Progress as Bar
    from rich.table import Column
    from rich.text import Text

    class Summary(ProgressColumn):
        def render(self, task: Task) -> Text:
            return Text(meter.summary())

    line = Column(no_wrap=True)
    rest = Column(no_wrap=True, overflow="ellipsis", ratio=1)
    bar = Bar(
        TextColumn("{task.description}", markup=False, table_column=line),
        BarColumn(bar_width=24),
        Summary(table_column=line),
        TextColumn(
            "{task.fields[values]}", style="dim", markup=False, table_column=rest
        ),
        console=_console(sys.stderr),
        refresh_per_second=4,
        expand=True,
        transient=patience > 0,
    )
    task = bar.add_task(name, total=meter.total, completed=meter.done, values="")

    class Shown:
        def advance(self, n: int = 1, **fields: float | int | str) -> None:
            _interrupt.check()
            meter.advance(n)
            bar.update(task, advance=n, values=_fields(fields))
            if meter.elapsed >= patience:
                bar.start()

        def compile(self, work: Callable[[], Any], seconds: float | None) -> Any:
            if seconds is None or seconds < _SHORT or _many():
                return work()
            meter.expected = seconds
            return _beside(work, lambda: None)  # the bar moves by itself

    try:
        if patience == 0:
            bar.start()
        yield Shown()
    finally:
        bar.stop()


def _console(stream: Any) -> Any:
    from rich.console import Console

    # A pipe or a file has no width; 80 columns would fold the tables.
    return Console(file=stream, width=None if stream.isatty() else 120)


def _fields(fields: dict[str, float | int | str]) -> str:
    return "  ".join(f"{k.replace('_', ' ')} {_text(v)}" for k, v in fields.items())


def _text(value: object) -> str:
    if hasattr(value, "item"):
        value = value.item()  # type: ignore[attr-defined]
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _line(text: str) -> str:
    """One line that a terminal shows as it is, whatever a file put into it."""
    plain = " ".join(text.split())
    if len(plain) > _LONGEST:
        plain = f"{plain[: _LONGEST // 2]} ... {plain[-_LONGEST // 2 :]}"
    return "".join(c if c.isprintable() else repr(c)[1:-1] for c in plain)


def _left(out: Path | str | None, resumable: bool) -> str:
    """What a command leaves that ends before its time."""
    if out is None:
        return ""
    if Path(out).suffix == ".jsonl":
        return f"; {out} keeps the lines of all that was done"
    if not resumable:
        return f"; nothing was written to {out}, start the command again"
    kept = any(Path(out).glob("checkpoints/**/step_*"))
    if kept:
        return (
            f"; {out} keeps all up to the last checkpoint: the same command with "
            "--resume goes on from there"
        )
    return f" before the first checkpoint; nothing to resume in {out}"


def _heard() -> bool:
    """Whether this process speaks: of several in one run, the first does."""
    from easi_jax.devices import distributed

    return distributed.leader()


def _many() -> bool:
    """Whether several processes share this run: they begin programs in one order."""
    from easi_jax.devices import distributed

    return distributed.count() > 1


def _parted(error: BaseException) -> bool:
    """Whether a program failed because another process of this run is gone."""
    from easi_jax.devices import distributed

    if distributed.count() == 1:
        return False
    import jax

    return isinstance(error, jax.errors.JaxRuntimeError) and any(
        word in str(error) for word in _GONE
    )


def _leave_others(error: BaseException) -> None:
    """Ends a process of several at once: at its end Python would wait for them, and
    they for it."""
    from easi_jax.devices import distributed

    if distributed.count() > 1 and not isinstance(error, SystemExit):
        import traceback

        traceback.print_exception(error)
        os._exit(1)


def _stop(message: str, status: int, leave: bool) -> NoReturn:
    if message:
        print(message, file=sys.stderr)
    if not leave:
        raise SystemExit(status)
    # Not by the interpreter's end: it waits for what still compiles, and XLA's threads
    # that are at work then end the process with messages of their own.
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError):
            stream.flush()
    os._exit(status)
