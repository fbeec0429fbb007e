"""A policy trained under what a run of ``train.easi`` found."""

import json
import shutil
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from easi_jax.errors import UserError
from easi_jax.model.distribution import draw
from envs import load
from train import easi, evaluate, udr
from train._found import found_robot
from train._robots import load_policies, load_udr

TEMPLATE = Path(__file__).parents[2] / "examples" / "my_robot" / "env.py"
_EFFECTS = {
    "effects": [
        {
            "effect": "coulomb_friction",
            "at": "elbow",
            "kind": "joint",
            "columns": {"coulomb": 0.05},
            "std": {"coulomb": 0.0},
        }
    ],
    "refitted": [{"address": "joint.elbow.damping", "value": 0.3}],
}


def _parameter(name: str, address: str, scale: str = "log") -> dict[str, Any]:
    ends = {"nominal": 1.0, "initial": [0.5, 2.0], "bounds": [0.01, 100.0]}
    return {"name": name, "addresses": [address], "unit": "", "scale": scale, **ends}


def _run_of(folder: Path, *addresses: str, **config: Any) -> Path:
    """A folder as `train.easi` leaves it: means 1 and 1.25, correlated."""
    n, folder = len(addresses), folder / "easi"
    folder.mkdir()
    unit = np.full(n, 0.5)
    unit[-1] = (np.log(1.25) - np.log(0.5)) / np.log(4.0)
    cov = 1e-4 * (np.eye(n) + 0.9 * (1 - np.eye(n)))
    mean = 0.5 * 4.0**unit
    seed = {
        "mean": mean.tolist(),
        "std": (0.014 * mean).tolist(),
        "unit_mean": unit.tolist(),
        "unit_covariance": cov.tolist(),
    }
    found = {
        "parameters": [_parameter(f"p{i}", a) for i, a in enumerate(addresses)],
        "seeds": {"0": seed, "3": seed},
        "best_seed": 3,
    }
    head = {"format": 1, "command": "train.easi", "config": config}
    (folder / "distribution.json").write_text(json.dumps(found))
    (folder / "config.json").write_text(json.dumps(head))
    return folder


def test_the_robot_is_as_it_was_identified(tmp_path: Path) -> None:
    """Also what the environment does not vary, and with the effects of the run."""
    addresses = "body.upper.mass", "joint.shoulder.armature"
    run = _run_of(tmp_path, *addresses, effects=_EFFECTS)
    env = load(TEMPLATE)
    found = found_robot(run, env)
    assert found.env.space.names == ("p0", "p1")
    np.testing.assert_allclose(found.env.space.nominal, [1.0, 1.25], rtol=1e-6)
    model = found.env.model(jnp.asarray(found.env.space.nominal))
    shoulder = env.mj_model.joint("shoulder").dofadr[0]
    elbow = env.mj_model.joint("elbow").dofadr[0]
    assert model.mjx.dof_armature[shoulder] == pytest.approx(1.25)
    assert model.mjx.dof_damping[elbow] == pytest.approx(0.3)
    assert model.effects is not None
    assert model.effects.coulomb[elbow] == pytest.approx(0.05)
    assert env.space.names[0] == "upper_mass"  # as it was
    lower = env.mj_model.body("lower").id  # which the run lacks
    assert model.mjx.body_mass[lower] == pytest.approx(env.mj_model.body_mass[lower])
    keys = jax.random.split(jax.random.key(0), 4000)
    drawn = jax.vmap(lambda k: draw(found.env.space, found.distribution, k))(keys)
    logs = np.log(np.asarray(drawn, float))
    np.testing.assert_allclose(logs.mean(0), np.log([1.0, 1.25]), atol=2e-3)
    np.testing.assert_allclose(logs.std(0), 0.01 * np.log(4.0), rtol=0.05)
    assert np.corrcoef(logs.T)[0, 1] == pytest.approx(0.9, abs=0.02)


def test_a_mean_at_its_bound_is_one(tmp_path: Path) -> None:
    """Single precision may be a little beyond it."""
    run = _run_of(tmp_path, "body.upper.mass")
    content = json.loads((run / "distribution.json").read_text())
    content["parameters"][0] |= {
        "nominal": 0.2,
        "initial": [0.1, 0.3],
        "bounds": [0.01, 0.3],
    }
    content["seeds"]["3"]["mean"] = [float(np.float32(0.3))]
    (run / "distribution.json").write_text(json.dumps(content))
    assert found_robot(run, load(TEMPLATE)).env.space.nominal == pytest.approx([0.3])


def test_what_is_no_result_for_this_robot_is_refused(tmp_path: Path) -> None:
    run = _run_of(tmp_path, "joint.wrist.damping")
    asked: dict[str, Any] = {"env": TEMPLATE, "out": tmp_path / "policy"}
    with pytest.raises(UserError, match=r"--found .*easi: .*wrist"):
        udr.run(udr.Config(**asked, found=run))
    with pytest.raises(UserError, match=r"no distribution\.json"):
        udr.run(udr.Config(**asked, found=tmp_path))
    with pytest.raises(UserError, match="--fixed goes without --found"):
        udr.run(udr.Config(**asked, found=run, fixed=True))
    assert not (tmp_path / "policy").exists()


def test_a_policy_is_trained_and_tested_in_it(tmp_path: Path) -> None:
    run = _run_of(tmp_path, "body.upper.mass", "joint.elbow.armature", effects=_EFFECTS)
    out = tmp_path / "policy"
    few: dict[str, Any] = {"env_steps": 1500, "eval_episodes": 2}
    udr.run(udr.Config(env=TEMPLATE, found=run, out=out, **few))
    made = json.loads((out / "results.json").read_text())
    assert made["methods"] == ["EASI"] and made["effects"] == _EFFECTS
    assert made["target"] == pytest.approx({"p0": 1.0, "p1": 1.25})
    assert np.isfinite(made["returns"]["EASI"]["0"])
    assert f"under what {run} found" in (out / "report.html").read_text()
    asked: dict[str, Any] = {"run": out, "env": TEMPLATE, "episodes": 2}
    asked["out"] = tmp_path / "r.json"
    evaluate.run(evaluate.Config(**asked))
    assert json.loads((tmp_path / "r.json").read_text())["robot"] == "two_link"
    # In the robot as it was identified, wherever the run has gone.
    shutil.rmtree(run)
    known = load_policies(out, env_file=TEMPLATE)
    assert known["env"].space.names == ("p0", "p1")
    assert known["env"].space.nominal == pytest.approx([1.0, 1.25])
    assert load_udr(out, TEMPLATE)["method"] == "EASI"
    with pytest.raises(UserError, match=r"train\.udr without --found"):
        easi.run(easi.Config(udr=out, env=TEMPLATE, out=tmp_path / "easi2"))
