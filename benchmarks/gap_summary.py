"""Pages of results on the gap workflow."""

from collections.abc import Iterable, Iterator
from functools import partial
from itertools import product
from pathlib import Path
from statistics import NormalDist, median
from typing import Any

import numpy as np

from benchmarks._common import markdown_table, short
from benchmarks._page import Section, each_of, load, met, table
from benchmarks.coverage_summary import GOALS as COVERED
from benchmarks.coverage_summary import judged as covered
from benchmarks.coverage_summary import share
from benchmarks.found_laws import CLOSED, LIKE
from benchmarks.found_laws import GOALS as LAW_GOALS
from benchmarks.gap_frozen import COUNT, FROZEN, MIXTURE
from benchmarks.gap_horizons_cases import COUNT as SMALL
from benchmarks.gap_horizons_cases import LINES as HORIZONS
from benchmarks.gap_real import MACHINES
from benchmarks.gap_score import (
    GOALS,
    PARAMETER_GOAL,
    RATIO_GOAL,
    brier,
    calibration,
    confusion,
    is_among,
    judged,
    keys_of,
    parameter_errors,
    ratios,
    shares,
    standardised,
    wilson,
)
from benchmarks.gap_times import EFFECTS
from benchmarks.gap_times import GOALS as TIME_GOALS
from benchmarks.loop import HIDDEN

EMPS_GOAL = 8e-4  # m, over 0.5 s of the pulses
_FIGURES = {"mean confidence": ".2f", "Brier score": ".3f", "calibration error": ".3f"}


def _cases(rows: list[Any]) -> list[str]:
    commits = ", ".join(sorted({short(r["commit"]) for r in rows}))
    left = "" if len(rows) == COUNT else "; the others are not run"
    kinds = {kind: [r for r in rows if r["kind"] == kind] for kind in MIXTURE}
    pairs = judged(rows)
    bins = [(f"{c:.2f}", f"{s:.2f}", n) for c, s, n in calibration(pairs)]
    return [
        f"{len(rows)} of {COUNT} generated machines (`python -m "
        f"benchmarks.gap_frozen`{left}), commit {commits}, by seeds "
        "that nothing was fitted to. Of each kind every other machine has one or two "
        "joints at usual rates; the rest have one to twelve, at 50 to 1000 Hz, slow "
        "and fast, with velocities that may be late or filtered, and gaps to thousands "
        "of floors.",
        markdown_table(
            ("what", "cases", "95 % (Wilson)", "goal", ""),
            [*_goals(rows), *_sizes(rows)],
        ),
        "Listed as alike: the held-out data do not tell it from the one named.",
        table(
            [(kind, some) for kind, some in kinds.items() if some],
            {
                "hidden": lambda line: line[0],
                "cases": lambda line: str(len(line[1])),
                "right": lambda line: str(sum(r["right"] for r in line[1])),
                "explained": lambda line: _verdicts(line[1], "explained"),
                "no gap": lambda line: _verdicts(line[1], "no_gap"),
                "unexplained": lambda line: _verdicts(line[1], "unexplained"),
                "gap over floor after, median": lambda line: _after(line[1]),
                "median seconds": lambda line: (
                    f"{median(r['seconds'] for r in line[1]):.0f}"
                ),
            },
        ),
        *_spreads(rows),
        markdown_table(("confidence stated", "share right", "names"), bins),
        f"Brier score {brier(pairs):.3f} over {len(pairs)} names.",
        "![Calibration of the stated confidence](gap_calibration.svg)",
        "![What each true effect was named](gap_confusion.svg)",
        "The counts are in `gap_confusion.json`.",
    ]


def _spreads(rows: list[Any]) -> list[str]:
    """What stated deviations of effects are worth."""
    off = np.abs(standardised(rows))
    if not len(off):
        return []
    inside = {q: off <= NormalDist().inv_cdf(0.5 + q / 2) for q in COVERED}
    told = (
        f"{share(hit)} ({COVERED[q][0]:.0%} to {COVERED[q][1]:.0%}; "
        f"{covered(hit, COVERED[q])})"
        for q, hit in inside.items()
    )
    lines = zip((f"{q:.0%}" for q in COVERED), told, strict=True)
    return [
        f"True values of the effects that were named right, {len(off)} numbers, inside "
        "the intervals that their deviations make:",
        markdown_table(("interval", "inside [95 %] (goal)"), list(lines)),
    ]


def _after(rows: list[Any]) -> str:
    return f"{median(r['gap']['after'] / r['gap']['floor'] for r in rows):.2f}"


def _verdicts(rows: list[Any], verdict: str) -> str:
    return str(sum(r["verdict"] == verdict for r in rows))


