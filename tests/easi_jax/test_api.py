"""The public API: the example in the README, and one line for each mistake."""

import re
import subprocess
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import mujoco
import numpy as np
import pytest

import easi_jax
from easi_jax import UserError, api
from easi_jax.model.distribution import gaussian
from easi_jax.model.found_effects import EffectEntry, FoundEffects
from tests.tiny_robot.env import Tiny

ROOT = Path(__file__).parents[2]
EXAMPLE = ROOT / "examples" / "ten_lines.py"
DAMPING = 0.2

MODEL = """<mujoco model="pendulum">
  <option timestep="0.01" integrator="implicitfast"/>
  <worldbody><body name="rod">
    <joint name="hinge" axis="0 1 0" damping="0.05"/>
    <geom type="capsule" fromto="0 0 0 0 0 -0.4" size="0.02" mass="0.5"/>
  </body></worldbody>
  <actuator><motor name="drive" joint="hinge"/></actuator>
</mujoco>"""
PARAMETERS = """parameters:
  - {name: damping, address: joint.hinge.damping, initial: [0.02, 0.5]}
"""


def write_log(path: Path, shift: float) -> None:
    """Motion of the pendulum with another damping, and noise of 0.5 mrad."""
    m = mujoco.MjModel.from_xml_string(MODEL)
    m.dof_damping[0] = DAMPING
    d, rng, rows = mujoco.MjData(m), np.random.default_rng(0), []
    for k in range(600):
        d.ctrl[0] = 0.8 * np.sin(0.05 * k + shift) + 0.5 * np.sin(0.013 * k)
        angle = d.qpos[0] + 5e-4 * rng.normal()
        rows.append(f"{0.01 * k:.6g},{angle:.6f},{d.ctrl[0]:.6f}")
        mujoco.mj_step(m, d)
    path.write_text("\n".join(["time,qpos.hinge,ctrl.drive", *rows]) + "\n")


@pytest.fixture(scope="module")
def machine(tmp_path_factory: pytest.TempPathFactory) -> Any:
    folder = tmp_path_factory.mktemp("machine")
    files = {n: folder / n for n in ("model.xml", "parameters.yaml")}
    files["model.xml"].write_text(MODEL)
    files["parameters.yaml"].write_text(PARAMETERS)
    for name, shift in (("sweep.csv", 0.0), ("moves.csv", 1.0)):
        files[name] = folder / name
        write_log(files[name], shift)
    model = easi_jax.read_model(files["model.xml"])
    return SimpleNamespace(
        folder=folder,
        model=model,
        space=easi_jax.read_parameters(files["parameters.yaml"], model),
        log=easi_jax.read_log(files["sweep.csv"], model),
    )


def test_readme_holds_the_example_as_it_is() -> None:
    readme = (ROOT / "README.md").read_text()
    assert f"```python\n{EXAMPLE.read_text()}```" in readme
    code = EXAMPLE.read_text().split('"""\n', 1)[1]
    assert len([x for x in code.splitlines() if x and "import" not in x]) <= 10


