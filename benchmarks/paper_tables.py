"""The paper's tables and figures from the cells that were run, as Markdown and SVG.

Cells that were not run are shown as not run; trials with fewer steps than the robot's
preset (``--env-steps``) are left out.
"""

from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from itertools import product
from pathlib import Path
from statistics import mean, median, stdev
from typing import Any

from benchmarks import paper_matrix
from benchmarks._cells import read_rows
from benchmarks._common import markdown_table
from benchmarks._page import Named, Section, each_of, met, named, table, those
from benchmarks.paper_cells import IMITATING, METHODS, WARM
from benchmarks.paper_experiments import (
    CHANGED,
    MUST,
    ON_HARDWARE,
    SEARCHES,
    STARTS,
    robots,
)
from benchmarks.paper_runtime import WAYS
from benchmarks.paper_twin import TWIN
from benchmarks.twin_measures import COMMANDS, EPISODES, TRACKED

_FILE = "paper.jsonl"
FLAT = 3.0  # times the best setting's error: no setting of the default is worse
OURS = "EASI default"
GOAL = 0.9  # share of the way from UDR to Oracle
# What the paper states (Tables 1 and 3), of another simulator: places and shares
# compare, not values.
PUBLISHED: dict[str, dict[str, str]] = {
    target: dict(zip(("UDR", "FineTune", "GARAT", "EASI"), told, strict=True))
    for target, told in {
        "cart_kp*0.25": ("116.8 ± 13.0", "135.1 ± 7.8", "144.4 ± 1.2", "164.4 ± 4.6"),
        "cart_kp*0.5": ("157.0 ± 10.5", "171.2 ± 8.4", "161.6 ± 4.5", "182.9 ± 2.2"),
        "torso_mass*0.25": (
            *("588.9 ± 65.9", "590.2 ± 18.6", "327.7 ± 15.9", "780.7 ± 41.5"),
        ),
        "torso_mass*0.5": (
            *("596.4 ± 52.3", "640.8 ± 30.0", "228.4 ± 19.2", "777.4 ± 37.5"),
        ),
    }.items()
}
_BY_COUNT = {
    "cartpole": (
        *("161.3 ± 15.3", "185.1 ± 3.1", "182.7 ± 2.7", "181.1 ± 4.4", "182.9 ± 4.3"),
    ),
    "ant": (
        *("557.4 ± 55.6", "724.2 ± 7.5", "747.0 ± 25.0", "703.1 ± 63.1"),
        "724.0 ± 31.5",
    ),
    "ballbalance": (
        *("226.9 ± 61.7", "360.1 ± 53.8", "421.3 ± 26.1", "428.5 ± 16.9"),
        "393.1 ± 60.5",
    ),
}
# Two a robot, as in the paper's Fig. 4: those that demonstrations determine best.
SHOWN = {
    "cartpole": ("cart_kp", "pole_armature"),
    "ant": ("torso_mass", "foot_mass"),
    "ballbalance": ("knee_kp", "ball_mass"),
    **dict.fromkeys(("go2", IMITATING), ("thigh_kp", "base_mass")),
}
_NOT_RUN = "not run"
_EXACT = 1e-3  # log ratios below it train the same policy, but for chance
_NO_HARDWARE = (
    "**A twin, not hardware**: MuJoCo C at 0.5 ms with effects that the model lacks "
    "(`benchmarks.twin`) stands for the paper's real"
)
_ERROR = (
    "RMS of the log ratio to the truth along the directions that the demonstrations "
    "determine, as least squares could: of these the discriminator sees the strongest "
    "only, by which the prediction errors of [Recovery]"
    "(#recovery-of-known-cartpole-parameters) fall; the finish, which these searches "
    "are without, finds the others."
)
_LENGTHS = (
    "Oracle and EASI train anew, by as many steps as UDR. FineTune and GARAT go on "
    "from UDR's policy, GARAT by as many steps again: it may pass Oracle where a "
    "training of that length has not settled. With a warm start Oracle and EASI go on "
    "from it, too. It harmed on neither robot, so `train.easi` has it by default (not "
    "with the preset paper)."
)

