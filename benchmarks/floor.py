"""Whether a gap is called a gap, and only then: models that are right, or nearly.

    python -m benchmarks.floor

Machines of one or two joints are recorded by MuJoCo itself, with the timestep and the
integrator of the owner's model, at control rates from 50 to 1,000 Hz, slow and fast,
their readings plain, with velocities (also late or filtered ones) or in coarse steps;
one drive has an activation, one joint is read by nobody, one machine is driven by its
own readings, one runs against its end stop, one slides on a foot. ``train.gap`` then
sees the true model and the logs: its gap should be its floor, and the verdict
``no_gap``. With ``--hidden`` the machine has an effect that the model lacks, as strong
as raises the gap to about three floors, which should be found. One line a case is added
to ``floor.jsonl``; a run that was stopped goes on, and several share the work by
``--shard``.
"""

import dataclasses
import itertools
import json
import tempfile
import time
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

import mujoco
import numpy as np

from benchmarks._cells import Share, run_cells
from benchmarks._common import RESULTS, commits_of
from benchmarks._page import Section, computing, met, table
from benchmarks.coverage_summary import NOT_TOLD, judged
from benchmarks.gap_score import keys_of, wilson
from train._command import main
from train._options import EngineOptions

RATES = (50, 100, 250, 500, 1000)  # Hz
SPEEDS = {"slow": 1.0, "fast": 3.0}  # of commands
READINGS = ("plain", "velocities", "late velocities", "filtered velocities", "coarse")
MACHINES = (
    *("pendulum", "arm", "servo", "filtered", "coupled", "closed loop", "stop"),
    "foot",
)
EFFECTS = ("coulomb_friction", "constant_force", "armature", "actuator_gain")
NEAR, WIDE, INSIDE, RIGHT, POWER = 0.03, (0.85, 1.2), 0.95, 0.9, 0.8  # goals
_DRAWN = 1000  # sets of cases, for the interval of a median
_SECONDS, _RUNS = 8.0, 3
_NOISE, _COARSE = 1e-3, 4e-3  # rad; the step of coarse readings, noise of a tenth of it
_SPEED_NOISE, _LATE = 0.02, 0.012  # rad/s, s
_HORIZON, _TIMES = 0.2, 3.0  # s; floors that a hidden effect raises the gap to
_CLEAR = 1.5  # floors: fewer is no gap that a verdict is about
_STEP = 0.002  # s, of the physics at most


@dataclasses.dataclass(frozen=True)
class Case:
    """A machine, how it is recorded, and what its model lacks."""

    machine: str
    rate: int
    speed: str
    reading: str
    hidden: str
    seed: int

    @property
    def key(self) -> str:
        """Its name."""
        hidden = f", {self.hidden}" if self.hidden else ""
        return (
            f"{self.machine}, {self.rate} Hz, {self.speed}, {self.reading}{hidden}, "
            f"{self.seed}"
        )


@dataclasses.dataclass(frozen=True)
class Config(Share, EngineOptions):
    """Asks train.gap about machines whose model is right, or lacks one effect."""

    hidden: bool = False
    """Whether the machines have an effect that the model lacks."""
    seeds: int = 1
    """Of each machine, rate, speed and reading."""
    engine: Literal["auto", "mjx", "mujoco"] = "mujoco"
    """Native MuJoCo, since every machine would be compiled anew."""
    out: Path = RESULTS / "floor.jsonl"
    """Where a line for each case is added."""


def cases(config: Config) -> list[Case]:
    """Machines in turns, so that any first part of them is a fair one."""
    drawn = itertools.product(
        range(config.seeds), READINGS, SPEEDS, EFFECTS if config.hidden else ("",)
    )
    out = []
    for k, (seed, reading, speed, hidden) in enumerate(drawn):
        for i, machine in enumerate(MACHINES):
            rates = RATES if not config.hidden else (RATES[(i + k) % len(RATES)],)
            out += [Case(machine, r, speed, reading, hidden, seed) for r in rates]
    order = np.random.default_rng(0).permutation(len(out))
    return [out[i] for i in order]


