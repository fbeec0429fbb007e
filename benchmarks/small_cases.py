"""Small inputs of other people's robots, of which the model is the very truth.

    python -m benchmarks.small_cases --data ../shared/cases

A drive with an activation, an encoder that wraps inside its joint's range, a pendulum
without actuators, play in a joint that nobody reads. ``train.gap`` should end with
``no_gap``; where a folder has ``parameters.yaml``, ``train.easi --data`` should state
intervals that hold the model's own values. Minutes; results go to ``small_cases.json``.
"""

import dataclasses
import json
import tempfile
import time
from pathlib import Path
from typing import Any

from benchmarks._page import met, table
from train._command import main, say

CASES: dict[str, tuple[str, ...]] = {
    "filter_act": ("log.csv",),
    "wrap_limited": ("log.csv",),
    "passive": ("run1.csv", "run2.csv"),
    "backlash_joint": ("log.csv",),
    "backlash_joint, all read": ("full.csv",),
}
_WIDE = 1.645  # standard deviations of a 90 % interval


@dataclasses.dataclass(frozen=True)
class Config:
    """Asks both commands about models that are right."""

    data: Path = Path("../shared/cases")
    """Folder of the cases."""


def run(config: Config) -> None:
    """Runs the cases and writes the JSON."""
    from benchmarks._common import write_result
    from easi_jax.errors import UserError

    rows = []
    for name, logs in CASES.items():
        folder = config.data / name.split(",")[0]
        if not (folder / "model.xml").is_file():
            raise UserError(f"{folder} does not hold model.xml: give --data")
        rows.append({"case": name, **_gap(folder, logs), **_values(folder, logs)})
        say(f"{name}: {rows[-1]['verdict']}, {rows[-1]['ratio']:.2f} floors")
    command = "python -m benchmarks.small_cases --data DATA"
    path = write_result("small_cases", command, {}, rows=rows)
    say(f"written: {path}")


def _gap(folder: Path, logs: tuple[str, ...]) -> dict[str, Any]:
    from train import gap

    with tempfile.TemporaryDirectory() as out:
        began = time.perf_counter()
        gap.run(
            gap.Config(
                model=str(folder / "model.xml"),
                data=tuple(folder / log for log in logs),
                out=Path(out) / "gap",
            )
        )
        seconds = time.perf_counter() - began
        told = json.loads((Path(out) / "gap" / "gap.json").read_text())
    return {
        "verdict": told["verdict"],
        "named": [f"{e['effect']}@{e['at']}" for e in told["effects"]],
        "ratio": told["gap"]["after"] / told["gap"]["floor"],
        "gap_s": seconds,
    }


def _values(folder: Path, logs: tuple[str, ...]) -> dict[str, Any]:
    """What ``train.easi --data`` states, where the case asks for parameters: each one's
    value and deviation beside the model's own."""
    from train import easi

    file = folder / "parameters.yaml"
    if not file.is_file():
        return {}
    with tempfile.TemporaryDirectory() as out:
        began = time.perf_counter()
        easi.run(
            easi.Config(
                model=folder / "model.xml",
                parameters=file,
                data=tuple(folder / log for log in logs),
                out=Path(out) / "easi",
            )
        )
        seconds = time.perf_counter() - began
        told = json.loads((Path(out) / "easi" / "distribution.json").read_text())
    found = told["seeds"]["0"]
    values = {
        p["name"]: {"truth": p["nominal"], "mean": mean, "std": std}
        for p, mean, std in zip(
            told["parameters"], found["mean"], found["std"], strict=True
        )
    }
    return {"values": values, "no_region": found["no_region"], "easi_s": seconds}


def paragraphs(r: Any) -> list[str]:
    """What came out of each case."""
    rows = r["rows"]
    columns: dict[str, Any] = {"case": "{case}", "verdict": "{verdict}"}
    columns["named"] = lambda x: ", ".join(x["named"]) or "nothing"
    columns |= {"gap in floors": "{ratio:.2f}", "train.gap [s]": "{gap_s:.0f}"}
    right = all(row["verdict"] == "no_gap" for row in rows)
    said = [
        f"`{r['command']}`: models that are right, in ways that others' robots are. "
        f"All are to end with `no_gap`: {met(right)}.",
        table(rows, columns),
    ]
    for row in (row for row in rows if "values" in row):
        inside = [
            abs(v["mean"] - v["truth"]) <= _WIDE * v["std"]
            for v in row["values"].values()
        ]
        told = ", ".join(
            f"{name} {v['mean']:.4g} ± {v['std']:.2g} ({v['truth']:g})"
            for name, v in row["values"].items()
        )
        said.append(
            f"`train.easi --data` of {row['case']}, value, standard deviation (truth): "
            f"{told}; {row['easi_s']:.0f} s. Inside 90 %: {sum(inside)} of "
            f"{len(inside)}."
        )
    return said


if __name__ == "__main__":
    main(Config, run, name="benchmarks.small_cases")
