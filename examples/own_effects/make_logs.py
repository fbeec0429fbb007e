"""Makes logs of two machines that have what no catalog of effects knows.

    python examples/own_effects/make_logs.py [FOLDER]

writes ``coupled_arm/`` (two joints with a cable over both) and ``lift/`` (a propeller)
into FOLDER (default: results/own_effects): a model without the effect and three runs.
MuJoCo plays the machine; its forces and commands are written here, in plain numpy.
"""

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

ROWS, CONTROL_STEP = 400, 0.01  # of each of the runs; s
RUNS = 3
NOISE = 3e-4  # rad or m, standard deviation of a reading
SPRING, REST = 0.4, 0.2  # N m/rad, rad
SHARE = 0.6  # of the thrust that goes with the squared command
ARM = """<mujoco model="coupled_arm">
<option timestep="0.0025" integrator="implicitfast"/>
<worldbody><body><joint name="shoulder" axis="0 0 1" damping="0.05"/>
<geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.02" mass="0.5"/>
<body pos="0.3 0 0"><joint name="elbow" axis="0 0 1" damping="0.02"/>
<geom type="capsule" fromto="0 0 0 0.25 0 0" size="0.02" mass="0.3"/></body></body>
</worldbody><actuator><motor name="m1" joint="shoulder"/>
<motor name="m2" joint="elbow"/></actuator></mujoco>
"""
LIFT = """<mujoco model="lift"><option timestep="0.005"/>
<worldbody><body><joint name="height" type="slide" axis="0 0 1" damping="0.5"/>
<geom size="0.1" mass="0.5"/></body></worldbody>
<actuator><motor name="rotor" joint="height" gear="2"/></actuator></mujoco>
"""


def coupled(d: mujoco.MjData, u: np.ndarray) -> None:
    """A spring over both joints."""
    twist = SPRING * (d.qpos[1] - d.qpos[0] - REST)
    d.ctrl[:], d.qfrc_applied[:] = u, (twist, -twist)


def quadratic(d: mujoco.MjData, u: np.ndarray) -> None:
    """A propeller."""
    d.ctrl[:] = (1 - SHARE) * u + SHARE * u * np.abs(u)


@dataclass(frozen=True)
class Machine:
    """A model, what its machine does before each physics step, and its commands: a
    mean, and the size of two sines about it."""

    xml: str
    acts: Callable[[mujoco.MjData, np.ndarray], None]
    mean: float
    size: float


MACHINES = {
    "coupled_arm": Machine(ARM, coupled, 0.0, 0.3),
    "lift": Machine(LIFT, quadratic, 2.4, 0.4),
}


def recorded(machine: Machine, seed: int) -> dict[str, list[float]]:
    """The columns of a log."""
    m = mujoco.MjModel.from_xml_string(machine.xml)
    d = mujoco.MjData(m)
    rng = np.random.default_rng(seed)
    speed, phase = rng.uniform(2, 9, (2, m.nu)), rng.uniform(0, 6, (2, m.nu))
    table: dict[str, list[float]] = {"time": []}
    for k in range(ROWS):
        sines = np.sin(speed * k * CONTROL_STEP + phase).sum(0)
        u = machine.mean + machine.size * sines
        table["time"].append(round(k * CONTROL_STEP, 6))
        for j in range(m.njnt):
            read = d.qpos[j] + NOISE * rng.normal()
            table.setdefault(f"qpos.{m.joint(j).name}", []).append(round(read, 7))
        for a in range(m.nu):
            table.setdefault(f"ctrl.{m.actuator(a).name}", []).append(round(u[a], 7))
        for _ in range(round(CONTROL_STEP / m.opt.timestep)):
            machine.acts(d, u)
            mujoco.mj_step(m, d)
    return table


def make(folder: Path) -> None:
    """Writes all models and logs."""
    for name, machine in MACHINES.items():
        place = folder / name
        place.mkdir(parents=True, exist_ok=True)
        (place / "model.xml").write_text(machine.xml)
        for run in range(RUNS):
            table = recorded(machine, run)
            rows = zip(*table.values(), strict=True)
            lines = [",".join(str(float(x)) for x in row) for row in rows]
            text = "\n".join([",".join(table), *lines, ""])
            (place / f"run{run + 1}.csv").write_text(text)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", nargs="?", type=Path, default="results/own_effects")
    make(Path(parser.parse_args().folder))
