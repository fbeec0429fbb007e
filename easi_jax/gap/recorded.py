"""A model with its recordings, as windows of every length see them."""

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from easi_jax.data.noise import finest, pooled, resolutions
from easi_jax.data.recording import Run
from easi_jax.data.sensor_channels import Sensors
from easi_jax.estimation.starts import known_noise
from easi_jax.gap.batched_least_squares import Bounds
from easi_jax.model.effect_catalog import Scales


@dataclass(frozen=True)
class Recorded:
    """A model with its recordings; c channels are compared, positions first.

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
        noise_is_bound: where it may be less, ``(c,)`` bool.
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
    """With motion, noise and resolution of all channels; ``noise (nv,)`` is that of
    positions."""
    runs = [*fit, *held]
    motion = np.concatenate([scales.position, np.maximum(sensors.spread(fit), 1e-9)])
    told, is_bound = sensors.noise(fit)
    step = finest([resolutions(run) for run in runs])
    return Recorded(
        m,
        fit,
        runs,
        scales,
        bounds,
        sensors,
        lead,
        motion,
        known_noise(np.concatenate([noise, told]), motion),
        np.concatenate([pooled(fit).is_bound[: m.nv], is_bound]),
        np.concatenate([step, sensors.finest(runs)]),
    )
