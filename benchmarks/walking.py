"""A walking Go2 that logs its joints and an inertial unit, and no base.

    python -m train.udr --robot go2 --option parameters=real --out results/go2_udr
    python -m benchmarks.walking

The policy walks for 40 s at 1.4 m/s in a robot that nobody knows, seven parameters and
how late commands come are searched, and each answer is a line of
``results/walking.jsonl``:

- joints and IMU: ``train.easi --data LOG --policy RUN``; the log has no base.
- with base pose: ``train.easi --data LOG``, paired; the log has the base's pose, too.
- paper preset: the reference's recipe, with the base's pose.
- the range of UDR: what knowing nothing is.

The robot is one of the model's own laws (parameters and delay drawn by seed), or the
twin of `benchmarks.twin`, which has friction, motors, contact and mass that the model
lacks, so that no parameters are right there: what the twin's constants make of gains
and mass is compared.
"""

import dataclasses
import json
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks._cells import Share, run_cells
from benchmarks._common import RESULTS, commits_of, markdown_table
from benchmarks._page import Section
from benchmarks.paper_twin import COMMAND, LOGGED, walked
from train._command import main

IMU, BASE, PAPER, UDR = "joints and IMU", "with base pose", "paper preset", "UDR range"
METHODS = (IMU, BASE, PAPER, UDR)
MACHINES = ("same laws", "twin")
OBSERVED = (f"command.forward={COMMAND}", "command.sideways=0", "command.turn=0")
_FACTOR = 1.6  # that parameters of the same laws may differ by
_STEP = 0.004  # s, of delays there: the model's own timestep
_DELAY = "{{effect: actuator_delay, at: {at}, kind: actuator, columns: {{delay: 0.01}}"
_BASE_JOINT = "root"


@dataclasses.dataclass(frozen=True)
class Cell:
    """A log and a method."""

    machine: str
    method: str
    seed: int

    @property
    def key(self) -> str:
        """All of it, for files."""
        return f"{self.machine}, {self.method}, {self.seed}"


@dataclasses.dataclass(frozen=True)
class Config(Share):
    """Identifies a walking Go2 from what it logs of itself."""

    udr: Path = Path("results/go2_udr")
    """Run folder of train.udr, whose policy walks."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Of machines, logs and searches."""
    out: Path = dataclasses.field(default=RESULTS / "walking.jsonl", kw_only=True)
    """Where a line for each is added."""


def run(config: Config) -> None:
    """Runs the cells, the commands of a user first."""
    cells = [
        Cell(machine, method, seed)
        for method in METHODS
        for machine in MACHINES
        for seed in config.seeds
    ]
    run_cells(cells, config, lambda cell: solve(cell, config.udr), told)


def told(row: dict[str, Any]) -> str:
    """A line on an answer."""
    off = row["error"]
    return f"{off:.3f} of a log ratio, {row['seconds']:.0f} s"


# -- machines and logs ---------------------------------------------------------------


def machine_of(cell: Cell, env: Any) -> tuple[Any, dict[str, float]]:
    """The robot that walks, and what is true of it: parameters, and ``delay`` [s]."""
    import mujoco

    from benchmarks.twin import GO2, Gap, Twin

    nominal = dict(zip(env.space.names, np.asarray(env.space.nominal), strict=True))
    if cell.machine == "twin":
        truth = dict(nominal)
        for joint, gain, viscous in zip(
            ("hip", "thigh", "calf"),
            np.asarray(GO2.gain)[:3],
            np.asarray(GO2.viscous)[:3],
            strict=True,
        ):
            truth[f"{joint}_kp"] *= gain
            truth[f"{joint}_kv"] = truth[f"{joint}_kv"] * gain + viscous
        truth["base_mass"] += 1.0
        return Twin(env, GO2), truth | {"delay": GO2.delay}
    rng = np.random.default_rng([11, cell.seed])
    names = list(nominal)
    factor = _FACTOR ** rng.uniform(-1, 1, len(names))
    truth = {n: float(nominal[n] * f) for n, f in zip(names, factor, strict=True)}
    delay = _STEP * int(rng.integers(0, 5))

    def change(m: mujoco.MjModel) -> None:
        for k, joint in enumerate(("hip", "thigh", "calf")):
            kp, kv = truth[f"{joint}_kp"], truth[f"{joint}_kv"]
            m.actuator_gainprm[k::3, 0], m.actuator_biasprm[k::3, 1] = kp, -kp
            m.actuator_biasprm[k::3, 2] = -kv
        base = m.body("base").id
        m.body_inertia[base] *= truth["base_mass"] / m.body_mass[base]
        m.body_mass[base] = truth["base_mass"]

    gap = Gap(timestep=_STEP, delay=delay, change=change, noise=GO2.noise)
    return Twin(env, gap), truth | {"delay": delay}


