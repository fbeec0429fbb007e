"""What is read of a run of make in a fresh clone."""

from pathlib import Path

import pytest

from benchmarks import fresh_clone
from easi_jax.errors import UserError
from easi_jax.io.runs import versions


@pytest.mark.parametrize(
    ("last", "counts"),
    [
        ("===== 2 failed, 7 passed, 1 skipped in 61.25s (0:01:01) =====", (7, 2, 1)),
        ("1 failed, 5 passed, 2 errors in 3.00s", (5, 3, 0)),
        ("2205 passed, 10 skipped in 825.00s (0:13:45)", (2205, 0, 10)),
    ],
)
def test_what_pytest_says_last(last: str, counts: tuple[int, ...]) -> None:
    said = f"3 passed in 1.00s\n0 errors, 0 warnings\n{last}\n"
    found = fresh_clone.summary(said)
    assert tuple(found[k] for k in ("passed", "failed", "skipped")) == counts
    assert f" in {found['pytest_s']:.2f}s" in last


def test_a_demo_has_no_tests() -> None:
    assert fresh_clone.summary("report: results/demo/easi/report.html\n") == {
        **{"passed": "", "failed": "", "skipped": "", "pytest_s": None}
    }


def test_what_is_not_committed_is_not_cloned(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(versions, "versions", lambda: {"commit": "1234567+"})
    with pytest.raises(UserError, match="commit first"):
        fresh_clone.run(fresh_clone.Config(out=tmp_path / "runs.jsonl"))
    with pytest.raises(UserError, match="write test or demo"):
        fresh_clone.run(fresh_clone.Config(target="all"))
