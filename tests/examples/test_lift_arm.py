"""The lift arm example: its logs are what make_log.py makes, and carry the truth."""

import runpy
from pathlib import Path
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest

from easi_jax.data.recording import physics_steps
from easi_jax.data.windows import make_windows
from easi_jax.io.logs.reader import read_logs
from easi_jax.io.models.parameter_file import read_parameter_file
from easi_jax.io.report.numbers import shown_unit

EXAMPLE = Path(__file__).parents[2] / "examples" / "lift_arm"
LOGS = [EXAMPLE / "sweep.csv", EXAMPLE / "moves.csv"]


@pytest.fixture(scope="module")
def make_log():
    return SimpleNamespace(**runpy.run_path(str(EXAMPLE / "make_log.py")))


@pytest.fixture(scope="module")
def nominal() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_path(str(EXAMPLE / "model.xml"))


def test_logs_are_made_again_byte_for_byte(make_log, tmp_path):
    make_log.main(tmp_path)
    for path in LOGS:
        assert (tmp_path / path.name).read_bytes() == path.read_bytes()
    assert sum(path.stat().st_size for path in EXAMPLE.iterdir()) < 400_000


def test_logs_read_without_complaint(nominal):
    log = read_logs(LOGS, nominal)
    assert [(run.name, len(run), run.dt) for run in log.runs] == [
        ("sweep", 2000, 0.01),
        ("moves", 2000, 0.01),
    ]
    assert all("velocities estimated" in note for note in log.notes)


def prediction_error(model: mujoco.MjModel, timestep: float) -> np.ndarray:
    model.opt.timestep = timestep
    data = mujoco.MjData(model)
    errors = []
    for run in read_logs(LOGS, model).runs:
        steps = physics_steps(run.dt, timestep)
        windows = make_windows(run, 0.2)
        for w in range(len(windows.start_row)):
            mujoco.mj_resetData(model, data)
            data.qpos[:] = windows.start_qpos[w]
            data.qvel[:] = windows.start_qvel[w]
            for ctrl, target in zip(
                windows.ctrl[w], windows.target_qpos[w], strict=True
            ):
                data.ctrl[:] = ctrl
                mujoco.mj_step(model, data, nstep=steps)
                errors.append(data.qpos - target)
    return np.sqrt(np.mean(np.square(errors), axis=0))


def test_truth_predicts_the_logs_and_the_model_does_not(make_log, nominal):
    timestep = nominal.opt.timestep
    truth = make_log.real_machine(EXAMPLE / "model.xml")
    assert np.all(prediction_error(truth, timestep) < 0.002)
    assert np.all(prediction_error(nominal, timestep) > 0.03)


def test_parameter_file_holds_the_truth_inside_its_start(make_log, nominal):
    space = read_parameter_file(EXAMPLE / "parameters.yaml", nominal)
    assert space.names == tuple(make_log.TRUTH)
    truth = np.array(list(make_log.TRUTH.values()))
    low, high = space.initial
    assert np.all((low < truth) & (truth < high))
    assert np.all(np.abs(truth / space.nominal - 1) > 0.05)
    readme = (EXAMPLE / "README.md").read_text()
    for value, given, unit in zip(truth, space.nominal, space.units, strict=True):
        assert f"| {given:g} | {value:g} | {shown_unit(unit)} |" in readme
