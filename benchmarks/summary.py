"""All committed results against their goals, as one page of Markdown.

    python -m benchmarks.summary

Reads ``benchmarks/results/*.json`` and ``SUMMARY.md``, which is written by hand and
begins the page, and nothing else; writes ``README.md`` beside them. A result that was
not run is named as not run.
"""

import dataclasses
import math
import statistics
from pathlib import Path
from typing import Any

from benchmarks import (
    coverage_summary,
    crash_summary,
    gap_summary,
    paper_tables,
    rivals_summary,
    scaling_summary,
)
from benchmarks._common import RESULTS, markdown_table
from benchmarks.devices import SAME, STEPS
from benchmarks.export import GOAL
from benchmarks.physics import GOALS
from benchmarks.recovery import CASES
from benchmarks.robots import STARTS
from train._command import main, say

FACTORS = (0.25, 0.5, 2, 4)
SUBSTEPS = 4  # physics steps in a control step of Cartpole: 0.02 s of 0.005 s
KNOWN = 0.02  # Cramer-Rao standard deviation below which a parameter must be found


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
    for section in (
        *(
            _speed,
            _physics,
            _robots,
            _own_robot,
            _policies,
            _recovery,
            coverage_summary.section,
            _transfer,
            _real,
            _fuzz,
            _export,
            _devices,
            crash_summary.faults,
            crash_summary.crashes,
            crash_summary.soak,
        ),
        *(gap_summary.generated, gap_summary.real, gap_summary.times, gap_summary.loop),
        *(paper_tables.sections, rivals_summary.section),
        scaling_summary.growth,
    ):
        parts += section(config.results)
    drawings = gap_summary.figures, paper_tables.figures, scaling_summary.figures
    for drawn in drawings:
        for name, text in drawn(config.results).items():
            atomic_write(config.results / name, text)
    path = config.results / "README.md"
    atomic_write(path, "\n\n".join(parts) + "\n")
    say(f"written: {path}")


def _read(folder: Path, name: str) -> Any:
    from easi_jax.io.files import read_json

    path = folder / f"{name}.json"
    return read_json(path) if path.is_file() else None


def _percent(log_ratio: float) -> str:
    return f"{100 * (math.exp(log_ratio) - 1):.1f}"


def _met(ok: bool) -> str:
    return "met" if ok else "**missed**"


def _speed(folder: Path) -> list[str]:
    r = _read(folder, "speed")
    if r is None:
        return ["## Speed", "Not run: `python -m benchmarks.speed`."]
    best, outside = (
        min(r["search"]["search_s"]),
        r["search"]["outside_physics_per_generation_s"],
    )
    done = [s["finished"] for s in r["stress"]]
    compiled = {
        k: f"{v['trace_s']:.0f} + {v['compile_s']:.0f}" for k, v in r["compile"].items()
    }
    size = r.get("config")
    rows = [
        (
            "physics of Cartpole beside native MuJoCo, rollouts of 200 control steps",
            f"{r['ratio']:.2f} times",
            "4",
            _met(r["ratio"] >= 4),
        ),
    ]
    if size:
        steps = math.prod(size[k] for k in ("population", "steps", "generations"))
        rate = SUBSTEPS * steps / min(r["search"]["physics_s"])
        native = statistics.median(r["native_steps_per_s"])
        rows.append(
            (
                "the same inside a search, pieces of one control step",
                f"{rate / native:.2f} times",
            )
        )
    rows += [
        ("search of 50 x 300 x 200 [s]", f"{best:.1f}", "60", _met(best < 60)),
        (
            "a generation outside physics [s]",
            f"{outside:.3f}",
            "0.25",
            _met(outside <= 0.25),
        ),
        ("trace + compile, cold [s]", compiled["cold"], "", ""),
        ("trace + compile, cached [s]", compiled["cached"], "", ""),
        (
            "large batches finished",
            f"{sum(done)} of {len(done)}",
            "all",
            _met(all(done)),
        ),
    ]
    return [
        "## Speed",
        f"`{r['command']}`: Cartpole alone, on 2 cores, float32 beside native float64. "
        "[The next table](#physics-of-every-robot) has another commit's figure for it, "
        "and the other robots; until all are measured anew the lower figure stands.",
        markdown_table(("figure", "measured", "goal", ""), rows),
    ]