def _goals(rows: list[Any]) -> Iterator[tuple[str, ...]]:
    """Shares of cases against their goals."""
    for name, (hits, count) in shares(rows).items():
        goal, way = GOALS[name]
        most = f"{way} {goal:.0%}"
        if not count:
            yield name, "not run", "", most
            continue
        asked = (goal, 1.0) if way == "at least" else (0.0, goal)
        yield *_share(name, hits, count), most, covered(np.arange(count) < hits, asked)


def _share(name: str, hits: int, count: int) -> tuple[str, str, str]:
    low, high = wilson(hits, count)
    return name, f"{hits} of {count}", f"{low:.0%} to {high:.0%}"


def _sizes(rows: list[Any]) -> Iterator[tuple[str, ...]]:
    """Medians of what is measured in a case against their goals."""
    for name, values, goal, shown in (
        ("error of a parameter, median", parameter_errors(rows), PARAMETER_GOAL, "%"),
        ("gap after in floors, one effect, median", ratios(rows), RATIO_GOAL, ""),
    ):
        if values:
            middle = median(values)
            told = f"{100 * middle:.1f} %" if shown else f"{middle:.2f}"
            most = f"at most {100 * goal:.0f} %" if shown else f"at most {goal:g}"
            reached = "met" if middle <= goal else "missed"
            yield f"{name} of {len(values)}", told, "", most, reached


def _contacts(rows: list[Any]) -> list[str]:
    """Cases whose hidden effect is one of contacts, on a machine that hops along."""
    columns = {
        "machine": "{mechanism}",
        "hidden": lambda r: ", ".join(r["truth"]),
        "named (confidence)": lambda r: _sure(r["named"], r["confidence"]),
        "gap in floors": lambda r: f"{r['gap']['refit'] / r['gap']['floor']:.2f}",
        "after": lambda r: f"{r['gap']['after'] / r['gap']['floor']:.2f}",
    }
    return [
        "Contacts are drawn seldom, and only legs have them; these are drawn on "
        "purpose (`python -m benchmarks.gap --effect contact_friction --mechanism "
        "hopper --out benchmarks/results/gap_contacts.jsonl`, and so on):",
        table(rows, columns),
    ]


def _sure(names: Iterable[str], confidence: Iterable[float]) -> str:
    """Names with the confidence stated in each."""
    told = (f"{n} ({c:.2f})" for n, c in zip(names, confidence, strict=True))
    return ", ".join(told) or "none"


def _coarse(rows: list[Any]) -> list[str]:
    """Cases whose model is off by its own timestep."""
    lines = [_share(name, *of) for name, of in shares(rows).items() if of[1]]
    return [
        "Models whose own physics step and start velocities make a gap of 1.3 to 4 "
        "floors where nothing is missing (`python -m benchmarks.gap --coarse --cheap "
        "--out benchmarks/results/gap_coarse.jsonl`):",
        markdown_table(("what", "cases", "95 % (Wilson)"), lines),
    ]


def figures(folder: Path) -> dict[str, str]:
    """Texts of the pictures and counts, by file name; none without cases."""
    from benchmarks.gap_figures import calibration_curve, confusion_matrix
    from easi_jax.io.files import to_json

    rows = load(folder, FROZEN.name)
    if not rows:
        return {}
    counts, pairs = confusion(rows), judged(rows)
    bins = calibration(pairs)
    reach = [wilson(round(share * n), n) for _, share, n in bins]
    found = {"gap_calibration.svg": calibration_curve(bins, reach)}
    if counts:
        found["gap_confusion.json"] = to_json(counts)
        found["gap_confusion.svg"] = confusion_matrix(counts)
    return found


def _loop(robot: str, found: dict[str, Any]) -> list[str]:
    """Returns in a target with a hidden effect, before and after it is found."""
    lines = []
    for effect, r in found.items():
        named = ", ".join(keys_of(r["found"]["effects"]))
        each = [[*v.values()] for v in r["returns"].values()]
        lines.append((effect, named, *map(_mean_and_all, each)))
    methods = list(r["returns"])
    return [
        markdown_table((f"{robot}, hidden", "named by train.gap", *methods), lines),
        "`python -m benchmarks.loop`: mean return in the target (every seed).",
    ]


def _mean_and_all(values: list[float]) -> str:
    return f"{sum(values) / len(values):.1f} ({each_of(values, 1)})"


