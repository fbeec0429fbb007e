"""The model's own parameters that a refit may move."""

import mujoco
import numpy as np

from easi_jax.parameters import Parameter, ParameterSpace
from easi_jax.quantities import scalar_dofs


def own_space(m: mujoco.MjModel) -> ParameterSpace:
    """What the model states and a refit may move: damping, frictionloss and stiffness
    of joints where they are not zero, each within a factor of 5."""
    found = []
    for j, (_, d) in scalar_dofs(m).items():
        name = m.joint(j).name
        if not name:
            continue
        for quantity, value in (
            ("damping", m.dof_damping[d]),
            ("frictionloss", m.dof_frictionloss[d]),
            ("stiffness", m.jnt_stiffness[j]),
        ):
            value = float(np.atleast_1d(value)[0])
            if value > 0:
                edge = (value / 5, value * 5)
                address = f"joint.{name}.{quantity}"
                found.append(Parameter(address, (address,), value, edge, edge))
    return ParameterSpace(tuple(found))
