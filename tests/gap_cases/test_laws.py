"""The generator of hidden laws: sizes, and what it writes down."""

import json
from pathlib import Path

import mujoco
import numpy as np
import pytest

from tests.gap_cases.laws import CONTROLS, LAWS, MACHINES, ROW, RUNS, draw_law


@pytest.mark.parametrize("control", [False, True])
def test_a_case_says_what_it_hides(control: bool, tmp_path: Path) -> None:
    answer = draw_law(3, tmp_path, control)
    assert answer == json.loads((tmp_path / "answer.json").read_text())
    assert answer["law"] in (CONTROLS if control else LAWS)
    assert 3 <= answer["floors"] <= 30
    m = mujoco.MjModel.from_xml_path(str(tmp_path / "model.xml"))
    hidden = np.load(tmp_path / "hidden.npz")
    assert len(hidden.files) == RUNS
    for name in hidden.files:
        table = np.loadtxt(tmp_path / f"{name}.csv", delimiter=",", skiprows=1)
        assert table.shape == (len(hidden[name]), 1 + m.njnt + m.nu)
        np.testing.assert_allclose(np.diff(table[:, 0]), ROW, atol=1e-9)
        assert np.abs(hidden[name]).max() > 0
    again = tmp_path / "again"
    draw_law(3, again, control)
    assert (again / "run1.csv").read_text() == (tmp_path / "run1.csv").read_text()


@pytest.mark.parametrize("machine", MACHINES)
def test_machines_have_a_motor_at_each_joint(machine: str) -> None:
    m = mujoco.MjModel.from_xml_string(MACHINES[machine])
    assert m.nu == m.njnt == m.nv
