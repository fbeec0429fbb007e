"""A recorded run and its file."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np


@dataclass(frozen=True)
class Log:
    """One run, a row per control step.

    Attributes:
        time: (T,) seconds.
        qpos: (T, nq) measured positions, m or rad.
        qvel: (T, nq) measured velocities.
        ctrl: (T, nu) command sent during the interval that starts at the row.
        true_qpos: (T, nq) readings before noise and quantization.
        true_qvel: (T, nq) velocities at the same moments.
        force: (T, nu) what the actuators gave, before their gears.
        qacc: (T, nq) accelerations.
    """

    time: np.ndarray
    qpos: np.ndarray
    qvel: np.ndarray
    ctrl: np.ndarray
    true_qpos: np.ndarray
    true_qvel: np.ndarray
    force: np.ndarray
    qacc: np.ndarray

    @property
    def step(self) -> float:
        """Control step, s."""
        return float(np.median(np.diff(self.time)))


@dataclass(frozen=True)
class Noise:
    """What the encoders do to a reading, per joint.

    Attributes:
        std: (nq,) Gaussian noise, m or rad.
        quantum: (nq,) resolution of the encoder, 0 for none.
    """

    std: np.ndarray
    quantum: np.ndarray

    @property
    def total(self) -> np.ndarray:
        """Standard deviation with quantization included, (nq,)."""
        return np.sqrt(self.std**2 + self.quantum**2 / 12.0)

    def read(self, rng: np.random.Generator, position: np.ndarray) -> np.ndarray:
        """Readings of positions whose last axis is the joint."""
        noisy = position + self.std * rng.standard_normal(np.shape(position))
        grain = np.where(self.quantum > 0, self.quantum, 1.0)
        return np.where(self.quantum > 0, grain * np.round(noisy / grain), noisy)


READINGS = ("positions", "velocities", "late velocities", "filtered velocities")
"""What wide draws log."""


def velocities_of(log: Log, reading: str, lag: float) -> np.ndarray | None:
    """Velocities as a reading has them, (T, nq), `lag` seconds late; None for none."""
    if reading == "positions":
        return None
    noise = log.qvel - log.true_qvel
    if reading == "late velocities":
        after = log.time - log.time[0]
        late = [np.interp(after - lag, after, column) for column in log.true_qvel.T]
        return np.stack(late, axis=1) + noise
    if reading == "filtered velocities":
        found, kept = log.qvel.copy(), np.exp(-log.step / lag)
        for row in range(1, len(found)):
            found[row] = kept * found[row - 1] + (1.0 - kept) * log.qvel[row]
        return found
    return log.qvel


def write_csv(
    path: Path,
    log: Log,
    joints: list[str],
    actuators: list[str],
    velocities: np.ndarray | None,
) -> None:
    """Write a log; the time column keeps microseconds."""
    names = ["time", *(f"qpos.{name}" for name in joints)]
    columns = [log.time[:, None], log.qpos]
    if velocities is not None:
        names += [f"qvel.{name}" for name in joints]
        columns.append(velocities)
    names += [f"ctrl.{name}" for name in actuators]
    columns.append(log.ctrl)
    table = np.concatenate(columns, axis=1)
    formats = ["%.6f"] + ["%.9g"] * (table.shape[1] - 1)
    np.savetxt(
        path, table, fmt=formats, delimiter=",", header=",".join(names), comments=""
    )
