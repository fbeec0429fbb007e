"""How large positions, torques and commands are in recorded data."""

from collections.abc import Sequence

import mujoco
import numpy as np

from easi_jax.data.activations import activation_guess
from easi_jax.data.drive_forces import drive_forces
from easi_jax.data.recording import Run
from easi_jax.data.unmeasured import hidden_in_any, start_spread
from easi_jax.data.windows import fitted_velocity
from easi_jax.model.contact_pairs import pair_ids, touching
from easi_jax.model.effect_catalog import Scales
from easi_jax.model.joint_space import scalar_places

_ROWS = 400
_LONGEST = 0.1  # s
_PEAK = 99.8  # percentile


def scales_of(m: mujoco.MjModel, runs: Sequence[Run]) -> Scales:
    """Scales of the motion in ``runs`` under the model as given; of what is hidden, how
    far and how fast it may be (`easi_jax.data.unmeasured.start_spread`)."""
    d = mujoco.MjData(m)
    total = sum(len(r) for r in runs)
    stride = max(1, total // _ROWS)
    names = "v", "a", "torque", "force", "inertia", "alone", "ctrl", "q", "touching"
    rows: dict[str, list[np.ndarray]] = {name: [] for name in names}
    full, pairs = np.zeros((m.nv, m.nv)), pair_ids(m)
    for run in runs:
        v = fitted_velocity(run.qpos, run.dt, run.configuration)
        span = min(max(1, round(0.02 / run.dt)), len(run) - 1)
        start = np.broadcast_to(m.qpos0, run.qpos.shape)
        moved = run.configuration.difference(start, run.qpos)
        act = activation_guess(m, run)
        for i in range(0, len(run) - span, stride):
            d.qpos[:], d.qvel[:] = run.qpos[i], v[i]
            d.qacc[:] = (v[i + span] - v[i]) / (span * run.dt)
            d.ctrl[:], d.act[:] = run.ctrl[i], act[i]
            acceleration = d.qacc.copy()
            mujoco.mj_forward(m, d)
            rows["touching"].append(np.array(touching(pairs, d)))
            driven = d.qfrc_actuator.copy()
            force = d.actuator_force.copy()
            d.qacc[:] = acceleration
            mujoco.mj_inverse(m, d)
            mujoco.mj_fullM(m, d, full)
            rows["torque"].append(np.hypot(d.qfrc_inverse, driven))
            rows["force"].append(force)
            rows["inertia"].append(np.diag(full).copy())
            rows["alone"].append(1.0 / np.diag(np.linalg.pinv(full)))
            rows["v"].append(v[i])
            rows["a"].append(acceleration)
            rows["ctrl"].append(run.ctrl[i])
            rows["q"].append(moved[i])
    got = {k: np.array(x) for k, x in rows.items()}

    def rms(x: np.ndarray) -> np.ndarray:
        return np.sqrt(np.mean(np.minimum(x**2, 1e12), 0))

    low, high, home = got["q"].min(0), got["q"].max(0), np.zeros(m.nv)
    at, dof = scalar_places(m).T
    home[dof] = m.qpos0[at]
    forces = np.concatenate([drive_forces(m, run) for run in runs])
    inertia = got["inertia"].mean(0)
    speed = rms(got["v"])
    torque = np.median(np.abs(got["torque"]), 0)
    torque = np.maximum(torque, inertia * np.median(np.abs(got["a"]), 0))
    position, span = got["q"].std(0), high - low
    hidden = hidden_in_any(runs)
    if hidden.any():
        far, fast = np.split(start_spread(m, runs), 2)
        position, speed = np.where(hidden, [far, fast], [position, speed])
        span = np.where(hidden, 2 * far, span)
    return Scales(
        position=np.maximum(position, 1e-9),
        speed=np.maximum(speed, 1e-9),
        acceleration=rms(got["a"]),
        torque=np.maximum(torque, 1e-9),
        most=np.abs(got["torque"]).max(0),
        inertia=inertia,
        alone=got["alone"].min(0),
        command=np.maximum(rms(got["ctrl"]), 1e-9) if m.nu else np.zeros(0),
        force=np.maximum(rms(got["force"]), 1e-9) if m.nu else np.zeros(0),
        peak=np.percentile(np.abs(forces), _PEAK, axis=0) if m.nu else np.zeros(0),
        span=np.maximum(span, 1e-9),
        middle=home + 0.5 * (low + high),
        touching=got["touching"].mean(0),
        dt=runs[0].dt,
        longest=max(_LONGEST, 3 * runs[0].dt),
        hidden=tuple(hidden.tolist()),
    )