def mjcf(machine: str, timestep: float, hidden: str = "", size: float = 0.0) -> str:
    """The machine's model; ``hidden`` is what it has besides, of a ``size``."""
    motor = '<motor name="m" joint="a"/>'
    drives = {
        "servo": '<position name="m" joint="a" kp="8" kv="0.4"/>',
        "filtered": (
            '<general name="m" joint="a" dyntype="filterexact" dynprm="0.04" '
            'gainprm="8" biastype="affine" biasprm="0 -8 -0.4"/>'
        ),
    }
    drive, second, coupling = drives.get(machine, motor), "", ""
    if machine in ("arm", "coupled", "closed loop"):
        second = (
            '<body pos="0 0 -0.35"><joint name="b" axis="0 -1 0" damping="0.05"/>'
            '<geom type="capsule" fromto="0 0 0 0 0 -0.25" size="0.02" mass="0.3"/>'
            "</body>"
        )
    if machine == "coupled":
        law = 'joint1="b" joint2="a" polycoef="0 -0.6 0 0 0"'
        coupling = f"<equality><joint {law}/></equality>"
    joint = {"coulomb_friction": "frictionloss", "armature": "armature"}.get(hidden)
    more = f'{joint}="{size}"' if joint else ""
    if machine == "foot":
        return f"""
<mujoco>
  <option timestep="{timestep}" integrator="implicitfast"/>
  <worldbody><geom type="plane" size="9 9 1" friction="0.3" solref="0.05 1"/>
  <body pos="0 0 0.05">
    <joint name="a" type="slide" axis="1 0 0" damping="0.5" {more}/>
    <joint name="b" type="slide" axis="0 0 1"/>
    <geom name="foot" size="0.05" mass="0.5" friction="0.3" solref="0.05 1"/>
  </body></worldbody>
  <actuator><motor name="m" joint="a" gear="4"/></actuator>
</mujoco>"""
    limit = 'limited="true" range="-1 0.6"' if machine == "stop" else ""
    m = f"""
<mujoco>
  <compiler angle="radian"/>
  <option timestep="{timestep}" integrator="implicitfast"/>
  <worldbody><body>
    <joint name="a" axis="0 -1 0" damping="0.15" {limit} {more}/>
    <geom type="capsule" fromto="0 0 0 0 0 -0.35" size="0.02" mass="0.5"/>
    {second}
  </body></worldbody>
  {coupling}
  <actuator>{drive}</actuator>
</mujoco>"""
    return m


def _machine(case: Case, size: float = 0.0) -> tuple[mujoco.MjModel, float, float]:
    """The real one, a torque that is always there, and a gain of its commands."""
    dt = 1.0 / case.rate
    step = dt / int(np.ceil(dt / _STEP - 1e-9))
    own = case.hidden in ("coulomb_friction", "armature")
    xml = mjcf(case.machine, step, case.hidden if own else "", size)
    torque = size if case.hidden == "constant_force" else 0.0
    gain = 1.0 - size if case.hidden == "actuator_gain" else 1.0
    return mujoco.MjModel.from_xml_string(xml), torque, gain