def _times(rows: list[Any]) -> list[str]:
    """Seconds of the whole command."""
    done = {(r["mechanism"], r["effect"]): r for r in rows}
    lines: list[tuple[object, ...]] = []
    for mechanism, effect in product(TIME_GOALS, EFFECTS):
        c, goal = done.get((mechanism, effect)), TIME_GOALS[mechanism]
        if c is None:
            lines.append((mechanism, effect, "not run"))
            continue
        told = (f"{c['seconds']:.0f}", f"{goal}, {met(c['seconds'] <= goal)}")
        named = ", ".join(c["named"]) or "none"
        lines.append((mechanism, ", ".join(c["truth"]), named, *told))
    cores = ", ".join(sorted({str(r["cores"]) for r in rows}))
    return [
        f"`python -m benchmarks.gap_times`: from a first start, nothing cached, on "
        f"{cores} cores.",
        markdown_table(("machine", "hidden", "named", "s", "goal [s]"), lines),
    ]


def _real(found: dict[str, Any]) -> list[str]:
    """Recordings of real machines."""
    by_name = {name.removeprefix("gap_real_"): r for name, r in found.items()}
    rows = [{"name": n, **by_name[n]} for n in MACHINES if n in by_name]
    columns = {
        "recordings": "{name}",
        "named (confidence)": lambda r: _sure(
            keys_of(r["effects"]),
            [e["confidence"] for e in r["effects"]],
        ),
        "expected but not named": _unnamed,
        "never to be named": lambda r: ", ".join(r["wrongly_named"]) or "none",
        "gap given, refitted, after": (
            "{gap[before]:.3g}, {gap[refit]:.3g}, {gap[after]:.3g}"
        ),
        "floor": "{gap[floor]:.2g}",
        "error held out, given to repaired": lambda r: (
            "; ".join(
                f"{j} {v['before']:.2g} to {v['after']:.2g} {v['unit']}"
                for j, v in r["gap_si"].items()
            )
            + f" in {r['config']['horizon']:g} s"
        ),
        "s": "{seconds:.0f}",
    }
    out = ["`python -m benchmarks.gap_real`.", table(rows, columns)]
    if "emps" in by_name:
        (axis,) = by_name["emps"]["gap_si"].values()
        verdict = met(axis["after"] <= EMPS_GOAL)
        out.append(f"emps: {1000 * axis['after']:.2f} mm (goal 0.8 mm: {verdict}).")
    return out


def _unnamed(r: Any) -> str:
    alike = {n for e in r["effects"] for n in e["indistinguishable"]}
    missing = [
        k.replace("|", " or ") + (" (listed as alike)" if is_among(k, alike) else "")
        for k, ok in r["found"].items()
        if not ok
    ]
    return ", ".join(missing) or "none"


def _confidence(r: dict[str, Any]) -> list[str]:
    """How often what was named is there, on machines the curve has not seen."""
    families = {"all": "all", "known": "effects of the table, or nothing"}
    families |= {"mixed": "effects of the table beside ones that no table has"}
    families |= {"unknown": "one that no table has, alone"}
    lines = [
        (
            *(name, families[k], f["names"], f["there"]),
            *(f"{f[x]:{d}}" for x, d in _FIGURES.items()),
            f["wrong above 0.8"],
        )
        for name, told in r["families"].items()
        for k, f in told.items()
    ]
    head = "machines", "hidden", "named", "there", *_FIGURES, "wrong above 0.8"
    curve = ", ".join(f"{k} {v:.2f}" for k, v in r["curve"].items())
    return [
        f"`python -m benchmarks.gap_confidence`: the curve was fitted to "
        f"{r['config']['lines']} generated machines, most of one or two joints, "
        f"commits {', '.join(map(short, r['config']['commits']))} ({curve}). "
        "Mechanism left out: these, by a curve fitted to the other mechanisms. Goals: "
        "Brier score below 0.08; calibration error below 0.05, of each kind below 0.1; "
        "over at least 300 names.",
        markdown_table(head, lines),
        *(f"{name}: {_judged(told)}." for name, told in r["families"].items()),
    ]


def _judged(told: dict[str, dict[str, float]]) -> str:
    """Figures of `benchmarks.gap_confidence` by their goals."""
    every = told["all"]
    error = all(
        f["calibration error"] < (0.05 if family == "all" else 0.1)
        for family, f in told.items()
    )
    return (
        f"Brier score {met(every['Brier score'] < 0.08)}, calibration error "
        f"{met(error)}, names {met(every['names'] >= 300)}"
    )


def _horizons(found: dict[str, Any]) -> list[str]:
    """Names of real machines at several horizons of the report."""
    lines = []
    for machine, r in found.items():
        for told in r["horizons"]:
            names = keys_of(told["effects"])
            gap = told["gap"]
            lines.append(
                (
                    *(machine.removeprefix("gap_horizons_"), f"{told['horizon']:g}"),
                    *(", ".join(names), f"{gap['before']:.3g} to {gap['after']:.3g}"),
                )
            )
    same = sum(r["same_names"] for r in found.values())
    far = max(r["farthest_value"] for r in found.values())
    return [
        "`python -m benchmarks.gap_horizons`: the same names at all horizons on "
        f"{same} of {len(found)} machines; values differ by {100 * far:.2g} % at most.",
        markdown_table(("recordings", "horizon [s]", "named", "gap"), lines),
    ]


