"""Regions that cover what they say, and how the benchmark counts it."""

import json
from pathlib import Path

import numpy as np
import pytest

from benchmarks import coverage, coverage_summary
from benchmarks._page import shown
from easi_jax.estimation.identifiability import identifiability
from envs import make


@pytest.fixture(scope="module")
def known():
    """Five of Cartpole's parameters; what the data say of the last is next to nothing,
    and the first two are seen through their sum alone."""
    space = make("cartpole").space
    space = space.select(list(space.names[:5]))
    rng = np.random.default_rng(0)
    slope = rng.normal(size=(40, 5)) * np.array([30.0, 30.0, 10.0, 50.0, 1e-4])
    slope[:, 0] = slope[:, 1]
    scaled = slope.T @ slope
    return identifiability(space, scaled * np.outer(space.log_width, space.log_width))


def test_distances_are_chi_squared_where_all_is_right(known) -> None:
    assert known.rank == 3
    rng = np.random.default_rng(1)
    cov = known.covariance * np.outer(known.scale, known.scale)
    wide = cov + 4.0 * known.null @ known.null.T  # nothing is known of those
    root = np.linalg.svd(cov)
    root = root[0] * np.sqrt(root[1])
    found = [
        coverage.distances(
            root @ rng.normal(size=5) + known.null @ rng.normal(size=2), wide, known
        )
        for _ in range(2000)
    ]
    for name in ("distance", "bound"):
        mean = np.mean([f[name] for f in found])
        assert mean == pytest.approx(3.0, rel=0.1), "chi-squared of 3 degrees"


def test_half_the_spread_covers_less(known) -> None:
    cov = known.covariance * np.outer(known.scale, known.scale)
    off = np.linalg.svd(cov)[0][:, 0] * 0.01
    whole = coverage.distances(off, cov + known.null @ known.null.T, known)
    half = coverage.distances(off, cov / 4 + known.null @ known.null.T, known)
    assert half["distance"] == pytest.approx(4 * whole["distance"])
    assert half["bound"] == whole["bound"]


def test_the_page_counts_what_is_inside(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    lines = []
    for seed in range(200):
        row: dict = {"seed": seed, "rank": 4, "versions": {"commit": "0123456789"}}
        for way, size in zip(coverage.WAYS, (3.0, 0.2, 1.0), strict=True):
            square = float((rng.normal(size=4) ** 2).sum())
            row[way] = {"distance": size**2 * square, "bound": square}
        lines.append(json.dumps(row))
    (tmp_path / "coverage.jsonl").write_text("\n".join(lines) + "\n")
    text = "\n".join(shown(coverage_summary.SECTIONS, tmp_path))
    rows = {
        w: next(x for x in text.splitlines() if f"| {w} |" in x) for w in coverage.WAYS
    }
    assert rows["refined"].count("], met |") == 2
    middle, most = (x.strip() for x in rows["refined"].strip("|").split("|")[-2:])
    assert middle.endswith(", met")
    # A chi with four degrees of freedom over its root.
    assert float(most) == pytest.approx((9.49 / 4) ** 0.5, rel=0.1)
    assert rows["search"].count("100% [") == 2
    assert rows["search"].count("], **missed** |") == 2
    assert "missed" not in rows["search, own spread"]
    inside = coverage_summary.covered([json.loads(x) for x in lines], "refined", 0.5)
    assert inside.mean() == pytest.approx(0.5, abs=0.08)


def test_what_is_stated_of_the_unseen_is_counted(tmp_path: Path) -> None:
    """A limit that no data show, said to be known, is in no determined direction."""
    given = {"off": [0.1, -2.0, 0.5], "std": [1.0, 0.5, 0.01]}
    row: dict = {"seed": 0, "rank": 1, "versions": {"commit": "0123456789"}}
    row |= {w: {"distance": 1.0, "bound": 1.0} for w in coverage.WAYS}
    row[coverage.WAYS[-1]] |= given
    for seen, said in (
        ([False, False, True], "Of 2 parameters that"),
        ([True, False, False], "2 are outside"),
        ([False, True, True], "0 are outside"),
        ([True, True, False], "1 of them farther than 3 "),
    ):
        row["determined"] = seen
        (tmp_path / "coverage.jsonl").write_text(json.dumps(row) + "\n")
        assert said in "\n".join(shown(coverage_summary.SECTIONS, tmp_path))


def test_a_mean_that_is_off_is_told(tmp_path: Path) -> None:
    lines = []
    for seed, off in enumerate((0.3, 0.5, 0.4) * 100):
        row: dict = {"seed": seed, "rank": 1, "versions": {"commit": "0123456789"}}
        row |= {w: {"distance": 1.0, "bound": 1.0} for w in coverage.WAYS}
        row[coverage.WAYS[-1]] |= {"off": [off, -0.01, 9.0], "std": [1.0, 0.1, 1.0]}
        row["determined"] = [True, True, False]
        lines.append(json.dumps(row))
    (tmp_path / "coverage.jsonl").write_text("\n".join(lines) + "\n")
    page = "\n".join(shown(coverage_summary.SECTIONS, tmp_path))
    assert "Of 2 parameters" in page and "is 0.40 of its stated" in page
    assert "(by 300 targets, standard error 0.06); goal 0.2: **missed**" in page


@pytest.mark.slow
@pytest.mark.parametrize("seed", [14, 356])
def test_a_limit_that_no_piece_meets_is_not_stated_as_known(
    tmp_path: Path, seed: int
) -> None:
    """Noise dug dips for these targets' force limits, beside speed limits that many
    pieces meet: they were stated 55 and 43 % too low, within 1 %."""
    out, count = tmp_path / "coverage.jsonl", seed + 1
    coverage.run(coverage.Config(targets=count, shard=f"{count}/{count}", out=out))
    (row,) = (json.loads(x) for x in out.read_text().splitlines())
    assert row["seed"] == seed and row["rank"] == 7
    force, speed = row["refined"]["std"][-2:]
    assert speed < 0.01 < 0.3 < force


def test_nothing_run_is_said(tmp_path: Path) -> None:
    assert "Not run" in shown(coverage_summary.SECTIONS, tmp_path)[-1]


def test_late_targets_have_a_table_of_their_own(tmp_path: Path) -> None:
    """Regions that allow for what the model errs by, beside those that do not."""
    rng, lines = np.random.default_rng(0), []
    for seed in range(100):
        square = float((rng.normal(size=4) ** 2).sum())
        row: dict = {"seed": seed, "rank": 4, "late": 0.005}
        row |= {"versions": {"commit": "0123456789"}}
        row[coverage.WAYS[-1]] = {"distance": square, "bound": 100.0 * square}
        row["times_noise"] = 2.5 if seed % 20 == 0 else 1.3
        lines.append(json.dumps(row))
    (tmp_path / "coverage_late.jsonl").write_text("\n".join(lines) + "\n")
    page = "\n".join(shown(coverage_summary.SECTIONS, tmp_path))
    said = next(line for line in page.splitlines() if "| 5 ms" in line)
    late, count, *shares, ratio, none = [x.strip() for x in said.strip("|").split("|")]
    assert (late, count, none) == ("5 ms", "100", "5")
    shares = [x.split(" [")[0] for x in shares]
    plain, stated = (
        [float(x[:-1]) for x in shares[:2]],
        [float(x[:-1]) for x in shares[2:]],
    )
    assert max(plain) <= 2
    assert stated == pytest.approx([50, 90], abs=12)
    assert float(ratio) == pytest.approx(10, rel=0.2)