def _recorded(case: Case, seed: int, size: float) -> dict[str, np.ndarray]:
    """Columns of one run's log."""
    m, torque, gain = _machine(case, size)
    rng, d, dt = np.random.default_rng(seed), mujoco.MjData(m), 1.0 / case.rate
    t = dt * np.arange(round(_SECONDS * case.rate))
    wave, phase = rng.uniform(0.3, 1.5, 3), rng.uniform(0, 2 * np.pi, 3)
    wave = wave * (1.5 if case.speed == "fast" else 1.0)
    ahead = np.sin(2 * np.pi * wave * t[:, None] + phase).sum(1) / 3
    ahead = ahead * SPEEDS[case.speed]
    white = _NOISE if case.reading != "coarse" else 0.1 * _COARSE
    q, v, read, sent = [], [], [], []
    d.qfrc_applied[0] = torque
    for u in ahead:
        seen = d.qpos + white * rng.normal(size=m.nq)
        if case.reading == "coarse":
            seen = np.round(seen / _COARSE) * _COARSE
        if case.machine == "closed loop":
            u = 3.0 * (0.4 * u - seen[0])
        q.append(d.qpos.copy())
        v.append(d.qvel.copy())
        read.append(seen)
        sent.append(u)
        d.ctrl[:] = gain * u
        for _ in range(round(dt / m.opt.timestep)):
            mujoco.mj_step(m, d)
    out = {"time": t, "qpos.a": np.array(read)[:, 0], "ctrl.m": np.array(sent)}
    speed = np.array(v)
    if "velocities" in case.reading:
        if case.reading.startswith("late"):
            late = [np.interp(t - _LATE, t, x) for x in speed.T]
            speed = np.stack(late, 1)
        speed = speed + _SPEED_NOISE * rng.normal(size=speed.shape)
        if case.reading.startswith("filtered"):
            keeps = np.exp(-dt / _LATE)
            for k in range(1, len(speed)):
                speed[k] = keeps * speed[k - 1] + (1.0 - keeps) * speed[k]
        out["qvel.a"] = speed[:, 0]
    if m.nq > 1 and case.machine != "coupled":
        out["qpos.b"] = np.array(read)[:, 1]
        if "qvel.a" in out:
            out["qvel.b"] = speed[:, 1]
    return out


def _strength(case: Case) -> float:
    """Of the hidden effect, such that predictions over a horizon are off by three times
    what noise makes of them; by bisection of its logarithm."""
    if not case.hidden:
        return 0.0
    noise = _NOISE if case.reading != "coarse" else _COARSE / np.sqrt(12)
    dt = 1.0 / case.rate
    steps = round(_HORIZON * case.rate)

    def times(size: float) -> float:
        plain = dataclasses.replace(case, hidden="")
        model, _, _ = _machine(plain)
        real, torque, gain = _machine(case, size)
        d, e, rng = mujoco.MjData(real), mujoco.MjData(model), np.random.default_rng(0)
        parts, off = round(dt / real.opt.timestep), []
        d.qfrc_applied[0] = torque
        wave = rng.uniform(0.5, 2.0, 2)
        for k in range(round(6.0 * case.rate)):
            if k % steps == 0:
                e.qpos[:], e.qvel[:], e.act[:] = d.qpos, d.qvel, d.act
            u = SPEEDS[case.speed] * np.sin(2 * np.pi * wave * k * dt).mean()
            if case.machine == "closed loop":
                u = 3.0 * (0.4 * u - d.qpos[0])
            d.ctrl[:], e.ctrl[:] = gain * u, u
            for _ in range(parts):
                mujoco.mj_step(real, d)
                mujoco.mj_step(model, e)
            off.append(d.qpos[0] - e.qpos[0])
        # Start and noise of a perfect model come to some 1.4 times the noise.
        return float(
            np.sqrt(np.mean(np.square(off)) + (1.4 * noise) ** 2) / 1.4 / noise
        )

    low, high = np.log(1e-6), np.log(0.9)
    for _ in range(24):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if times(np.exp(middle)) < _TIMES else (low, middle)
    return float(np.exp(low))


