"""Whether what is stated holds where the model lacks something that nobody knows of.

    python -m benchmarks.lacking

An arm of two joints with position drives is recorded by MuJoCo itself: its parameters
differ from the model's, and so does one thing that no parameter sets (a late command, a
zero that is off, a load at the tip, friction that falls with speed, play, ...).
``train.easi --data`` is asked for seven parameters. Counted is how often the truth lies
inside what is stated of a parameter, or no region is stated at all. One line a case is
added to ``lacking.jsonl``; a run that was stopped goes on, and several share the work
by ``--shard``.
"""

import dataclasses
import itertools
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from benchmarks._cells import Share, run_cells
from benchmarks._common import RESULTS, commits_of, markdown_table
from benchmarks._page import Section
from train._command import main

NOTHING = "nothing"
LACKS = (
    *(NOTHING, "finer steps", "zeros", "late commands", "lag", "gain", "load"),
    *("tilt", "ripple", "drag", "stribeck", "force limit", "play", "compliance"),
)
_DT, _ROWS, _RUNS = 0.01, 1000, 3  # s, rows of a recording, recordings
_STEP, _FINER = 0.002, 8  # s, and how many times finer
_NOISE = 1e-4  # rad
_AWAY = 1.5  # times the model's value, that a parameter is off at most
_LEVEL = 1.645  # standard deviations of 90 %, two-sided

# Of the model as its owner has it: what is asked for, at its address.
ASKED = {
    "shoulder_damping": ("joint.shoulder.damping", 0.2),
    "elbow_damping": ("joint.elbow.damping", 0.1),
    "shoulder_friction": ("joint.shoulder.frictionloss", 0.05),
    "elbow_friction": ("joint.elbow.frictionloss", 0.03),
    "shoulder_kp": ("actuator.s.kp", 40.0),
    "elbow_kp": ("actuator.e.kp", 20.0),
    "fore_mass": ("body.fore.mass", 0.6),
}


@dataclasses.dataclass(frozen=True)
class Case:
    """What the model lacks, and a seed."""

    lacks: str
    seed: int

    @property
    def key(self) -> str:
        return f"{self.lacks}/{self.seed}"


@dataclasses.dataclass(frozen=True)
class Config(Share):
    """Fits logs of arms whose models lack something."""

    seeds: tuple[int, ...] = (0, 1, 2)
    """Machines for each thing that is lacking."""
    generations: int = 15
    """Generations of each search."""
    out: Path = RESULTS / "lacking.jsonl"
    """Where a line for each case is added."""


def mjcf(values: dict[str, float], lacks: str = "", size: float = 0.0) -> str:
    """The arm, MJCF; a machine whose joint gives way has a drive of its own."""
    step = _STEP / (_FINER if lacks == "finer steps" else 1)
    angle = size if lacks == "tilt" else 0.0
    gravity = -9.81 * np.array([np.sin(angle), 0.0, np.cos(angle)])
    limit = f'forcerange="{-size} {size}"' if lacks == "force limit" else ""
    load = f'<geom type="sphere" size=".02" pos=".25 0 0" mass="{size}"/>'
    given = {
        "play": f'range="{-size / 2} {size / 2}" damping=".005"',
        "compliance": f'stiffness="{size}" damping=".02"',
    }
    last = f"""<geom type="capsule" fromto="0 0 0 .25 0 0" size=".025"
        mass="{values["fore_mass"]}"/>{load if lacks == "load" else ""}"""
    if lacks in given:
        last = f"""<inertial pos="0 0 0" mass="1e-4" diaginertia="1e-5 1e-5 1e-5"/>
        <body><joint name="gives" axis="0 1 0" {given[lacks]}/>{last}</body>"""
    return f"""<mujoco><compiler angle="radian"/>
  <option timestep="{step}" integrator="implicitfast"
    gravity="{" ".join(map(str, gravity))}"/>
  <default><geom contype="0" conaffinity="0"/></default>
  <worldbody><body name="upper"><joint name="shoulder" axis="0 1 0"
      damping="{values["shoulder_damping"]}" armature=".01"
      frictionloss="{values["shoulder_friction"]}"/>
    <geom type="capsule" fromto="0 0 0 .3 0 0" size=".03" mass="1"/>
    <body name="fore" pos=".3 0 0"><joint name="elbow" axis="0 1 0"
        damping="{values["elbow_damping"]}" armature=".005"
        frictionloss="{values["elbow_friction"]}"/>{last}</body></body></worldbody>
  <actuator>
    <position name="s" joint="shoulder" kp="{values["shoulder_kp"]}" kv="1.5" {limit}/>
    <position name="e" joint="elbow" kp="{values["elbow_kp"]}" kv=".6"/>
  </actuator></mujoco>"""


