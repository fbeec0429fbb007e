"""All committed results against their goals, as one page of Markdown.

    python -m benchmarks.summary

Reads ``benchmarks/results/*.json`` and ``SUMMARY.md``, which is written by hand and
begins the page, and nothing else; writes ``README.md`` beside them. A result that was
not run is named as not run.
"""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import (
    brax_beside,
    circles,
    commands,
    compile_times,
    coverage_summary,
    crash_summary,
    engines,
    floor,
    fresh_clone,
    gap_summary,
    go2_in_air,
    imitation,
    lacking,
    lines,
    own_robot,
    paper_claims,
    paper_tables,
    parity,
    rivals_summary,
    same_twice,
    scaling_summary,
    settling,
    slow_tests,
    small_cases,
    strangers,
    walking,
    where_tests_spend,
)
from benchmarks._common import RESULTS, markdown_table
from benchmarks._page import Section, each_of, met, percent, shown, table
from benchmarks.accuracy import ROBOTS as ACCURATE
from benchmarks.devices import SAME, STEPS
from benchmarks.export import GOAL
from benchmarks.recovery import CASES
from benchmarks.robots import STARTS
from train._command import main, say

FACTORS = (0.25, 0.5, 2, 4)
KNOWN = 0.02  # Cramer-Rao standard deviation below which a parameter must be found
ROBOTS = ("ant", "ballbalance", "go2", "go2_parameters_full")


@dataclasses.dataclass(frozen=True)
class Config:
    """Writes the page of results."""

    results: Path = RESULTS
    """Folder of the JSON files."""


def run(config: Config) -> None:
    """Writes ``README.md`` and the pictures in it."""
    from easi_jax.io.files import atomic_write

    parts = ["# Results", "Made by `python -m benchmarks.summary` from the files here."]
    by_hand = config.results / "SUMMARY.md"
    if by_hand.is_file():
        parts.append(by_hand.read_text().strip())
    parts += shown(SECTIONS, config.results)
    for module in (gap_summary, go2_in_air, paper_tables, scaling_summary):
        for name, text in module.figures(config.results).items():
            atomic_write(config.results / name, text)
    claims = config.results / "CLAIMS.md"
    atomic_write(claims, paper_claims.page(config.results) + "\n")
    path = config.results / "README.md"
    atomic_write(path, "\n\n".join(parts) + "\n")
    say(f"written: {path}")


def _accuracy(found: dict[str, Any]) -> list[str]:
    """What solver and time step of each robot cost in accuracy."""
    rows, head = [], ()
    for name, r in found.items():
        head = ("robot", "compared", *(f"{s} % of models" for s in r["percentiles"]))
        used = f"{r['used']} Newton steps"
        for what, by_time in r["difference"].items():
            label = f"**{what}**, as used" if what == used else what
            rows.append((name, label, *(f"{x:.1e}" for x in by_time[-1])))
    return [
        "`python -m benchmarks.accuracy`: largest difference of a position [m, rad] "
        "after 0.2 s of random commands, over random models: Newton steps of the "
        "contact solver against a converged one, and beside it what a quarter of the "
        "time step would change:",
        markdown_table(head, rows),
    ]


def _memory(found: dict[str, Any]) -> list[str]:
    columns = {
        "robot": "{robot}",
        "run": "{what}",
        "peak GiB": "{peak_gib:.1f}",
        "goal 8": lambda r: met(r["peak_gib"] < r["goal_gib"]),
    }
    made = "`python -m benchmarks.robots --udr RUN --part memory` (or `--part buffer`)"
    return [made, table(found.values(), columns)]


def _known(seeds: list[Any]) -> tuple[np.ndarray, int]:
    """Parameters that the data show to `KNOWN`, and how many there are."""
    std = np.median(np.array([s["cramer_rao_std"] for s in seeds], float), 0)
    return np.flatnonzero(std < KNOWN), len(std)