def test_the_example_finds_the_truth(
    machine: Any,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """On a smaller machine, with a shorter search."""
    text = EXAMPLE.read_text().replace("examples/lift_arm", str(machine.folder))
    small = partial(api.estimate_parameters, generations=2, population=8)
    monkeypatch.setattr(easi_jax, "estimate_parameters", small, raising=False)
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    exec(compile(text, str(EXAMPLE), "exec"), names)
    found, lacks = names["found"], names["lacks"]
    assert found.mean[0] == pytest.approx(DAMPING, rel=0.02)
    assert 0 < found.std[0] < 0.1 * DAMPING and found.flags == ("determined",)
    errors = found.held_out
    assert errors.what == "moves" and errors.after[0][0] < 0.3 * errors.before[0]
    said = capsys.readouterr().out
    assert re.search(r"damping +0\.\d+ ± [\de.-]+ N·m·s/rad\n", said)
    assert "hinge    error over 0.2 s" in said
    written = mujoco.MjModel.from_xml_path("results/arm/model.xml")
    assert written.dof_damping[0] == pytest.approx(found.mean[0], rel=1e-5)
    assert lacks.refit.gap < 0.3 * lacks.before.gap
    assert not any("damping" in e.effect for e in lacks.effects)


def test_a_search_is_where_an_estimate_starts(
    machine: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    given: dict[str, Any] = {}

    def ready(problem: Any, search: Any, *rest: Any) -> Any:
        def finish(means: jax.Array, covs: jax.Array) -> Any:
            given.update(mean=means, cov=covs)
            raise UserError("enough")

        return finish

    found = easi_jax.search_parameters(
        machine.model, machine.space, machine.log, generations=3, population=8
    )
    assert found.history.shape == (3, 1) and np.isfinite(found.history).all()
    assert found.space.names == ("damping",) and found.non_finite == 0
    monkeypatch.setattr(api, "ready_finish", ready)
    with pytest.raises(UserError, match="enough"):
        easi_jax.estimate_parameters(
            machine.model, machine.space, machine.log, start=found
        )
    np.testing.assert_array_equal(given["mean"][0], found.mean)
    np.testing.assert_array_equal(given["cov"][0], found.cov)
    one = replace(machine.space.parameters[0], name="other")
    other = type(machine.space)((one,))
    with pytest.raises(UserError, match="start is of damping, parameters are other"):
        easi_jax.estimate_parameters(machine.model, other, machine.log, start=found)


def test_found_effects_join_the_parameters_and_are_written(
    machine: Any, tmp_path: Path
) -> None:
    entry = EffectEntry("armature", "hinge", "joint", {"armature": 0.02}, {})
    effects = FoundEffects((entry,))
    problem = api._problem(
        machine.model, machine.space, machine.log, None, effects, (), None
    )
    names = problem.simulator.space.names
    assert names == ("damping", "armature@hinge.armature")
    found: Any = SimpleNamespace(
        names=names,
        mean=np.array([0.3, 0.04]),
        space=problem.simulator.space,
        simulator=problem.simulator,
        effects=effects,
    )
    easi_jax.export_model(found, machine.folder / "model.xml", tmp_path)
    written = mujoco.MjModel.from_xml_path(str(tmp_path / "model.xml"))
    assert written.dof_damping[0] == pytest.approx(0.3)
    assert written.dof_armature[0] == pytest.approx(0.04)


def test_a_policy_is_trained_and_exported(tmp_path: Path) -> None:
    policy = easi_jax.train_policy(Tiny())
    assert policy.returns.size and 0 < policy.returns[-1] <= Tiny.episode_length
    action = policy(np.zeros((3, 2)))
    assert action.shape == (3, 1) and (np.abs(action) <= 1).all()
    with pytest.raises(UserError, match=r"obs has shape \(3,\), needed is \(2\)"):
        policy(np.zeros(3))
    with pytest.raises(UserError, match="obs is not finite"):
        policy([0.0, np.nan])
    files = easi_jax.export_policy(policy, tmp_path / "out", ["stablehlo"])
    assert sorted(p.name for p in files) == [
        *("policy.json", "policy.mlir", "policy.stablehlo"),
    ]
    program = jax.export.deserialize(bytearray(files[1].read_bytes()))
    np.testing.assert_allclose(
        program.call(np.zeros((3, 2), np.float32))["action"], action, atol=1e-6
    )
    with pytest.raises(UserError, match=r'no form "onx".*did you mean "onnx"'):
        easi_jax.export_policy(policy, tmp_path / "other", ["onx"])
    assert not (tmp_path / "other").exists()


def test_a_policy_is_trained_under_what_was_found(machine: Any) -> None:
    """With a parameter that the environment does not vary."""
    env = Tiny()
    addresses = {a for p in env.space.parameters for a in p.addresses}
    joint = env.mj_model.joint(0).name
    one = machine.space.parameters[0]
    one = replace(one, name="dry", addresses=(f"joint.{joint}.frictionloss",))
    assert not addresses & {*one.addresses}
    space = type(machine.space)((one,))
    found: Any = SimpleNamespace(
        space=space,
        mean=[0.02],
        distribution=gaussian(space, [0.5], [[1e-4]]),
        simulator=SimpleNamespace(fixed={}),
    )
    policy = easi_jax.train_policy(env, found)
    assert policy.returns.size and np.isfinite(policy.returns).all()
    assert env.space.names != space.names


def test_other_parameters_than_the_robots_are_refused(machine: Any) -> None:
    one = replace(machine.space.parameters[0], addresses=("joint.other.damping",))
    space = type(machine.space)((one,))
    fixed = SimpleNamespace(fixed={})
    wrong: Any = SimpleNamespace(
        space=space, distribution=None, mean=[0.3], simulator=fixed
    )
    with pytest.raises(UserError, match="other"):
        easi_jax.train_policy(Tiny(), wrong)
    with pytest.raises(UserError, match="unknown algorithm"):
        easi_jax.train_policy(Tiny(), algorithm="sacc")


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda r: replace(r, ctrl=r.ctrl[:-1]), r"sweep: ctrl has shape \(599, 1\)"),
        (lambda r: replace(r, qpos=r.qpos * np.nan), "sweep: qpos is not finite"),
        (lambda r: replace(r, qvel=r.qvel[:, :0]), r"sweep: qvel has shape \(600, 0\)"),
    ],
)
def test_runs_made_by_hand_are_checked(machine: Any, change: Any, said: str) -> None:
    log = replace(machine.log, runs=tuple(map(change, machine.log.runs)))
    with pytest.raises(UserError, match=said):
        easi_jax.search_parameters(machine.model, machine.space, log)


@pytest.mark.parametrize(
    ("noise", "said"),
    [([0.1], "needs 2 numbers"), ([np.nan, 1.0], "0 or more")],
)
def test_noise_is_checked(machine: Any, noise: Any, said: str) -> None:
    with pytest.raises(UserError, match=said):
        easi_jax.search_parameters(
            machine.model, machine.space, machine.log, noise=noise
        )


def test_files_that_cannot_be_used(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"nowhere\.xml"):
        easi_jax.read_model(tmp_path / "nowhere.xml")
    still = tmp_path / "still.xml"
    still.write_text("<mujoco><worldbody><geom size='1'/></worldbody></mujoco>")
    with pytest.raises(UserError, match="no joint"):
        easi_jax.read_model(still)


def test_every_public_name_is_there_and_the_package_imports_quickly() -> None:
    for name in easi_jax.__all__:
        assert getattr(easi_jax, name) is not None
    assert set(easi_jax.__all__) <= set(dir(easi_jax))
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = easi_jax.nothing
    code = (
        "import sys, easi_jax; from jax._src import xla_bridge as b; "
        "heavy = {'brax', 'gymnasium', 'easi_jax.api'} & {*sys.modules}; "
        "sys.exit(f'{heavy} {b.backends_are_initialized()}' if heavy else 0)"
    )
    subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=True, timeout=120)