# How large what is lacking is, by a random number generator.
_SIZES: dict[str, Callable[[np.random.Generator], float]] = {
    "zeros": lambda rng: 1.0,  # standard deviations of a hundredth of a radian
    "late commands": lambda rng: rng.uniform(0.002, 0.01),  # s
    "lag": lambda rng: rng.uniform(0.003, 0.015),  # s
    "gain": lambda rng: 1.0 + rng.choice([-1, 1]) * rng.uniform(0.01, 0.04),
    "load": lambda rng: rng.uniform(0.03, 0.15),  # kg
    "tilt": lambda rng: np.radians(rng.choice([-1, 1]) * rng.uniform(0.5, 3.0)),
    "ripple": lambda rng: rng.uniform(0.02, 0.1),  # N m
    "drag": lambda rng: rng.uniform(0.01, 0.05),  # N m s^2
    "stribeck": lambda rng: rng.uniform(0.02, 0.1),  # N m
    "force limit": lambda rng: rng.uniform(4.0, 7.0),  # N m
    "play": lambda rng: rng.uniform(0.005, 0.02),  # rad
    "compliance": lambda rng: rng.uniform(100.0, 400.0),  # N m/rad
}


def _torque(lacks: str, size: float, q: np.ndarray, v: np.ndarray) -> np.ndarray | None:
    """What acts on the joints besides, ``(2,)`` [N m]."""
    if lacks == "ripple":
        return size * np.sin(9 * q + 0.7)
    if lacks == "drag":
        return -size * v * np.abs(v)
    if lacks == "stribeck":
        return -size * np.exp(-np.abs(v) / 0.3) * np.tanh(v / 0.02)
    return None


def _recorded(case: Case, truth: dict[str, float]) -> tuple[list[Any], float]:
    """Runs, and how large what is lacking is."""
    from easi_jax.data.recording import Run
    from easi_jax.data.windows import fitted_velocity
    from easi_jax.model.joint_space import Configuration

    rng = np.random.default_rng([case.seed, LACKS.index(case.lacks)])
    draw = _SIZES.get(case.lacks)
    size = float(draw(rng)) if draw else 0.0
    m = mujoco.MjModel.from_xml_string(mjcf(truth, case.lacks, size))
    shape = Configuration.of(mujoco.MjModel.from_xml_string(mjcf(truth)))
    off = 0.01 * size * rng.normal(size=2) if case.lacks == "zeros" else np.zeros(2)
    sub = round(_DT / m.opt.timestep)
    late = size if case.lacks == "late commands" else 0.0
    runs = []
    for k in range(_RUNS):
        d, times = mujoco.MjData(m), _DT * np.arange(_ROWS)
        turn, phase = rng.uniform(0.6, 7.0, (2, 5)), rng.uniform(0.0, 6.0, (2, 5))
        sent = 0.3 * np.sin(turn * times[:, None, None] + phase).sum(2)
        gain = size if case.lacks == "gain" else 1.0
        q, arrived = np.zeros((_ROWS, 2)), sent[0].copy()
        for row in range(_ROWS):
            elbow = d.qpos[1:].sum() if m.nq > 2 else d.qpos[1]
            q[row] = np.array([d.qpos[0], elbow]) + off + _NOISE * rng.normal(size=2)
            for i in range(sub):
                then = row * _DT + (i + 0.5) * m.opt.timestep - late
                u = gain * sent[max(0, int(then / _DT))]
                d.ctrl[:] = u
                if case.lacks == "lag":  # of a step, the mean of what arrives
                    share = m.opt.timestep / size
                    d.ctrl[:] = u - (u - arrived) * -np.expm1(-share) / share
                    arrived = u - (u - arrived) * np.exp(-share)
                more = _torque(case.lacks, size, d.qpos[:2], d.qvel[:2])
                if more is not None:
                    d.qfrc_applied[:2] = more
                mujoco.mj_step(m, d)
        v, name = fitted_velocity(q, _DT, shape), f"run{k}"
        runs.append(Run(name, name, _DT, times, q, v, False, sent, shape))
    return runs, size


