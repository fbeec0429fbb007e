"""Makes a case: an owner's model, recordings of a machine that differs, the answer."""

import json
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tests.gap_cases import strengths
from tests.gap_cases.effects import UNLISTED, CaseError, Effect
from tests.gap_cases.gap import Gap
from tests.gap_cases.logs import READINGS, Log, Noise, velocities_of, write_csv
from tests.gap_cases.mechanisms import Mechanism, Stated
from tests.gap_cases.places import kindred, twins
from tests.gap_cases.robots import build
from tests.gap_cases.search import (
    LEAST,
    MOST,
    Trial,
    given,
    own_numbers,
    stronger,
    wrong_numbers,
)
from tests.gap_cases.settings import Setting, settle
from tests.gap_cases.truth import apart

LOUD, UNKNOWN = (3.4, 3000.0), (3.4, 40.0)
"""Gaps in floors of wide cases: of an effect of the table, of what no table has."""
LAGS = (0.006, 0.02)
"""How late velocities are in wide cases [s]."""
PERFECT = 1.1
"""Most that the owner's model may be off in a machine without effects, in floors."""
COARSE = (1.3, 4.0)
"""What it is off by in a coarse case, in floors: its own timestep shows."""
REACHABLE = 1.15
"""Above this share of the floor a perfect model may not count as one."""


@dataclass(frozen=True)
class Case:
    """What was written, and the truth behind it."""

    seed: int
    mechanism: Mechanism
    effects: tuple[Effect, ...]
    own: dict[str, float]
    noise: Noise
    gap: Gap
    directory: Path
    runs: tuple[str, ...]
    reading: str
    lag: float


def _streams(seed: int, mechanism: str) -> list[np.random.Generator]:
    return np.random.default_rng([seed, zlib.crc32(mechanism.encode())]).spawn(4)


def build_machine(
    seed: int, mechanism: str, stated: Stated, wide: bool = False
) -> Mechanism:
    """The mechanism that `make_case` begins from."""
    return build(mechanism, _streams(seed, mechanism)[0], stated, wide)


def make_case(
    seed: int,
    mechanism: str,
    effects: Sequence[Effect],
    out_dir: Path,
    *,
    stated: Stated | None = None,
    wrong_own: bool = False,
    kind: str = "",
    coarse: bool = False,
    most: float = MOST,
    wide: bool = False,
) -> Case:
    """Write a case into `out_dir`.

    Effects that come with their main parameter keep it; the others are sized, each by
    itself, until the gap is between `LEAST` and `most` times the floor. With
    `wrong_own` the model's own numbers are wrong instead. A `coarse` case is one whose
    model is off by its own timestep and velocity fits. A `wide` one has any rate,
    speed and reading, and gaps as real machines have them. Raises CaseError where this
    cannot be had.
    """
    for effect in effects:
        if effect.name not in strengths.SIZERS:
            raise ValueError(f"unknown effect {effect.name!r}")
    machine = build_machine(seed, mechanism, stated or Stated(), wide)
    rngs = _streams(seed, mechanism)
    setting = settle(machine, rngs[1], coarse)
    trial = Trial(setting, seed, most if wide else MOST)
    context = setting.context
    perfect = trial.gap(trial.logs(setting.plans, [], {}), quick=True).ratio
    low, high = COARSE if coarse else (0.0, PERFECT)
    if not low <= perfect <= high:
        raise CaseError(f"a perfect model is at {perfect:.2f} floors")
    chosen = [strengths.filled(effect, rngs[2], context) for effect in effects]
    own: dict[str, float] = {}
    target = rngs[3].uniform(np.log(3.4), np.log(12.0 if len(chosen) < 2 else 7.0))
    if coarse:
        target = max(target, np.log(2.0 * perfect))
    sizing = [i for i, e in enumerate(effects) if not given(e, chosen[i], context)]
    for index in sizing:
        alternative = stronger(chosen, index, context)
        if wide:
            sizes = UNKNOWN if effects[index].name in UNLISTED else LOUD
            target = rngs[3].uniform(*np.log(sizes))
        strength = trial.search(alternative, float(np.exp(target)))
        chosen[index] = alternative(strength)[0][0]
    if wrong_own:
        alternative = wrong_numbers(setting.mechanism, rngs[2])
        own = alternative(trial.search(alternative, float(np.exp(target))))[1]
    logs = trial.logs(setting.plans, chosen, own)
    gap = trial.gap(logs, chosen, own)
    if not chosen and not wrong_own and gap.ratio > high:
        raise CaseError(f"a perfect model is at {gap.ratio:.2f} floors")
    if (sizing or wrong_own) and not LEAST <= gap.ratio <= most:
        raise CaseError(f"over all runs the gap is {gap.ratio:.2f} floors")
    reading, lag = READINGS[int(rngs[3].random() < 1 / 3)], 0.0
    if wide:
        reading = str(rngs[3].choice(READINGS))
        lag = float(f"{np.exp(rngs[3].uniform(*np.log(LAGS))):.2g}")
    runs = _write(out_dir, setting, logs, reading, lag)
    case = Case(
        *(seed, setting.mechanism, tuple(chosen), own, setting.noise, gap, out_dir),
        *(runs, reading, lag),
    )
    answer = describe(case, kind, setting, perfect)
    (out_dir / "answer.json").write_text(json.dumps(answer, indent=2) + "\n")
    return case