def _physics(folder: Path) -> list[str]:
    """Physics steps per second of every robot, and ways to run a step."""
    import numpy as np

    title = "## Physics of every robot"
    found = {name: _read(folder, f"physics_{name}") for name in GOALS}
    if not any(found.values()):
        return [title, "Not run (`python -m benchmarks.physics`)."]
    rows, tried = [], []
    for name, result in found.items():
        if result is None:
            rows.append((name, "not run"))
            continue
        native = float(np.median(result["native_steps_per_s"]))
        ours = float(np.median(result["search_steps_per_s"]))
        met = "met" if result["ratio"] >= result["ratio_goal"] else "**missed**"
        rows.append(
            (
                name,
                f"{ours:,.0f}",
                f"{native:,.0f}",
                f"{result['ratio']:.2f}",
                f"{result['ratio_goal']:g}, {met}",
                f"{result['compile_s']:.0f} s",
            )
        )
        for label, variant in result["variants"].items():
            rate = float(np.median(variant["steps_per_s"]))
            compiled = f"{variant['compile_s']:.0f} s"
            tried.append((name, label, f"{rate / native:.2f}", compiled))
    return [
        title,
        "`python -m benchmarks.physics`: a population of 300, each a model of its own, "
        "against `mujoco.rollout` on the same cores, float32 beside "
        "its float64; medians, all timings in the "
        "files.",
        markdown_table(
            ("robot", "steps/s", "native", "ratio", "goal", "trace and compile"), rows
        ),
        "Other ways to run a step that were tried (ratio to native):",
        markdown_table(("robot", "step", "ratio", "trace and compile"), tried),
        *_accuracy(folder),
    ]


def _accuracy(folder: Path) -> list[str]:
    """What solver and time step of each robot cost in accuracy."""
    rows, head = [], ()
    for name in GOALS:
        r = _read(folder, f"accuracy_{name}")
        if r is None:
            continue
        head = ("robot", "compared", *(f"{s} % of models" for s in r["percentiles"]))
        used = f"{r['used']} Newton steps"
        for what, by_time in r["difference"].items():
            label = f"**{what}**, as used" if what == used else what
            rows.append((name, label, *(f"{x:.1e}" for x in by_time[-1])))
    if not rows:
        return []
    return [
        "`python -m benchmarks.accuracy`: largest difference of a position [m, rad] "
        "after 0.2 s of random commands, over random models: Newton steps of the "
        "contact solver against a converged one, and beside it what a quarter of the "
        "time step would change:",
        markdown_table(head, rows),
    ]


SEARCH_GOALS = {"ant_200": 180, "go2_200": 480, "ballbalance_50": 480}  # s
ROBOTS = ("ant", "ballbalance", "go2", "go2_parameters_full")


def _robots(folder: Path) -> list[str]:
    """Searches on the larger robots: time, memory, recovery."""
    import numpy as np

    out = ["## Searches on the other robots"]
    rows = []
    for path in sorted(folder.glob("search_*.json")):
        r = _read(folder, path.stem)
        name = path.stem.removeprefix("search_")
        goal = SEARCH_GOALS.get(name)
        rows.append(
            (
                r["robot"],
                f"{r['generations']} x {r['population']} x {r['steps']}",
                f"{r['search_s']:.0f} s",
                f"{goal} s, {_met(r['search_s'] < goal)}" if goal else "",
                f"{r['trace_and_compile_s']:.0f} s",
                f"{r['peak_gib']:.1f}",
            )
        )
    if rows:
        out.append("`python -m benchmarks.robots --udr RUN --part time`")
        head = (
            *("robot", "generations x individuals x control steps", "search", "goal"),
            *("trace and compile", "peak GiB"),
        )
        out.append(markdown_table(head, rows))
    rows = []
    for path in sorted(folder.glob("memory_*.json")):
        r = _read(folder, path.stem)
        ok = _met(r["peak_gib"] < r["goal_gib"])
        label = r["robot"]
        rows.append((label, r["what"], f"{r['peak_gib']:.1f}", ok))
    if rows:
        out.append(
            "`python -m benchmarks.robots --udr RUN --part memory` (or `--part buffer`)"
        )
        out.append(markdown_table(("robot", "run", "peak GiB", "goal 8"), rows))
    rows, said, missing = [], [], []
    for name in ROBOTS:
        for start in STARTS:
            r = _read(folder, f"robots_{name}_{start}")
            if r is None:
                missing.append(f"{name} {start}")
                continue
            seeds = r["seeds"]
            std = np.median(np.array([s["cramer_rao_std"] for s in seeds], float), 0)
            known = np.flatnonzero(std < KNOWN)
            for method, s in r["summary"].items():
                if not len(known):
                    rows.append((name, start, method, len(seeds), f"0 of {len(std)}"))
                    continue
                middle = np.array(s["median_abs_log_ratio"])[known]
                worst = np.array(s["worst_abs_log_ratio"])[known]
                k = int(np.argmax(worst))
                rows.append(
                    (
                        name,
                        start,
                        method,
                        len(seeds),
                        f"{len(known)} of {len(std)}",
                        f"{_percent(float(np.median(middle)))} %",
                        f"{_percent(float(worst[k]))} % ({r['parameters'][known[k]]})",
                    )
                )
            ranks = sorted({s["rank"] for s in seeds})
            open_ = sorted({d for s in seeds for d in s["undetermined"]})
            said.append(
                f"- {name}, {start}: the data determine "
                f"{' or '.join(map(str, ranks))} of {len(std)} directions"
                + (f"; {'; '.join(open_)}" if open_ else "")
                + "."
            )
    if rows:
        head = (
            *("robot", "start", "method", "seeds", "known to 2 %"),
            *("median error of these", "worst error of these, any seed"),
        )
        out.append(
            "`python -m benchmarks.robots --udr RUN`: `default` is "
            "the search alone, `refine` with the least-squares finish; `high` and "
            "`low` start at 2 to 4 and 0.05 to 0.5 times the truth. What the data can "
            "know to 2 % is read from their Fisher information."
        )
        out += [markdown_table(head, rows), "\n".join(said)]
    if missing:
        out.append(f"Not run: {', '.join(missing)}.")
    return out