def solve(config: Config, case: Case) -> dict[str, Any]:
    """What ``train.easi --data`` states of a case, beside the truth."""
    from easi_jax.api import estimate_parameters
    from easi_jax.data.recording import Log
    from easi_jax.model.parameters import ParameterSpace, declare

    rng = np.random.default_rng([case.seed, 99])
    away = _AWAY ** rng.uniform(-1.0, 1.0, len(ASKED))
    given = {name: value for name, (_, value) in ASKED.items()}
    truth = {name: v * a for (name, v), a in zip(given.items(), away, strict=True)}
    runs, size = _recorded(case, truth)
    m = mujoco.MjModel.from_xml_string(mjcf(given))
    space = ParameterSpace(
        tuple(declare(m, name, address) for name, (address, _) in ASKED.items())
    )
    log, held = Log(tuple(runs[:-1]), ()), Log(tuple(runs[-1:]), ())
    began = time.perf_counter()
    asked = {"generations": config.generations, "engine": "mujoco"}
    found = estimate_parameters(m, space, log, held_out=held, **asked)
    told = zip(found.names, found.mean, found.std, found.flags, strict=True)
    return {
        "size": size,
        "truth": truth,
        "found": {n: [float(x), float(s), str(f)] for n, x, s, f in told},
        "no_region": found.no_region,
        "notes": [n for n in found.notes if "does not know" in n],
        "seconds": time.perf_counter() - began,
    }


def off(row: dict[str, Any]) -> dict[str, float]:
    """Errors in stated standard deviations of what is said to be determined."""
    return {
        name: (mean - row["truth"][name]) / max(std, 1e-12)
        for name, (mean, std, flag) in row["found"].items()
        if flag == "determined"
    }


def _told(row: dict[str, Any]) -> str:
    errors = ", ".join(f"{name} {x:.1f}" for name, x in off(row).items())
    said = "no region" if row["no_region"] else errors
    return f"{row['size']:.3g}; {said}; {row['seconds']:.0f} s"


def run(config: Config) -> None:
    """Runs the cases that have no line yet."""
    cases = [Case(what, s) for s, what in itertools.product(config.seeds, LACKS)]
    run_cells(cases, config, lambda case: solve(config, case), _told)


def paragraphs(rows: list[dict[str, Any]]) -> list[str]:
    """What is stated, by what the model lacks."""
    from benchmarks.coverage_summary import share

    lines = []
    for what in ("all", *LACKS):
        mine = [r for r in rows if what in ("all", r["lacks"])]
        if not mine:
            continue
        stated = [r for r in mine if not r["no_region"]]
        errors = np.abs([x for r in stated for x in off(r).values()])
        inside = share(errors < _LEVEL) if len(errors) else "-"
        far = f"{int((errors > 3.0).sum())}" if len(errors) else "-"
        none = f"{len(mine) - len(stated)}"
        most = f"{errors.max():.1f}" if len(errors) else "-"
        lines.append((what, len(mine), none, len(errors), inside, far, most))
    head = (
        *("the model lacks", "machines", "no region", "numbers stated"),
        *("inside 90 %", "more than 3 deviations off", "farthest"),
    )
    return [
        "`python -m benchmarks.lacking`: an arm of two joints with position drives, "
        "recorded by MuJoCo at 100 Hz; `train.easi --data` is asked for seven "
        "parameters while the model lacks something that none of them sets; commits "
        f"{commits_of(rows)}. Of what is said to be determined, truths inside the 90 % "
        "intervals (95 % interval of the share), one parameter at a time.",
        markdown_table(head, lines),
    ]


SECTIONS = (
    Section(
        "### Where the model lacks something", "lacking.jsonl", "lacking", paragraphs
    ),
)


if __name__ == "__main__":
    main(Config, run, name="benchmarks.lacking")
