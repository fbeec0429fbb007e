"""An environment in a file outside the package: ``--env FILE``."""

import json
import shutil
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.commands import ENV
from benchmarks.parity_models import feature_models
from easi_jax.errors import UserError
from envs import load, open_env
from train import easi, evaluate, udr

ROOT = Path(__file__).parents[2]
TEMPLATE = ROOT / "examples" / "my_robot" / "env.py"


def _file(folder: Path, text: str) -> Path:
    path = folder / "env.py"
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("x = 1", "no function make"),
        ("def make(:", "line 1: SyntaxError"),
        ("\nimport nothing_of_that_name", "line 2: ModuleNotFoundError"),
        ("def make():\n    return 1 / 0", "line 2: ZeroDivisionError"),
        ("def make():\n    return 3", "lacks name, obs_size"),
    ],
)
def test_a_broken_file_gets_one_line(text: str, said: str, tmp_path: Path) -> None:
    with pytest.raises(UserError) as caught:
        load(_file(tmp_path, text))
    message = str(caught.value)
    assert said in message and str(tmp_path) in message and "\n" not in message


def test_a_file_may_have_dataclasses(tmp_path: Path) -> None:
    """Which look up the module that they are in."""
    head = "from __future__ import annotations\nfrom dataclasses import dataclass\n"
    data = "\n\n@dataclass\nclass Gains:\n    kp: float = 1.0\n"
    folder = tmp_path / "own"
    shutil.copytree(TEMPLATE.parent, folder)
    _, about, rest = TEMPLATE.read_text().split('"""', 2)
    path = _file(folder, f'"""{about}"""\n{head}{rest}{data}')
    assert load(path).name


def test_a_robot_that_nothing_drives_has_no_policy(tmp_path: Path) -> None:
    """With action_size = nu = 0 `train.udr` ended in a traceback, its folder begun."""
    model, out = tmp_path / "m.xml", tmp_path / "udr"
    model.write_text(feature_models()["solver PGS"])
    env = _file(tmp_path, ENV.format(model=str(model)))
    with pytest.raises(UserError, match=r"action_size is 0: .* has no actuators"):
        udr.run(udr.Config(env=env, out=out))
    assert not out.exists()


def test_a_missing_file_and_another_kind_of_file(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no such file"):
        load(tmp_path / "env.py")
    with pytest.raises(UserError, match="Python file"):
        load(tmp_path / "env.xml")
    assert open_env("cartpole").name == "cartpole"


# brax's own imports warn.
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
@pytest.mark.filterwarnings("ignore:Brax System:UserWarning")
def test_the_brax_adapter_observes_as_brax_does_and_its_physics_varies() -> None:
    env = load(ROOT / "examples" / "brax_env" / "env.py")

    @jax.jit
    def first_step(theta: jax.Array) -> jax.Array:
        model = env.model(theta)
        state = env.reset(model, jax.random.key(0))
        return env.step(model, state, jnp.ones(1)).obs

    nominal = jnp.asarray(env.space.nominal)
    here, heavier = first_step(nominal), first_step(nominal * jnp.array([2.0, 1.0]))
    state = env.brax.reset(jax.random.key(0))
    assert here.shape == state.obs.shape and np.isfinite(here).all()
    assert np.abs(np.asarray(heavier - here)).max() > 1e-3


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_udr_and_search_with_an_own_environment(tmp_path: Path) -> None:
    start, out = tmp_path / "udr", tmp_path / "easi"
    udr.run(udr.Config(env=TEMPLATE, out=start, env_steps=1500, eval_episodes=4))
    settings = {
        "udr": start,
        "out": out,
        "generations": 3,
        "population": 16,
        "trajectories": 4,
        "eval_episodes": 4,
    }
    # A folder's word alone does not run a file.
    with pytest.raises(UserError, match="say --env FILE"):
        easi.run(easi.Config(**settings))
    easi.run(easi.Config(**settings, env=TEMPLATE))
    result = json.loads((out / "results.json").read_text())
    assert result["robot"] == "two_link" and result["env"] == str(TEMPLATE)
    found = json.loads((out / "distribution.json").read_text())
    assert "upper_mass" in json.dumps(found)
    with pytest.raises(UserError, match="say --env FILE"):
        evaluate.run(evaluate.Config(run=out, episodes=2))
    evaluate.run(
        evaluate.Config(run=out, env=TEMPLATE, episodes=2, out=tmp_path / "r.json")
    )
    assert json.loads((tmp_path / "r.json").read_text())["robot"] == "two_link"