Row = dict[str, Any]


def figures(folder: Path) -> dict[str, str]:
    """Pictures by file name."""
    drawn = _drawn(whole(read_rows(folder / _FILE)))
    return {name: text for of in drawn.values() for name, text in of.items()}


def _drawn(rows: Sequence[Row]) -> Named:
    """Pictures by experiment and file name."""
    out = Named()
    plain = [r for r in rows if not r["options"]]
    for figure, draw in (
        ("fig4", _drawn_fig4),
        ("fig5", _drawn_fig5),
        ("fig6", _drawn_fig6),
    ):
        texts = {x: draw([r for r in plain if r["robot"] == x]) for x in CHANGED}
        out[figure] = {f"paper_{figure}_{x}.svg": t for x, t in texts.items() if t}
    texts = {x: _drawn_fig7(x, rows) for x in robots("fig7")}
    out["fig7"] = {f"paper_fig7_{x}.svg": t for x, t in texts.items() if t}
    text = _drawn_appendix_a(rows)
    out["appendix_a"] = {"paper_appendix_a.svg": text} if text else {}
    return out


def _shown(found: dict[str, dict[str, str]]) -> list[str]:
    names = sorted(name for of in found.values() for name in of)
    return [f"![{_title(name)}]({name})" for name in names]


def whole(rows: Iterable[Row]) -> list[Row]:
    """Rows of whole trainings, not of trials."""
    return [r for r in rows if r["env_steps"] is None]


def _title(name: str) -> str:
    words = name.removeprefix("paper_").removesuffix(".svg").split("_")
    return {
        "fig4": "Parameters by generation, as ratios to the truth (Fig. 4)",
        "fig5": "Return in the target by training step (Fig. 5)",
        "fig6": "Return by what the target's parameter is multiplied with (Fig. 6)",
        "fig7": "Joint motion at 1.4 m/s, and speed by command, in a twin and not on "
        "hardware (Fig. 7)",
        "appendix": "25 parameters of Go2 (Appendix A)",
    }[words[0]] + (f": {words[-1]}" if words[0] != "appendix" else "")


def returns(
    rows: Sequence[Row], robot: str, target: str, trajectories: int = 200
) -> dict[str, dict[int, float]]:
    """Return by method and seed."""
    out: dict[str, dict[int, float]] = defaultdict(dict)
    for r in rows:
        where = (r["robot"], r["target"], r["trajectories"])
        plain = "return" in r and not r["settings"] and r["method"] in METHODS
        if plain and where == (robot, target, trajectories):
            out[r["method"]][r["seed"]] = r["return"]
    return out


def told(values: Sequence[float], digits: int = 1) -> str:
    """Mean and standard deviation over seeds, and every seed."""
    if not values:
        return _NOT_RUN
    each = each_of(values, digits)
    if len(values) == 1:
        return each
    return f"{mean(values):.{digits}f} ± {stdev(values):.{digits}f} ({each})"


def share(of: dict[int, float], udr: dict[int, float], best: dict[int, float]) -> str:
    """Of the way from UDR to Oracle, seeds that all three have."""
    seeds = sorted(of.keys() & udr.keys() & best.keys())
    way = sum(best[s] - udr[s] for s in seeds)
    if not seeds or way <= 0:
        return ""
    return f"{sum(of[s] - udr[s] for s in seeds) / way:.2f}"


def _in_targets(robot: str, rows: Sequence[Row]) -> list[Row]:
    """Rows of a robot, some of which are trainings for its targets of Table 1."""
    mine = [r for r in rows if r["robot"] == robot]
    return mine if any(_by_target(robot, mine).values()) else []


def _by_target(
    robot: str, rows: Sequence[Row]
) -> dict[float, dict[str, dict[int, float]]]:
    """Return by factor on the changed parameter, method and seed."""
    return {x: returns(rows, robot, f"{CHANGED[robot]}*{x:g}") for x in (0.25, 0.5)}