def _horizons_cases(rows: list[Any]) -> list[str]:
    """Names of generated machines at several horizons of the report."""
    same = sum(r["same_names"] for r in rows)
    far = max(r["farthest_value"] for r in rows)
    differ = [
        (r["key"], *(", ".join(names) or "none" for names in r["named"].values()))
        for r in rows
        if not r["same_names"]
    ]
    head = ("machine", *(f"{h} s" for h in rows[0]["named"]))
    return [
        f"`python -m benchmarks.gap_horizons_cases`: {len(rows)} of {SMALL} generated "
        f"machines, the same names at all horizons on {same}; values differ by "
        f"{100 * far:.2g} % at most.",
        *([markdown_table(head, differ)] if differ else []),
    ]


def _laws(rows: list[Any]) -> list[str]:
    """Laws that no table has: found, and where there is none."""
    hidden = [r for r in rows if not r["control"]]
    controls = [r for r in rows if r["control"]]
    lines = []
    for law in sorted({r["law"] for r in hidden}):
        mine = [r for r in hidden if r["law"] == law]
        right = sum(r["correlation"] >= LIKE for r in mine)
        told = sum(bool(r["laws"]) for r in mine)
        lines.append((law, len(mine), right, told, sum(map(_halved, mine))))
    right = sum(r["correlation"] >= LIKE for r in hidden)
    halved = sum(map(_halved, hidden))
    false = sum(bool(r["laws"]) for r in controls)
    share = LAW_GOALS["law right"], LAW_GOALS["half of the gap"]
    most = LAW_GOALS["false laws at most"]
    return [
        f"`python -m benchmarks.found_laws`: {len(hidden)} hidden laws, "
        f"{len(controls)} controls of equal size. The force that was found goes with "
        f"the hidden one (correlation {LIKE:g}) in {right} (goal {share[0]:.0%}: "
        f"{met(right >= share[0] * len(hidden))}); the gap is at most half of what the "
        f"table leaves, or closed, in {halved} (goal {share[1]:.0%}: "
        f"{met(halved >= share[1] * len(hidden))}); a law on {false} controls (goal "
        f"{most:.0%} at most: {met(false <= most * len(controls))}).",
        markdown_table(
            ("law", "cases", "right", "law named", "gap halved or closed"), lines
        ),
        *_law_time(rows),
    ]


def _law_time(rows: list[Any]) -> list[str]:
    """What laws cost beside the rest, where that was measured."""
    import numpy as np

    timed = [r for r in rows if "law_seconds" in r]
    if not timed:
        return []
    share = [r["law_seconds"] / (r["seconds"] - r["law_seconds"]) for r in timed]
    median, most = np.median(share), np.quantile(share, 0.9)
    return [
        f"Of {len(timed)} cases the search for laws took {median:.0%} of the time of "
        f"the rest (median; nine in ten at most {most:.0%}; goal "
        f"{LAW_GOALS['time']:.0%}: {met(median <= LAW_GOALS['time'])})."
    ]


def _halved(r: dict[str, Any]) -> bool:
    gap = r["gap"]
    if gap["after"] <= CLOSED * gap["floor"]:
        return True
    return "known_effects" in gap and gap["after"] <= 0.5 * gap["known_effects"]


_FIRST = next(iter(HIDDEN))
SECTIONS = (
    Section("## Hidden effects", FROZEN.name, "gap_frozen", _cases),
    Section("", "gap_contacts.jsonl", "gap --effect contact_friction", _contacts),
    Section("", "gap_coarse.jsonl", "gap --coarse --cheap", _coarse, optional=True),
    Section(
        "### What a stated confidence is worth",
        "gap_confidence.json",
        "gap_confidence",
        _confidence,
    ),
    Section(
        "### Names at several horizons",
        "gap_horizons_*.json",
        "gap_horizons",
        _horizons,
    ),
    Section("", HORIZONS.name, "gap_horizons_cases", _horizons_cases),
    Section("### Laws that no table has", "found_laws.jsonl", "found_laws", _laws),
    Section("## Effects in real recordings", "gap_real_*.json", "gap_real", _real),
    Section("## Time of train.gap", "gap_times.jsonl", "gap_times", _times),
    *(
        Section(
            "## The loop closed: a hidden effect in the target" * (robot == _FIRST),
            {effect: f"loop_{robot}_{effect}.json" for effect in effects},
            f"loop --robot {robot} --effect {{name}}",
            partial(_loop, robot),
        )
        for robot, effects in HIDDEN.items()
    ),
)
