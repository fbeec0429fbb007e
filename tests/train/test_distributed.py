"""The commands themselves as several processes: what one process gives."""

from pathlib import Path

import numpy as np
import pytest

from tests.commands import read
from tests.processes import Processes

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1800)]

LIMIT = 800  # s; two processes share two cores, and each compiles
SMALL = ("--env-steps", "2400", "--eval-episodes", "4", "--target", "cart_kp*0.5")
SEARCH = (
    # The least-squares finish drifts along the common scale of masses and forces, which
    # the data leave open, by what sums round.
    "--no-refine",
    *("--generations", "4", "--population", "16", "--trajectories", "8"),
    *("--set", "segments=16", "real_batch=64", "discriminator_updates=2"),
)
SAME = 1e-4  # relative; sums over devices round otherwise, and training goes on from it


def ran(count: int, *words: object) -> None:
    ended = Processes(count, *words, devices=2 // count).ended(LIMIT)
    assert [status for status, *_ in ended] == [0] * count, ended


def test_udr_and_easi(tmp_path: Path) -> None:
    results = []
    for count in (1, 2):
        root = tmp_path / str(count)
        first = ("train.udr", "--out", root / "udr", "--seeds", 0, 1, *SMALL)
        ran(count, *first, "--chunk", 12)
        second = ("train.easi", "--udr", root / "udr", "--out", root / "easi")
        ran(count, *second, *SEARCH, *SMALL[2:], "--chunk", 12, "--search-chunk", 2)
        results.append(
            [read(root / run / "results.json")["returns"] for run in ("udr", "easi")]
            + [read(root / "easi" / "distribution.json")["seeds"]]
        )
    for seed in ("0", "1"):
        one, two = (r[2][seed]["mean"] for r in results)
        np.testing.assert_allclose(two, one, rtol=SAME)
    for method in ("UDR", "EASI"):
        one, two = (r[method == "EASI"][method] for r in results)
        np.testing.assert_allclose(list(two.values()), list(one.values()), rtol=SAME)


def test_pipeline(tmp_path: Path) -> None:
    returns = []
    for count in (1, 2):
        out = tmp_path / str(count)
        ran(count, "train.pipeline", "--out", out, *SMALL, *SEARCH)
        returns.append(read(out / "results.json")["returns"])
    for method, one in returns[0].items():
        two = returns[1][method]
        np.testing.assert_allclose(list(two.values()), list(one.values()), rtol=SAME)