def solve(case: Case) -> dict[str, Any]:
    """What ``train.gap`` says of a case."""
    from train import gap

    size = _strength(case)
    m, *_ = _machine(dataclasses.replace(case, hidden=""))
    begin = zlib.crc32(case.key.encode())  # no two cases share their waves and noise
    with tempfile.TemporaryDirectory() as folder:
        at = Path(folder)
        model = at / "model.xml"
        model.write_text(mjcf(case.machine, m.opt.timestep))
        data = []
        for k in range(_RUNS):
            columns = _recorded(case, begin + k, size)
            path = at / f"run{k + 1}.csv"
            np.savetxt(
                path,
                np.stack([*columns.values()], 1),
                fmt="%.9g",
                delimiter=",",
                header=",".join(columns),
                comments="",
            )
            data.append(path)
        began = time.perf_counter()
        asked = gap.Config(model=str(model), data=tuple(data), out=at / "gap")
        gap.run(asked)
        seconds = time.perf_counter() - began
        told = json.loads((at / "gap" / "gap.json").read_text())
    sizes = {
        k: (v["after"], v["floor"], v.get("floor_is_upper_bound", False))
        for k, v in told["gap_si"].items()
    }
    left_out = {row["at"] for row in told["ignored"]}
    return {
        "strength": size,
        "verdict": told["verdict"],
        "named": keys_of(told["effects"]),
        "alike": [k for e in told["effects"] for k in e["indistinguishable"]],
        "confidence": [e["confidence"] for e in told["effects"]],
        "gap": told["gap"],
        "ratio": told["gap"]["after"] / told["gap"]["floor"],
        "refit_ratio": told["gap"]["refit"] / told["gap"]["floor"],
        "channels": {k: a / f for k, (a, f, _) in sizes.items() if k not in left_out},
        "bounded": [k for k, (*_, bounded) in sizes.items() if bounded],
        "seconds": seconds,
    }


def _told(row: dict[str, Any]) -> str:
    return (
        f"{row['verdict']}, {', '.join(row['named']) or 'nothing'}; gap "
        f"{row['ratio']:.2f} floors, {row['seconds']:.0f} s"
    )


def run(config: Config) -> None:
    """Runs the cases that have no line yet."""
    run_cells(cases(config), config, solve, _told)


# -- the page of results -----------------------------------------------------------


def _ratios(rows: list[dict[str, Any]]) -> list[np.ndarray]:
    """Gap over floor of the channels of each case, those aside whose floor is an upper
    bound."""
    return [
        np.array(
            [x for k, x in row["channels"].items() if k not in row.get("bounded", ())]
        )
        for row in rows
    ]


def _spread(rows: list[dict[str, Any]]) -> str:
    ratios = np.concatenate([np.zeros(0), *_ratios(rows)])
    if not len(ratios):
        return "none is told"
    low, middle, high = np.quantile(ratios, (0.025, 0.5, 0.975))
    return f"{middle:.2f} ({low:.2f} to {high:.2f})"


def _is_right(row: dict[str, Any]) -> bool:
    """No gap; nothing is named but a late or filtered velocity that is so."""
    wrong = row["reading"].startswith(("late", "filtered"))
    told = "sensor_delay@qvel" if wrong else "none"
    named = [name for name in row["named"] if not name.startswith(told)]
    return not named and row["verdict"] != "unexplained"


def _right(rows: list[dict[str, Any]]) -> str:
    return f"{sum(map(_is_right, rows))} of {len(rows)}"


def _seconds(rows: list[dict[str, Any]]) -> str:
    return f"{np.median([row['seconds'] for row in rows]):.0f}" if rows else ""


def _found(row: dict[str, Any], also: Sequence[str] = ()) -> bool:
    names = (*row["named"], *also)
    return any(name.split("@")[0] == row["hidden"] for name in names)


def _listed(row: dict[str, Any]) -> bool:
    """Found, or among what the data do not tell from what was: a weaker drive of one
    mass that a refitted damping slows is a heavier mass."""
    return _found(row, row.get("alike", ()))


def _by_margin(rows: list[dict[str, Any]]) -> list[tuple[str, list[dict[str, Any]]]]:
    """All of the rows, then those of each value of each margin, none left out."""
    margins = {"rate": RATES, "speed": SPEEDS, "reading": READINGS, "machine": MACHINES}
    lines = [("all", rows)]
    for name, values in margins.items():
        for value in values:
            lines.append((f"{name}: {value}", [r for r in rows if r[name] == value]))
    return lines


