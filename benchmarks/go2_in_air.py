"""A real Go2 in a stand: what ``train.parameters`` proposes, identified by
``train.easi --data``, on all of the recording and on interleaved blocks of it.

    python -m benchmarks.go2_in_air --data ../shared/data/go2_in_air

The whole recording is fitted from a first start, with a compilation cache of its own;
parts of it are held out. Then blocks of 2 s are dealt out in turns to two halves,
each fitted while the other is held out: what is said of a parameter should be the same.
Results go to ``go2_in_air.json``.
"""

import dataclasses
import json
import math
import tempfile
from pathlib import Path
from typing import Any

from train._command import main, say, show_table

GOAL, BLOCK = 180.0, 2.0  # s
_LIMIT = 1800  # s
_FEWEST = 0.5  # s, of the last block
_PICTURES = {
    "go2_in_air_errors.svg": "Held-out errors of a real Go2's joints",
    "go2_in_air_values.svg": "Parameters of a real Go2 from two halves of a recording",
}
_HEAD = ("parameter", "even blocks", "odd blocks", "apart", "in deviations")


@dataclasses.dataclass(frozen=True)
class Config:
    """Identifies a real Go2 in a stand, three times."""

    data: Path = Path("../shared/data/go2_in_air")
    """Folder with model.xml and chirp.csv."""


def run(config: Config) -> None:
    """Proposes parameters, fits three times, writes the JSON."""
    from benchmarks._common import write_result
    from easi_jax.errors import UserError

    model, log = config.data / "model.xml", config.data / "chirp.csv"
    if not (model.is_file() and log.is_file()):
        raise UserError(f"{config.data} does not hold model.xml and chirp.csv")
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        parameters = _proposed(folder, model, log)
        halves = blocks(log, folder)
        whole = _fitted(folder / "whole", model, parameters, [log], [])
        say(f"all of the recording: {whole['seconds']:.0f} s")
        each = [
            _fitted(folder / name, model, parameters, halves[k], halves[1 - k])
            for k, name in enumerate(("first", "second"))
        ]
    path = write_result(
        "go2_in_air",
        "python -m benchmarks.go2_in_air --data DATA",
        {"block": BLOCK},
        whole=whole,
        halves=each,
        goal_s=GOAL,
    )
    show_table("Values of the blocks", _HEAD, _beside(*each))
    say(f"written: {path}")


def _proposed(folder: Path, model: Path, log: Path) -> Path:
    """The parameter file of ``train.parameters``."""
    from benchmarks._common import first_start

    out = folder / "parameters.yaml"
    given = "--model", str(model.resolve()), "--data", str(log.resolve())
    words = ["-m", "train.parameters", *given, "--out", str(out)]
    first_start(words, folder / "proposal", _LIMIT)
    return out


def blocks(log: Path, folder: Path) -> tuple[list[Path], list[Path]]:
    """Logs of every other block of a ``log`` (CSV), and of the others."""
    head, *lines = log.read_text().splitlines()
    times = [float(line.split(",", 1)[0]) for line in lines]
    dealt: dict[int, list[str]] = {}
    for t, line in zip(times, lines, strict=True):
        dealt.setdefault(int((t - times[0]) / BLOCK), []).append(line)
    halves: tuple[list[Path], list[Path]] = ([], [])
    step = times[1] - times[0]
    for k, rows in dealt.items():
        if len(rows) * step < _FEWEST:
            continue
        path = folder / f"block{k:02d}.csv"
        path.write_text("\n".join([head, *rows]) + "\n")
        halves[k % 2].append(path)
    return halves


def _fitted(
    out: Path, model: Path, parameters: Path, data: list[Path], held: list[Path]
) -> dict[str, Any]:
    """What one identification says, and how long it took from a first start."""
    from benchmarks._common import first_start

    words = ["-m", "train.easi", "--model", str(model.resolve())]
    words += ["--parameters", str(parameters), "--data"]
    words += [str(path.resolve()) for path in data]
    if held:
        words += ["--held-out", *(str(path.resolve()) for path in held)]
    cache = out.with_name(f"cache_{out.name}")
    seconds, _ = first_start([*words, "--out", str(out)], cache, _LIMIT)
    found = json.loads((out / "distribution.json").read_text())
    seed = found["seeds"]["0"]
    names = [p["name"] for p in found["parameters"]]
    columns = (seed["mean"], seed["std"], seed["flags"])
    return {
        "seconds": round(seconds, 1),
        "parameters": {
            name: {"mean": mean, "std": std, "flag": flag}
            for name, mean, std, flag in zip(names, *columns, strict=True)
        },
        "no_region": seed.get("no_region", ""),
        "held_out": found["held_out"],
    }


def _beside(even: dict[str, Any], odd: dict[str, Any]) -> list[tuple[str, ...]]:
    """Each parameter's value in both fits, and how far these are apart in what both
    state together."""
    rows = []
    for name, one in even["parameters"].items():
        other = odd["parameters"][name]
        off = other["mean"] - one["mean"]
        apart = abs(off) / max(math.hypot(one["std"], other["std"]), 1e-300)
        values = (f"{x['mean']:.3g} ± {x['std']:.2g}" for x in (one, other))
        rows.append(
            (name, *values, f"{100 * off / one['mean']:+.0f} %", f"{apart:.2f}")
        )
    return rows


def paragraphs(r: dict[str, Any]) -> list[str]:
    """For the page of results."""
    from benchmarks._common import markdown_table
    from benchmarks._page import met

    fits = [("all", r["whole"])]
    fits += [
        (f"{name} blocks", x)
        for name, x in zip(("even", "odd"), r["halves"], strict=True)
    ]
    rows = []
    for name, fit in fits:
        held = fit["held_out"]
        after = next(iter(held["after"].values()))
        share = [b / a for a, b in zip(held["before"], after, strict=True)]
        middle = sorted(share)[len(share) // 2]
        region = "none" if fit["no_region"] else "stated"
        rows.append((name, f"{fit['seconds']:.0f}", f"{middle:.2f}", region))
    error = "held-out error over that of the model as given, median joint"
    head = "fitted to", "seconds, first start", error, "region"
    rest = _beside(*r["halves"])
    most = max(float(row[-1]) for row in rest)
    return [
        f"`{r['command']}`: a real Go2 in a stand, with all that `train.parameters` "
        f"proposes. Goal {r['goal_s']:.0f} s: "
        f"{met(r['whole']['seconds'] <= r['goal_s'])}.",
        markdown_table(head, rows),
        "Fitted to even and to odd blocks, with the deviations of `distribution.json`; "
        f"at most {most:.2f} of them apart:",
        markdown_table(_HEAD, rest),
        *(f"![{what}]({name})" for name, what in _PICTURES.items()),
    ]


def figures(folder: Path) -> dict[str, str]:
    """Pictures by file name: held-out errors of each joint, and values of the two
    halves of the recording."""
    from benchmarks._page import load
    from benchmarks.go2_in_air_figures import errors_by_joint, values_of_halves

    r = load(folder, "go2_in_air.json")
    if r is None:
        return {}
    held = r["whole"]["held_out"]
    after = next(iter(held["after"].values()))
    errors = {"as given": held["before"], "identified": after}
    halves = [half["parameters"] for half in r["halves"]]
    return {
        "go2_in_air_errors.svg": errors_by_joint(
            held["channels"], errors, held["noise_floor"]
        ),
        "go2_in_air_values.svg": values_of_halves(*halves),
    }


if __name__ == "__main__":
    main(Config, run, name="benchmarks.go2_in_air")