def _table1(robot: str, rows: Sequence[Row]) -> list[str]:
    lines = []
    by_target = _by_target(robot, rows)
    others = [m for m in METHODS if any(m in found for found in by_target.values())]
    for method in dict.fromkeys((*MUST, *others)):
        cells: list[str] = []
        for factor, found in by_target.items():
            mine = found.get(method, {})
            cells.append(told([mine[s] for s in sorted(mine)]))
            ends = (found.get("UDR", {}), found.get("Oracle", {}))
            cells.append(_judged(method, share(mine, *ends)))
            stated = PUBLISHED.get(f"{CHANGED[robot]}*{factor:g}", {})
            theirs = "EASI" if method == SEARCHES[0] else method
            cells.append(stated.get(theirs, ""))
        lines.append((named(method, rows), *cells))
    name = CHANGED[robot]
    head = (
        *("method", f"{name}*0.25", "share", "published"),
        *(f"{name}*0.5", "share", "published"),
    )
    return [
        f"{robot}: mean ± standard deviation (every seed); share of the way from "
        f"UDR to Oracle, goal of EASI default {GOAL}; published are the paper's, "
        "in another simulator:",
        markdown_table(head, lines),
        *_first(robot, by_target, rows),
        *_other_recipe(robot, rows),
    ]


def _other_recipe(robot: str, rows: Sequence[Row]) -> list[str]:
    """Cells of the paper's recipe that are older than that the preset knows robots."""
    from train._robots import search_config

    theirs = search_config("paper", (), robot).discriminator_updates
    before = search_config("paper", ()).discriminator_updates
    mine = [
        r["target"]
        for r in rows
        if r["robot"] == robot
        and r["method"] == SEARCHES[0]
        and r["policy"]
        and not r["settings"]
        and r.get("discriminator_updates", before) != theirs
    ]
    if not mine:
        return []
    return [
        f"{SEARCHES[0]} ran with {before} discriminator steps a generation in "
        f"{len(mine)} cells here; the reference has {theirs} for {robot}."
    ]


def _judged(method: str, share: str) -> str:
    if method != OURS or not share:
        return share
    return f"{share}, {met(float(share) >= GOAL)}"


def _first(
    robot: str, by_target: dict[float, dict[str, dict[int, float]]], rows: Sequence[Row]
) -> list[str]:
    """Whether EASI is ahead of all that do not train in the target, as it should be."""
    said = []
    for factor, found in by_target.items():
        target = f"{CHANGED[robot]}*{factor:g}"
        rivals = {m: v for m, v in found.items() if m not in ("Oracle", OURS, *WARM)}
        if OURS not in found or len(rivals) < 2:
            continue
        place = _place(OURS, found, rivals)
        off = [
            abs(x)
            for r in rows
            if (r["robot"], r["target"], r["trajectories"]) == (robot, target, 200)
            and r["method"] == OURS
            and not (r["settings"] or r["curves"])
            for x in r.get("log_ratio", ())
        ]
        if off and max(off) < _EXACT:
            place += (
                "; its parameters are the truth's in every seed (largest log ratio "
                f"{max(off):.0e}): it trains where Oracle does, and what is between it "
                "and Oracle is a training's chance"
            )
        if WARM[1] in found:
            place += f". {_place(WARM[1], found, rivals)}"
        said.append(f"- {target}: {place}")
    return ["\n".join(said)] if said else []


def _place(
    ours: str, found: dict[str, dict[int, float]], rivals: dict[str, dict[int, float]]
) -> str:
    first = max(rivals, key=lambda m: mean(rivals[m].values()))
    if mean(rivals[first].values()) > mean(found[ours].values()):
        return f"**{first} ahead of {ours}**{_by(rivals[first], found[ours])}"
    by = _by(found[ours], rivals[first])
    return f"{ours} first beside Oracle" + (f", ahead of {first}{by}" if by else "")


def _by(first: dict[int, float], second: dict[int, float]) -> str:
    """By how much on the seeds that both have, and how sure that is."""
    ahead = [first[s] - second[s] for s in first.keys() & second.keys()]
    if len(ahead) < 2:
        return ""
    error = stdev(ahead) / len(ahead) ** 0.5
    return f" by {mean(ahead):.1f} (standard error {error:.1f}, same seeds)"


