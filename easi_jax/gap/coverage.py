"""What the fitting data never show, so that no fit can know it."""

from collections.abc import Sequence

import mujoco
import numpy as np

from easi_jax.quantities import actuator_name, joint_name, joint_unit, scalar_dofs
from easi_jax.recording import Run
from easi_jax.windows import fitted_velocity

_ONE_WAY = 0.02  # share of the travel that the way back has at least
_FASTER = 1.5  # times what the fitting data reach
_MOST = 99.0  # percentile; single rows are outliers


def coverage_notes(
    m: mujoco.MjModel, fit: Sequence[Run], held: Sequence[Run]
) -> list[str]:
    """Directions and ranges that are missing in the fitting data, a sentence each.

    A joint that only ever moves one way cannot tell dry friction from a constant force;
    commands of one sign cannot tell an offset from a gain; held-out data beyond the
    fitted range test what was extrapolated.

    Args:
        m: the model; hinges and slides are looked at.
        fit: runs that fits see.
        held: runs that are held out.
    """
    notes = []
    speeds = [
        [fitted_velocity(r.qpos, r.dt, r.configuration) for r in part]
        for part in (fit, held)
    ]
    for j, (_, dof) in scalar_dofs(m).items():
        name = joint_name(m, j)
        unit = joint_unit("m/s", "rad/s")(m, j)
        mine, theirs = (np.concatenate([v[:, dof] for v in part]) for part in speeds)
        forth, back = np.maximum(mine, 0).sum(), np.maximum(-mine, 0).sum()
        if forth + back > 0 and min(forth, back) < _ONE_WAY * (forth + back):
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
    return notes


def _beyond(what: str, fit: np.ndarray, held: np.ndarray, unit: str) -> list[str]:
    mine, theirs = (float(np.percentile(np.abs(x), _MOST)) for x in (fit, held))
    if theirs <= _FASTER * mine or theirs == 0:
        return []
    unit = f" {unit}" if unit else ""
    return [
        f"{what} reaches {theirs:.3g}{unit} in the held-out data and {mine:.3g}{unit} "
        "in the fitting data: effects that only show beyond that are extrapolated"
    ]
