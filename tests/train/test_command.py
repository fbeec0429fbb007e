import asyncio
import contextlib
import dataclasses
import errno
import importlib
import inspect
import io
import os
import re
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Literal

import mujoco
import numpy as np
import pytest

from easi_jax.errors import UserError
from train import _command
from train._command import Meter, duration, main, progress, show_table
from train._options import EngineOptions

ROOT = Path(__file__).parents[2]


@dataclasses.dataclass(frozen=True)
class Config:
    """Does a thing worth doing."""

    out: Path
    """Folder that holds the run."""
    preset: Literal["paper", "default"] = "default"
    """Recipe of the search."""
    population: int = 300
    """Individuals per generation."""
    resume: bool = False
    """Go on."""


def _call(run, *args):
    main(Config, run, name="train.thing", args=args)


def _nothing(config):
    pass


def test_arguments_become_the_config():
    seen = []
    _call(seen.append, "--out", "a", "--preset", "paper", "--population", "3")
    assert seen == [Config(Path("a"), "paper", 3)]


def test_help_shows_docstrings_and_defaults(capsys):
    with pytest.raises(SystemExit) as exit_:
        _call(_nothing, "--help")
    assert exit_.value.code == 0
    text = capsys.readouterr().out
    assert "python -m train.thing" in text
    assert "Does a thing worth doing." in text
    assert "Individuals per generation. (default: 300)" in text
    assert "{paper,default}" in text


@pytest.mark.parametrize(
    ("args", "said"),
    [
        ([], "--out PATH"),
        (["--out", "a", "--presett", "paper"], "--preset {paper,default}"),
        (["--out", "a", "--preset", "papr"], "'paper'"),
        (["--out", "a", "--population", "many"], "Error parsing --population"),
    ],
)
@pytest.mark.fault("wrong options and files")
def test_wrong_arguments_exit_with_2_and_help(args, said, capsys):
    with pytest.raises(SystemExit) as exit_:
        _call(_nothing, *args)
    assert exit_.value.code == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert said in err


def test_user_error_is_one_line_and_2(capsys):
    def run(config):
        raise UserError('unknown robot "antt";\n  did you mean "ant"?')

    with pytest.raises(SystemExit) as exit_:
        _call(run, "--out", "a")
    assert exit_.value.code == 2
    assert capsys.readouterr() == (
        "",
        'error: unknown robot "antt"; did you mean "ant"?\n',
    )


def test_what_the_system_says_is_one_line_and_2(tmp_path, capsys):
    place = tmp_path / ("x" * 300)
    with pytest.raises(SystemExit) as exit_:
        _call(lambda config: place.read_text(), "--out", "a")
    assert exit_.value.code == 2
    said = capsys.readouterr().err.strip()
    assert said == f"error: {place}: {os.strerror(errno.ENAMETOOLONG)}"
    with pytest.raises(FileNotFoundError):  # may be our own fault
        _call(lambda config: (tmp_path / "none").read_text(), "--out", "a")


def test_what_mujoco_gives_up_on_is_one_line_and_2(capsys):
    def run(config):
        raise mujoco.FatalError("mj_stackAlloc: out of memory (increase <size memory>)")

    with pytest.raises(SystemExit) as exit_:
        _call(run, "--out", "a")
    assert exit_.value.code == 2
    said = capsys.readouterr().err
    assert "error: MuJoCo cannot simulate this model: mj_stackAlloc" in said


def test_names_of_files_may_be_any_bytes():
    code = (
        "from pathlib import Path; from dataclasses import dataclass\n"
        "from train._command import main, say\n"
        "@dataclass\nclass Config:\n    'Says.'\n    out: Path = Path('a')\n"
        "main(Config, lambda c: say('note: mess_\\udcfc.csv'), name='train.thing')\n"
    )
    found = subprocess.run(
        [sys.executable, "-c", code],
        cwd=ROOT,
        env=os.environ | {"PYTHONUTF8": "1"},
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    )
    assert found.stdout.strip() == r"note: mess_\udcfc.csv"


def test_programming_errors_are_not_dressed_up():
    def run(config):
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        _call(run, "--out", "a")


@pytest.mark.parametrize(
    ("kept", "said"), [(True, "--resume"), (False, "before the first checkpoint")]
)
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.fault("interrupted (Ctrl-C)")
def test_interrupt_says_what_is_kept(tmp_path, capsys, kept, said, number):
    if kept:
        (tmp_path / "checkpoints" / "search" / "step_000000000003").mkdir(parents=True)

    def run(config):
        os.kill(os.getpid(), number)

    before = signal.getsignal(signal.SIGTERM)
    with pytest.raises(SystemExit) as exit_:
        _call(run, "--out", str(tmp_path))
    assert exit_.value.code == 130
    err = capsys.readouterr().err
    assert said in err
    assert str(tmp_path) in err
    assert signal.getsignal(signal.SIGTERM) is before


