"""What is killed with ``--engine mujoco`` goes on to the same end, to the last bit."""

import json
import shutil
from pathlib import Path
from typing import Any

import jax
import mujoco
import numpy as np
import pytest

from easi_jax.io.runs import checkpoints
from easi_jax.io.runs.folder import engine_of
from easi_jax.pipeline.stages import Pipeline, PipelineConfig, seed_keys
from easi_jax.simulation import engine, native
from tests.commands import command
from tests.tiny_robot.env import XML, Tiny
from train import easi, udr
from train._robots import training_config

pytestmark = pytest.mark.timeout(900)

# Dry friction that one iteration of the solver does not find: it begins where the last
# step ended, so that is part of the state.
_ROUGH = XML.replace("damping", 'frictionloss="0.3" damping').replace(
    "integrator", 'iterations="1" ls_iterations="2" integrator'
)
_ENV = f'''from tests.tiny_robot.env import Tiny

def make():
    return Tiny("""{_ROUGH}""")
'''
_UDR = ("--env-steps", 1200, "--eval-episodes", 2, "--chunk", 12, "--target", "gear*.5")
_SEARCH = (
    *("--generations", 4, "--search-chunk", 2, "--population", 8, "--no-refine"),
    *("--set", "segments=16", "real_batch=64", "discriminator_updates=2"),
)
_EASI = (
    *_SEARCH,
    *("--trajectories", 4, "--eval-episodes", 2, "--target", "gear*.5"),
)
_PARAMETERS = """parameters:
  - {name: damping, address: joint.hinge.damping, initial: [0.05, 0.5]}
  - {name: dry, address: joint.hinge.frictionloss, initial: [0.1, 1.0]}
"""
_LAST = 24  # steps of training


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("native")
    (root / "env.py").write_text(_ENV)
    _call(udr, root, root / "udr", *_UDR)
    return root


def _call(module: object, root: Path, out: Path, *args: object) -> None:
    given = ("--env", root / "env.py", "--out", out, "--engine", "mujoco")
    command(module, *given, *args)


def _trained(run: Path) -> list[np.ndarray]:
    with engine.using("mujoco"):
        env = Tiny()
    pipe = Pipeline(env, PipelineConfig(training=training_config(env, 1200)))
    wide = pipe.spread(pipe.udr(), 1)
    like = jax.eval_shape(lambda k: pipe.train_init(k, wide), seed_keys([0]))
    found = checkpoints.restore(run / "checkpoints" / "train", like)
    assert found is not None and found.step == _LAST
    return [np.asarray(x) for x in jax.tree.leaves(found.state)]


@pytest.mark.fault("killed (signal 9), then resumed")
def test_training(runs: Path, tmp_path: Path) -> None:
    whole, copy = runs / "udr", tmp_path / "udr"
    assert engine_of(whole) == ("mujoco", "--engine mujoco")
    shutil.copytree(whole, copy)
    # As a kill in the second chunk would have left it.
    shutil.rmtree(copy / "checkpoints" / "train" / f"step_{_LAST:012d}")
    (copy / "results.json").unlink()
    _call(udr, runs, copy, *_UDR, "--resume")
    for a, b in zip(_trained(whole), _trained(copy), strict=True):
        np.testing.assert_array_equal(a, b)
    told = [json.loads((r / "results.json").read_text()) for r in (whole, copy)]
    assert told[0]["returns"] == told[1]["returns"]


@pytest.mark.slow
@pytest.mark.fault("killed (signal 9), then resumed")
def test_search_with_policies(runs: Path, tmp_path: Path) -> None:
    whole, copy = tmp_path / "whole", tmp_path / "easi"
    given = "--udr", runs / "udr", *_EASI
    _call(easi, runs, whole, *given)
    _kill_in_search(whole, copy)
    _call(easi, runs, copy, *given, "--resume")
    for name in ("distribution.json", "results.json"):
        assert (copy / name).read_text() == (whole / name).read_text(), name


def _kill_in_search(whole: Path, copy: Path) -> None:
    """As a kill in the second chunk of the search would have left it."""
    shutil.copytree(whole, copy)
    shutil.rmtree(copy / "checkpoints" / "search" / "step_000000000004")
    for stage in (copy / "checkpoints").iterdir():
        if stage.name != "search":
            shutil.rmtree(stage)
    for name in ("results.json", "distribution.json", "report.html"):
        (copy / name).unlink(missing_ok=True)


@pytest.mark.fault("an engine that fails in a run")
@pytest.mark.timeout(600, method="thread")  # a wait inside a program takes no signal
def test_search_of_logs_in_which_the_engine_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """What was written stays, and goes on to the same end."""
    m = mujoco.MjModel.from_xml_string(_ROUGH)
    d, rows = mujoco.MjData(m), ["time,qpos.hinge,ctrl.motor"]
    m.dof_damping[:] = 0.2
    for k in range(150):
        d.ctrl[:] = np.sin(0.2 * k)
        rows.append(f"{0.02 * k:.6g},{d.qpos[0]:.7f},{d.ctrl[0]:.7f}")
        mujoco.mj_step(m, d)
    files = {"model": "m.xml", "parameters": "p.yaml", "data": "log.csv"}
    texts = (_ROUGH, _PARAMETERS, "\n".join(rows) + "\n")
    given: list[object] = ["--engine", "mujoco", *_SEARCH]
    for (option, name), text in zip(files.items(), texts, strict=True):
        (tmp_path / name).write_text(text)
        given += [f"--{option}", tmp_path / name]
    whole, copy = tmp_path / "whole", tmp_path / "copy"
    command(easi, "--out", whole, *given)
    steps = native._Host.steps

    def failing(self: native._Host, *args: Any) -> Any:
        if any(copy.glob("checkpoints/search/step_*")):
            raise MemoryError("no room for 8 simulations")
        return steps(self, *args)

    capsys.readouterr()
    with monkeypatch.context() as patched, pytest.raises(SystemExit) as stop:
        patched.setattr(native._Host, "steps", failing)
        command(easi, "--out", copy, *given)
    line = capsys.readouterr().err.splitlines()[-1]
    assert stop.value.code == 2
    assert line.startswith("error: the engine mujoco failed in a simulation: MemoryErr")
    assert f"{copy} keeps all up to the last checkpoint" in line
    command(easi, "--out", copy, *given, "--resume")
    name = "distribution.json"
    assert (copy / name).read_text() == (whole / name).read_text()