def _off(summary: Any, known: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Their median and worst absolute log ratios to the truth."""
    keys = ("median_abs_log_ratio", "worst_abs_log_ratio")
    middle, worst = (np.array(summary[k])[known] for k in keys)
    return middle, worst


def _found(found: dict[tuple[str, str], Any]) -> list[str]:
    """What searches of each robot found, by where they started."""
    rows, said = [], []
    for (name, start), r in found.items():
        seeds = r["seeds"]
        known, count = _known(seeds)
        for method, s in r["summary"].items():
            rows.append((name, start, method, len(seeds), f"{len(known)} of {count}"))
            if not len(known):
                continue
            middle, worst = _off(s, known)
            k = int(np.argmax(worst))
            rows[-1] += (
                f"{percent(float(np.median(middle)))} %",
                f"{percent(float(worst[k]))} % ({r['parameters'][known[k]]})",
            )
        ranks = " or ".join(map(str, sorted({s["rank"] for s in seeds})))
        open_ = sorted({d for s in seeds for d in s["undetermined"]})
        said.append(
            f"- {name}, {start}: the data determine {ranks} of {count} directions"
            + (f"; {'; '.join(open_)}" if open_ else "")
            + "."
        )
    head = (
        *("robot", "start", "method", "seeds", "known to 2 %"),
        *("median error of these", "worst error of these, any seed"),
    )
    return [
        "`python -m benchmarks.robots --udr RUN`: `default` is "
        "the search alone, `refine` with the least-squares finish; `high` and "
        "`low` start at 2 to 4 and 0.05 to 0.5 times the truth. What the data can "
        "know to 2 % is read from their Fisher information.",
        markdown_table(head, rows),
        "\n".join(said),
    ]


def _own_robot(r: Any) -> list[str]:
    """The README's example of a robot of one's own."""
    errors = [abs(r["found"][k] / r["truth"][k] - 1) for k in r["truth"]]
    after = " and ".join(f"{x:.5f}" for x in r["held_out"]["after"]["0"])
    before = " and ".join(f"{x:.3f}" for x in r["held_out"]["before"])
    return [
        f"`{r['command']}`, the README's arm with nothing cached: {r['seconds']:.0f} s "
        f"(goal {own_robot.GOAL} s, {met(r['seconds'] < own_robot.GOAL)}). "
        f"{len(errors)} parameters within {100 * max(errors):.1f} % of the truth; "
        f"held-out error {after} rad, {before} rad in the model as given.",
    ]


def _fuzz(r: Any) -> list[str]:
    """Hostile and broken files: how many, and what the readers did."""
    total = r["total"]
    columns: dict[str, Any] = {"reader": "{reader}"}
    columns |= {c: f"{{{c}}}" for c in ("cases", "refused", "accepted", "failed")}
    columns["slowest [ms]"] = lambda x: f"{1000 * x['slowest_s']:.0f}"
    return [
        f"`{r['command']}`: {total['cases']} files changed, drawn or written to do "
        f"harm, in {r['seconds']:.0f} s of one core. Each is accepted or refused in "
        "one line; anything else (another exception, a hang, something unpickled or "
        "started, a file read or written elsewhere) is a failure: "
        f"{total['failed']} of them ({met(total['failed'] == 0)}).",
        table(r["readers"], columns),
    ]


def _devices(found: dict[str, Any]) -> list[str]:
    head, ok = [], True
    rows: list[tuple[object, ...]] = []
    for r in found.values():
        last = {name: steps[-1] for name, steps in r["positions"].items()}
        share = list(next(iter(last.values())))[-1]
        head = [f"{name}, {share}" for name in last]
        told = [f"{r['other_device']} beside {r['device']}"]
        told += [f"{x[share]:.1e}" for x in last.values()]
        worst = (max(r["search_apart_std"]), max(r["refined_apart_std"]))
        rows.append((*told, *(f"{x:.2g}" for x in worst)))
        ok &= max(worst) <= SAME
    return [
        f"`python -m benchmarks.devices`: positions [m, rad] after {STEPS[-1]} control "
        "steps under the same commands, 64 random models of each robot; the results of "
        "a search of the Cartpole and of its finish in their own standard deviations, "
        f"goal {SAME:g}: {met(ok)}. Largest differences, of positions the percentile "
        "that is named.",
        markdown_table(("", *head, "search [std]", "finish [std]"), rows),
    ]


def _export(r: Any) -> list[str]:
    rows, most = [], max(c["onnx"] for c in r["cases"])
    for robot in dict.fromkeys(c["robot"] for c in r["cases"]):
        mine = [c for c in r["cases"] if c["robot"] == robot]
        trained = sum("trained" in c["policy"] for c in mine)
        off = (f"{max(c[k] for c in mine):.1e}" for k in ("onnx", "stablehlo"))
        fastest = f"{min(c['onnx_us'] for c in mine):.0f}"
        rows.append((robot, f"{len(mine)} ({trained} trained)", *off, fastest))
    head = ("robot", "policies", "ONNX", "StableHLO", "a call of ONNX [us]")
    return [
        f"`{r['command']}`: largest difference of an action or a command from JAX over "
        f"{r['observations']:,} observations; goal {GOAL:g} for ONNX: "
        f"{met(most <= GOAL)}.",
        markdown_table(head, rows),
    ]


def _policies(found: dict[str, Any]) -> list[str]:
    """Policies of the larger robots: how long they trained and what they reach."""
    runs = [
        {"robot": r["robot"], "goal": r["goal_minutes"] or "", **run}
        for r in found.values()
        for run in r["runs"]
    ]
    columns = {
        "robot": "{robot}",
        "trained": "{method}",
        "algorithm, steps": "{algorithm}, {env_steps:,}",
        "minutes": "{minutes:.0f}",
        "allowed": "{goal}",
        "returns": lambda run: each_of(run["returns"].values(), 1),
    }
    out = [
        "`python -m benchmarks.policies --runs RUN...`: trained under randomization "
        "(UDR) or in the nominal model (Fixed), return of each seed in the nominal "
        "robot. The curves are in the files.",
        table(runs, columns),
    ]
    tracked = [run for run in runs if "tracking" in run]
    if tracked:
        head = (f"{c:g} m/s" for c in tracked[-1]["tracking"]["commands"])
        rows = [
            (run["method"], *map(_speed_told, speed, fallen))
            for run in tracked
            for t in [run["tracking"]]
            for speed, fallen in zip(t["speed"], t["fallen"], strict=True)
        ]
        out.append("Speed of Go2 at forward commands:")
        out.append(markdown_table(("policy", *head), rows))
    return out


def _speed_told(speed: float | None, fallen: int) -> str:
    if speed is None:
        return "fell"
    return f"{speed:.2f}" + (f" ({fallen} fell)" if fallen else "")


def _recovery(found: dict[str, Any]) -> list[str]:
    """Errors of prediction, and of parameters that the data determine."""
    errors, parameters = [], []
    for name, r in found.items():
        case = CASES[name]
        for method, s in r["summary"].items():
            goal = case["free"] and not any(case["noise"]) and method != "paper"
            cells = [
                f"{100 * x:.2f} %" + (f" ({met(x <= g / 100)}: {g} %)" if goal else "")
                for k, g in (("median_one_step", 1), ("median_open_loop", 3))
                for x in [max(s[k])]
            ]
            errors.append((name, method, len(r["seeds"]), *cells))
        seeds = [row for row in r["seeds"] if "cramer_rao_std" in row]
        if case["free"] or not seeds:
            continue
        known, _ = _known(seeds)
        limit = 0.05 if "start" not in case else 0.10
        for method, s in r["summary"].items():
            middle, worst = _off(s, known)
            ok = middle.max() <= np.log1p(limit)
            if "start" not in case:
                ok = ok and worst.max() <= np.log1p(0.15)
            cells = [
                f"{r['parameters'][k]} {percent(m)} ({percent(w)})"
                for k, m, w in zip(known, middle, worst, strict=True)
            ]
            parameters.append((name, method, ", ".join(cells), met(ok)))
    head = ("case", "method", "seeds", "one step", "open loop 0.2 s")
    out = [
        "Worst channel of the held-out error, median over seeds, as a share of "
        "the motion:",
        markdown_table(head, errors),
    ]
    if parameters:
        out.append(
            "Parameters whose Cramer-Rao standard deviation is below 2 %: error in %, "
            "median (worst) over seeds. Goal: 5 (15), from starts that exclude the "
            "truth 10 in the median."
        )
        out.append(markdown_table(("case", "method", "parameters", ""), parameters))
    return out


def _transfer(found: dict[str, dict[str, Any]]) -> list[str]:
    def mean(method: str) -> Any:
        return lambda r: f"{np.mean([*r['returns'][method].values()]):.1f}"

    def goal(r: Any) -> str:
        return met(r["share_of_gap"] >= 0.9) if r["goal_applies"] else "no gap"

    columns = {
        "target": "{name}",
        "seeds": lambda r: len(next(iter(r["returns"].values()))),
        **{method: mean(method) for method in ("UDR", "EASI", "Oracle")},
        "Oracle - UDR": (
            "{oracle_minus_udr[mean]:.1f} +- {oracle_minus_udr[standard_error]:.1f}"
        ),
        "share closed": "{share_of_gap:.2f} [{share_95[0]:.2f}, {share_95[1]:.2f}]",
        "goal 0.9": goal,
    }
    rows = [
        {"name": name.removeprefix("transfer_"), **r}
        for files in found.values()
        for name, r in files.items()
    ]
    return [table(rows, columns)]


def _joint(_: Any) -> list[str]:
    return [
        "`_jointN`: the policy goes on training inside the search, N steps of all "
        "environments a generation, which are taken off the final training."
    ]


def _real(r: Any) -> list[str]:
    rows = [
        (
            *(measure, name, joint, f"{row['nominal'][joint]:.4f}", f"{x:.4f}"),
            *(f"{v[joint]:.4f}" for v in [row.get("fitted_to_itself")] if v),
        )
        for measure, sets in r["measures"].items()
        for name, row in sets.items()
        for joint, x in row["identified_median"].items()
    ]
    head = (
        *("measure", "recordings", "joint", "nominal", "identified"),
        "fitted to itself",
    )
    return [
        f"`{r['command']}`: {r['measure']} (m, rad), median over seeds.",
        markdown_table(head, rows),
        "Fitted to itself: the best these parameters can do, fitted to the recordings "
        "that they are measured on.",
        *(f"{measure}: {verdict}." for measure, verdict in r["verdicts"].items()),
    ]


SECTIONS = (
    Section("## Speed", "engines.jsonl", "engines", engines.paragraphs),
    Section(
        "",
        {name: f"accuracy_{name}.json" for name in ACCURATE},
        "accuracy --robots {name}",
        _accuracy,
    ),
    Section(
        *("## Searches on the other robots", "memory_*.json", "robots --part memory"),
        _memory,
    ),
    Section(
        "",
        {(r, s): f"robots_{r}_{s}.json" for r in ROBOTS for s in STARTS},
        "robots --udr RUN_OF_{name[0]} --starts {name[1]}",
        _found,
    ),
    Section("## A robot of one's own", "own_robot.json", "own_robot", _own_robot),
    Section("", "strangers.json", "strangers", strangers.paragraphs),
    Section(
        *("### Models that are right", "small_cases.json", "small_cases"),
        small_cases.paragraphs,
    ),
    Section(
        *("## Policies of the other robots", "policies_*.json", "policies", _policies)
    ),
    Section(
        "## Recovery of known Cartpole parameters",
        {name: f"recovery_{name}.json" for name in CASES},
        "recovery --cases {name}",
        _recovery,
    ),
    *coverage_summary.SECTIONS,
    *lacking.SECTIONS,
    Section(
        "## Transfer: return in a target unlike the model",
        {f"{factor:g}": f"transfer_kp_x{factor:g}*.json" for factor in FACTORS},
        "transfer --factors {name}",
        _transfer,
    ),
    Section(
        "",
        {robot: f"transfer_{robot}*_x*.json" for robot in ROBOTS[:3]},
        "transfer --robot {name}",
        _transfer,
    ),
    Section("", "transfer_kp_*_joint*.json", "transfer --joint 10", _joint),
    Section("## Real cart-pole", "real_cartpole.json", "real_cartpole", _real),
    Section(
        *("## Real Go2 in a stand", "go2_in_air.json", "go2_in_air"),
        go2_in_air.paragraphs,
    ),
    *walking.SECTIONS,
    *brax_beside.SECTIONS,
    *settling.SECTIONS,
    *imitation.SECTIONS,
    *circles.SECTIONS,
    Section(*("## MuJoCo's features", "parity.json", "parity", parity.paragraphs)),
    *commands.SECTIONS,
    Section(
        *("## Time to compile the physics", "compile_times.json", "compile_times"),
        compile_times.paragraphs,
    ),
    Section("## Hostile and broken files", "fuzz.json", "fuzz", _fuzz),
    Section("## Exported policies", "export.json", "export", _export),
    Section(
        *("## Same result on other devices", "devices_*.json", "devices", _devices)
    ),
    *same_twice.SECTIONS,
    *crash_summary.SECTIONS,
    *gap_summary.SECTIONS,
    *floor.SECTIONS,
    *paper_tables.SECTIONS,
    *rivals_summary.SECTIONS,
    *scaling_summary.SECTIONS,
    *fresh_clone.SECTIONS,
    *where_tests_spend.SECTIONS,
    *slow_tests.SECTIONS,
    Section("## Lines by package", "lines.json", "lines", lines.paragraphs),
)


if __name__ == "__main__":
    main(Config, run, name="benchmarks.summary")
