"""What a model says that its drives did in a recording."""

import mujoco
import numpy as np

from easi_jax.data.activations import activation_guess
from easi_jax.data.recording import Run
from easi_jax.data.windows import fitted_velocity


def drive_forces(m: mujoco.MjModel, run: Run) -> np.ndarray:
    """Forces or torques of all actuators in each row, ``(T, nu)`` [N, N m].

    By the measured positions, their fitted velocities, the commands, and activations
    as far as these tell (`easi_jax.data.activations`).
    """
    d = mujoco.MjData(m)
    velocity = fitted_velocity(run.qpos, run.dt, run.configuration)
    out = np.zeros((len(run), m.nu))
    act = activation_guess(m, run)
    for t in range(len(run)):
        d.qpos[:], d.qvel[:] = run.qpos[t], velocity[t]
        d.ctrl[:], d.act[:] = run.ctrl[t], act[t]
        mujoco.mj_fwdPosition(m, d)
        mujoco.mj_fwdVelocity(m, d)
        mujoco.mj_fwdActuation(m, d)
        out[t] = d.actuator_force
    return out


def exertion(m: mujoco.MjModel, run: Run) -> np.ndarray:
    """Sizes of drive forces and of speeds in each row, ``(T, nu + nv)``."""
    speed = fitted_velocity(run.qpos, run.dt, run.configuration)
    return np.abs(np.c_[drive_forces(m, run), speed])