def _own_robot(folder: Path) -> list[str]:
    """The README's example of a robot of one's own."""
    r = _read(folder, "own_robot")
    if r is None:
        return []
    errors = [abs(r["found"][k] / r["truth"][k] - 1) for k in r["truth"]]
    held = r["held_out"]
    after = " and ".join(f"{x:.5f}" for x in held["after"]["0"])
    before = " and ".join(f"{x:.3f}" for x in held["before"])
    return [
        "## A robot of one's own",
        f"`{r['command']}`, the README's arm with nothing cached: {r['seconds']:.0f} s "
        f"(goal {r['goal_s']} s, {_met(r['seconds'] < r['goal_s'])}). "
        f"{len(errors)} parameters within {100 * max(errors):.1f} % of the truth; "
        f"held-out error {after} rad, {before} rad in the model as given.",
    ]


def _fuzz(folder: Path) -> list[str]:
    """Hostile and broken files: how many, and what the readers did."""
    r = _read(folder, "fuzz")
    if r is None:
        return ["## Hostile and broken files", "Not run: `python -m benchmarks.fuzz`."]
    columns = ("cases", "refused", "accepted", "failed")
    rows = [
        (x["reader"], *(x[c] for c in columns), f"{1000 * x['slowest_s']:.0f}")
        for x in r["readers"]
    ]
    total = r["total"]
    return [
        "## Hostile and broken files",
        f"`{r['command']}`: {total['cases']} files changed, drawn or written to do "
        f"harm, in {r['seconds']:.0f} s of one core. Each is accepted or refused in "
        "one line; anything else (another exception, a hang, something unpickled or "
        "started, a file read or written elsewhere) is a failure: "
        f"{total['failed']} of them ({_met(total['failed'] == 0)}).",
        markdown_table(("reader", *columns, "slowest [ms]"), rows),
    ]


def _devices(folder: Path) -> list[str]:
    out, head, ok = ["## Same result on other devices"], [], True
    rows: list[tuple[object, ...]] = []
    for path in sorted(folder.glob("devices_*.json")):
        r = _read(folder, path.stem)
        last = {name: steps[-1] for name, steps in r["positions"].items()}
        share = list(next(iter(last.values())))[-1]
        head = [f"{name}, {share}" for name in last]
        told = [f"{r['other_device']} beside {r['device']}"]
        told += [f"{x[share]:.1e}" for x in last.values()]
        worst = (max(r["search_apart_std"]), max(r["refined_apart_std"]))
        rows.append((*told, *(f"{x:.2g}" for x in worst)))
        ok &= max(worst) <= SAME
    if not rows:
        return [*out, "Not run: `python -m benchmarks.devices`."]
    titles = ("", *head, "search [std]", "finish [std]")
    return [
        *out,
        f"`python -m benchmarks.devices`: positions [m, rad] after {STEPS[-1]} control "
        "steps under the same commands, 64 random models of each robot; the results of "
        "a search of the Cartpole and of its finish in their own standard deviations, "
        f"goal {SAME:g}: {_met(ok)}. Largest differences, of positions the percentile "
        "that is named.",
        markdown_table(titles, rows),
    ]