def _table2(found: dict[str, list[Row]]) -> list[str]:
    columns = {
        "method": lambda m: m[0],
        "pole angle [0.01 rad]": lambda m: _of(m[1], lambda r: r["angle_error"], 2),
        "cart speed [0.1 m/s]": lambda m: _of(m[1], lambda r: r["speed"], 2),
        "return": lambda m: _of(m[1], lambda r: r["return"], 1),
        "fell": lambda m: f"{sum(r['fallen'] for r in m[1])} of {EPISODES * len(m[1])}",
    }
    return [
        f"{_NO_HARDWARE} cart-pole; 50 logged episodes. Mean sizes until a fall; mean "
        "± standard deviation (every seed). Published, on hardware: pole 2.65 ± 0.19 "
        "and cart 1.63 ± 0.03 for UDR, 1.67 ± 0.16 and 1.21 ± 0.08 for EASI.",
        table(found.items(), columns),
    ]


def _of(rows: Sequence[Row], value: Callable[[Row], Any], digits: int) -> str:
    """A value over seeds, without those that have none."""
    return told([v for v in map(value, rows) if v is not None], digits)


def in_twin(robot: str, rows: Sequence[Row]) -> dict[str, list[Row]]:
    """Rows by method, in the order of seeds."""
    mine = [r for r in rows if (r["robot"], r["target"]) == (robot, TWIN)]
    mine.sort(key=lambda r: r["seed"])
    found = {m: [r for r in mine if r["method"] == m] for m in ON_HARDWARE}
    return {m: f for m, f in found.items() if f}


def _fig7(robot: str, found: dict[str, list[Row]]) -> list[str]:
    def speed(rows: Sequence[Row]) -> str:
        speeds = [v for r in rows for v in r["speed"]]
        left = sum(v is not None for v in speeds)
        at = f", at {left} of {len(speeds)} commands" if left < len(speeds) else ""
        return _of(rows, lambda r: r["tracking_error"], 3) + at

    columns = {
        "method": lambda m: m[0],
        "joint motion, simulated from logged [dB]": lambda m: _of(
            m[1], lambda r: r["spectrum"]["distance_db"], 2
        ),
        "speed from command [m/s]": lambda m: speed(m[1]),
        "return": lambda m: _of(m[1], lambda r: r["return"], 1),
        "fell": lambda m: (
            f"{sum(sum(r['fallen']) for r in m[1])} of "
            f"{len(m[1]) * len(COMMANDS) * TRACKED[0]}"
        ),
    }
    return [
        f"{_NO_HARDWARE} Go2 ({_CONTROLLERS[robot]}); one log of 40 s at 1.4 m/s. The "
        "UDR policy's joint motion in the simulation as given (UDR) or as identified "
        "(EASI), against that in the twin, RMS over 0.25 to 10 Hz; speeds are of each "
        "method's own policy, at commands at which it does not fall.",
        table(found.items(), columns),
    ]


_CONTROLLERS = {
    "go2": "its controller is PPO with hand-made rewards",
    IMITATING: "its controller is the paper's, Ess-InfoGAIL",
}


def _drawn_fig7(robot: str, rows: Sequence[Row]) -> str:
    from benchmarks.paper_figures import motion_and_speed

    mine = in_twin(robot, rows)
    first = {m: found[0] for m, found in mine.items()}
    if "UDR" not in first or first["UDR"]["spectrum"]["twin"] is None:
        return ""
    before = first["UDR"]["spectrum"]
    shown = {m: "UDR, simulation as given" if m == "UDR" else m for m in mine}
    density = {
        joint: {
            "twin": before["twin"][joint],
            **{
                shown[m]: r["spectrum"]["simulation"][joint]
                for m, r in first.items()
                if r["spectrum"]["simulation"] is not None
            },
        }
        for joint in before["twin"]
    }
    speed = {shown[m]: [r["speed"] for r in found] for m, found in mine.items()}
    return motion_and_speed(before["frequency"], density, COMMANDS, speed)