def logs_of(cell: Cell, env: Any, policy: Any, folder: Path) -> tuple[Path, Path, Any]:
    """Logs with and without the base, and recordings; ``folder`` holds the logs."""
    from easi_jax.io.logs.reader import write_log

    twin = machine_of(cell, env)[0]
    recordings = walked(twin, policy, cell.seed)
    runs = [run for recording in recordings for run in recording.runs(twin)]
    runs = [
        # The unit sits square on the base: what it reads is the base's own.
        dataclasses.replace(
            run,
            name=str(i),
            sensors={"gyro": run.qvel[:, 3:6], "orientation": run.qpos[:, 3:7]},
        )
        for i, run in enumerate(runs)
        if len(run) > 1
    ]
    whole, alone = folder / "whole.csv", folder / "alone.csv"
    write_log(whole, env.mj_model, runs)
    rows = [line.split(",") for line in whole.read_text().splitlines()]
    kept = [i for i, name in enumerate(rows[0]) if f".{_BASE_JOINT}." not in name]
    alone.write_text("\n".join(",".join(row[i] for i in kept) for row in rows) + "\n")
    return whole, alone, recordings


# -- answers -------------------------------------------------------------------------


def solve(cell: Cell, udr: Path) -> dict[str, Any]:
    """What a method finds, and how far that is from the truth."""
    import jax

    from benchmarks.paper_twin import walker
    from train._robots import load_policies

    env = walker()
    known = load_policies(udr)
    policy = jax.tree.map(lambda x: x[0], known["policies"])
    truth = machine_of(cell, env)[1]
    begun = time.monotonic()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        given = logs_of(cell, env, policy, folder)
        found = _ANSWERS[cell.method](cell, env, policy, given, folder, udr)
    names = env.space.names
    found["seconds"] = time.monotonic() - begun
    off = np.log([found["mean"][n] / truth[n] for n in names])
    found["log_ratio"] = dict(zip(names, off.tolist(), strict=True))
    spread = found.get("log_std", 0.0)
    found["error"] = float(np.sqrt(np.mean(off**2 + np.square(spread))))
    return {"truth": truth, "logged": [int(r.steps.sum()) for r in given[2]], **found}


def _effects(env: Any, folder: Path) -> Path:
    """Commands that come late, all alike, as ``train.gap`` would have them."""
    m, path = env.mj_model, folder / "effects.yaml"
    rows = (
        "- " + _DELAY.format(at=m.actuator(a).name) + ", std: {delay: 0.003}}"
        for a in range(m.nu)
    )
    path.write_text("effects:\n" + "\n".join(rows) + "\n")
    return path


def _by_command(cell: Cell, env: Any, folder: Path, **given: Any) -> dict[str, Any]:
    from train import easi

    out = folder / "run"
    effects = _effects(env, folder)
    easi.run(easi.Config(out=out, effects=effects, seeds=(cell.seed,), **given))
    told = json.loads((out / "distribution.json").read_text())
    result = told["seeds"][str(cell.seed)]
    names = [p["name"] for p in told["parameters"]]
    columns = {k: dict(zip(names, result[k], strict=True)) for k in ("mean", "std")}
    held = told["held_out"]
    ratio = np.array(held["after"][str(cell.seed)]) / np.array(held["before"])
    return {
        **columns,
        "flags": dict(zip(names, result["flags"], strict=True)),
        "delay": {k: columns[k][names[-1]] for k in ("mean", "std")},
        "held_out_ratio": float(np.sqrt(np.nanmean(ratio**2))),
    }


