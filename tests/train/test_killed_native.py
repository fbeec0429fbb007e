"""What is killed with ``--engine mujoco`` goes on to the same end, to the last bit."""

import json
import shutil
from pathlib import Path

import jax
import numpy as np
import pytest

from easi_jax.io.runs import checkpoints
from easi_jax.io.runs.folder import engine_of
from easi_jax.pipeline.stages import Pipeline, PipelineConfig, seed_keys
from easi_jax.simulation import engine
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
_EASI = (
    *("--generations", 4, "--population", 8, "--trajectories", 4, "--no-refine"),
    *("--set", "segments=16", "real_batch=64", "discriminator_updates=2"),
    *("--search-chunk", 2, "--eval-episodes", 2),
    *("--target", "gear*.5"),
)
_LAST = 24  # steps of training


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("native")
    (root / "env.py").write_text(_ENV)
    _call(udr, root, root / "udr", *_UDR)
    _call(easi, root, root / "easi", "--udr", root / "udr", *_EASI)
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


@pytest.mark.fault("killed (signal 9), then resumed")
def test_search(runs: Path, tmp_path: Path) -> None:
    whole, copy = runs / "easi", tmp_path / "easi"
    shutil.copytree(whole, copy)
    last = "search/step_000000000004"
    for lost in (last, "estimate", "final", "policy_EASI", "policy_UDR"):
        shutil.rmtree(copy / "checkpoints" / lost)
    for name in ("results.json", "distribution.json", "report.html"):
        (copy / name).unlink()
    _call(easi, runs, copy, "--udr", runs / "udr", *_EASI, "--resume")
    for name in ("distribution.json", "results.json"):
        assert (copy / name).read_text() == (whole / name).read_text(), name
