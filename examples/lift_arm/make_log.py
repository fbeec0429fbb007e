"""Makes the example's logs: MuJoCo C plays the real machine, at a fine timestep.

    python examples/lift_arm/make_log.py [FOLDER]

writes ``sweep.csv`` and ``moves.csv`` into FOLDER (default: beside this file), the
same bytes each time. ``TRUTH`` is what identification should find; ``README.md``
states it for people.
"""

import argparse
from pathlib import Path

import mujoco
import numpy as np

from easi_jax.data.recording import Run
from easi_jax.io.logs.reader import write_log
from easi_jax.model.joint_space import Configuration

HERE = Path(__file__).parent

TRUTH = {
    "shoulder_damping": 0.12,
    "elbow_damping": 0.03,
    "friction": 0.16,
    "rotor_inertia": 0.022,
    "shoulder_gain": 1.55,
    "elbow_gain": 0.98,
    "load_mass": 0.42,
}
SEED = 20
CONTROL_STEP = 0.01  # s
FINE_STEPS = 20  # physics steps of the "real" machine in one control step
NOISE = 2e-4  # rad, standard deviation of a measured angle
DIGITS = 6


def real_machine(xml: Path) -> mujoco.MjModel:
    """The model with the true values, at the fine timestep."""
    spec = mujoco.MjSpec.from_file(str(xml))
    spec.option.timestep = CONTROL_STEP / FINE_STEPS
    for name in ("shoulder", "elbow"):
        joint = spec.joint(name)
        joint.damping[0] = TRUTH[f"{name}_damping"]
        joint.frictionloss = TRUTH["friction"]
        joint.armature = TRUTH["rotor_inertia"]
        spec.actuator(f"{name}_motor").gainprm[0] = TRUTH[f"{name}_gain"]
    spec.geom("load").mass = TRUTH["load_mass"]
    return spec.compile()


def sweep(time: np.ndarray) -> np.ndarray:
    """Wanted angles: slow and fast sines together, ``(T, 2)`` rad."""
    slow = np.sin(2 * np.pi * 0.21 * time)
    fast = np.sin(2 * np.pi * (0.3 + 0.02 * time) * time)
    ramp = np.minimum(time / 2.0, 1.0)  # from rest, without a jerk
    wanted = np.stack([0.9 * slow + 0.25 * fast, 0.8 + 0.5 * fast - 0.5 * slow])
    return (ramp * wanted).T


def moves(time: np.ndarray) -> np.ndarray:
    """Wanted angles: from pose to pose, with rests, ``(T, 2)`` rad."""
    poses = np.array([[0.0, 0.0], [1.3, 0.5], [0.6, 1.6], [-0.8, 0.4], [1.0, -0.9]])
    at = time / 2.0
    index = np.floor(at).astype(int)
    share = np.clip((at - index) / 0.4, 0.0, 1.0)[:, None]
    smooth = share**2 * (3 - 2 * share)
    first, second = (poses[(index + i) % len(poses)] for i in (0, 1))
    return first + smooth * (second - first)


def record(
    model: mujoco.MjModel, name: str, wanted: np.ndarray, rng: np.random.Generator
) -> Run:
    """Runs the arm under its controller and measures it; ``wanted`` is (T, 2) rad."""
    data = mujoco.MjData(model)
    gains, rates = np.array([9.0, 8.0]), np.array([0.9, 0.5])  # A/rad, A s/rad
    measured = np.empty((len(wanted), model.nq))
    sent = np.empty((len(wanted), model.nu))
    for t, target in enumerate(wanted):
        measured[t] = data.qpos + NOISE * rng.standard_normal(model.nq)
        speed = (measured[t] - measured[max(t - 2, 0)]) / (2 * CONTROL_STEP)
        command = gains * (target - measured[t]) - rates * speed
        # the log holds what was sent, so the drive gets no more digits than it
        sent[t] = np.round(np.clip(command, -8.0, 8.0), 3)
        data.ctrl[:] = sent[t]
        mujoco.mj_step(model, data, nstep=FINE_STEPS)
    return Run(
        name=name,
        source="",
        dt=CONTROL_STEP,
        time=CONTROL_STEP * np.arange(len(wanted)),
        qpos=np.round(measured, 5),
        qvel=np.zeros_like(measured),
        qvel_measured=False,
        ctrl=sent,
        configuration=Configuration.of(model),
    )


def main(folder: Path) -> None:
    """Writes both logs into ``folder``."""
    folder.mkdir(parents=True, exist_ok=True)
    model = real_machine(HERE / "model.xml")
    rng = np.random.default_rng(SEED)
    time = CONTROL_STEP * np.arange(2000)
    for motion in (sweep, moves):
        run = record(model, motion.__name__, motion(time), rng)
        path = folder / f"{run.name}.csv"
        write_log(path, model, run, velocities=False, digits=DIGITS)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", nargs="?", type=Path, default=HERE)
    main(parser.parse_args().folder)