def _by_count(rows: Sequence[Row]) -> Named:
    """Rows of each robot; none without a training by less demonstrations than all."""
    found = Named()
    for robot, changed in CHANGED.items():
        counts = [returns(rows, robot, f"{changed}*0.5", n) for n in (1, 50, 100)]
        some = any(OURS in c for c in counts)
        found[robot] = [r for r in rows if r["robot"] == robot] if some else []
    return found


def _table3(found: dict[str, list[Row]]) -> list[str]:
    lines, mixed, shares = [], [], []
    for robot, rows in found.items():
        target = f"{CHANGED[robot]}*0.5"
        full = returns(rows, robot, target)
        udr, oracle = (full.get(m, {}) for m in ("UDR", "Oracle"))
        by_count = {
            n: returns(rows, robot, target, n).get(OURS, {}) for n in (1, 50, 100, 200)
        }
        cells = [told([m[s] for s in sorted(m)]) for m in (udr, *by_count.values())]
        lines.append((f"{robot}, {target}", *cells))
        if robot in _BY_COUNT:
            lines.append((f"{robot}, published", *_BY_COUNT[robot]))
        mixed += _mixed(rows, robot)
        if robot == "cartpole":
            shares = [share(by_count[n], udr, oracle) for n in (1, 200)]
    head = ("target", "UDR", "1", "50", "100", "200")
    out = [markdown_table(head, lines), *mixed]
    if shares and all(shares):
        out.append(
            f"With one demonstration, {OURS} goes {shares[0]} of Cartpole's way from "
            f"UDR to Oracle, with 200 {shares[1]}."
        )
    return out


def _mixed(rows: Sequence[Row], robot: str) -> list[str]:
    """That demonstrations came from more than one training of UDR."""
    target, columns = f"{CHANGED[robot]}*0.5", defaultdict[str, set[int]](set)
    for r in rows:
        mine = (r["robot"], r["target"], r["method"]) == (robot, target, OURS)
        if mine and r["policy"] and not (r["settings"] or r["curves"]):
            columns[r.get("udr") or paper_matrix.device(r)].add(r["trajectories"])
    if len(columns) < 2:
        return []
    told = "; ".join(
        f"{', '.join(map(str, sorted(counts)))} on {kind}"
        for kind, counts in sorted(columns.items())
    )
    return [f"{robot}, demonstrations by machine, each with UDR of its own: {told}."]


def with_setting(name: str, rows: Sequence[Row]) -> list[Row]:
    """Searches in which a setting was changed, each with its ``value``."""
    return [
        {**r, "value": float(word.partition("=")[2])}
        for r in sorted(rows, key=lambda r: r["seed"])
        for word in r["settings"]
        if word.startswith(f"{name}=") and r["method"] in SEARCHES
    ]


def _table4(rows: Sequence[Row]) -> list[str]:
    return [
        *_swept(rows),
        "Weights of the better half alone are above zero "
        "(`easi_jax.search.evolution.recombination_weights`); EASI default leaves the "
        "others out, so that from μ/λ = 0.5 on it is the same search.",
    ]


def _swept(rows: Sequence[Row]) -> list[str]:
    lines = []
    for robot, method in product(CHANGED, SEARCHES):
        mine = [r for r in rows if (r["robot"], r["method"]) == (robot, method)]
        if not mine:
            continue
        errors: dict[float, list[float]] = defaultdict(list)
        for r in mine:
            errors[r["value"]].append(r["error"])
        middle = [median(e) for e in errors.values()]
        ratio = max(middle) / min(middle)
        verdict = f"{ratio:.1f}"
        if method != SEARCHES[0]:
            verdict += f", {met(ratio <= FLAT)}"
        cells = "; ".join(f"{v:g}: {_middle(errors[v])}" for v in sorted(errors))
        begun = [r["start_error"] for r in mine if "start_error" in r]
        start = f"{median(begun):.3f}" if begun else ""
        lines.append((robot, method, start, cells, verdict))
    goal = f"worst/best (goal {FLAT:g})"
    head = ("robot", "search", "start", "median error (every seed)", goal)
    return [
        f"{_ERROR} `start`: of the middle of where the search starts.",
        markdown_table(head, lines),
    ]


