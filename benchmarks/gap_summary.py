"""Pages of results on the gap workflow."""

from collections.abc import Sequence
from pathlib import Path
from statistics import median

from benchmarks._cells import read_rows
from benchmarks._common import markdown_table, short
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
    parameter_errors,
    ratios,
    read_cases,
    shares,
    wilson,
)
from benchmarks.gap_times import EFFECTS
from benchmarks.gap_times import GOALS as TIME_GOALS
from benchmarks.loop import HIDDEN

EMPS_GOAL = 8e-4  # m, over 0.5 s of the pulses


def generated(folder: Path) -> list[str]:
    """Cases with a hidden effect."""
    rows = read_cases(folder / "gap_cases.jsonl")
    if not rows:
        return ["## Hidden effects", "Not run: `python -m benchmarks.gap`."]
    out = [
        "## Hidden effects",
        f"{len(rows)} generated cases (`python -m benchmarks.gap`), commits "
        f"{', '.join(sorted({short(r['commit']) for r in rows}))}.",
    ]
    lines = []
    for name, (hits, count) in shares(rows).items():
        goal, way = GOALS[name]
        if not count:
            lines.append((name, "not run", "", f"{way} {goal:.0%}", ""))
            continue
        low, high = wilson(hits, count)
        met = hits / count >= goal if way == "at least" else hits / count <= goal
        lines.append(
            (
                name,
                f"{hits} of {count}",
                f"{low:.0%} to {high:.0%}",
                f"{way} {goal:.0%}",
                "met" if met else "missed",
            )
        )
    for name, values, goal, shown in (
        ("error of a parameter, median", parameter_errors(rows), PARAMETER_GOAL, "%"),
        ("gap after in floors, one effect, median", ratios(rows), RATIO_GOAL, ""),
    ):
        if values:
            middle = median(values)
            told = f"{100 * middle:.1f} %" if shown else f"{middle:.2f}"
            most = f"at most {100 * goal:.0f} %" if shown else f"at most {goal:g}"
            lines.append(
                (
                    f"{name} of {len(values)}",
                    told,
                    "",
                    most,
                    "met" if middle <= goal else "missed",
                )
            )
    out.append(markdown_table(("what", "cases", "95 % (Wilson)", "goal", ""), lines))
    strict = {
        k: sum(r["right"] for r in rows if r["kind"] == k) for k in ("single", "pair")
    }
    out.append(
        f"Right names and pairs that are named themselves: {strict['single']} and "
        f"{strict['pair']}; the others are listed as names that the held-out data "
        "do not tell from the one named."
    )
    pairs = judged(rows)
    bins = [(f"{c:.2f}", f"{s:.2f}", n) for c, s, n in calibration(pairs)]
    out.append(
        markdown_table(("confidence stated", "share right", "names"), list(bins))
    )
    out.append(f"Brier score {brier(pairs):.3f} over {len(pairs)} names.")
    out += [
        "![Calibration of the stated confidence](gap_calibration.svg)",
        "![What each true effect was named](gap_confusion.svg)",
        "The counts are in `gap_confusion.json`.",
    ]
    return out + contacts(folder) + coarse(folder)


def contacts(folder: Path) -> list[str]:
    """Cases whose hidden effect is one of contacts, on a machine that hops along."""
    rows = read_cases(folder / "gap_contacts.jsonl")
    if not rows:
        return []
    lines = [
        (
            r["mechanism"],
            ", ".join(r["truth"]),
            _sure(r["named"], r["confidence"]),
            *(f"{r['gap'][k] / r['gap']['floor']:.2f}" for k in ("refit", "after")),
        )
        for r in rows
    ]
    return [
        "Contacts are drawn seldom, and only legs have them; these are drawn on "
        "purpose (`python -m benchmarks.gap --effect contact_friction --mechanism "
        "hopper --out benchmarks/results/gap_contacts.jsonl`, and so on):",
        markdown_table(
            ("machine", "hidden", "named (confidence)", "gap in floors", "after"), lines
        ),
    ]


def _sure(names: Sequence[str], confidence: Sequence[float]) -> str:
    """Names with the confidence stated in each."""
    told = (f"{n} ({c:.2f})" for n, c in zip(names, confidence, strict=True))
    return ", ".join(told) or "none"


def coarse(folder: Path) -> list[str]:
    """Cases whose model is off by its own timestep."""
    rows = read_cases(folder / "gap_coarse.jsonl")
    if not rows:
        return []
    lines = []
    for name, (hits, count) in shares(rows).items():
        if count:
            low, high = wilson(hits, count)
            lines.append((name, f"{hits} of {count}", f"{low:.0%} to {high:.0%}"))
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

    rows = read_cases(folder / "gap_cases.jsonl")
    if not rows:
        return {}
    counts, pairs = confusion(rows), judged(rows)
    bins = calibration(pairs)
    reach = [wilson(round(share * n), n) for _, share, n in bins]
    return {
        "gap_confusion.json": to_json(counts),
        "gap_confusion.svg": confusion_matrix(counts),
        "gap_calibration.svg": calibration_curve(bins, reach),
    }