def _export(folder: Path) -> list[str]:
    out, r = ["## Exported policies"], _read(folder, "export")
    if r is None:
        return [*out, "Not run: `python -m benchmarks.export`."]
    rows, most = [], max(c["onnx"] for c in r["cases"])
    for robot in dict.fromkeys(c["robot"] for c in r["cases"]):
        mine = [c for c in r["cases"] if c["robot"] == robot]
        trained = sum("trained" in c["policy"] for c in mine)
        rows.append(
            (
                robot,
                f"{len(mine)} ({trained} trained)",
                f"{max(c['onnx'] for c in mine):.1e}",
                f"{max(c['stablehlo'] for c in mine):.1e}",
                f"{min(c['onnx_us'] for c in mine):.0f}",
            )
        )
    return [
        *out,
        f"`{r['command']}`: largest difference of an action or a command from JAX over "
        f"{r['observations']:,} observations; goal {GOAL:g} for ONNX: "
        f"{_met(most <= GOAL)}.",
        markdown_table(
            ("robot", "policies", "ONNX", "StableHLO", "a call of ONNX [us]"), rows
        ),
    ]


def _policies(folder: Path) -> list[str]:
    """Policies of the larger robots: how long they trained and what they reach."""
    out, rows, speeds = ["## Policies of the other robots"], [], []
    for path in sorted(folder.glob("policies_*.json")):
        r = _read(folder, path.stem)
        for run in r["runs"]:
            goal = r["goal_minutes"]
            rows.append(
                (
                    r["robot"],
                    run["method"],
                    f"{run['algorithm']}, {run['env_steps']:,}",
                    f"{run['minutes']:.0f}",
                    goal or "",
                    ", ".join(f"{x:.1f}" for x in run["returns"].values()),
                )
            )
            if "tracking" in run:
                t = run["tracking"]
                for speed, fallen in zip(t["speed"], t["fallen"], strict=True):
                    speeds.append(
                        (
                            run["method"],
                            *(
                                ("fell" if v is None else f"{v:.2f}")
                                + (f" ({n} fell)" if n and v is not None else "")
                                for v, n in zip(speed, fallen, strict=True)
                            ),
                        )
                    )
                head = ("policy", *(f"{c:g} m/s" for c in t["commands"]))
    if not rows:
        return [*out, "Not run: `python -m benchmarks.policies`."]
    out.append(
        "`python -m benchmarks.policies --runs RUN...`: trained under randomization "
        "(UDR) or in the nominal model (Fixed), return of each seed in the nominal "
        "robot. The curves are in the files."
    )
    columns = ("robot", "trained", "algorithm, steps", "minutes", "allowed", "returns")
    out.append(markdown_table(columns, rows))
    if speeds:
        out += ["Speed of Go2 at forward commands:", markdown_table(head, speeds)]
    return out