def _fig4(rows: Sequence[Row]) -> list[str]:
    """What the pictures of Fig. 4 end with."""
    lines = [
        (robot, *line)
        for robot in CHANGED
        for line in _by_start([r for r in rows if r["robot"] == robot])
    ]
    return [
        f"{_ERROR} Median (every seed), and after it of the middle of where the search "
        "starts. From UDR's range, the target has one value halved (a target in the "
        "middle of the range would be found before the search); from the others, whose "
        "factors are on its values, none: there forces and masses start off by one "
        "factor, of which motion says nothing.",
        markdown_table(("robot", "search", *map(_from, STARTS)), lines),
    ]


def _appendix_a(rows: Sequence[Row]) -> list[str]:
    """What its picture ends with."""
    return [
        "As Fig. 4; the target has one leg's thigh drive at half its stiffness.",
        markdown_table(("search", *map(_from, STARTS)), _by_start(rows)),
    ]


def _by_start(rows: Sequence[Row]) -> list[tuple[str, ...]]:
    """Errors of each search by its start, seeds in order; none that was not run."""
    rows = sorted(rows, key=lambda r: r["seed"])
    lines = []
    for method in SEARCHES:
        mine = [r for r in rows if r["method"] == method]
        cells = [_from_start([r for r in mine if start_of(r) == s]) for s in STARTS]
        if mine:
            lines.append((method, *cells))
    return lines


def _traced(row: Row) -> bool:
    return "trace" in row and not row["policy"] and not row["options"]


def _middle(errors: Sequence[float]) -> str:
    """Median, and every seed."""
    return f"{median(errors):.3f} ({each_of(errors, 3)})"


def _from_start(rows: Sequence[Row]) -> str:
    if not rows:
        return _NOT_RUN
    errors = [r["error"] for r in rows]
    text = _middle(errors)
    begun = [r["start_error"] for r in rows if "start_error" in r]
    return f"{text}; {median(begun):.3f}" if begun else text


def _runtime(rows: Sequence[Row]) -> list[str]:
    columns = {
        "chain": "{robot}, seed {seed}",
        "as": "{method}",
        "seconds in all": "{seconds:.0f}",
        "of them compiling": "{compile_s:.0f}",
        "programs compiled": "{programs}",
        "transfers to the host": lambda r: (
            f"{r['transfers']} ({r['bytes'] / 1e6:.1f} MB)"
        ),
        "return": "{return:.1f}",
    }
    both: dict[tuple[str, int], dict[str, Row]] = defaultdict(dict)
    for r in rows:
        both[r["robot"], r["seed"]][r["method"]] = r
    pairs = [[b[w] for w in WAYS] for b in both.values() if len(b) == len(WAYS)]
    paired = []
    if pairs:
        times, moved = (
            median(one[k] / other[k] for one, other in pairs)
            for k in ("seconds", "bytes")
        )
        paired.append(
            f"In one program it takes {times:.2f} times as long and moves "
            f"{moved:.2g} times the bytes (medians of {len(pairs)} seeds). The "
            "programs compiled beside it are small ones, which prepare and report."
        )
    return [table(rows, columns), *paired]


def _drawn_fig4(rows: Sequence[Row]) -> str:
    from benchmarks.paper_figures import ratios_by_generation

    traced = [r for r in rows if _traced(r)]
    if not traced:
        return ""
    names = traced[0]["parameters"]
    shown = SHOWN[traced[0]["robot"]]
    panels = {}
    for name in shown:
        for start in STARTS:
            mine = [r for r in traced if start_of(r) == start]
            panels[f"{name}, {_from(start)}"] = {
                m: [_column(r, names.index(name)) for r in mine if r["method"] == m]
                for m in SEARCHES
            }
    return ratios_by_generation(panels, columns=len(STARTS))


def start_of(row: Row) -> tuple[float, float] | None:
    return None if row["start"] is None else tuple(row["start"])


def _from(start: tuple[float, float] | None) -> str:
    return "from UDR's range" if start is None else f"from {start[0]:g} to {start[1]:g}"


def _column(row: Row, i: int) -> list[list[float]]:
    return [[g[i] for g in side] for side in row["trace"]]