@pytest.mark.parametrize(
    ("name", "said"),
    [("", "nothing was written"), ("rows.jsonl", "keeps the lines of all that")],
)
@pytest.mark.fault("interrupted (Ctrl-C)")
def test_interrupt_of_what_cannot_be_resumed(tmp_path, capsys, name, said):
    @dataclasses.dataclass(frozen=True)
    class Short:
        """Takes seconds."""

        out: Path = tmp_path / name
        """Folder, or a file that lines are added to."""

    with pytest.raises(SystemExit) as exit_:
        main(Short, lambda _: os.kill(os.getpid(), signal.SIGINT), name="t", args=())
    assert exit_.value.code == 130
    err = capsys.readouterr().err
    assert said in err and "resume" not in err


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.fault("interrupted (Ctrl-C)")
def test_an_interrupt_that_python_drops_is_not_lost(tmp_path, capsys, number):
    """A finalizer, jax's callback of the garbage collector: exceptions end there."""

    class Finalized:
        def __del__(self):
            os.kill(os.getpid(), number)

    passed = []

    def run(config):
        with progress("search", total=4) as shown:
            shown.advance()
            Finalized()
            passed.append("the finalizer")
            shown.advance()
            passed.append("the next chunk")

    with pytest.raises(SystemExit) as exit_:
        _call(run, "--out", str(tmp_path))
    assert exit_.value.code == 130
    assert passed == ["the finalizer"]
    assert "interrupted" in capsys.readouterr().err.splitlines()[-1]


@pytest.mark.fault("interrupted (Ctrl-C)")
def test_a_cancelled_event_loop_is_an_interrupt(tmp_path, capsys):
    def run(config):
        with contextlib.suppress(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)
        raise asyncio.CancelledError

    with pytest.raises(SystemExit) as exit_:
        _call(run, "--out", str(tmp_path))
    assert exit_.value.code == 130
    assert "Traceback" not in capsys.readouterr().err
    with pytest.raises(asyncio.CancelledError):
        _call(lambda c: asyncio.run(_cancelled()), "--out", str(tmp_path))


async def _cancelled():
    raise asyncio.CancelledError


def test_an_ignored_signal_stays_ignored(tmp_path):
    """As under ``nohup``, or in the background of a shell without job control."""
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        _call(lambda c: os.kill(os.getpid(), signal.SIGINT), "--out", str(tmp_path))
    finally:
        signal.signal(signal.SIGINT, before)


def test_progress_without_terminal_is_plain_lines(capsys, monkeypatch):
    monkeypatch.setattr(_command, "LOG_SECONDS", 0.0)
    with progress("search", total=4) as shown:
        shown.advance(2, fitness=np.float32(1.23456).item(), non_finite=3)
        shown.advance(2)
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 2
    assert lines[0].startswith("search  2/4  0:00 so far  fitness 1.235  non finite 3")
    assert lines[1].startswith("search  4/4  0:00 in all")


def test_progress_log_is_rationed(capsys):
    with progress("search", total=100) as shown:
        for _ in range(100):
            shown.advance(1)
    lines = capsys.readouterr().err.splitlines()
    assert [line.split()[1] for line in lines] == ["1/100", "100/100"]


def test_a_short_stage_shows_no_progress(capsys):
    for patience, lines in ((60.0, 0), (0.0, 2)):
        with progress("fitting effects", total=3, patience=patience) as shown:
            for _ in range(3):
                shown.advance()
        assert len(capsys.readouterr().err.splitlines()) == lines


def test_a_stage_that_outlasts_patience_shows_progress(capsys):
    with progress("fitting effects", total=3, patience=0.01) as shown:
        shown.advance()
        time.sleep(0.02)
        shown.advance()
        shown.advance()
    lines = capsys.readouterr().err.splitlines()
    assert [line.split()[2] for line in lines] == ["2/3", "3/3"]


def test_a_bar_is_shown_once_patience_is_over(monkeypatch):
    told = _Terminal()
    monkeypatch.setattr(sys, "stderr", told)
    with progress("trying effects", total=2, patience=60.0) as shown:
        shown.advance(2)
    assert "trying effects" not in told.getvalue()
    with progress("trying effects", total=2) as shown:
        shown.advance(2)
    assert "trying effects" in told.getvalue()


class _Terminal(io.StringIO):
    def isatty(self):
        return True


def test_rate_leaves_out_the_chunk_that_compiles():
    now = [0.0]
    meter = Meter(total=40, done=10, clock=lambda: now[0])
    now[0] = 60.0  # compilation and the first chunk
    meter.advance(10)
    assert meter.rate is None
    assert meter.summary() == "20/40  1:00 so far"
    now[0] = 65.0
    meter.advance(10)
    assert meter.rate == pytest.approx(2.0)
    now[0] = 66.0  # time left falls between chunks as well
    assert meter.left == pytest.approx(4.0)
    assert meter.summary() == "30/40  2/s  0:04 left"


def test_compiling_is_told_with_the_time_that_it_takes():
    now = [0.0]
    meter = Meter(total=50, clock=lambda: now[0])
    meter.expected = 40.0
    now[0] = 12.0
    assert meter.summary() == "0/50  compiling, 0:12 (physics: about 0:40)"
    meter.expected = 90.0
    assert meter.summary() == (
        "0/50  compiling, 0:12 (physics: about 1:30; --engine mujoco compiles none)"
    )
    meter.advance(10)
    assert meter.summary() == "10/50  0:12 so far"


