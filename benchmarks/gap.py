"""Whether the gap workflow names hidden effects: many cases, made by separate physics.

    python -m benchmarks.gap --kind single --seeds 0 60 --cheap

Cases come from ``tests/gap_cases``; the workflow sees ``model.xml`` and the runs, the
grader below alone sees the answer. One line a case is added to ``gap_curve.jsonl``;
cases that are there already are left out, so a run that was stopped goes on.
"""

import dataclasses
import itertools
import json
import tempfile
import time
from pathlib import Path
from typing import Any

from benchmarks._cells import add_row, read_rows
from benchmarks.gap_score import keys_of
from train._command import main, say
from train._options import EngineOptions

RESULTS = Path(__file__).parent / "results"
LARGE = ("arm3", "leg", "arm3", "leg", "arm6")  # in turns
_EVIDENCE = ("removal_cost", "removal_sure", "rival_odds", "explains")
_ASKED = "kind", "cheap", "wide", "coarse", "effect", "mechanism"
_HALF = 0.5  # of the gap, that an effect in another law takes; of the contract


@dataclasses.dataclass(frozen=True)
class Config(EngineOptions):
    """Runs train.gap on generated cases and grades its names."""

    kind: str = "single"
    """single, pair, none, wrong_own, outside (an effect that no table has), mixed (one
    of the table beside one outside), several (three to five) or real (two to four
    beside one or two outside)."""
    seeds: tuple[int, int] = (0, 10)
    """First seed, and the one after the last."""
    cheap: bool = False
    """Mechanisms of one or two joints; without it those of three and six, and a leg."""
    wide: bool = False
    """Machines of one to twelve joints, 50 to 1000 Hz, slow and fast, with velocities,
    also late or filtered ones, drives with an activation, gaps to thousands of floors
    and laws that no table has."""
    coarse: bool = False
    """Models whose own physics step is seen in the gap; give --out gap_coarse.jsonl."""
    effect: str = ""
    """The hidden effect, drawn where not given; give --out gap_contacts.jsonl or so."""
    mechanism: str = ""
    """The machine, drawn where not given."""
    out: Path = RESULTS / "gap_curve.jsonl"
    """Where a line for each case is added."""


def run(config: Config) -> None:
    """Makes, runs and grades each case."""
    from benchmarks._common import command_of
    from easi_jax.io.runs.versions import versions
    from tests.gap_cases import CaseError, draw_case

    done = {tuple(r["asked"]) for r in read_rows(config.out, ("asked",))}
    commit = versions()["commit"]
    for seed in range(*config.seeds):
        asked_for = (seed, *(getattr(config, name) for name in _ASKED))
        if asked_for in done:
            continue
        with tempfile.TemporaryDirectory() as folder:
            data = Path(folder) / "case"
            try:
                large = "" if config.cheap or config.wide else LARGE[seed % len(LARGE)]
                draw_case(
                    seed,
                    config.kind,
                    data,
                    cheap=config.cheap,
                    effect=config.effect,
                    mechanism=config.mechanism or large,
                    coarse=config.coarse,
                    wide=config.wide,
                )
            except CaseError as error:
                say(f"{config.kind} {seed}: no case ({error})")
                continue
            row = solved(data, Path(folder) / "gap")
        row = {
            "asked": asked_for,
            "kind": config.kind,
            "seed": seed,
            **row,
            "commit": commit,
            "command": command_of("benchmarks.gap", config),
        }
        add_row(config.out, row)
        say(f"{config.kind} {seed}: {told(row)}")


def told(row: dict[str, Any]) -> str:
    """What is said of a line."""
    truth, named = (", ".join(row[k]) or "-" for k in ("truth", "named"))
    right = "right" if row["right"] else "WRONG"
    return (
        f"{row['mechanism']}, {truth} -> {named} ({row['verdict']}), {right}, "
        f"{row['seconds']:.0f} s"
    )


def solved(data: Path, out: Path) -> dict[str, Any]:
    """Runs train.gap on a case that was written to ``data``, and grades it."""
    began = time.perf_counter()
    told = asked(data, out)
    seconds = time.perf_counter() - began
    answer = json.loads((data / "answer.json").read_text())
    return {**graded(told, answer), "seconds": seconds}


