"""What train.gap finds in recordings of real machines.

    python -m benchmarks.gap_real --data ../shared/data

``expected`` is what is known of each machine from elsewhere; no method sees it.
Recordings under ``held_out`` take part in no fit.
"""

import dataclasses
import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from benchmarks.gap_score import is_among, keys_of
from train._command import main, say, show_table
from train._options import EngineOptions


@dataclasses.dataclass(frozen=True)
class Simulator:
    """Recordings of one machine, and what is known of it."""

    folder: str
    data: tuple[str, ...]
    held_out: tuple[str, ...]
    horizon: float
    expected: tuple[str, ...]
    """Names, alternatives joined by |."""
    never: tuple[str, ...] = ()


MACHINES = {
    "emps": Simulator(
        "emps",
        ("run1.csv",),
        ("run2_pulses.csv",),
        0.5,
        (
            "viscous_damping@slide",
            "coulomb_friction@slide|stribeck_friction@slide",
            "constant_force@slide",
        ),
        ("actuator_delay", "sensor_delay"),
    ),
    "cartpole": Simulator(
        "quanser_cartpole",
        ("chirp_plus_*.csv", "chirp_minus_*.csv"),
        ("swingup_0?.csv",),
        0.2,
        (
            "payload_mass@cart|armature@slider",
            "coulomb_friction@slider|stribeck_friction@slider",
        ),
    ),
    "drive_velocities": Simulator(
        "quanser_cartpole",
        ("swingup_00_with_drive_velocities.csv",),
        (),
        0.2,
        ("sensor_delay@qvel.slider",),
    ),
    "pendulum": Simulator(
        "dfki_pendulum",
        ("sac.csv", "energy_0.5kg.csv", "swingup_ddp.csv"),
        (),
        0.2,
        ("coulomb_friction|stribeck_friction", "actuator_gain|payload_mass|armature"),
    ),
    # The torque follows the sign of the speed in what is left: friction is gain.
    "pendulum_held_out": Simulator(
        "dfki_pendulum",
        ("sac.csv", "energy_0.5kg.csv"),
        ("swingup_ddp.csv",),
        0.2,
        ("coulomb_friction|stribeck_friction", "actuator_gain|payload_mass|armature"),
    ),
    # Its model has neither friction nor rotors.
    "double_pendulum": Simulator(
        "dfki_double_pendulum",
        tuple(f"trajectory_0{k}.csv" for k in (0, 2, 4, 6)),
        tuple(f"trajectory_0{k}.csv" for k in (1, 3, 5)),
        0.2,
        tuple(
            f"{e}@{joint}"
            for joint in ("elbow", "shoulder")
            for e in ("armature", "coulomb_friction")
        ),
    ),
    # In a stand; its public users report armature and friction of the calves.
    "go2_in_air": Simulator(
        "go2_in_air",
        ("chirp.csv",),
        (),
        0.2,
        (
            "armature@*_calf_joint",
            "coulomb_friction@*_calf_joint|stribeck_friction@*_calf_joint",
        ),
    ),
    "pendulum_1kg": Simulator(
        "dfki_pendulum", ("energy_1kg.csv",), (), 0.2, ("payload_mass",)
    ),
}


@dataclasses.dataclass(frozen=True)
class Config(EngineOptions):
    """Runs train.gap on recordings of real machines."""

    data: Path = Path("../shared/data")
    """Folder of the recordings."""
    machines: tuple[str, ...] = tuple(MACHINES)
    """Which of them."""
    out: Path = Path("results/gap_real")
    """Folder of the runs."""
    resume: bool = False
    """Go on from where these were stopped; the seconds are then those from there."""


def check(names: Iterable[str], known: Mapping[str, Simulator], data: Path) -> None:
    """UserError for machines that are not known, or have no recordings in ``data``."""
    from easi_jax.errors import UserError, nearest

    for name in names:
        if name not in known:
            raise UserError(f'unknown machine "{name}"{nearest(name, known)}')
        if not (data / known[name].folder / "model.xml").is_file():
            raise UserError(f"{data} does not hold the recordings; give --data")


def run(config: Config) -> None:
    """Analyses each, and writes what was found."""
    from benchmarks._common import command_of, write_result

    check(config.machines, MACHINES, config.data)
    for name in config.machines:
        chosen = dataclasses.replace(config, machines=(name,))
        out = config.out / name
        told = analysed(MACHINES[name], config.data, out, config.resume)
        path = write_result(
            f"gap_real_{name}",
            command_of("benchmarks.gap_real", chosen),
            {**dataclasses.asdict(MACHINES[name]), "machine": name},
            **told,
        )
        show_table(
            name,
            ("expected", "found"),
            [(e, "yes" if ok else "NO") for e, ok in told["found"].items()],
        )
        say(f"written: {path}")


def analysed(
    machine: Simulator, data: Path, out: Path, resume: bool = False
) -> dict[str, Any]:
    """What train.gap says, and which of the expected names are among it."""
    from train import gap

    folder = data / machine.folder

    def files(patterns: tuple[str, ...]) -> tuple[Path, ...]:
        return tuple(p for x in patterns for p in sorted(folder.glob(x)))

    held = files(machine.held_out)
    gap.run(
        gap.Config(
            model=str(folder / "model.xml"),
            data=(*files(machine.data), *held),
            held_out=held,
            horizon=machine.horizon,
            out=out,
            overwrite=not resume,
            resume=resume,
        )
    )
    told = json.loads((out / "gap.json").read_text())
    effects = told["effects"]
    names = set(keys_of(effects))
    return {
        "found": {e: is_among(e, names) for e in machine.expected},
        "wrongly_named": [e["effect"] for e in effects if e["effect"] in machine.never],
        **{
            k: told[k]
            for k in (
                *("verdict", "effects", "refitted", "gap", "gap_si", "held_out"),
                *("disagreeing_runs", "record_next", "seconds"),
            )
        },
    }


if __name__ == "__main__":
    main(Config, run, name="benchmarks.gap_real")
