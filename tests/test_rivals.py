"""How rivals are scored, and that cells are run once."""

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks import rivals
from benchmarks._cells import Share, read_rows, run_cells
from benchmarks._page import shown
from benchmarks.gap_first import own, runs
from benchmarks.rigs import RIGS
from benchmarks.rival_cells import BUDGETS, Cell, method_of, score
from benchmarks.rivals_summary import SECTIONS, best_rival, verdict
from easi_jax.baselines import Identified
from easi_jax.errors import UserError
from easi_jax.io.logs.reader import read_logs, write_log
from easi_jax.model.distribution import covariance, gaussian
from easi_jax.model.parameters import Parameter, ParameterSpace

# Two whose product alone is seen, one by itself; a unit is a factor of 9.
SPACE = ParameterSpace(
    tuple(
        Parameter(n, (f"body.{n}.mass",), 1.0, (1 / 3, 3.0), (1e-3, 1e3)) for n in "abc"
    )
)
SEEN = np.array([[1.0, 1.0, 0.0], [0.0, 0.0, np.sqrt(2)]]) / np.sqrt(2)


def scored(off: list[float], std: float) -> dict:
    """Found beside the truth by log ratios ``off``, with ``std`` (log) everywhere."""
    width = SPACE.log_width
    information = 1e4 * (SEEN * width).T @ (SEEN * width)
    truth = np.full(3, 0.5)
    cov = np.diag((std / width) ** 2)
    return score(SPACE, information, truth + np.array(off) / width, cov, truth)


def test_errors_count_along_what_the_data_determine() -> None:
    got = scored([0.3, -0.3, 0.0], 0.01)
    assert got == {
        "error": pytest.approx(0.0, abs=1e-9),
        "bound": pytest.approx(0.01, rel=1e-6),
        "covered": True,
        "rank": 2,
    }
    got = scored([0.0, 0.0, 0.2], 0.01)
    assert got["error"] == pytest.approx(0.2 / np.sqrt(2))
    assert not got["covered"]
    # chi2 of 2 at 90 % is 4.6: 2.1 standard deviations are inside, 2.2 are not.
    assert scored([0.0, 0.0, 0.2], 0.2 / 2.1)["covered"]
    assert not scored([0.0, 0.0, 0.2], 0.2 / 2.2)["covered"]


def test_nothing_determined_is_said() -> None:
    nothing = score(SPACE, np.zeros((3, 3)), np.ones(3), np.eye(3), np.zeros(3))
    assert nothing == {"error": None, "bound": None, "covered": None, "rank": 0}


def test_simopt_runs_where_it_can() -> None:
    every = rivals.cells(rivals.Config(methods=("SimOpt", "EASI"), seeds=(0,)))
    simopt = {(c.robot, c.setting) for c in every if c.method == "SimOpt"}
    assert simopt == {("cartpole", s) for s in rivals.SETTINGS if s != "unpaired"}
    assert len(every) == 3 * 5 + 4 and len({c.key for c in every}) == len(every)
    with pytest.raises(UserError, match="did you mean"):
        rivals.cells(rivals.Config(settings=("pairde",)))


@dataclass(frozen=True)
class One:
    key: str


def test_a_cell_is_run_once_and_shared(tmp_path: Path) -> None:
    out, ran = tmp_path / "rows.jsonl", []

    def go(shard: str = "1/1", only: str = "") -> None:
        def solve(c: One) -> dict:
            ran.append(c.key)
            return {"value": len(ran)}

        share = Share(shard=shard, only=only, out=out)
        run_cells([One(k) for k in "abcd"], share, solve, lambda row: "done")

    go("2/2")
    assert ran == ["b", "d"]
    go(only="a")
    go()
    assert ran == ["b", "d", "a", "c"]
    assert [r["key"] for r in read_rows(out)] == ran
    assert json.loads(out.read_text().splitlines()[0])["value"] == 1
    with pytest.raises(UserError, match="--list"):
        go(only="e")
    with pytest.raises(UserError, match="2/4"):
        go("3/2")


def line(method: str, seed: int, error: float, setting: str = "paired") -> dict:
    return {
        "robot": "cartpole",
        "setting": setting,
        "method": method,
        "seed": seed,
        "error": error,
        "bound": 0.05,
        "covered": error < 0.1,
        "rank": 6,
        "start_error": 0.3,
        "seconds": 4.0,
        "simulated": 3_000_000,
        "budget": 3_000_000,
        "measured": 6000 if method == "SimOpt" else 0,
        "versions": {"commit": "0123456789"},
    }