def asked(data: Path, out: Path, **options: Any) -> dict[str, Any]:
    """What train.gap tells of such a case, with other options than its own."""
    from train import gap

    model, runs = str(data / "model.xml"), tuple(sorted(data.glob("run*.csv")))
    gap.run(gap.Config(model=model, data=runs, out=out, **options))
    return json.loads((out / "gap.json").read_text())


def graded(told: dict[str, Any], answer: dict[str, Any]) -> dict[str, Any]:
    """What is right in a ``gap.json``, by the answer of the case.

    A name is right where it is the truth's, or an exact twin of it by physics; the
    first names have to be the truth's, in any order (``found``). ``listed``: what is
    among the names that the held-out data do not tell from one of those. ``there``: of
    each name whether that acts at this place; an effect in another law does, where it
    takes half of the gap, or of what was left of it before it joined, and so does a law
    that was found where one acts that no table has. Velocities that are late or
    filtered are named besides, rightly.
    """
    known = [e for e in answer["effects"] if e["kind"] != "outside"]
    truth = dict(zip(keys_of(known), (set(e["twins"]) for e in known), strict=True))
    outside = answer["kind"] == "outside"
    keys = keys_of(told["effects"])
    readings = sorted({*keys} & {*answer["readings"]})
    every = zip(keys, told["effects"], strict=True)
    effects = [e for k, e in every if k not in readings]
    named = keys_of(effects)
    first = named[: max(1, len(truth))]
    found = {
        key: any(n == key or n in twins for n in first) for key, twins in truth.items()
    }
    listed = {key: any(key in e["indistinguishable"] for e in effects) for key in truth}
    if outside:
        right = told["verdict"] == "unexplained"
    elif truth:
        right = all(found.values())
    else:
        right = not named
    return {
        "mechanism": answer["mechanism"],
        "truth": list(truth),
        "unknown": keys_of(e for e in answer["effects"] if e["kind"] == "outside"),
        "named": named,
        "there": [
            _there(e, n, answer, part)
            for e, n, part in zip(effects, named, _taken(told, effects), strict=True)
        ],
        "readings": readings,
        "setting": answer["setting"],
        "confidence": [e["confidence"] for e in effects],
        **{k: [e[k] for e in effects] for k in _EVIDENCE},
        "unexplained_share": told["unexplained_share"],
        "found": found,
        "listed": listed,
        "verdict": told["verdict"],
        "verdicts": answer["verdicts"],
        "right": right,
        "gap_after": [e["gap_after"] for e in effects],
        "parameters": [
            {k: v["value"] for k, v in e["parameters"].items()} for e in effects
        ],
        "deviations": [
            {k: v["std"] for k, v in e["parameters"].items()} for e in effects
        ],
        "outcomes": [e["outcome"] for e in effects],
        "true_parameters": [e["parameters"] for e in known],
        "gap": told["gap"],
        "true_floor": answer["gap"]["floor"],
    }


def _taken(told: dict[str, Any], effects: list[dict[str, Any]]) -> list[float]:
    """What share each effect takes of what is left of the squared gap before it."""
    gap = told["gap"]
    path = [gap["refit"], *(e["gap_after"] for e in effects)]
    left = [max(x**2 - gap["floor"] ** 2, 0.0) for x in path]
    return [
        1.0 - after / before if before > 0 else 0.0
        for before, after in itertools.pairwise(left)
    ]


def _there(
    effect: dict[str, Any], name: str, answer: dict[str, Any], taken: float
) -> bool:
    """Whether a named effect acts at its place; it takes a share of what is left."""
    if effect["effect"] == "found_law":
        return effect["at"] in answer["laws"]
    half = max(effect["explains"] or 0.0, taken) >= _HALF
    return any(
        name in {key, *e["twins"]} or (half and name in e["kindred"])
        for key, e in zip(keys_of(answer["effects"]), answer["effects"], strict=True)
    )


if __name__ == "__main__":
    main(Config, run, name="benchmarks.gap")