def _at_floor(rows: list[dict[str, Any]]) -> str:
    """Whether gaps are their floors, as the goal asks for: missed where the 95 %
    interval of the median, drawn over cases, or of the share inside excludes it."""
    each = [x for x in _ratios(rows) if len(x)]
    if not each:
        return ""
    rng, medians = np.random.default_rng(0), []
    for _ in range(_DRAWN):
        drawn = rng.integers(len(each), size=len(each))
        medians.append(np.median(np.concatenate([each[k] for k in drawn])))
    low, high = np.quantile(medians, (0.025, 0.975))
    ratios = np.concatenate(each)
    middle = abs(float(np.median(ratios)) - 1)
    inside = judged((ratios >= WIDE[0]) & (ratios <= WIDE[1]), (INSIDE, 1.0))
    if high < 1 - NEAR or low > 1 + NEAR:
        return met(False)
    return inside if middle <= NEAR or inside == met(False) else NOT_TOLD


def _power(
    rows: list[dict[str, Any]], way: Callable[[dict[str, Any]], bool] = _found
) -> str:
    """How many are found, and whether that is the goal or cannot be told from it."""
    if not rows:
        return "no case yet"
    hit = np.array(list(map(way, rows)))
    found, count = int(hit.sum()), len(hit)
    low, high = wilson(found, count)
    return f"{found} of {count} [{low:.0%}, {high:.0%}], {judged(hit, (POWER, 1.0))}"


def paragraphs(rows: list[dict[str, Any]]) -> list[str]:
    """Of cases without an effect, by each margin; then of those with one."""
    clean = [row for row in rows if not row["hidden"]]
    hidden = [row for row in rows if row["hidden"]]
    said = []
    if clean:
        right = np.mean(list(map(_is_right, clean)))
        said += [
            "`python -m benchmarks.floor`: the model is right, so the gap should be "
            "the floor, and nothing be named but late and filtered velocities; commits "
            f"{commits_of(clean)}. Goal for channels, in every margin: median within "
            f"{NEAR} of 1 and 95 % between {WIDE[0]} and {WIDE[1]}, those aside whose "
            "floor is stated as an upper bound; missed where a 95 % interval excludes "
            f"it. Right in {100 * right:.0f} %, goal {100 * RIGHT:.0f} %: "
            f"{met(right >= RIGHT)}.",
            table(
                _by_margin(clean),
                {
                    "cases": lambda line: line[0],
                    "gap over floor: median (95 %)": lambda line: _spread(line[1]),
                    "goal": lambda line: _at_floor(line[1]),
                    "nothing named": lambda line: _right(line[1]),
                    "median seconds": lambda line: _seconds(line[1]),
                },
            ),
            computing(clean),
        ]
    if hidden:
        by_effect = {e: [r for r in hidden if r["hidden"] == e] for e in EFFECTS}
        # Of a coupled joint that nobody reads the floor is higher than was reckoned.
        clear = [row for row in hidden if row["refit_ratio"] >= _CLEAR]
        said += [
            "`python -m benchmarks.floor --hidden`: an effect that raises the gap to "
            f"about three floors. It did raise it to {_CLEAR:g} at least in "
            f"{len(clear)} of {len(hidden)} cases; commits {commits_of(hidden)}. "
            f"Found by name, of these; goal in every margin {100 * POWER:.0f} %, with "
            "95 % intervals:",
            table(
                _by_margin(clear) if clear else [],
                {
                    "cases": lambda line: line[0],
                    "found": lambda line: _power(line[1]),
                    "or listed as alike": lambda line: _power(line[1], _listed),
                },
            ),
            table(
                [(e, some) for e, some in by_effect.items() if some],
                {
                    "effect": lambda line: line[0],
                    "named": lambda line: (
                        f"{sum(map(_found, line[1]))} of {len(line[1])}"
                    ),
                    "explained": lambda line: (
                        f"{sum(r['verdict'] == 'explained' for r in line[1])}"
                    ),
                    "gap over floor after": lambda line: _spread(line[1]),
                },
            ),
            computing(hidden),
        ]
    return said


SECTIONS = (Section("### Gap and floor", "floor.jsonl", "floor", paragraphs),)


if __name__ == "__main__":
    main(Config, run, name="benchmarks.floor")