def test_the_page_says_who_is_ahead(tmp_path: Path) -> None:
    rows = [line("EASI", s, 0.05 + 0.01 * s) for s in range(3)]
    rows += [line("CMA-ES", s, 0.12) | {"seconds": None} for s in range(3)]
    # Better, but of one seed only.
    rows += [line("NPE", 0, 0.01), line("SimOpt", 0, 0.2)]
    assert best_rival(rows, "paired") == ("CMA-ES", 0.12, pytest.approx(0.06))
    assert best_rival(rows, "clean") is None
    out = tmp_path / "rivals.jsonl"
    out.write_text("".join(json.dumps(r) + "\n" for r in rows))
    text = "\n".join(shown(SECTIONS, tmp_path))
    assert "| EASI | not run | 0.06 (0.05, 0.06, 0.07); in 3 of 3 | not run |" in text
    assert "| CMA-ES | not run | 0.12 (0.12, 0.12, 0.12); in 0 of 3 |" in text
    # Where there is nothing to be found it is not tried.
    assert "| EASI after train.gap |  |  |  |  | not run |" in text
    assert "where searches start" not in text
    late = [line(m, 0, e, "effect") for m, e in (("EASI", 0.9), ("NPE", 0.5))]
    late.append(line("EASI after train.gap", 0, 0.08, "effect"))
    out.write_text("".join(json.dumps(r) + "\n" for r in late))
    lines = "\n".join(shown(SECTIONS, tmp_path)).splitlines()
    told = next(x for x in lines if "- effect" in x)
    assert "**NPE ahead**" in told and "start is nearer (0.3)" in told
    assert told.endswith("; EASI after train.gap 0.08")
    assert "paired: EASI ahead, 0.06 against 0.12 of CMA-ES" in text
    assert "| SimOpt | 4 | 3.00 | 6,000 |" in text
    assert "| CMA-ES | not measured | 3.00 | none |" in text
    assert "beyond the budget" not in text
    assert "Not run: `python -m benchmarks.rivals --robots go2`." in text
    assert "**NPE ahead**: EASI 0.05 against 0.01" in verdict("NPE", 0.01, 0.05)
    assert "both exact" in verdict("NPE", 1e-5, 1e-4)
    rows[1]["simulated"] = 4_500_000
    out.write_text("".join(json.dumps(r) + "\n" for r in rows))
    text = "\n".join(shown(SECTIONS, tmp_path))
    assert "Beyond the budget of 3 million: EASI in 1 of 3 cells, up to 4.5." in text


def test_rivals_know_single_transitions_as_such() -> None:
    def of(method: str, setting: str) -> Any:
        return method_of(Cell("arm6", setting, method, 0, 40, 3_000_000), "")

    for method in ("CMA-ES", "random search", "mujoco.sysid", "NPE"):
        assert of(method, "paired").horizon == 25
        assert of(method, "unpaired").horizon == 1
        assert of(method, "paired").pieces is None
    assert {c.budget for c in rivals.cells(rivals.Config(robots=("go2",)))} == {
        BUDGETS["go2"]
    }


def test_a_result_is_told_in_the_coordinates_that_were_asked_for() -> None:
    """What was refitted starts about its new value, and effects come after it."""
    a, b, c = SPACE.parameters
    moved = replace(b, nominal=2.0, initial=(1.8, 2.2))
    wider = ParameterSpace((a, moved, c, replace(a, name="delay")))
    std = np.array([0.1, 0.05, 0.2, 0.3])
    mean = jnp.array([0.7, 0.5, 0.1, 0.9])
    result = Identified(gaussian(wider, mean, np.diag(std**2)), wider, 5)
    got = own(result, SPACE)
    assert got.space is SPACE and got.simulated == 5
    np.testing.assert_allclose(
        SPACE.to_si(got.distribution.mean), wider.to_si(mean)[:3], rtol=1e-5
    )
    in_logs = np.sqrt(np.diag(covariance(got.distribution))) * SPACE.log_width
    np.testing.assert_allclose(in_logs, std[:3] * wider.log_width[:3], rtol=1e-4)


def test_recordings_become_logs(tmp_path: Path) -> None:
    rig = RIGS["cartpole"]()
    theta = jnp.asarray(rig.simulator.space.nominal, jnp.float32)
    demos = jax.jit(lambda k: rig.record(rig.simulator, theta, k, 2, 1.0))(
        jax.random.key(0)
    )
    path = tmp_path / "log.csv"
    write_log(path, rig.simulator.mj_model, runs(rig.simulator, demos))
    read = read_logs(path, rig.simulator.mj_model).runs
    assert len(read) == 2
    for i, run in enumerate(read):
        steps = int(demos.weight[i].sum())
        assert len(run) == steps + 1
        np.testing.assert_allclose(run.qpos[:-1], demos.qpos[i, :steps], atol=1e-6)
        np.testing.assert_allclose(
            run.qvel[1:], demos.next_qvel[i, :steps, 0], atol=1e-5
        )
        np.testing.assert_allclose(run.ctrl[:-1], demos.ctrl[i, :steps, 0], atol=1e-6)
