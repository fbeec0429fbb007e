"""Reference motions: multisine, chirp and smoothed steps, with phases of rest."""

import numpy as np

SHAPES = ("multisine", "chirp", "steps")
SLOWEST = 0.15
"""Lowest frequency of a multisine [Hz]."""
LEAD = 0.8
"""Seconds of motion before a run's first row, so that hidden states have settled."""


def _pace(rng: np.random.Generator, time: np.ndarray) -> np.ndarray:
    """Warped time: stands still at the start and in one or two rests, else runs."""
    speed = np.clip((time - time[0]) / 0.4, 0.0, 1.0)
    span = time[-1] - time[0]
    for center in rng.uniform(0.2, 0.9, size=rng.integers(1, 3)):
        away = np.abs(time - time[0] - center * span)
        # At rest for 0.5 s, back at full pace 0.35 s later.
        speed = np.minimum(speed, np.clip((away - 0.25) / 0.35, 0.0, 1.0))
    smooth = speed**2 * (3.0 - 2.0 * speed)
    return np.cumsum(smooth) * (time[1] - time[0])


def _multisine(rng: np.random.Generator, phase: np.ndarray, speed: float) -> np.ndarray:
    frequency = np.exp(rng.uniform(np.log(SLOWEST), np.log(speed), size=5))
    offset = rng.uniform(0.0, 2 * np.pi, size=5)
    waves = np.sin(2 * np.pi * np.outer(phase, frequency) + offset)
    return waves @ (1.0 / np.sqrt(frequency))


def _chirp(rng: np.random.Generator, phase: np.ndarray, speed: float) -> np.ndarray:
    low = rng.uniform(0.1, 0.2)
    span = max(float(phase[-1]), 1e-3)
    cycles = low * phase + 0.5 * (speed - low) * phase**2 / span
    return np.sin(2 * np.pi * cycles + rng.uniform(0.0, 2 * np.pi))


def _steps(rng: np.random.Generator, time: np.ndarray, speed: float) -> np.ndarray:
    """Quintic moves between random levels, each followed by a rest."""
    signal = np.zeros(len(time))
    start, level = time[0] + 0.2, rng.uniform(-0.5, 0.5)
    signal += level
    while start < time[-1]:
        target = rng.uniform(-1.0, 1.0)
        target = target if abs(target - level) > 0.5 else -np.sign(level) * 0.8
        move = rng.uniform(0.9, 1.4) * np.sqrt(abs(target - level)) / (1.3 * speed)
        s = np.clip((time - start) / move, 0.0, 1.0)
        signal += (target - level) * s**3 * (10.0 - 15.0 * s + 6.0 * s**2)
        start, level = start + move + rng.uniform(0.0, 0.5), target
    return signal


def reference(
    rng: np.random.Generator,
    shape: str,
    time: np.ndarray,
    amplitudes: np.ndarray,
    speed: float,
) -> np.ndarray:
    """Reference motion about zero, one column per amplitude: (T, n).

    `speed` is the highest frequency in Hz, above `SLOWEST`. The first moments are at
    rest.
    """
    pace = _pace(rng, time)
    columns = []
    for amplitude in amplitudes:
        if shape == "multisine":
            column = _multisine(rng, pace, speed)
        elif shape == "chirp":
            column = _chirp(rng, pace, speed)
        else:
            column = _steps(rng, time, speed)
        columns.append(amplitude * column / max(float(np.abs(column).max()), 0.5))
    return np.stack(columns, axis=1) if columns else np.zeros((len(time), 0))
