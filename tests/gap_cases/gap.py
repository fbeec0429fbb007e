"""The contract's gap and floor in plain MuJoCo C, open loop."""

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from mujoco import rollout

from tests.gap_cases.effects import CaseError
from tests.gap_cases.logs import Log, Noise

HORIZON = 0.2
FIT = 0.02
LEAST_STEPS = 10


@dataclass(frozen=True)
class Gap:
    """Figures over all windows of the given runs.

    Attributes:
        gap: the contract's gap of the model.
        floor: what noise alone gives, pushed through the model.
        best: what a perfect model would have: noise as it fell, with the error of the
            quadratic fit to motion that is no quadratic.
        rms: (nq,) the gap per joint, m or rad.
        rms_floor: (nq,) the floor per joint, m or rad.
        ignored: joints that move too little to count.
        windows: number of windows.
    """

    gap: float
    floor: float
    best: float
    rms: np.ndarray
    rms_floor: np.ndarray
    ignored: list[str]
    windows: int

    @property
    def ratio(self) -> float:
        return self.gap / self.floor


@dataclass(frozen=True)
class Windows:
    """Windows of one run: indices of their first rows, and their commands; `sent` are
    all commands of the run."""

    start: np.ndarray
    steps: int
    half: int
    dt: float
    ctrl: np.ndarray
    sent: np.ndarray

    def rows(self) -> np.ndarray:
        """(N, H) indices of the predicted rows."""
        return self.start[:, None] + np.arange(1, self.steps + 1)


def half_width(dt: float) -> int:
    """Rows on either side that a velocity fit takes: 20 ms, at least 5 rows in all."""
    return max(2, int(np.floor(FIT / dt + 1e-6)))


def slope(values: np.ndarray, dt: float) -> np.ndarray:
    """Derivative at the middle of a quadratic through (..., 2 w + 1) even samples."""
    half = values.shape[-1] // 2
    k = np.arange(-half, half + 1)
    return values @ k / (dt * np.sum(k**2))


def windows_of(log: Log, every: int = 1) -> Windows:
    """Windows every half horizon that lie, with their fits, inside the run."""
    dt = log.step
    steps = max(LEAST_STEPS, round(HORIZON / dt))
    half = half_width(dt)
    last = len(log.time) - 1 - max(steps, half)
    start = np.arange(half, last + 1, every * max(1, steps // 2))
    rows = start[:, None] + np.arange(steps)
    return Windows(start, steps, half, dt, log.ctrl[rows], log.ctrl)


def activations(model: mujoco.MjModel, sent: np.ndarray, dt: float) -> np.ndarray:
    """What commands (T, nu) make of the activations of exact filters, (T, na); settled
    at the first row."""
    of = np.flatnonzero(model.actuator_dyntype != mujoco.mjtDyn.mjDYN_NONE.value)
    kept = np.exp(-dt / model.actuator_dynprm[of, 0])
    found = sent[:, of].copy()
    for row in range(1, len(found)):
        found[row] = kept * found[row - 1] + (1.0 - kept) * sent[row - 1, of]
    return found


def predict(
    model: mujoco.MjModel, windows: Windows, qpos: np.ndarray, qvel: np.ndarray
) -> np.ndarray:
    """Open-loop positions (N, H, nq) from states (N, nq), at the model's timestep."""
    parts = int(np.ceil(windows.dt / model.opt.timestep - 1e-6))
    keep = model.opt.timestep
    model.opt.timestep = windows.dt / parts
    count = mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS.value)
    initial = np.zeros((len(qpos), count))
    initial[:, 1 : 1 + model.nq] = qpos
    initial[:, 1 + model.nq : 1 + model.nq + model.nv] = qvel
    if model.na:
        first = 1 + model.nq + model.nv
        act = activations(model, windows.sent, windows.dt)
        initial[:, first : first + model.na] = act[windows.start]
    control = np.repeat(windows.ctrl, parts, axis=1)
    states, _ = rollout.rollout(model, mujoco.MjData(model), initial, control)
    model.opt.timestep = keep
    return states[:, parts - 1 :: parts, 1 : 1 + model.nq]


def _wrapped(model: mujoco.MjModel, error: np.ndarray) -> np.ndarray:
    free = (model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE) & (model.jnt_limited == 0)
    turned = (error + np.pi) % (2 * np.pi) - np.pi
    return np.where(free, turned, error)


def start_states(log: Log, windows: Windows) -> tuple[np.ndarray, np.ndarray]:
    """Position and fitted velocity at each window's first row, both (N, nq)."""
    around = windows.start[:, None] + np.arange(-windows.half, windows.half + 1)
    return log.qpos[windows.start], slope(
        np.moveaxis(log.qpos[around], 1, -1), windows.dt
    )


def measure(
    model: mujoco.MjModel,
    logs: Sequence[Log],
    noise: Noise,
    rng: np.random.Generator,
    final: mujoco.MjModel | None = None,
    quick: bool = False,
) -> Gap:
    """The gap of `model` on the runs, with the floor of their noise.

    Noise is pushed through `final`, the model nearest to the truth, or through `model`.
    `quick` takes every second window and leaves out `best`.
    """
    push = final or model
    everything = np.concatenate([log.qpos for log in logs])
    variance = everything.var(axis=0)
    errors, floors, bests, changes = [], [], [], []
    for log in logs:
        windows = windows_of(log, every=2 if quick else 1)
        count, width = len(windows.start), 2 * windows.half + 1
        targets = log.qpos[windows.rows()]
        qpos, qvel = start_states(log, windows)
        path = predict(model, windows, qpos, qvel)
        draws = noise.total * rng.standard_normal((count, width, model.nq))
        pushed = path if final is None else predict(push, windows, qpos, qvel)
        shaken = predict(
            push,
            windows,
            qpos + draws[:, windows.half],
            qvel + slope(np.moveaxis(draws, 1, -1), windows.dt),
        )
        if not quick:
            first = windows.start
            exact = predict(push, windows, log.true_qpos[first], log.true_qvel[first])
            missed = targets - log.true_qpos[windows.rows()]
            bests.append(_wrapped(model, pushed - exact - missed))
        blur = noise.total * rng.standard_normal(targets.shape)
        errors.append(_wrapped(model, path - targets))
        floors.append(_wrapped(model, shaken - pushed) + blur)
        changes.append(log.qpos[windows.start + windows.steps] - qpos)
    change = np.sqrt(np.mean(np.concatenate(changes) ** 2, axis=0))
    counted = change >= 5.0 * noise.total
    names = [model.joint(i).name for i in range(model.nq)]

    def total(parts: list[np.ndarray]) -> tuple[float, np.ndarray]:
        square = np.concatenate(
            [np.mean(part**2, axis=1) for part in parts], axis=0
        ).mean(axis=0)
        return float(np.sqrt(np.mean((square / variance)[counted]))), np.sqrt(square)

    if not counted.any():
        raise CaseError("no joint moves by more than its noise")
    (gap, rms), (floor, rms_floor) = total(errors), total(floors)
    return Gap(
        gap=gap,
        floor=floor,
        best=total(bests)[0] if bests else float("nan"),
        rms=rms,
        rms_floor=rms_floor,
        ignored=[name for name, use in zip(names, counted, strict=True) if not use],
        windows=sum(len(part) for part in errors),
    )
