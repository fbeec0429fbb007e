"""Every notebook runs at its smallest and finds what it says it finds."""

import importlib.util
import json
import math
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from scripts import notebooks
from tests.commands import refused

# Several programs are compiled in each; on a busy machine that takes its time.
LIMIT = 1500  # s
pytestmark = pytest.mark.timeout(LIMIT + 60)

# Runs a notebook as the plain Python that it is; prints the variables asked for, and
# the axis labels of all figures, as one line of JSON.
DRIVER = """
import json, runpy, sys
import matplotlib
matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
left = runpy.run_path(sys.argv[1])
figures = [[(a.get_xlabel(), a.get_ylabel()) for a in plt.figure(n).axes]
           for n in plt.get_fignums()]
told = {"figures": figures, **{name: left[name] for name in sys.argv[2:]}}
print(json.dumps(told, default=lambda x: np.asarray(x).tolist()))
"""
# Notebooks compile for longer than they simulate at this size.
QUICK = "--xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true"


def executed(name: str, folder: Path, *variables: str) -> dict[str, Any]:
    """The ``variables`` that a notebook ends with; it runs in ``folder``."""
    source = notebooks.SOURCES / f"{name}.py"
    done = subprocess.run(
        [sys.executable, "-c", DRIVER, str(source), *variables],
        cwd=folder,
        env={
            **os.environ,
            "EASI_NOTEBOOK_SIZE": "tiny",
            "PYTHONPATH": str(notebooks.ROOT),
            "XLA_FLAGS": QUICK,
        },
        capture_output=True,
        text=True,
        timeout=LIMIT,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    told = json.loads(done.stdout.splitlines()[-1])
    assert told["figures"], "a notebook without a picture"
    for axes in told["figures"]:
        assert all(x or y for x, y in axes)  # a color bar has one label
        assert sum(bool(x and y) for x, y in axes) >= max(1, len(axes) - 1)
    return told


def test_every_notebook_has_a_test() -> None:
    tested = {n.removeprefix("test_") for n in globals() if n.startswith("test_")}
    assert {p.stem for p in notebooks.SOURCES.glob("*.py")} <= tested


@pytest.mark.slow
def test_cartpole_to_transfer(tmp_path: Path) -> None:
    told = executed(
        "cartpole_to_transfer", tmp_path, "stiffness", "before", "after", "returns"
    )
    found, simulator = (told["stiffness"][k] for k in ("found", "machine"))
    assert told["stiffness"]["model"] == pytest.approx(4 * simulator)
    assert found == pytest.approx(simulator, rel=0.1)
    for before, after in zip(told["before"], told["after"], strict=True):
        assert after < 0.2 * before
    assert list(told["returns"]) == ["UDR", "EASI", "Oracle"]
    assert all(-10 < r <= 200 for (r,) in told["returns"].values())


@pytest.mark.slow
def test_your_own_robot(tmp_path: Path) -> None:
    wanted = ("mean", "std", "true", "nominal", "held", "result")
    told = executed("your_own_robot", tmp_path, *wanted)
    assert told["result"]["flags"] == ["determined"] * 4
    for found, std, true, given in zip(
        *(told[k] for k in ("mean", "std", "true", "nominal")), strict=True
    ):
        assert found == pytest.approx(true, rel=0.03)
        assert abs(found - true) < 0.1 * abs(given - true)
        assert 0 < std < 0.05 * true
    held = told["held"]
    for before, after, floor in zip(
        held["before"], held["after"]["0"], held["noise_floor"], strict=True
    ):
        assert after < 2 * floor < 0.05 * before


def test_gap_on_a_log(tmp_path: Path) -> None:
    told = executed("gap_on_a_log", tmp_path, "REAL", "HIDDEN", "told", "rms")
    assert not told["REAL"]
    (effect,) = told["told"]["effects"]
    assert (effect["effect"], effect["at"]) == ("coulomb_friction", "hinge")
    torque = effect["parameters"]["torque"]["value"]
    assert torque == pytest.approx(told["HIDDEN"], rel=0.1)
    gap = told["told"]["gap"]
    assert gap["after"] < 1.5 * gap["floor"] < 0.5 * gap["refit"]
    assert told["rms"]["repaired"] < 0.3 * told["rms"]["model as given"]


@pytest.mark.slow
def test_reproduce_a_table(tmp_path: Path) -> None:
    told = executed("reproduce_a_table", tmp_path, "table", "rows", "names", "ROWS")
    lines = (tmp_path / "results/reproduce_a_table/paper.jsonl").read_text()
    rows = [json.loads(line) for line in lines.splitlines()]
    assert rows == told["rows"] and [r["method"] for r in rows] == told["ROWS"]
    body = told["table"].splitlines()[2:]
    for row, line in zip(rows, body, strict=True):
        assert line.startswith(f"| {row['method']} | {row['return']:.1f} |")
    assert "116.8" in body[0] and "164.4" in body[1]
    off = dict(zip(told["names"], rows[1]["log_ratio"], strict=True))
    # Motion tells forces and masses but for a scale that they share.
    assert abs(off["cart_kp"] - off["cart_mass"]) < 0.25 * math.log(4)


def test_mistakes_end_with_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    said = refused(capsys, notebooks, "--only", "gap_on_log")
    assert 'did you mean "gap_on_a_log"?' in said
    assert "--limit" in refused(capsys, notebooks, "--limit", "0")


def missing() -> list[str]:
    needed = ("jupytext", "nbclient", "ipykernel")
    return [n for n in needed if importlib.util.find_spec(n) is None]


without_jupyter = pytest.mark.skipif(
    bool(missing()), reason=f"not installed: {', '.join(missing())}"
)


def convert(*args: object) -> None:
    """In a process of its own: what Jupyter warns of is not an error here."""
    subprocess.run(
        [sys.executable, "-m", "scripts.notebooks", *map(str, args)],
        cwd=notebooks.ROOT,
        timeout=LIMIT,
        check=True,
    )


@without_jupyter
def test_sources_become_notebooks(tmp_path: Path) -> None:
    convert("--out", tmp_path)
    for source in notebooks.SOURCES.glob("*.py"):
        cells = json.loads((tmp_path / f"{source.stem}.ipynb").read_text())["cells"]
        assert cells[0]["cell_type"] == "markdown"
        assert cells[0]["source"][0].startswith("# ")
        text = source.read_text()
        assert len(cells) == sum(x.startswith("# %%") for x in text.splitlines())


@pytest.mark.slow
@without_jupyter
@pytest.mark.parametrize("name", sorted(p.stem for p in notebooks.SOURCES.glob("*.py")))
def test_jupyter_runs_it(name: str, tmp_path: Path) -> None:
    convert("--only", name, "--execute", "--size", "tiny", "--out", tmp_path)
    cells = json.loads((tmp_path / f"{name}.ipynb").read_text())["cells"]
    code = [c for c in cells if c["cell_type"] == "code"]
    assert all(c["execution_count"] for c in code)
    shown = [out.get("data", {}) for c in code for out in c["outputs"]]
    assert any("image/png" in data for data in shown)
