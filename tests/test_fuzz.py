"""Some hundreds of hostile and broken files; `benchmarks.fuzz` reads thousands."""

import pickle
from pathlib import Path
from typing import Any

import pytest

from benchmarks import fuzz_worker
from benchmarks.fuzz import fuzz
from benchmarks.fuzz_mutations import Evil
from benchmarks.fuzz_readers import READERS, Reader, harmless


@pytest.mark.timeout(600)
def test_every_reader_accepts_or_refuses() -> None:
    jobs = [(r.name, round(400 * r.share)) for r in READERS]
    found = fuzz(jobs, seed=1, limit=120)
    assert [text for r in found for text in r["failures"]] == []
    assert [r["cases"] for r in found] == [count for _, count in jobs]
    assert all(r["failed"] == 0 and r["refused"] > 0 for r in found[:-1])
    assert sum(r["accepted"] for r in found) > 20


@pytest.fixture(scope="module")
def watch() -> fuzz_worker.Watch:
    """One for all tests: an audit hook stays."""
    return fuzz_worker.Watch()


@pytest.mark.parametrize(
    ("act", "said"),
    [
        (lambda p: pickle.loads(pickle.dumps(Evil(p / "canary"))), "pickle.find_class"),
        (lambda p: (p.parent / "x").write_text(""), "open"),
        (lambda p: (p / "x").write_text(""), "open"),
        (lambda p: (p.parent / "y").mkdir(), "os.mkdir"),
        (lambda p: 1 / 0, "ZeroDivisionError"),
        (lambda p: (p / "results.json").write_text(""), ""),
        (lambda p: 0, ""),
    ],
)
def test_what_a_reader_must_not_do_is_seen(
    tmp_path: Path, watch: fuzz_worker.Watch, act: Any, said: str
) -> None:
    """The checks can fail: a reader that does wrong is reported."""
    outside = tmp_path / "outside"
    outside.mkdir()
    reader = Reader("bad", 1.0, lambda: [], act, writes=("results.json",))
    case = fuzz_worker.Case({"a": b""})
    outcome, text = fuzz_worker._outcome(
        reader, case, tmp_path / "case", outside, watch
    )
    text = text or "; ".join(watch.seen)
    assert said in text
    assert bool(text) == bool(said)
    assert outcome == ("failed" if "Zero" in said else "accepted")


def test_cases_are_the_same_for_the_same_seed(tmp_path: Path) -> None:
    reader = next(r for r in READERS if r.name == "mapping files")

    def some(seed: int) -> list[Any]:
        return list(fuzz_worker.cases(reader, 60, seed, tmp_path / "c", tmp_path))

    assert some(1) == some(1)
    assert some(1) != some(2)
    assert {kind for kind, _ in some(1)} == {"special", "drawn", "mutated"}


def test_harm_in_a_page_is_seen() -> None:
    harmless("<p>&lt;script&gt;</p><use href='#a'>")
    for text in ("<script>", "<p onclick='x'>", "<img src='x'>", "<use href='//x'>"):
        with pytest.raises(AssertionError):
            harmless(text)
