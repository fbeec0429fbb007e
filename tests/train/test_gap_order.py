"""train.gap has its results on disk before anything optional begins."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from easi_jax.errors import UserError
from easi_jax.gap import law_curves, summary
from easi_jax.io.report import gap_report
from easi_jax.io.report.html import Picture, Report, Table
from easi_jax.io.runs.folder import RunFolder
from tests.commands import read
from tests.gap_results import result
from train import _extras, _gap_results, gap
from train._results import write_pages

PARTS = {
    "model.xml": (_gap_results, "_write_model"),
    "where the error sits": (summary, "error_places"),
    'the picture "the gap, step by step"': (gap_report, "steps_picture"),
    'the picture "the law that was found"': (law_curves, "law_curves"),
    'the picture "where and when"': (summary, "error_map"),
    'the picture "measured and predicted"': (summary, "telling_traces"),
    "what to record next": (_gap_results, "_record_next"),
    "the retraining": (_gap_results, "retrained"),
}
FIRST = ("gap.json", "effects.yaml", "report.html")


@pytest.fixture
def write(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Callable[[], tuple[Any, bool]]:
    """Writes a result whose optional parts all succeed, with nothing in them."""
    monkeypatch.setattr(_gap_results, "_result", lambda *_: result(where=None))
    for module, name in PARTS.values():
        if name != "steps_picture":
            empty = () if name in ("_write_model", "error_places") else None
            monkeypatch.setattr(module, name, lambda *_, e=empty: e)
    monkeypatch.setattr(_gap_results, "_record_next", lambda *_: ("play steps",))
    some = Picture("Measured and predicted", "<svg></svg>", "traces")
    monkeypatch.setattr(gap_report, "traces_picture", lambda _: some)
    config = dataclasses.replace(gap.Config(), out=tmp_path / "out", retrain="x")
    problem: Any = SimpleNamespace(
        model=SimpleNamespace(mj_model=None, path=None, name="m"),
        held=[None],
        notes=[],
    )
    nothing: Any = None

    def made() -> tuple[Any, bool]:
        with RunFolder.open(config.out, config, command="train.gap") as folder:
            return _gap_results.write_all(folder, config, problem, nothing, nothing)

    return made


@pytest.mark.parametrize("part", PARTS)
@pytest.mark.fault("an optional part fails")
def test_a_part_that_fails_becomes_a_note(
    part: str,
    write: Callable[[], tuple[Any, bool]],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    out, seen = tmp_path / "out", []

    def fails(*_: Any) -> None:
        seen.append(all((out / name).exists() for name in FIRST))
        assert read(out / "gap.json")["effects"], "complete, not a stub"
        raise ValueError("zero-size array\nto reduction")

    monkeypatch.setattr(*PARTS[part], fails)
    told, whole = write()
    assert seen == [True] and not whole
    (note,) = told.notes[-1:]
    assert note.startswith(f"{part} left out: ValueError: zero-size array to reduction")
    assert note in read(out / "gap.json")["notes"]
    page = (out / "report.html").read_text()
    assert "left out: ValueError: zero-size array to reduction" in page
    assert f"note: {part} left out" in capsys.readouterr().out
    trace = (out / _extras.FAILURES).read_text()
    assert trace.startswith(part) and "in fails" in trace
    # What did not fail is there all the same.
    if part != "what to record next":
        assert read(out / "gap.json")["record_next"] == ["play steps"]
    assert ("<h2>Measured and predicted" in page) == ("measured" not in part)


def test_where_nothing_fails_nothing_is_noted(
    write: Callable[[], tuple[Any, bool]], tmp_path: Path
) -> None:
    told, whole = write()
    assert whole and told.notes == result().notes
    assert read(tmp_path / "out" / "gap.json")["not_in_model_xml"] == []
    assert not (tmp_path / "out" / _extras.FAILURES).exists()


@pytest.mark.fault("an optional part fails")
def test_a_report_is_there_before_its_pictures(tmp_path: Path) -> None:
    """As train.easi writes it."""
    page = tmp_path / "out" / "report.html"

    def fails() -> str:
        assert "<h2>Errors" in page.read_text()
        raise ZeroDivisionError("no such scale")

    svg = '<svg width="1" height="1"></svg>'
    report = Report(
        "Pendulum",
        ["It errs less."],
        tables=[Table("Errors", ["joint"], [("swing",)])],
        pictures=[
            Picture("Errors in bars", fails, "bars", file="errors"),
            Picture("By generation", lambda: svg, "lines", file="parameters"),
        ],
        notes=["a note"],
    )
    with RunFolder.open(tmp_path / "out", {}) as folder:
        write_pages(folder, report)
    text = page.read_text()
    assert "ZeroDivisionError: no such scale" in text and "a note" in text
    assert "<h2>By generation" in text and "<h2>Errors in bars" not in text
    figures = sorted(p.name for p in (tmp_path / "out" / "figures").iterdir())
    assert figures == ["parameters.svg"]


def test_a_mistake_of_the_user_has_no_traceback(tmp_path: Path) -> None:
    def refused() -> None:
        raise UserError("no such robot")

    with RunFolder.open(tmp_path / "out", {}) as folder:
        extras = _extras.Extras(folder)
        assert extras.attempt("the retraining", refused, None) is None
    assert extras.notes == ["the retraining left out: no such robot"]
    assert not (tmp_path / "out" / _extras.FAILURES).exists()


def test_an_interrupt_is_no_failure(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stopped() -> None:
        raise KeyboardInterrupt

    def turned() -> None:
        raise RuntimeError("cancelled")

    with RunFolder.open(tmp_path / "out", {}) as folder:
        extras = _extras.Extras(folder)
        with pytest.raises(KeyboardInterrupt):
            extras.attempt("pictures", stopped, None)
        monkeypatch.setattr("train._interrupt._asked", True)
        with pytest.raises(KeyboardInterrupt):
            extras.attempt("pictures", turned, None)
    assert extras.notes == []