def _alone(
    cell: Cell, env: Any, policy: Any, given: Any, folder: Path, udr: Path
) -> dict[str, Any]:
    return _by_command(
        *(cell, env, folder), data=(given[1],), policy=str(udr), observed=OBSERVED
    )


def _paired(
    cell: Cell, env: Any, policy: Any, given: Any, folder: Path, udr: Path
) -> dict[str, Any]:
    from easi_jax.io.models.parameter_file import write_parameter_file

    path = folder / "parameters.yaml"
    write_parameter_file(path, env.space)
    return _by_command(
        *(cell, env, folder), data=(given[0],), robot="go2", parameters=path
    )


def _reference(
    cell: Cell, env: Any, policy: Any, given: Any, folder: Path, udr: Path
) -> dict[str, Any]:
    from benchmarks import paper_twin
    from benchmarks.paper_cells import Cell as PaperCell

    paper = PaperCell("EASI paper", "go2", "", cell.seed)
    found = paper_twin.by_controller(paper, folder, env, policy, None, given[2])
    names = env.space.names
    std = np.sqrt(np.diag(found["unit_cov"]))
    return {
        "mean": dict(
            zip(names, np.asarray(found["mean"], float).tolist(), strict=True)
        ),
        "unit_std": std.tolist(),
    }


def _nothing(
    cell: Cell, env: Any, policy: Any, given: Any, folder: Path, udr: Path
) -> dict[str, Any]:
    """The middle of the range, and its spread, which an error has as well."""
    low, high = env.space.initial
    middle = np.sqrt(low * high)
    return {
        "mean": dict(zip(env.space.names, middle.tolist(), strict=True)),
        "log_std": (np.log(high / low) / 12**0.5).tolist(),
    }


_ANSWERS = {IMU: _alone, BASE: _paired, PAPER: _reference, UDR: _nothing}


# -- the page ------------------------------------------------------------------------


def _shown(rows: list[dict[str, Any]]) -> list[str]:
    """Errors of each method on each machine, and what a delay comes out as."""
    lines = []
    for machine in MACHINES:
        for method in METHODS:
            mine = [r for r in rows if (r["machine"], r["method"]) == (machine, method)]
            if not mine:
                continue
            lines.append(
                (
                    *(machine, method, len(mine)),
                    ", ".join(f"{r['error']:.3f}" for r in mine),
                    ", ".join(_late(r) for r in mine if "delay" in r) or "-",
                    f"{_inside(mine):.0%}" if "std" in mine[0] else "-",
                    f"{np.median([r['seconds'] for r in mine]):.0f}",
                )
            )
    logged = LOGGED * 0.02
    return [
        f"`python -m benchmarks.walking`: {logged:g} s of a Go2 at {COMMAND} m/s "
        f"(commits {commits_of(rows)}); seven parameters and the delay of commands. "
        "Errors are RMS log ratios over the seven parameters, a seed each; for UDR's "
        "range its spread is in them. On the twin, which is no hardware, no parameters "
        "are right, for it has friction, motors and contact that the model lacks.",
        markdown_table(
            (
                *("machine", "method", "seeds", "error", "delay found (true) [ms]"),
                *("truths within two standard deviations", "seconds, one core"),
            ),
            lines,
        ),
    ]


def _late(r: dict[str, Any]) -> str:
    return f"{1e3 * r['delay']['mean']:.1f} ({1e3 * r['truth']['delay']:g})"


def _inside(rows: list[dict[str, Any]]) -> float:
    """Share of parameters within two of their stated deviations of the truth."""
    off = [
        abs(r["mean"][n] - r["truth"][n]) < 2 * r["std"][n]
        for r in rows
        for n in r["log_ratio"]
    ]
    return float(np.mean(off))


SECTIONS = (Section("## A robot that walks", "walking.jsonl", "walking", _shown),)


if __name__ == "__main__":
    main(Config, run, name="benchmarks.walking")
