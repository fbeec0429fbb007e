"""What is said of measured runs before anything is fitted."""

from pathlib import Path

import mujoco
import numpy as np
import pytest

from easi_jax.data.measured import measured_runs
from easi_jax.io.logs.reader import read_logs

XML = """<mujoco><option timestep=".01"/><worldbody><body><joint name="hinge"/>
<geom size=".1"/></body></worldbody><actuator>{drive}</actuator></mujoco>"""


@pytest.mark.parametrize(
    ("drive", "told"),
    [
        ('<motor name="a" joint="hinge"/>', False),
        ('<position name="a" joint="hinge" kp="9" timeconst=".05"/>', True),
        ('<intvelocity name="a" joint="hinge" kp="9" actrange="-1 1"/>', True),
    ],
)
def test_drives_with_a_state_are_named(tmp_path: Path, drive: str, told: bool) -> None:
    m = mujoco.MjModel.from_xml_string(XML.format(drive=drive))
    time = 0.01 * np.arange(400)
    rows = np.stack([time, np.sin(3 * time), np.cos(3 * time)], 1)
    path = tmp_path / "log.csv"
    header = "time,qpos.hinge,ctrl.a"
    np.savetxt(path, rows, delimiter=",", header=header, comments="")
    notes = measured_runs(m, read_logs([path], m), None, 0.2).notes
    said = [n for n in notes if "with a state of their own (activation): a;" in n]
    assert len(said) == told
