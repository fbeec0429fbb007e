"""A small set of generated cases, graded as `benchmarks.gap` grades the large one."""

from pathlib import Path

import pytest

from benchmarks.gap import solved
from tests.gap_cases import draw_case

pytestmark = pytest.mark.timeout(900)

USUAL = (("single", 1),)
MORE = (
    *(("single", 2), ("single", 3), ("none", 1), ("none", 2)),
    # In the second pair the mass looks like a center of mass until the spring is in.
    *(("pair", 1), ("pair", 2001), ("wrong_own", 1), ("outside", 1)),
)


@pytest.mark.parametrize(
    ("kind", "seed"),
    [*USUAL, *(pytest.param(*c, marks=pytest.mark.slow) for c in MORE)],
)
def test_the_answer_is_right(kind: str, seed: int, tmp_path: Path) -> None:
    draw_case(seed, kind, tmp_path / "case", cheap=True)
    row = solved(tmp_path / "case", tmp_path / "gap")
    assert row["right"], row
    if kind in ("single", "pair"):
        assert row["gap"]["after"] < 1.25 * row["gap"]["floor"], row
    else:
        assert row["verdict"] in row["verdicts"], row
