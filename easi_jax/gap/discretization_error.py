"""What the model's own physics step does to its predictions.

A machine knows no steps. A model that takes steps of milliseconds lets commands act
half a step early and damps at the end of a step, which looks like a delay, damping or
mass that it lacks. The same predictions by MuJoCo with smaller steps say how large that
is.
"""

import copy

import mujoco
import numpy as np
from mujoco import rollout

from easi_jax.data.recording import physics_steps
from easi_jax.gap.table import Place
from easi_jax.gap.window_set import WindowSet
from easi_jax.model.joint_space import Configuration
from easi_jax.model.mujoco_warnings import warnings_to

FINER = 8
_OWN_SHIFT = 0.75  # of a physics step


def error_of_steps(
    mj_model: mujoco.MjModel, windows: WindowSet, dt: float
) -> tuple[np.ndarray, np.ndarray]:
    """Predictions of the model as given less those of an eighth of its step.

    Args:
        windows: W of them, each of H control steps of ``dt`` [s].

    Returns:
        Tangents and velocities ``(W, H + 1, nv)``, from the start on; zero where either
        is not finite.
    """
    m = copy.deepcopy(mj_model)
    parts = physics_steps(dt, m.opt.timestep)
    start = windows.speed.shape[1] // 2
    size = mujoco.mj_stateSize(m, mujoco.mjtState.mjSTATE_FULLPHYSICS.value)
    state = np.zeros((len(windows), size))
    state[:, 1 : 1 + m.nq] = windows.start_qpos
    state[:, 1 + m.nq : 1 + m.nq + m.nv] = windows.speed[:, start]
    state[:, 1 + m.nq + m.nv : 1 + m.nq + m.nv + m.na] = windows.start_act
    configuration, paths, speeds = Configuration.of(m), [], []
    # What explodes is left out below; MuJoCo would write a file about it.
    with warnings_to():
        for fine in (FINER * parts, parts):
            m.opt.timestep = dt / fine
            ctrl = np.repeat(windows.ctrl, fine, axis=1)
            states, _ = rollout.rollout(m, mujoco.MjData(m), state, ctrl)
            states = states[:, fine - 1 :: fine, 1 : 1 + m.nq + m.nv]
            qpos, qvel = np.split(states, [m.nq], -1)
            paths.append(configuration.difference(windows.start_qpos[:, None], qpos))
            speeds.append(qvel)
    out = np.array([x[1] - x[0] for x in (paths, speeds)])
    out = np.pad(out, [(0, 0), (0, 0), (1, 0), (0, 0)])
    finite = np.isfinite(out).all((0, 2, 3), keepdims=True)
    positions, fast = np.where(finite, out, 0.0)
    return positions, fast


def within_a_step(place: Place, value: float, step: float) -> bool:
    """Whether an effect is a shift in time that the model's own steps may make.

    A semi-implicit step lets a command act half a step early, beside a machine where it
    acts when it comes.

    Args:
        value: of the effect's first column.
        step: of the physics [s].
    """
    seconds = place.columns[0].of * value
    return place.row.is_shift and seconds < _OWN_SHIFT * step