def test_what_compiles_is_told_before_and_while_it_does(capsys, monkeypatch):
    monkeypatch.setattr(_command, "_LOOK", 0.01)
    monkeypatch.setattr(_command, "LOG_SECONDS", 0.05)
    work = lambda: time.sleep(0.2) or "done"  # noqa: E731
    assert _command.compiled("physics", work, 7.0) == "done"
    first, *between, last = capsys.readouterr().err.splitlines()
    assert first == "physics  0/1  compiling, 0:00 (physics: about 0:07)"
    assert between and all("compiling" in line for line in between)
    assert last == "physics  1/1  0:00 in all"
    assert _command.compiled("physics", work, None) == "done"
    assert _command.compiled("physics", work, 1.0) == "done"
    assert not capsys.readouterr().err


def test_a_failure_to_compile_is_not_lost():
    def work():
        raise UserError("no such thing")

    with pytest.raises(UserError, match="no such thing"):
        _command.compiled("physics", work, 60.0)


def test_ctrl_c_does_not_wait_for_the_compiler(capsys):
    ended, begin = threading.Event(), time.monotonic()

    def work():
        signal.raise_signal(signal.SIGINT)
        ended.wait(timeout=20)

    def run(config):
        with progress("search", total=4) as shown:
            shown.compile(work, 60.0)

    with pytest.raises(SystemExit) as exit_:
        _call(run, "--out", "a")
    ended.set()
    assert exit_.value.code == 130 and time.monotonic() - begin < 10
    assert "interrupted" in capsys.readouterr().err
    _call(_nothing, "--out", "a")  # the next command has not been told to stop


def test_duration():
    assert [duration(x) for x in (7.4, 750, 3723)] == ["0:07", "12:30", "1:02:03"]


def test_table_shows_every_cell_unfolded_in_a_pipe(capsys):
    show_table(
        "Returns [WD]", ("method", "return"), [("UDR [a]", 1.0), ("EASI" * 20, 2.5)]
    )
    out = capsys.readouterr().out
    assert "Returns [WD]" in out
    assert "UDR [a]" in out
    assert "EASI" * 20 in out
    assert "2.5 │" in out


def test_commands_import_without_jax():
    names = sorted(f"train.{p.stem}" for p in (ROOT / "train").glob("[a-z]*.py"))
    assert "train.info" in names
    code = (
        f"import sys\nimport {', '.join(names)}\n"
        "print([m for m in ('jax', 'mujoco', 'easi_jax') if m in sys.modules])"
    )
    found = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        timeout=60,
        cwd=ROOT,
        check=True,
    )
    assert found.stdout.strip() == "[]"


def test_what_a_file_put_into_a_message_is_shown_as_text():
    line = _command._line("bad\n name \x1b[31mred\x07 µ \ud800 " + "x" * 10_000)
    assert line.startswith("bad name \\x1b[31mred\\x07 µ \\ud800 xxx")
    assert len(line) < 2100


def test_a_reader_that_leaves_early_is_no_error():
    """``--help | head``: the text is longer than what the pipe's reader takes."""
    command = f"{sys.executable} -m train.easi --help | head -n 1"
    done = subprocess.run(
        command, shell=True, capture_output=True, text=True, timeout=120, cwd=ROOT
    )
    assert done.stdout.startswith("usage:") and done.stderr == ""


@pytest.mark.parametrize("name", ["auto", "mjx", "mujoco"])
def test_what_takes_engine_options_runs_on_that_engine(name: str) -> None:
    """Benchmarks, too, that call commands as functions."""
    from easi_jax.simulation import engine

    seen: list[str] = []

    def run(_: EngineOptions) -> None:
        seen.append(engine._stack[-1].name)

    main(EngineOptions, run, name="t", args=("--engine", name))
    assert seen == [name]


@pytest.mark.parametrize("name", ["easi", "gap", "import_logs", "export"])
def test_help_of_an_option_is_a_paragraph(
    name: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """tyro breaks it where the source does, and tells defaults that are none."""
    monkeypatch.setenv("COLUMNS", "80")
    module = importlib.import_module(f"train.{name}")
    with pytest.raises(SystemExit) as stop:
        main(module.Config, module.run, name=f"train.{name}", args=["--help"])
    assert stop.value.code == 0
    said = " ".join(capsys.readouterr().out.replace("│", " ").split())
    for field in dataclasses.fields(module.Config):
        assert field.name in said.replace("-", "_") or "_folder" in field.name
    assert "default: None" not in said and "(default: )" not in said
    texts: dict[str, str] = {}  # what stands under a field, that of a subclass first
    for cls in module.Config.__mro__[:-1]:
        below = re.findall(
            r'^    (\w+): [^\n]+\n    """(.+?)"""', inspect.getsource(cls), re.S | re.M
        )
        texts = {**dict(below), **texts}
    assert {*texts} == {f.name for f in dataclasses.fields(module.Config)}
    for text in texts.values():
        assert " ".join(text.split()) in said
