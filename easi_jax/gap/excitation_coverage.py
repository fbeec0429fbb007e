"""What the fitting data never show, so that no fit can know it."""

from collections.abc import Sequence

import mujoco
import numpy as np

from easi_jax.data.recording import Run
from easi_jax.data.unmeasured import hidden_in_any
from easi_jax.data.windows import fitted_velocity
from easi_jax.gap.decisions import DECIDE
from easi_jax.model.joint_space import joint_name, scalar_dofs
from easi_jax.model.quantities import actuator_name, joint_unit

_PAST = 4  # rows that a command is foretold from
_STILL = 1e-6  # share of their variance, below which nothing is new in commands
_MOST = 99.0  # percentile; single rows are outliers


def coverage_notes(
    m: mujoco.MjModel, fit: Sequence[Run], held: Sequence[Run]
) -> list[str]:
    """Directions and ranges that are missing in the fitting data, a sentence each.

    A joint that only ever moves one way cannot tell dry friction from a constant force;
    commands of one sign cannot tell an offset from a gain; held-out data beyond the
    fitted range test what was extrapolated.

    Args:
        m: the model; hinges and slides that were measured are looked at.
        fit: runs that fits see.
        held: runs that are held out.
    """
    notes = []
    speeds = [
        [fitted_velocity(r.qpos, r.dt, r.configuration) for r in part]
        for part in (fit, held)
    ]
    hidden = hidden_in_any([*fit, *held])
    for j, (_, dof) in scalar_dofs(m).items():
        if hidden[dof]:
            continue
        name = joint_name(m, j)
        unit = joint_unit("m/s", "rad/s")(m, j)
        mine, theirs = (np.concatenate([v[:, dof] for v in part]) for part in speeds)
        forth, back = np.maximum(mine, 0).sum(), np.maximum(-mine, 0).sum()
        if forth + back > 0 and min(forth, back) < DECIDE.one_way * (forth + back):
            way = "positive" if forth > back else "negative"
            notes.append(
                f"the fitting data move joint {name} in the {way} direction only: dry "
                "friction and a constant force look the same there; record both ways"
            )
        notes += _beyond(f"the speed of joint {name}", mine, theirs, unit)
    for i in range(m.nu):
        name = actuator_name(m, i)
        mine, theirs = (
            np.concatenate([r.ctrl[:, i] for r in part]) for part in (fit, held)
        )
        low, high = mine.min(), mine.max()
        if high > low and (low >= 0 or high <= 0):
            sign = "negative" if low >= 0 else "positive"
            notes.append(
                f"commands of actuator {name} are never {sign} in the fitting data: "
                "its gain and an offset look alike there; record both signs"
            )
        notes += _beyond(f"the command of actuator {name}", mine, theirs, "")
    closed = [actuator_name(m, a) for a in _fed_back(fit)]
    if closed:
        notes.append(
            f"commands of {', '.join(closed)} follow the measured state from row to "
            "row: recorded in closed loop, where the noise of the sensors comes back "
            "as commands and what the controller suppresses is hardly seen; add a test "
            "signal to the commands, or record open loop"
        )
    return notes


def _fed_back(runs: Sequence[Run]) -> list[int]:
    """Actuators whose command at a row is made from the state measured there.

    What is new in a reading, beyond all rows before it, is noise or what has just
    happened; a command that was not made from it does not know it.
    """
    state = np.concatenate([_new(r.qpos, r)[0] for r in runs])
    command = np.concatenate([_new(r.qpos, r)[1] for r in runs])
    if len(command) < DECIDE.fed_back_rows * max(1, state.shape[1]):
        return []
    known = np.linalg.lstsq(state, command, rcond=None)[0]
    left = (command - state @ known).var(0)
    whole = command.var(0)
    moved = np.concatenate([r.ctrl for r in runs]).var(0)
    told = (whole > _STILL * moved) & (left < (1 - DECIDE.fed_back) * whole)
    return np.flatnonzero(told).tolist()


def _new(qpos: np.ndarray, run: Run) -> tuple[np.ndarray, np.ndarray]:
    """What positions ``(T, n)`` and commands ``(T, nu)`` of a run do not owe to the
    rows before, by least squares."""
    c = run.configuration
    places = zip(c.scalar_qpos, c.scalar_qvel, strict=True)
    scalar = [q for q, v in places if not run.hidden[v]]
    both = np.concatenate([qpos[:, scalar], run.ctrl], 1)
    if len(both) <= _PAST + 1:
        return np.zeros((0, len(scalar))), np.zeros((0, run.ctrl.shape[1]))
    rows = len(both) - _PAST
    past = [both[k : k + rows] for k in range(_PAST)]
    given = np.concatenate([*past, np.ones((rows, 1))], 1)
    now = both[_PAST:]
    new = now - given @ np.linalg.lstsq(given, now, rcond=None)[0]
    return new[:, : len(scalar)], new[:, len(scalar) :]


def _beyond(what: str, fit: np.ndarray, held: np.ndarray, unit: str) -> list[str]:
    mine, theirs = (float(np.percentile(np.abs(x), _MOST)) for x in (fit, held))
    if theirs <= DECIDE.faster * mine or theirs == 0:
        return []
    unit = f" {unit}" if unit else ""
    return [
        f"{what} reaches {theirs:.3g}{unit} in the held-out data and {mine:.3g}{unit} "
        "in the fitting data: effects that only show beyond that are extrapolated"
    ]