def loop(folder: Path) -> list[str]:
    """Returns in a target with a hidden effect, before and after it is found."""
    from easi_jax.io.files import read_json

    out = ["## The loop closed: a hidden effect in the target"]
    for robot, effects in HIDDEN.items():
        lines, methods = [], []
        for effect in effects:
            path = folder / f"loop_{robot}_{effect}.json"
            if not path.is_file():
                how = "" if robot == "cartpole" else f" --robot {robot}"
                out.append(
                    f"{robot}, {effect}: not run (`python -m benchmarks.loop{how} "
                    f"--effect {effect}`)."
                )
                continue
            r = read_json(path)
            methods = list(r["returns"])
            named = ", ".join(f"{e['effect']}@{e['at']}" for e in r["found"]["effects"])
            each = [[*v.values()] for v in r["returns"].values()]
            lines.append((effect, named, *map(_mean_and_all, each)))
        if lines:
            head = (f"{robot}, hidden", "named by train.gap", *methods)
            out.append(markdown_table(head, lines))
            out.append(
                "`python -m benchmarks.loop`: mean return in the target (every seed)."
            )
    return out


def _mean_and_all(values: list[float]) -> str:
    each = ", ".join(f"{x:.1f}" for x in values)
    return f"{sum(values) / len(values):.1f} ({each})"


def times(folder: Path) -> list[str]:
    """Seconds of the whole command."""
    out, rows = ["## Time of train.gap"], read_rows(folder / "gap_times.jsonl")
    if not rows:
        return [*out, "Not run: `python -m benchmarks.gap_times`."]
    done = {(r["mechanism"], r["effect"]): r for r in rows}
    lines: list[tuple[object, ...]] = []
    for mechanism, goal in TIME_GOALS.items():
        for effect in EFFECTS:
            c = done.get((mechanism, effect))
            if c is None:
                lines.append((mechanism, effect, "not run"))
                continue
            met = "met" if c["seconds"] <= goal else "**missed**"
            named = ", ".join(c["named"]) or "none"
            told = (f"{c['seconds']:.0f}", f"{goal}, {met}")
            lines.append((mechanism, ", ".join(c["truth"]), named, *told))
    cores = ", ".join(sorted({str(r["cores"]) for r in rows}))
    return [
        *out,
        f"`python -m benchmarks.gap_times`: from a first start, nothing cached, on "
        f"{cores} cores.",
        markdown_table(("machine", "hidden", "named", "s", "goal [s]"), lines),
    ]


def real(folder: Path) -> list[str]:
    """Recordings of real machines."""
    from easi_jax.io.files import read_json

    out = ["## Effects in real recordings"]
    lines: list[tuple[object, ...]] = []
    for name in MACHINES:
        path = folder / f"gap_real_{name}.json"
        if not path.is_file():
            continue
        r = read_json(path)
        named = _sure(
            [f"{e['effect']}@{e['at']}" for e in r["effects"]],
            [e["confidence"] for e in r["effects"]],
        )
        alike = {n for e in r["effects"] for n in e["indistinguishable"]}
        missing = [
            k.replace("|", " or ")
            + (" (listed as alike)" if is_among(k, alike) else "")
            for k, ok in r["found"].items()
            if not ok
        ]
        gap = r["gap"]
        joints = "; ".join(
            f"{j} {v['before']:.2g} to {v['after']:.2g} {v['unit']}"
            for j, v in r["gap_si"].items()
        )
        lines.append(
            (
                name,
                named,
                ", ".join(missing) or "none",
                ", ".join(r["wrongly_named"]) or "none",
                f"{gap['before']:.3g}, {gap['refit']:.3g}, {gap['after']:.3g}",
                f"{gap['floor']:.2g}",
                f"{joints} in {r['config']['horizon']:g} s",
                f"{r['seconds']:.0f}",
            )
        )
    if not lines:
        return [*out, "Not run: `python -m benchmarks.gap_real`."]
    head = (
        *("recordings", "named (confidence)", "expected but not named"),
        *("never to be named", "gap given, refitted, after", "floor"),
        *("error held out, given to repaired", "s"),
    )
    out += ["`python -m benchmarks.gap_real`.", markdown_table(head, lines)]
    path = folder / "gap_real_emps.json"
    if path.is_file():
        (axis,) = read_json(path)["gap_si"].values()
        met = "met" if axis["after"] <= EMPS_GOAL else "**missed**"
        out.append(f"emps: {1000 * axis['after']:.2f} mm (goal 0.8 mm: {met}).")
    return out
