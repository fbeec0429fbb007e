"""The files shown in docs/your_own_robot.md work as they stand."""

import re
from pathlib import Path

import mujoco
import numpy as np
import pytest

from easi_jax.io.logs.reader import read_logs
from easi_jax.io.models.parameter_file import read_parameter_file

ROOT = Path(__file__).parents[2]
EXAMPLE = ROOT / "examples" / "lift_arm"


@pytest.fixture(scope="module")
def blocks() -> list[str]:
    page = (ROOT / "docs" / "your_own_robot.md").read_text(encoding="utf-8")
    return re.findall(r"```yaml\n(.*?)```", page, flags=re.DOTALL)


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_path(str(EXAMPLE / "model.xml"))


def test_mapping_of_the_page(blocks, model, tmp_path):
    (tmp_path / "map.yaml").write_text(blocks[0])
    (expected,) = read_logs(EXAMPLE / "moves.csv", model).runs
    lines = ["timestamp_ms,arm_angle_deg,qpos.elbow,motor_current,ctrl.elbow_motor"]
    for time, qpos, ctrl in zip(
        expected.time, expected.qpos, expected.ctrl, strict=True
    ):
        angle = np.degrees(qpos[0]) + 90
        lines.append(f"{1000 * time},{angle},{qpos[1]},{ctrl[0]},{ctrl[1]}")
    (tmp_path / "log.csv").write_text("\n".join(lines) + "\n")
    log = read_logs(tmp_path / "log.csv", model, mapping=tmp_path / "map.yaml")
    np.testing.assert_allclose(log.runs[0].qpos, expected.qpos, atol=2e-5)
    np.testing.assert_allclose(log.runs[0].time, expected.time, atol=1e-9)
    np.testing.assert_array_equal(log.runs[0].ctrl, expected.ctrl)


def test_parameters_of_the_page(blocks, model, tmp_path):
    (tmp_path / "parameters.yaml").write_text(blocks[1])
    space = read_parameter_file(tmp_path / "parameters.yaml", model)
    assert space.names == ("friction", "load_mass")
    np.testing.assert_allclose(space.nominal, [0.1, 0.3])
