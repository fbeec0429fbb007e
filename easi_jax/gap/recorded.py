"""A model with its recordings, as windows of every length see them."""

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from easi_jax.data.noise import pooled, resolutions
from easi_jax.data.recording import Run
from easi_jax.data.sensor_channels import Sensors
from easi_jax.data.velocity_lag import noise_in_starts, of_model, set_right
from easi_jax.estimation.starts import known_noise
from easi_jax.gap.batched_least_squares import Bounds
from easi_jax.model.effect_catalog import Scales
from easi_jax.model.joint_space import tangent_names


@dataclass(frozen=True)
class Recorded:
    """A model with its recordings; c channels are compared, positions first, then
    sensors, then velocities, which speak of starts only.

    Attributes:
        m: the model as given.
        fit: runs that fits see.
        runs: these, then those held out.
        scales: how large things are in ``fit``.
        bounds: of whole vectors.
        sensors: whose readings are compared.
        lead: rows before a start that a window begins.
        motion: of each channel, ``(c,)``.
        noise: of its readings; infinite where nobody measured, ``(c,)``.
        noise_is_bound: where it may be less, of positions and sensors, bool.
        resolution: step between two readings, ``(c,)``.
    """

    m: mujoco.MjModel
    fit: Sequence[Run]
    runs: Sequence[Run]
    scales: Scales
    bounds: Bounds
    sensors: Sensors
    lead: int
    motion: np.ndarray
    noise: np.ndarray
    noise_is_bound: np.ndarray
    resolution: np.ndarray

    @property
    def dt(self) -> float:
        """Control step [s]."""
        return self.fit[0].dt


def recorded(
    m: mujoco.MjModel,
    fit: Sequence[Run],
    held: Sequence[Run],
    scales: Scales,
    bounds: Bounds,
    sensors: Sensors,
    noise: np.ndarray,
    lead: int,
) -> Recorded:
    """With motion, noise and resolution of all channels; ``noise`` is that of positions
    ``(nv,)``, or also of velocities that are compared ``(2 nv,)``."""
    runs, nv = [*fit, *held], m.nv
    told, is_bound = sensors.noise(fit)
    spread, fast = np.maximum(sensors.spread(fit), 1e-9), scales.speed
    motion = np.concatenate([scales.position, spread, fast[: len(noise) - nv]])
    step = resolutions(runs)
    return Recorded(
        m,
        fit,
        runs,
        scales,
        bounds,
        sensors,
        lead,
        motion,
        known_noise(np.concatenate([noise[:nv], told, noise[nv:]]), motion),
        np.concatenate([pooled(fit).is_bound[:nv], is_bound]),
        np.concatenate([step, sensors.finest(runs), np.zeros(len(noise) - nv)]),
    )


def with_speeds(
    m: mujoco.MjModel, fit: Sequence[Run], held: Sequence[Run], noise: np.ndarray
) -> tuple[Sequence[Run], Sequence[Run], np.ndarray, list[str]]:
    """Runs whose velocities are set right (`easi_jax.data.velocity_lag`), and the noise
    of what helps to find starts: of positions, and of velocities where all runs have
    them.

    Args:
        noise: of positions and velocities, ``(2 nv,)``, or of positions, ``(nv,)``.

    Returns:
        Runs to fit, held-out ones, noise, ``(2 nv,)`` or ``(nv,)``, and notes.
    """
    nv, runs, dt = m.nv, [*fit, *held], fit[0].dt
    lack = sorted({run.recording for run in runs if not run.qvel_measured})
    if len(noise) == nv or lack:
        some = any(run.qvel_measured for run in runs)
        told = f"velocities are left unused, since {', '.join(lack)} has none"
        return fit, held, noise[:nv], [told] if some else []
    right = set_right(runs, tangent_names(m), of_model(m, dt))
    noise = noise * np.append(np.ones(nv), right.noisier)
    fit, held = right.runs[: len(fit)], right.runs[len(fit) :]
    noise[nv:] = noise_in_starts(m, fit, noise)
    return fit, held, noise, right.notes