def _write(
    out_dir: Path, setting: Setting, logs: Sequence[Log], reading: str, lag: float
) -> tuple[str, ...]:
    out_dir.mkdir(parents=True, exist_ok=True)
    mechanism = setting.mechanism
    (out_dir / "model.xml").write_text(mechanism.xml())
    joints = [joint.name for joint in mechanism.joints]
    actuators = [mechanism.joints[i].actuator for i in mechanism.driven]
    names = tuple(f"run{i + 1}.csv" for i in range(len(logs)))
    for name, log in zip(names, logs, strict=True):
        velocities = velocities_of(log, reading, lag)
        write_csv(out_dir / name, log, joints, actuators, velocities)
    return names


def _faults(case: Case) -> list[str]:
    """Names of what is wrong with velocities that are late or filtered."""
    if case.reading not in ("late velocities", "filtered velocities"):
        return []
    return [f"sensor_delay@qvel.{joint.name}" for joint in case.mechanism.joints]


def _laws(case: Case) -> list[str]:
    """Joints, and actuators at them, at which a law that no table has acts."""
    unknown = [e for e in case.effects if e.kind == "outside"]
    places = {e.at for e in unknown} | {str(e.parameters.get("other")) for e in unknown}
    at = [j for j in case.mechanism.joints if {j.name, j.actuator} & places]
    return sorted({n for j in at for n in (j.name, j.actuator) if n})


def describe(
    case: Case, kind: str, setting: Setting, perfect: float
) -> dict[str, object]:
    """The sealed answer, ready for JSON."""
    mechanism, gap = case.mechanism, case.gap
    verdicts = ["explained"] if case.effects else ["no_gap"]
    if any(effect.kind == "outside" for effect in case.effects):
        verdicts = ["unexplained"]
    elif gap.best > REACHABLE * gap.floor:
        # Shocks between two rows: even the true model would start with a wrong speed.
        verdicts.append("unexplained")
    stated = own_numbers(mechanism)
    return {
        "seed": case.seed,
        "kind": kind,
        "mechanism": mechanism.name,
        "verdicts": verdicts,
        "effects": [
            {
                "effect": effect.name,
                "at": effect.at,
                "kind": effect.kind,
                "places": [one.at for one in apart(mechanism, [effect])],
                "parameters": strengths.reported(effect),
                "twins": twins(mechanism, effect),
                "kindred": kindred(effect),
            }
            for effect in case.effects
        ],
        "readings": _faults(case),
        "laws": _laws(case),
        "own": {
            address: {"model": stated[address], "truth": value}
            for address, value in case.own.items()
        },
        "gap": {
            "before": gap.gap,
            "floor": gap.floor,
            "best": gap.best,
            "ratio": gap.ratio,
            "perfect": perfect,
            "windows": gap.windows,
        },
        "gap_si": {
            joint.name: {
                "unit": joint.unit,
                "before": float(gap.rms[i]),
                "floor": float(gap.rms_floor[i]),
                "noise": float(case.noise.std[i]),
                "quantum": float(case.noise.quantum[i]),
            }
            for i, joint in enumerate(mechanism.joints)
        },
        "setting": {
            "reading": case.reading,
            "lag": case.lag,
            "timestep": mechanism.timestep,
            "control_step": mechanism.control_step,
            "truth_step": setting.fine,
            "open_loop": mechanism.open_loop,
            **setting.notes,
        },
        "runs": {
            name: {"excitation": plan.shape, "duration": plan.duration}
            for name, plan in zip(case.runs, setting.plans, strict=True)
        },
    }
