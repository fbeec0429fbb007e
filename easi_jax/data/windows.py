"""Cuts runs into open-loop windows; nothing crosses a run's end."""

from typing import NamedTuple

import numpy as np

from easi_jax.data.recording import Run
from easi_jax.model.joint_space import Configuration

_FIT_SECONDS = 0.02
_FIT_ROWS = 5
MIN_STEPS = 10
_START_ROWS = 5  # and seconds, on either side of a window's start, that it is fitted to
_START_SECONDS = 0.03


class Windows(NamedTuple):
    """Open-loop windows of one run: W windows of H control steps.

    Attributes:
        start_row: row of the run at which each window starts, ``(W,)`` int.
        start_qpos: measured position there, ``(W, nq)``.
        start_qvel: fitted velocity there, ``(W, nv)``.
        ctrl: command of each step, ``(W, H, nu)``.
        target_qpos: measured position after each step, ``(W, H, nq)``.
        dt: control step, s.
    """

    start_row: np.ndarray
    start_qpos: np.ndarray
    start_qvel: np.ndarray
    ctrl: np.ndarray
    target_qpos: np.ndarray
    dt: float


def fitted_velocity(
    qpos: np.ndarray, dt: float, configuration: Configuration
) -> np.ndarray:
    """Velocity as the derivative of a local quadratic in the positions.

    The quadratic is fitted by least squares to the rows within 20 ms of each row
    and to at least 5; at the ends of the run to those that exist. Orientations
    are fitted as rotation vectors from the row's own.

    Args:
        qpos: positions of one run, ``(T, nq)``.
        dt: control step, s.
        configuration: where quaternions lie in ``qpos``.

    Returns:
        ``(T, nv)``, m/s and rad/s. Of two rows the slope; of one row zeros.
    """
    rows = len(qpos)
    if rows < 2:
        return np.zeros((rows, configuration.nv))
    row = np.arange(rows)
    low, high = _fitted_rows(rows, row, dt)
    velocity = np.zeros((rows, configuration.nv))
    shapes = {(int(a), int(b)) for a, b in zip(low - row, high - row, strict=True)}
    for first, last in shapes:
        chosen = row[(low - row == first) & (high - row == last)]
        weights = _derivative_weights(first, last) / dt
        for offset, weight in zip(range(first, last + 1), weights, strict=True):
            step = configuration.difference(qpos[chosen], qpos[chosen + offset])
            velocity[chosen] += weight * step
    return velocity


def slope_noise(dt: float) -> float:
    """Noise of a velocity of `fitted_velocity` inside a run [1/s], times that of a
    position."""
    reach = _reach(dt)
    return float(np.linalg.norm(_derivative_weights(-reach, reach)) / dt)


def lead_rows(dt: float) -> int:
    """Rows on either side of a window's start that the start is fitted to.

    Those within 30 ms, and at least 5 (``start_seconds`` of the log format).
    """
    return max(_START_ROWS, round(_START_SECONDS / dt))


def start_rows(dt: float) -> int:
    """Rows that a start is fitted to: `lead_rows` on either side, and its own."""
    return 2 * lead_rows(dt) + 1


def window_steps(dt: float, horizon_s: float) -> int:
    """Control steps of a horizon: to the nearest, at least `MIN_STEPS`, and more than
    follow a start that its state is fitted to."""
    return max(MIN_STEPS, lead_rows(dt) + 1, round(horizon_s / dt))


def window_rows(
    run: Run, horizon_s: float, every_s: float | None = None, lead: int = 0
) -> np.ndarray:
    """Rows in which windows of ``run`` begin, ``(W,)``, so that all lie inside, each
    ``lead`` rows longer than its horizon; else as `make_windows`."""
    if horizon_s <= 0 or (every_s is not None and every_s <= 0):
        raise ValueError("horizon and spacing of windows must be positive")
    steps = window_steps(run.dt, horizon_s)
    spacing = steps / 2 if every_s is None else every_s / run.dt
    return np.arange(0, max(len(run) - steps - lead, 0), max(1, round(spacing)))


def make_windows(
    run: Run,
    horizon_s: float,
    every_s: float | None = None,
) -> Windows:
    """Windows of ``run`` for open-loop prediction.

    Args:
        run: the recording.
        horizon_s: length of a window, s; rounded to control steps, at least 10.
        every_s: time from one start to the next, s; half a horizon by default.

    Returns:
        Windows that lie wholly inside the run, the first at its first row; none
        where the run is shorter than a window.

    Raises:
        ValueError: a length that is not positive.
    """
    start = window_rows(run, horizon_s, every_s)
    row = start[:, None] + np.arange(window_steps(run.dt, horizon_s))
    velocity = fitted_velocity(run.qpos, run.dt, run.configuration)
    return Windows(
        start_row=start,
        start_qpos=run.qpos[start],
        start_qvel=velocity[start],
        ctrl=run.ctrl[row],
        target_qpos=run.qpos[row + 1],
        dt=run.dt,
    )


def _reach(dt: float) -> int:
    """Rows on either side of one that its velocity is fitted to, inside a run."""
    return max(int(_FIT_SECONDS / dt + 1e-6), _FIT_ROWS // 2)


def _fitted_rows(
    rows: int, row: np.ndarray, dt: float
) -> tuple[np.ndarray, np.ndarray]:
    """First and last row of each row's own span: within reach, inside the run, at
    least `_FIT_ROWS` rows."""
    reach = _reach(dt)
    low = np.minimum(np.maximum(row - reach, 0), max(rows - _FIT_ROWS, 0))
    high = np.maximum(np.minimum(row + reach, rows - 1), min(_FIT_ROWS, rows) - 1)
    return low, high


def _derivative_weights(first: int, last: int) -> np.ndarray:
    """Weights of rows ``first..last`` that give the slope at 0 per row."""
    offset = np.arange(first, last + 1, dtype=float)
    degree = min(2, len(offset) - 1)
    powers = np.vander(offset, degree + 1, increasing=True)
    return np.linalg.pinv(powers)[1]
