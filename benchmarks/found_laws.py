"""Whether ``train.gap`` finds laws that no table has, and none where there is none.

    python -m benchmarks.found_laws

Machines of one to three joints (``tests/gap_cases/laws.py``: separate physics) hide
one of eight laws, sized 3 to 30 times the sensor noise; controls of equal size hide
what the table has. Each is a line of ``results/found_laws.jsonl``.

A law is right where the force that was found (laws, effects of the table and refitted
parameters together: `|v|` beside a damping is a damping that differs by direction) goes
with the hidden one by a correlation of 0.9 over the held-out motion.
"""

import dataclasses
import json
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks._cells import Share, run_cells
from benchmarks._common import RESULTS
from train._command import main

LIKE = 0.9  # correlation of a force that is right
CLOSED = 1.25  # floors
GOALS = {
    "law right": 0.7,
    "half of the gap": 0.8,
    "false laws at most": 0.05,
    "time": 0.5,
}


@dataclasses.dataclass(frozen=True)
class Cell:
    """A case."""

    seed: int
    control: bool

    @property
    def key(self) -> str:
        """All of it, for files."""
        return f"{'control' if self.control else 'law'} {self.seed}"


@dataclasses.dataclass(frozen=True)
class Config(Share):
    """Runs train.gap on machines with a hidden law, and on controls without any."""

    cases: int = 40
    """Of either kind, from seed 100 on."""
    out: Path = dataclasses.field(default=RESULTS / "found_laws.jsonl", kw_only=True)
    """Where a line for each case is added."""


FIRST = 100


def run(config: Config) -> None:
    """Runs the cases one after the other, laws and controls in turn."""
    seeds = range(FIRST, FIRST + config.cases)
    cells = [Cell(seed, control) for seed in seeds for control in (False, True)]
    run_cells(cells, config, solve, told)


def told(row: dict[str, Any]) -> str:
    """A line on a case."""
    laws = "; ".join(row["laws"]) or "no law"
    return f"{row['law']} on {row['machine']}: {laws} ({row['seconds']:.0f} s)"


def solve(cell: Cell) -> dict[str, Any]:
    """Draws a case, and compares what is said of it with what is hidden."""
    from tests.gap_cases.laws import draw_law
    from train import gap

    with tempfile.TemporaryDirectory() as folder:
        case, out = Path(folder) / "case", Path(folder) / "gap"
        answer = draw_law(cell.seed, case, cell.control)
        begin = time.perf_counter()
        runs = sorted(case.glob("run*.csv"))
        words = ["--model", case / "model.xml", "--data", *runs, "--out", out]
        main(gap.Config, gap.run, name="train.gap", args=[str(w) for w in words])
        seconds = time.perf_counter() - begin
        gap_json = json.loads((out / "gap.json").read_text())
        (held,) = gap_json["held_out"][:1]
        match = None if cell.control else correlation(case, out, held)
    effects = gap_json["effects"]
    return {
        **answer,
        "laws": [e["law"] for e in effects if e["effect"] == "found_law"],
        "named": [f"{e['effect']}@{e['at']}" for e in effects],
        "confidence": [e["confidence"] for e in effects],
        "verdict": gap_json["verdict"],
        "gap": gap_json["gap"],
        "correlation": match,
        "seconds": seconds,
        "law_seconds": gap_json["law_seconds"],
    }


def correlation(case: Path, out: Path, held: str) -> float:
    """Of the hidden and the found force over a held-out run, joints together, each by
    the size of the hidden one."""
    import mujoco
    import yaml

    from easi_jax import read_log
    from easi_jax.data.law_states import known_rows, term_path
    from easi_jax.model.law_terms import Term
    from easi_jax.model.own_laws import names_alone

    m = mujoco.MjModel.from_xml_path(str(case / "model.xml"))
    (run,) = read_log(case / f"{held}.csv", m).runs
    law = names_alone(m)
    known, dofs = known_rows(law, run), law.dofs
    found = np.zeros((len(run), m.nv))
    told = yaml.safe_load((out / "effects.yaml").read_text())
    for e in told["effects"]:
        if e["kind"] != "joint":
            continue
        c, at = e["columns"], e["at"]
        q, v = known.qpos[at], known.qvel[at]
        if e["effect"] == "found_law":
            force = np.zeros(len(run))
            for k, text in enumerate(e["terms"], 1):
                force += c[f"c{k}"] * term_path(Term(text), known, run.dt)
            for joint, share in e["acts"].items():
                found[:, dofs[joint]] += share * force
            continue
        found[:, dofs[at]] += c.get("constant", 0.0) - c.get("damping", 0.0) * v
        found[:, dofs[at]] -= c.get("coulomb", 0.0) * np.sign(v)
        found[:, dofs[at]] += c.get("spring", 0.0) - c.get("stiffness", 0.0) * q
    for r in told["refitted"]:
        _, joint, what = r["address"].split(".")
        if what == "damping":
            was = float(m.dof_damping[dofs[joint]])
            found[:, dofs[joint]] -= (r["value"] - was) * known.qvel[joint]
    hidden = np.load(case / "hidden.npz")[held][: len(run)]
    size = hidden.std(0)
    seen = size > 1e-9
    a, b = (x[:, seen] / size[seen] for x in (found[: len(hidden)], hidden))
    if not np.ptp(a) > 0:
        return 0.0
    return float(np.corrcoef(a.ravel(), b.ravel())[0, 1])


if __name__ == "__main__":
    main(Config, run, name="benchmarks.found_laws")
