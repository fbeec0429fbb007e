"""Machines and logs of `benchmarks.walking`."""

import numpy as np
import pytest

from benchmarks.paper_twin import walker
from benchmarks.walking import IMU, MACHINES, Cell, machine_of


@pytest.mark.parametrize("machine", MACHINES)
def test_what_is_true_of_a_machine_is_in_it(machine: str) -> None:
    env = walker()
    twin, truth = machine_of(Cell(machine, IMU, 1), env)
    m, nominal = twin.model, env.mj_model
    for k, joint in enumerate(("hip", "thigh", "calf")):
        np.testing.assert_allclose(m.actuator_gainprm[k::3, 0], truth[f"{joint}_kp"])
        kv = -m.actuator_biasprm[k::3, 2] + m.dof_damping[6 + k :: 3]
        np.testing.assert_allclose(kv, truth[f"{joint}_kv"])
    base = m.body("base").id
    assert m.body_mass[base] == pytest.approx(truth["base_mass"])
    assert truth["base_mass"] != pytest.approx(nominal.body_mass[base])
    late = twin._late[0] * env.dt + twin._late[1] * m.opt.timestep
    assert late == pytest.approx(truth["delay"])


def test_seeds_are_different_machines() -> None:
    env = walker()
    one, other = (machine_of(Cell(MACHINES[0], IMU, k), env)[1] for k in (0, 1))
    assert one != other
    assert machine_of(Cell(MACHINES[0], IMU, 0), env)[1] == one
