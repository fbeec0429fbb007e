"""Test signals of size one: multisine, chirp, pulses, steps, and their mixture.

All begin and end at zero. Sources: R. Pintelon and J. Schoukens, *System
Identification: A Frequency Domain Approach*, 2nd ed. 2012, ch. 5 (multisines,
interleaved lines of several inputs); M. Schroeder, *IEEE Trans. Inf. Theory* 16, 1970
(phases of a low crest factor).
"""

import numpy as np

KINDS = ("multisine", "chirp", "pulses", "steps", "mixed")
_LINES = 14  # sines of one multisine, at most
_PHASES = 24  # sets of phases that are tried
_FADE = 0.5  # s


def smooth(s: np.ndarray) -> np.ndarray:
    """From 0 to 1 with zero speed and acceleration at both ends."""
    s = np.clip(s, 0.0, 1.0)
    return s**3 * (10.0 - 15.0 * s + 6.0 * s**2)


def fade(time: np.ndarray, seconds: float = _FADE) -> np.ndarray:
    """Zero at both ends of ``time``, one in between, ``(T,)``."""
    rise = min(seconds, 0.25 * (time[-1] - time[0]))
    return smooth((time - time[0]) / rise) * smooth((time[-1] - time) / rise)


def lines(low: float, high: float, seconds: float, share: int, of: int) -> np.ndarray:
    """Frequencies [Hz] of one of several inputs, log-spaced in a band.

    They are harmonics of ``1 / seconds``, each of one input alone, so that what the
    inputs do can be told apart.
    """
    first, last = max(1, round(low * seconds)), max(1, round(high * seconds))
    every = np.arange(first, max(last, first + of) + 1)
    mine = every[share::of] if len(every) > of else every[:1]
    wanted = np.geomspace(mine[0], mine[-1], _LINES)
    near = np.unique(np.abs(mine[None] - wanted[:, None]).argmin(1))
    return mine[near] / seconds


def multisine(
    rng: np.random.Generator,
    time: np.ndarray,
    inputs: int,
    low: float,
    high: float,
    slope: float,
) -> np.ndarray:
    """Sums of sines with phases of a low crest, ``(T, inputs)``.

    Schroeder's phases suit lines at even distances; for these the best of them and
    some random ones is taken.

    Args:
        low, high: band [Hz].
        slope: amplitudes fall as frequency to this power.
    """
    seconds = float(time[-1] - time[0])
    out = []
    for i in range(inputs):
        f = lines(low, high, seconds, i, inputs)
        power = f ** (-2.0 * slope)
        power /= power.sum()
        # Schroeder: phase_n = -2 pi sum_{j<n} (n - j) p_j
        schroeder = -2 * np.pi * np.cumsum(np.cumsum(power))
        phases = rng.uniform(0, 2 * np.pi, (_PHASES, len(f)))
        phases[0] = schroeder + phases[0, 0]
        turn = 2 * np.pi * np.outer(time - time[0], f)
        sums = [np.sin(turn + phase) @ np.sqrt(power) for phase in phases]
        out.append(min(sums, key=lambda u: float(np.abs(u).max())))
    return np.stack(out, 1) * fade(time)[:, None]


def chirp(
    rng: np.random.Generator, time: np.ndarray, inputs: int, low: float, high: float
) -> np.ndarray:
    """Sweeps whose frequency grows exponentially (every second input: falls)."""
    seconds = float(time[-1] - time[0])
    t = time - time[0]
    out = []
    for i in range(inputs):
        top = high * (1.0 - 0.3 * i / inputs)
        rate = np.log(top / low)
        cycles = low * seconds / rate * np.expm1(rate * t / seconds)
        wave = np.sin(2 * np.pi * cycles + (i > 0) * rng.uniform(0, 2 * np.pi))
        out.append(wave[::-1] if i % 2 else wave)
    return np.stack(out, 1) * fade(time)[:, None]


def _edges(
    rng: np.random.Generator, time: np.ndarray, pace: float
) -> list[tuple[float, float]]:
    """Random stretches of ``pace`` seconds, give or take, that fill ``time``."""
    at, out = float(time[0]), []
    while at < time[-1] - 0.5 * pace:
        length = pace * rng.uniform(0.6, 1.6)
        out.append((at, min(at + length, float(time[-1]))))
        at += length
    return out


def steps(
    rng: np.random.Generator, time: np.ndarray, inputs: int, pace: float
) -> np.ndarray:
    """Levels held for about ``pace`` seconds, joined within a quarter of it.

    Every level has another size, small ones among them.
    """
    out = np.zeros((len(time), inputs))
    for i in range(inputs):
        level = 0.0
        stretches = _edges(rng, time, pace)
        for k, (at, _) in enumerate(stretches):
            new = rng.choice([-1.0, 1.0]) * rng.choice([0.15, 0.4, 0.7, 1.0])
            if k + 1 == len(stretches):
                new = 0.0
            rise = smooth((time - at) / (0.25 * pace))
            out[:, i] += (new - level) * rise
            level = new
    return out * fade(time)[:, None]


def pulses(
    rng: np.random.Generator, time: np.ndarray, inputs: int, pace: float
) -> np.ndarray:
    """A push, its opposite twice as long, a push: speed and travel come back to zero
    where nothing else acts. Each has another size and is followed by a rest."""
    out = np.zeros((len(time), inputs))
    for i in range(inputs):
        for k, (at, end) in enumerate(_edges(rng, time, pace)):
            if inputs > 1 and k % inputs == i and rng.random() < 0.3:
                continue  # now and then one stands while the others move
            size = rng.choice([-1.0, 1.0]) * rng.choice([0.15, 0.4, 0.7, 1.0])
            s = (time - at) / (0.7 * (end - at)) * 4.0
            shape = np.where((s >= 1) & (s < 3), -1.0, 1.0) * ((s >= 0) & (s < 4))
            out[:, i] += size * shape
    return out * fade(time)[:, None]


def balanced(time: np.ndarray, signal: np.ndarray) -> np.ndarray:
    """The signal ``(T, n)`` less what makes a free mass drift away.

    As a force it leaves a mass at rest where it was: its integral and its second
    integral end at zero.
    """
    weight = fade(time)
    t = np.linspace(-1.0, 1.0, len(time))
    basis = np.stack([weight, weight * t], 1)
    moments = np.stack([np.ones_like(t), t], 1)
    return signal - basis @ np.linalg.solve(moments.T @ basis, moments.T @ signal)


def normalized(signal: np.ndarray) -> np.ndarray:
    """Each column of ``(T, n)`` with largest size one."""
    size = np.abs(signal).max(0)
    return signal / np.where(size > 0, size, 1.0)
