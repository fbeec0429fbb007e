"""An environment in which a robot is sent what a log says it was sent.

For logs that come without their controller: each episode begins at a row of the log,
joints where they were read, a base that nobody measured upright on its feet and at
rest, and then follows the log's commands. What an episode does at first is the mistake
of that start, so it is left out of what is compared.
"""

import copy
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from easi_jax.data.recording import Run
from easi_jax.data.unmeasured import hidden_in_any
from easi_jax.errors import UserError
from easi_jax.model.joint_space import is_free, scalar_dofs
from easi_jax.simulation.env import EnvState, advance, start
from easi_jax.simulation.simulator import Simulator

_UPRIGHT = 0.5  # cosine of a base's tilt, below which it has fallen


class SentCommands:
    """Episodes of ``steps`` control steps of the log's commands; `Env`.

    The observation is the row, the action nothing. ``control`` is the command of the
    log.

    Args:
        name: of the robot.
        simulator: of the machine.
        runs: recordings at its control step.
        steps: control steps of an episode.

    Raises:
        UserError: no run holds that many rows.
    """

    obs_size, action_size = 1, 0

    def __init__(
        self, name: str, simulator: Simulator, runs: Sequence[Run], steps: int
    ) -> None:
        self.name, self.simulator, self.episode_length = name, simulator, steps
        self.mj_model, self.space, self.dt = (
            simulator.mj_model,
            simulator.space,
            simulator.dt,
        )
        ends = np.cumsum([len(run) for run in runs])
        rows = [
            np.arange(end - len(run), end - steps)
            for end, run in zip(ends, runs, strict=True)
        ]
        self._rows = np.concatenate(rows)
        if not len(self._rows):
            longest = max(runs, key=len)
            raise UserError(
                f"the longest run ({longest.name}) has {len(longest)} rows, too few to "
                f"send {steps} commands: record more in one run, or lower "
                "--set rollout_steps"
            )
        m, hidden = self.mj_model, hidden_in_any(runs)
        qpos = np.concatenate([on_its_feet(m, run) for run in runs])
        qvel = np.concatenate([np.where(hidden, 0.0, run.qvel) for run in runs])
        self._state = tuple(jnp.asarray(x, jnp.float32) for x in (qpos, qvel))
        self._ctrl = jnp.asarray(np.concatenate([r.ctrl for r in runs]), jnp.float32)
        base = [j for j in range(m.njnt) if is_free(m, j)]
        self._quat = int(m.jnt_qposadr[base[0]]) + 3 if base else None

    def model(self, theta: Any = None) -> Any:
        """The model at ``theta (n,)`` in SI units; nominal without it."""
        nominal = jnp.asarray(self.space.nominal)
        return self.simulator.model(nominal if theta is None else theta)

    def reset(self, model: Any, key: jax.Array) -> EnvState:
        """At a row of the log."""
        del model
        row = jax.random.choice(key, jnp.asarray(self._rows))
        qpos, qvel = (x[row] for x in self._state)
        return start(self.simulator.start(qpos, qvel), row[None].astype(float), row)

    def control(self, state: EnvState, action: jax.Array) -> jax.Array:
        """The log's command."""
        del action
        return self._ctrl[state.memory]

    def step(self, model: Any, state: EnvState, action: jax.Array) -> EnvState:
        """One control step; ends where the base tips over or is not finite."""
        ctrl = self.control(state, action)
        physics = self.simulator.step(model, state.physics, ctrl)
        failed = ~(jnp.isfinite(physics.qpos).all() & jnp.isfinite(physics.qvel).all())
        if self._quat is not None:
            _, x, y, _ = physics.qpos[self._quat : self._quat + 4]
            failed |= 1 - 2 * (x**2 + y**2) < _UPRIGHT
        row = state.memory + 1
        obs = row[None].astype(float)
        limit = self.episode_length
        return advance(state, physics, obs, jnp.zeros(()), failed, limit, row)


def on_its_feet(m: mujoco.MjModel, run: Run) -> np.ndarray:
    """Positions ``(T, nq)`` of a run, its base, where it was not measured, as in the
    first key frame or the model, and so high that the lowest geom that can touch
    something touches the ground, where there is a plane."""
    out = run.qpos.copy()
    free = [j for j in range(m.njnt) if is_free(m, j) and run.hidden[m.jnt_dofadr[j]]]
    if not free:
        return out
    at = int(m.jnt_qposadr[free[0]])
    kept = m.key_qpos[0] if m.nkey else m.qpos0
    out[:, at : at + 7] = kept[at : at + 7]
    planes = m.geom_type == int(mujoco.mjtGeom.mjGEOM_PLANE)
    moving = m.body_treeid[m.geom_bodyid] >= 0
    feet = moving & ((m.geom_contype | m.geom_conaffinity) > 0)
    if not planes.any() or not feet.any():
        return out
    scalars = [q for q, _ in scalar_dofs(m).values()]
    data, ground = mujoco.MjData(copy.copy(m)), int(np.flatnonzero(planes)[0])
    for row in out:
        data.qpos[:] = kept
        data.qpos[scalars] = row[scalars]
        mujoco.mj_kinematics(m, data)
        lowest = min(_clearance(m, data, int(g), ground) for g in np.flatnonzero(feet))
        row[at + 2] -= lowest
    return out


def _clearance(m: mujoco.MjModel, d: mujoco.MjData, geom: int, plane: int) -> float:
    """How far a geom is above a plane [m]."""
    return mujoco.mj_geomDistance(m, d, geom, plane, 10.0, None)