def _drawn_fig5(rows: Sequence[Row]) -> str:
    from easi_jax.io.report.figures import returns_by_step

    found: dict[str, list[list[list[float]]]] = defaultdict(list)
    for r in rows:
        if r["curves"] and r["policy"] and "curve" in r:
            found[r["method"]].append(r["curve"])
    curves = {
        m: (c[0][0], list(zip(*(returns for _, returns in c), strict=True)))
        for m, c in found.items()
    }
    return returns_by_step(curves) if curves else ""


def _drawn_fig6(rows: Sequence[Row]) -> str:
    from benchmarks.paper_figures import returns_by_factor

    if not rows:
        return ""
    robot = rows[0]["robot"]
    found: dict[str, dict[float, list[float]]] = {}
    for x in (0.25, 0.5, 2.0, 4.0):
        by_method = returns(rows, robot, f"{CHANGED[robot]}*{x:g}")
        for m in ("UDR", "EASI default", "Oracle"):
            if m in by_method:
                found.setdefault(m, {})[x] = list(by_method[m].values())
    # A line needs more than what table 1 runs.
    if all(x < 1 for by_factor in found.values() for x in by_factor):
        return ""
    return returns_by_factor(found, f"factor on {CHANGED[robot]}")


def _drawn_appendix_a(rows: Sequence[Row]) -> str:
    import numpy as np

    from benchmarks.paper_figures import ratios_by_generation

    traced = [r for r in rows if r["options"] and "trace" in r]
    if not traced:
        return ""

    def typical(row: Row) -> list[list[float]]:
        off = np.abs(np.log(np.maximum(np.array(row["trace"][0]), 1e-3)))
        return [np.exp(np.quantile(off, q, axis=1)).tolist() for q in (0.5, 0.25, 0.75)]

    panels = {
        f"factor off, {_from(start)}": {
            m: [typical(r) for r in traced if r["method"] == m and start_of(r) == start]
            for m in SEARCHES
        }
        for start in STARTS
    }
    return ratios_by_generation(panels, columns=len(STARTS), whole=True)


def _part(
    title: str,
    command: str,
    body: Callable[[Any], list[str]],
    of: Callable[[list[Row]], Any] = list,
) -> Section:
    """A section of whole trainings."""
    return Section(title, _FILE, f"paper {command}", body, lambda rows: of(whole(rows)))


_TITLE = "## The paper's tables and figures\n\n### What was run"
_TITLE5 = "### Table 5: parameter error by discriminator updates"
_TITLE4 = "### Fig. 4: parameter error after the search, by where it starts"
_TITLE_A = "### Appendix A: error of Go2's 25 parameters, by where the search starts"
_TITLE_TIME = "### Run time: one program beside separate programs"
_RATIO, _UPDATES = (
    partial(with_setting, name) for name in ("elite_ratio", "discriminator_updates")
)
SECTIONS = (
    _part(_TITLE, "table1", paper_matrix.paragraphs),
    _part("### Table 1: return in the target", "table1", lambda _: [_LENGTHS]),
    *(
        _part("", f"table1 --robot {x}", partial(_table1, x), partial(_in_targets, x))
        for x in CHANGED
    ),
    _part(
        *("### Table 2: balancing in a twin", "table2", _table2),
        partial(in_twin, "cartpole"),
    ),
    _part(
        "### Table 3: return by number of demonstrations",
        *("table3 --robot {name}", _table3, _by_count),
    ),
    _part("### Table 4: parameter error by μ/λ", "table4", _table4, _RATIO),
    _part(_TITLE5, "table5", _swept, _UPDATES),
    _part(_TITLE4, "fig4", _fig4, those(_traced)),
    *(
        _part(
            *("" if i else "### Fig. 7: walking in a twin", f"fig7 --robot {x}"),
            *(partial(_fig7, x), partial(in_twin, x)),
        )
        for i, x in enumerate(robots("fig7"))
    ),
    _part(_TITLE_A, "appendix_a", _appendix_a, those(lambda r: r["options"])),
    _part(_TITLE_TIME, "runtime", _runtime, those(lambda r: r["method"] in WAYS)),
    _part("", "{name}", _shown, _drawn),
)