def _recovery(folder: Path) -> list[str]:
    import numpy as np

    out = ["## Recovery of known Cartpole parameters"]
    errors, found = [], []
    for name, case in CASES.items():
        r = _read(folder, f"recovery_{name}")
        if r is None:
            out.append(f"Not run: `python -m benchmarks.recovery --cases {name}`.")
            continue
        count = len(r["seeds"])
        for method, s in r["summary"].items():
            one, long = max(s["median_one_step"]), max(s["median_open_loop"])
            goal = case["free"] and not any(case["noise"]) and method != "paper"
            errors.append(
                (
                    name,
                    method,
                    count,
                    f"{100 * one:.2f} %"
                    + (f" ({_met(one <= 0.01)}: 1 %)" if goal else ""),
                    f"{100 * long:.2f} %"
                    + (f" ({_met(long <= 0.03)}: 3 %)" if goal else ""),
                )
            )
        stds = [row["cramer_rao_std"] for row in r["seeds"] if "cramer_rao_std" in row]
        if case["free"] or not stds:
            continue
        std = np.median(np.array(stds, float), 0)
        known = np.flatnonzero(std < KNOWN)
        limit = 0.05 if "start" not in case else 0.10
        for method, s in r["summary"].items():
            middle = np.array(s["median_abs_log_ratio"])[known]
            worst = np.array(s["worst_abs_log_ratio"])[known]
            ok = middle.max() <= np.log1p(limit)
            if "start" not in case:
                ok = ok and worst.max() <= np.log1p(0.15)
            shown = [
                f"{r['parameters'][k]} {_percent(m)} ({_percent(w)})"
                for k, m, w in zip(known, middle, worst, strict=True)
            ]
            found.append(
                (
                    name,
                    method,
                    ", ".join(shown),
                    _met(bool(ok)),
                )
            )
    if errors:
        out.append(
            "Worst channel of the held-out error, median over seeds, as a share of "
            "the motion:"
        )
        head = ("case", "method", "seeds", "one step", "open loop 0.2 s")
        out.append(markdown_table(head, errors))
    if found:
        out.append(
            "Parameters whose Cramer-Rao standard deviation is below 2 %: error in %, "
            "median (worst) over seeds. Goal: 5 (15), from starts that exclude the "
            "truth 10 in the median."
        )
        out.append(markdown_table(("case", "method", "parameters", ""), found))
    return out


def _transfer(folder: Path) -> list[str]:
    out, rows = ["## Transfer: return in a target unlike the model"], []
    for factor in FACTORS:
        names = [f"transfer_kp_x{factor:g}"]
        names += sorted(p.stem for p in folder.glob(f"{names[0]}_joint*.json"))
        others = [f"transfer_{robot}_x{factor:g}" for robot in ROBOTS]
        names += [n for n in others if (folder / f"{n}.json").is_file()]
        for name in names:
            r = _read(folder, name)
            if r is None:
                out.append(
                    f"Not run: `python -m benchmarks.transfer --factors {factor:g}`."
                )
                continue
            mean = {m: sum(v.values()) / len(v) for m, v in r["returns"].items()}
            gap, (low, high) = r["oracle_minus_udr"], r["share_95"]
            verdict = _met(r["share_of_gap"] >= 0.9) if r["goal_applies"] else "no gap"
            rows.append(
                (
                    name.removeprefix("transfer_"),
                    len(next(iter(r["returns"].values()))),
                    *(f"{mean[m]:.1f}" for m in ("UDR", "EASI", "Oracle")),
                    f"{gap['mean']:.1f} +- {gap['standard_error']:.1f}",
                    f"{r['share_of_gap']:.2f} [{low:.2f}, {high:.2f}]",
                    verdict,
                )
            )
    if rows:
        head = (
            "target",
            "seeds",
            "UDR",
            "EASI",
            "Oracle",
            "Oracle - UDR",
            "share closed",
            "goal 0.9",
        )
        out.append(markdown_table(head, rows))
    for robot in ROBOTS[:3]:
        if not any(str(row[0]).startswith(robot) for row in rows):
            out.append(f"Not run: `python -m benchmarks.transfer --robot {robot}`.")
    if any("_joint" in str(row[0]) for row in rows):
        out.append(
            "`_jointN`: the policy goes on training inside the search, N steps of all "
            "environments a generation, which are taken off the final training."
        )
    return out


def _real(folder: Path) -> list[str]:
    r = _read(folder, "real_cartpole")
    if r is None:
        return ["## Real cart-pole", "Not run: `python -m benchmarks.real_cartpole`."]
    rows = [
        (
            measure,
            name,
            joint,
            f"{row['nominal'][joint]:.4f}",
            f"{x:.4f}",
            *(f"{v[joint]:.4f}" for v in [row.get("fitted_to_itself")] if v),
        )
        for measure, sets in r["measures"].items()
        for name, row in sets.items()
        for joint, x in row["identified_median"].items()
    ]
    out = [
        "## Real cart-pole",
        f"`{r['command']}`: {r['measure']} (m, rad), median over seeds.",
    ]
    out.append(
        markdown_table(
            (
                "measure",
                "recordings",
                "joint",
                "nominal",
                "identified",
                "fitted to itself",
            ),
            rows,
        )
    )
    out.append(
        "Fitted to itself: the best these parameters can do, fitted to the recordings "
        "that they are measured on."
    )
    out += [f"{measure}: {verdict}." for measure, verdict in r["verdicts"].items()]
    return out


if __name__ == "__main__":
    main(Config, run, name="benchmarks.summary")
