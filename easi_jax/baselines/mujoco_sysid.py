"""MuJoCo's own identification toolbox, on the same logs and parameters."""

import io
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from easi_jax.baselines.replay_cma_es import channel_scale, paid_pieces
from easi_jax.baselines.task import Budget, Identified, Task
from easi_jax.data.segments import Segments
from easi_jax.devices.runtime import cores
from easi_jax.errors import UserError
from easi_jax.model.distribution import gaussian
from easi_jax.model.joint_space import Configuration
from easi_jax.model.mujoco_warnings import warnings_to
from easi_jax.simulation.mujoco_c import InMujoco

_ITERATIONS = 20  # that Gauss-Newton needs from far away
_TRIALS = 8  # simulations of a step's length, on average, that the budget allows for
_FAR = 10.0  # initial ranges; the optimizer wants finite bounds


@dataclass(frozen=True)
class MujocoSysid:
    """``mujoco.sysid`` (MuJoCo 4.0, ``mujoco[sysid]``): Gauss-Newton in MuJoCo C.

    Its own rollouts, residual and optimizer (bounded Levenberg-Marquardt with finite
    differences, ``mujoco.minimize``), from the middle of where a search starts. Logged
    commands are replayed from logged states; errors, in the tangent space, count in
    units of their motion, as the toolbox does by default. It fits our unit coordinates,
    so that positive parameters are logarithms. The covariance is the toolbox's,
    from its last Jacobian and the residual's variance; along what the data leave open,
    where that is beyond all bounds, it is that of the start.

    MuJoCo C has no word for a joint's speed limit, nor for effects such as a delay:
    these stay at the start with its spread (`Identified.unreached`), and in C there is
    no such limit or effect.
    """

    pieces: int | None = None
    """Logged pieces that are replayed; not given: as many as the budget pays for in 20
    iterations."""
    horizon: int = 25
    """Control steps of a piece."""
    iterations: int = 200
    """At most; fewer where the budget does not pay for them."""

    def fit(
        self, task: Task, demonstrations: Segments, budget: Budget, key: jax.Array
    ) -> Identified:
        """The optimizer's solution, and its confidence.

        Raises:
            UserError: the toolbox's own dependencies are missing.
        """
        del key  # nothing is random
        sysid = toolbox()
        step = task.space.size + _TRIALS
        chosen = demonstrations, self.horizon, self.pieces
        pieces = paid_pieces(task, *chosen, budget, _ITERATIONS * step)
        each = pieces.count * pieces.horizon
        rounds = budget.rounds(each * step)
        write = InMujoco(task.simulator)
        logs = _Logs(task, pieces, write.base, sysid)
        start, free = np.asarray(task.start_mean, float), write.reaches
        simulated = 0

        def build(parameters: Any) -> mujoco.MjModel:
            unit = start.copy()
            unit[free] = parameters.as_vector()
            return write.at(unit)

        def residual(x: np.ndarray, parameters: Any) -> Any:
            """Of one point ``(k,)``, or of several ``(k, K)``."""
            nonlocal simulated
            points = x.reshape(len(x), -1).T
            simulated += each * len(points)
            found = [
                sysid.model_residual(
                    point,
                    parameters,
                    build,
                    logs.trajectories,
                    modify_residual=logs.difference,
                    n_threads=cores(),
                    resample_true=False,
                )[0]
                for point in points
            ]
            return [np.stack(found, -1).reshape(-1, *x.shape[1:])], [], []

        low, high = (np.clip(b, -_FAR, _FAR) for b in task.space.unit_bounds)
        parameters = sysid.ParameterDict()
        for i in np.flatnonzero(free):
            name = task.space.names[i]
            parameters.add(sysid.Parameter(name, start[i], low[i], high[i]))
        # One that goes astray is seen in the residual; MuJoCo need not tell of it.
        with warnings_to():
            found, result = sysid.optimize(
                parameters,
                residual,
                verbose=False,
                max_iters=min(self.iterations, rounds),
                output=io.StringIO(),
            )
            solution = found.as_vector()
            last = residual(solution, found)[0]
        own, _ = sysid.calculate_intervals(last, result.jac)
        mean, cov = start.copy(), np.diag(np.asarray(task.start_std, float) ** 2)
        mean[free] = solution
        cov[np.ix_(free, free)] = _within(own, np.diag(cov).max())
        distribution = gaussian(
            task.space, jnp.asarray(mean, float), jnp.asarray(cov, float)
        )
        unreached = tuple(task.space.names[i] for i in np.flatnonzero(~free))
        return Identified(distribution, task.space, simulated, unreached=unreached)


def toolbox() -> Any:
    """The module ``mujoco.sysid``.

    Raises:
        UserError: it is not there as a whole.
    """
    from mujoco import sysid

    # Its import does not fail where a dependency is missing: it is then empty.
    if not hasattr(sysid, "optimize") or not hasattr(sysid, "model_residual"):
        raise UserError("mujoco.sysid is incomplete: pip install easi-jax[peers]")
    return sysid


class _Logs:
    """Pieces as the toolbox takes them, and how they are compared."""

    def __init__(
        self, task: Task, pieces: Segments, m: mujoco.MjModel, sysid: Any
    ) -> None:
        self._joints, self._nq = Configuration.of(m), m.nq
        self._substeps = task.simulator.substeps
        self._scale = np.asarray(channel_scale(task, pieces), float)
        p = jax.tree.map(lambda x: np.asarray(x, float), pieces)
        after = np.concatenate([p.next_qpos, p.next_qvel], -1)
        # The toolbox leaves the last command out.
        sent = np.repeat(p.ctrl, self._substeps, axis=1)
        sent = np.concatenate([sent, sent[:, -1:]], 1)
        times = np.arange(sent.shape[1]) * m.opt.timestep
        ends = times[self._substeps :: self._substeps]
        self.trajectories = [
            sysid.SystemTrajectory(
                model=m,
                control=sysid.TimeSeries(times, sent[i]),
                sensordata=sysid.TimeSeries(ends, after[i]),
                initial_state=sysid.create_initial_state(m, p.qpos[i], p.qvel[i]),
                state=None,
            )
            for i in np.flatnonzero(p.weight > 0)
        ]

    def difference(
        self,
        parameters: Any,
        predicted: Any,
        measured: Any,
        model: mujoco.MjModel,
        return_all: bool,
        *,
        state: np.ndarray,
    ) -> tuple[np.ndarray, Any, Any]:
        """Residual ``(H, 2 nv)`` of one piece; ``state`` has a row per physics step:
        time, positions, velocities, activations."""
        del parameters, predicted, model, return_all
        after = state[self._substeps - 1 :: self._substeps, 1:]
        nq, nv = self._joints.nq, self._joints.nv
        qpos, qvel = np.split(measured.data, [nq], axis=1)
        error = [
            self._joints.difference(qpos, after[:, :nq]),
            after[:, nq : nq + nv] - qvel,
        ]
        return np.concatenate(error, 1) / self._scale, measured, measured


def _within(cov: np.ndarray, most: float) -> np.ndarray:
    """A covariance whose eigenvalues are at most ``most``; rounding of what is
    undetermined may have made them negative."""
    values, vectors = np.linalg.eigh(0.5 * (cov + cov.T))
    values = np.where((values < 0) | (values > most), most, values)
    return (vectors * values) @ vectors.T
