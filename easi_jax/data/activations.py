"""Activations of drives along a log: nobody measures them.

What is here is where an estimate of a start begins, and how far from it the truth may
be. The estimate itself is made with the model's own dynamics.
"""

from collections.abc import Sequence

import mujoco
import numpy as np

from easi_jax.data.recording import Run
from easi_jax.model.quantities import FILTERS

_DYN = mujoco.mjtDyn
_FOLLOWING = (*FILTERS, int(_DYN.mjDYN_MUSCLE))
_INTEGRATOR = int(_DYN.mjDYN_INTEGRATOR)


def activation_guess(m: mujoco.MjModel, run: Run) -> np.ndarray:
    """Activations at each row of a run as far as commands and positions tell,
    ``(T, na)``.

    A filter or a muscle follows its commands, from the first known one on. An
    integrator of a servo is where its transmission is; any other one sums its commands.
    """
    out = np.zeros((len(run), m.na))
    lengths, known = _lengths(m, run) if _servos(m) else None, len(run.before)
    for i, at in _places(m).items():
        u = _clipped(run.sent_until[:, i], bool(m.actuator_ctrllimited[i]), m, i)
        if m.actuator_dyntype[i] in _FOLLOWING:
            path = _followed(u, run.dt, float(m.actuator_dynprm[i, 0]))[known:]
        elif i in _servos(m):
            assert lengths is not None
            path = lengths[:, i]
        elif m.actuator_dyntype[i] == _INTEGRATOR:
            path = np.concatenate([[0.0], np.cumsum(u[:-1])])[known:] * run.dt
        else:
            path = np.zeros(len(run))
        if m.actuator_actlimited[i]:
            path = np.clip(path, *m.actuator_actrange[i])
        out[:, at] = path
    return out


def activation_spread(m: mujoco.MjModel, runs: Sequence[Run]) -> np.ndarray:
    """How far activations may be from their guess, standard deviations ``(na,)``.

    As much as the commands (of a filter) or the guess itself change in the runs: wide,
    so that the rows of a log decide.
    """
    out = np.ones(m.na)
    for i, at in _places(m).items():
        if m.actuator_dyntype[i] in _FOLLOWING:
            paths = [run.ctrl[:, i] for run in runs]
        else:
            paths = [activation_guess(m, run)[:, at] for run in runs]
        spread = float(np.std(np.concatenate(paths)))
        out[at] = spread if spread > 0 else 1.0
    return out


def _places(m: mujoco.MjModel) -> dict[int, int]:
    """Of each actuator with an activation, where the last of them is in ``act``."""
    return {
        i: int(m.actuator_actadr[i] + m.actuator_actnum[i] - 1)
        for i in range(m.nu)
        if m.actuator_actadr[i] >= 0
    }


def _servos(m: mujoco.MjModel) -> list[int]:
    """Integrators that a transmission's length is held against."""
    integrator = m.actuator_dyntype == _INTEGRATOR
    return np.flatnonzero(integrator & (m.actuator_biasprm[:, 1] != 0)).tolist()


def _lengths(m: mujoco.MjModel, run: Run) -> np.ndarray:
    """Of transmissions at each row, ``(T, nu)``."""
    d, out = mujoco.MjData(m), np.zeros((len(run), m.nu))
    for k, q in enumerate(run.qpos):
        d.qpos[:] = q
        mujoco.mj_fwdPosition(m, d)
        out[k] = d.actuator_length
    return out


def _clipped(u: np.ndarray, limited: bool, m: mujoco.MjModel, i: int) -> np.ndarray:
    return np.clip(u, *m.actuator_ctrlrange[i]) if limited else u


def _followed(u: np.ndarray, dt: float, tau: float) -> np.ndarray:
    """First-order response to commands that are held, from the first one on."""
    gain = 1.0 - np.exp(-dt / tau) if tau > 0 else 1.0
    out = np.empty(len(u))
    now = u[0] if len(u) else 0.0
    for k, target in enumerate(u):
        out[k] = now
        now += gain * (target - now)
    return out
