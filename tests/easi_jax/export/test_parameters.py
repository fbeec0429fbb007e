"""Exported parameters: the model moves as identified, randomization has its spread."""

import dataclasses
from importlib import resources
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import yaml
from mujoco import mjx

from easi_jax.errors import UserError
from easi_jax.estimation.identifiability import seed_result
from easi_jax.export.mjcf import identified_model, written_machine
from easi_jax.export.randomization import (
    domain_randomizer,
    read_randomization,
    to_yaml,
)
from easi_jax.io.files import to_json
from easi_jax.io.models.mjcf import mujoco_warnings
from easi_jax.io.runs.folder import RunFolder
from easi_jax.model import distribution
from easi_jax.model.found_effects import EffectEntry, FoundEffects
from easi_jax.model.parameters import ParameterSpace, declare
from easi_jax.model.written_effects import undone
from easi_jax.simulation.mujoco_c import InMujoco
from easi_jax.simulation.simulator import Simulator
from envs import make
from tests.commands import command
from train import export
from train._results import distribution_json

FRICTION = EffectEntry("coulomb_friction", "pole", "joint", {"coulomb": 0.05}, {})
LATE = EffectEntry("sensor_delay", "cart", "joint", {"late": 0.01}, {})


def source(robot: str) -> Path:
    return Path(str(resources.files("envs") / "assets" / f"{robot}.xml"))


def moved(m: mujoco.MjModel, seed: int = 0) -> np.ndarray:
    rng, d = np.random.default_rng(seed), mujoco.MjData(m)
    d.qpos[:] = m.key_qpos[0] if m.nkey else m.qpos0
    d.qvel[:] = rng.uniform(-0.5, 0.5, m.nv)
    rows = []
    for _ in range(60):
        d.ctrl[:] = rng.uniform(*m.actuator_ctrlrange.T)
        mujoco.mj_step(m, d, 2)
        rows.append(np.concatenate([d.qpos, d.qvel]))
    return np.array(rows)


@pytest.mark.parametrize(
    "robot",
    [
        "cartpole",
        pytest.param("ant", marks=pytest.mark.slow),
        pytest.param("ballbalance", marks=pytest.mark.slow),
        "go2",
    ],
)
def test_the_model_moves_as_identified(robot: str, tmp_path: Path) -> None:
    env = make(robot)
    unit = np.random.default_rng(0).uniform(0.2, 0.8, env.space.size)
    theta = np.asarray(env.space.to_si(unit), float)
    model = identified_model(source(robot), env.simulator, theta)
    assert model.left == (["cart_speed_limit"] if robot == "cartpole" else [])
    (tmp_path / "model.xml").write_text(model.xml)
    got = mujoco.MjModel.from_xml_path(str(tmp_path / "model.xml"))
    want = InMujoco(env.simulator).at(np.asarray(env.space.to_unit(theta), float))
    given = mujoco.MjModel.from_xml_path(str(source(robot)))
    given.opt.timestep = want.opt.timestep
    np.testing.assert_allclose(moved(got)[:20], moved(want)[:20], atol=2e-3)
    assert np.abs(moved(given) - moved(want))[:20].max() > 2e-2


def test_effects_are_in_the_model_where_mjcf_has_a_word() -> None:
    env = make("cartpole")
    theta = np.asarray(env.space.nominal, float)
    model = identified_model(source("cartpole"), env.simulator, theta, [FRICTION, LATE])
    assert model.left == ["cart_speed_limit", "sensor_delay@cart"]
    m = mujoco.MjModel.from_xml_string(model.xml)
    own = theta[env.space.names.index("pole_friction")]
    assert m.joint("pole").frictionloss[0] == pytest.approx(own + 0.05, rel=1e-4)


def test_a_foreign_model_is_refused() -> None:
    env = make("cartpole")
    with pytest.raises(UserError, match="not the model"):
        identified_model(source("ant"), env.simulator, np.asarray(env.space.nominal))


def found(space: ParameterSpace, mean: Any, cov: Any) -> dict[str, Any]:
    """What `distribution.json` holds of seed 3."""
    result = seed_result(space, mean, cov, np.eye(space.size))
    told = distribution_json(space, [3], [result])
    return {**told, "seeds": {"3": dataclasses.asdict(result)}}


def test_the_command_says_what_the_model_lacks(tmp_path: Path, capsys) -> None:
    """A built-in robot's own file is taken where no other is given."""
    space, run = make("cartpole").space, tmp_path / "run"
    unit = np.linspace(0.3, 0.7, space.size)
    with RunFolder.open(run, {"robot": "cartpole"}, command="train.easi"):
        told = found(space, unit, 1e-3 * np.eye(space.size))
        (run / "distribution.json").write_text(to_json(told))
    command(export, run, "--to", "mjcf")
    assert "note: not in model.xml: cart_speed_limit" in capsys.readouterr().out
    m = mujoco.MjModel.from_xml_path(str(run / "export" / "model.xml"))
    kp = space.to_si(unit)[space.names.index("cart_kp")]
    assert m.actuator("cart").gainprm[0] == pytest.approx(float(kp), rel=1e-4)


@pytest.fixture(scope="module")
def given(tmp_path_factory) -> tuple[ParameterSpace, Any, Path]:
    """Three of Cartpole's parameters, two of them correlated; one is linear."""
    m = make("cartpole").mj_model
    space = ParameterSpace(
        (
            declare(m, "cart_kp", "actuator.cart.kp"),
            declare(m, "pole_mass", "body.pole.mass", bounds=(0.01, 1.0)),
            declare(m, "damping", "joint.pole.damping", initial=(0, 0.01), log=False),
        )
    )
    mean = np.array([0.4, 0.6, 0.3])
    root = np.array([[0.05, 0.0, 0.0], [0.04, 0.02, 0.0], [0.0, 0.0, 0.03]])
    path = tmp_path_factory.mktemp("random") / "randomization.yaml"
    path.write_text(to_yaml(found(space, mean, root @ root.T), "3", "cartpole"))
    return space, distribution.gaussian(space, mean, root @ root.T), path


def test_draws_are_those_of_the_distribution(given) -> None:
    space, dist, path = given
    read = read_randomization(path)
    keys = jax.random.split(jax.random.key(0), 20_000)
    ours = np.asarray(jax.vmap(lambda k: distribution.draw(space, dist, k))(keys))
    theirs = np.asarray(jax.vmap(read.draw)(keys))
    np.testing.assert_allclose(theirs.mean(0), ours.mean(0), rtol=0.01)
    spread = ours.std(0)  # covariances in units of it
    got, want = (np.cov((x / spread).T) for x in (theirs, ours))
    np.testing.assert_allclose(got, want, atol=0.03)


def test_factors_are_of_the_nominal_value_beside_them(given) -> None:
    space, _, path = given
    entries = yaml.safe_load(path.read_text())["parameters"]
    assert [e["nominal"] for e in entries] == pytest.approx(list(space.nominal))
    for e in entries:
        sides = np.sort(np.multiply(e["factor"], e["nominal"]))
        np.testing.assert_allclose(sides, e["range"], rtol=1e-6)


def test_draws_stay_inside_the_bounds(given) -> None:
    read = read_randomization(given[2])
    middle = np.exp(read.mean[1])
    bounds = read.bounds.copy()
    bounds[:, 1] = 0.999 * middle, 1.001 * middle
    tight = dataclasses.replace(read, bounds=bounds)
    keys = jax.random.split(jax.random.key(0), 100)
    drawn = np.asarray(jax.vmap(tight.draw)(keys))[:, 1]
    np.testing.assert_allclose([drawn.min(), drawn.max()], bounds[:, 1], rtol=1e-5)


def test_brax_and_playground_take_the_function(given) -> None:
    """A batched model and its axes; only what is randomized has an axis."""
    space, _, path = given
    m = make("cartpole").mj_model
    randomize = domain_randomizer(path, m)
    model = mjx.put_model(m, impl="jax")
    keys = jax.random.split(jax.random.key(1), 6)
    batched, axes = randomize(model, keys)
    drawn = np.asarray(jax.vmap(read_randomization(path).draw)(keys))
    np.testing.assert_allclose(
        batched.actuator_gainprm[:, 0, 0], drawn[:, 0], rtol=1e-5
    )
    body = m.body("pole").id
    np.testing.assert_allclose(batched.body_mass[:, body], drawn[:, 1], rtol=1e-5)
    each = jax.tree.leaves(axes, is_leaf=lambda x: x is None)
    assert 0 < each.count(0) < 0.2 * len(each)

    def fell(model: Any) -> jax.Array:
        d = mjx.make_data(model).replace(qpos=jnp.array([0.0, 0.3]))
        return jax.lax.fori_loop(0, 20, lambda _, d: mjx.step(model, d), d).qpos

    ends = jax.jit(jax.vmap(fell, in_axes=(axes,)))(batched)
    assert len(np.unique(np.asarray(ends)[:, 1])) == 6
    assert space.size == 3


def test_what_mjx_leaves_out_is_said(given, tmp_path: Path) -> None:
    _, _, path = given
    m = make("cartpole").mj_model
    text = path.read_text().replace("joint.pole.damping", "joint.pole.frictionloss")
    (tmp_path / "other.yaml").write_text(text)
    domain_randomizer(tmp_path / "other.yaml", m)
    late = text.replace("joint.pole.frictionloss", "effect.delay.cart")
    (tmp_path / "late.yaml").write_text(late)
    with pytest.warns(UserWarning, match="no word for damping, which stay"):
        domain_randomizer(tmp_path / "late.yaml", m)
    m.dof_frictionloss[:] = 0.0
    with pytest.raises(UserError, match="leaves it out"):
        domain_randomizer(tmp_path / "other.yaml", m)
    m.dof_frictionloss[:] = 0.01


def test_what_mjx_compiles_out_of_a_free_body_is_said(tmp_path: Path) -> None:
    """Without the products of inertia its center cannot move, that of another body
    can; nor is there air around it."""
    text = """<mujoco><worldbody><body name="o" pos="0 0 1"><freejoint/>
    <geom size=".1"/></body><body name="b" pos="2 0 1"><joint axis="1 0 0"/>
    <geom size=".1" pos="0 0 .3"/></body></worldbody></mujoco>"""
    m = mujoco.MjModel.from_xml_string(text)
    free = {name: (f"body.{name}.com_x", (-0.1, 0.1)) for name in "ob"}
    for name, (address, initial) in {**free, "air": ("option.density", (1, 2))}.items():
        space = ParameterSpace((declare(m, "x", address, initial=initial),))
        made = to_yaml(found(space, np.full(1, 0.6), 0.01 * np.eye(1)), "3", "m")
        (tmp_path / f"{name}.yaml").write_text(made)
    domain_randomizer(tmp_path / "b.yaml", m)
    with pytest.raises(UserError, match="center of mass is at its joint"):
        domain_randomizer(tmp_path / "o.yaml", m)
    with pytest.raises(UserError, match=r"option\.density: MJX leaves it out"):
        domain_randomizer(tmp_path / "air.yaml", m)


@pytest.mark.parametrize("text", ["", "parameters: 3", "parameters: [{name: a}]"])
def test_a_file_of_another_form_is_refused(text: str, tmp_path: Path) -> None:
    (tmp_path / "bad.yaml").write_text(text)
    with pytest.raises(UserError, match=r"bad\.yaml"):
        read_randomization(tmp_path / "bad.yaml")


def test_a_machine_without_the_address_is_refused(given) -> None:
    _, _, path = given
    other = make("ballbalance").mj_model
    with pytest.raises(UserError):
        domain_randomizer(path, other)
    assert Simulator(make("cartpole").mj_model, given[0], 0.02).space.size == 3


DRIVEN = """<mujoco><worldbody><geom name="floor" type="plane" size="1 1 1"/>
<body name="b" pos="0 0 1"><joint name="j" armature="0.05" frictionloss="0.01"/>
<geom size=".1"/><body name="c"><joint name="k" axis="1 0 0" armature="0.05"/>
<geom size=".1" pos=".3 0 0"/></body></body></worldbody><actuator>
<position name="a" joint="j" kp="10" forcerange="-5 5"/></actuator></mujoco>"""


@pytest.mark.parametrize("as_entries", [True, False])
def test_effects_in_an_exported_model_count_once(
    as_entries: bool, tmp_path: Path
) -> None:
    """At the mean, what is drawn is the exported model, whatever of it varies."""
    path = tmp_path / "m.xml"
    path.write_text(DRIVEN)
    m = mujoco.MjModel.from_xml_path(str(path))
    rotor = ("effect.armature.j", 0.1, (0.01, 1.0))
    free = [rotor, ("effect.friction", 0.5, (0.3, 0.8))]
    free += [("effect.limit.a", 2.0, (1.0, 3.0)), ("effect.tilt.0", 0.1, (0.05, 0.2))]
    parameters = [declare(m, a, a, nominal=x, initial=r) for a, x, r in free]
    space, unit = ParameterSpace(tuple(parameters)), np.full(4, 0.5)
    means = np.asarray(space.to_si(unit), float).tolist()
    values = dict(zip(space.names, means, strict=True))
    tilt = {"tilt.0": 0.1, "tilt.1": 0.2}
    entries = [
        EffectEntry("armature", "j", "joint", {"armature": 0.1}, {}),
        EffectEntry("armature", "k", "joint", {"armature": 0.3}, {}),
        EffectEntry("coulomb_friction", "j", "joint", {"coulomb": 0.05}, {}),
        EffectEntry("gravity_tilt", "", "model", tilt, {}),
    ]
    own = FoundEffects(tuple(entries) if as_entries else ())
    got = written_machine(path, m, None, parameters, values, own)
    assert got.left == []
    text = to_yaml(found(space, unit, 1e-14 * np.eye(4)), "3", "m")
    (tmp_path / "random.yaml").write_text(text)
    randomize = domain_randomizer(tmp_path / "random.yaml", got.model)
    keys = jax.random.split(jax.random.key(0), 2)
    drawn, _ = randomize(mjx.put_model(got.model, impl="jax"), keys)
    for name in ("dof_armature", "geom_friction", "actuator_forcerange"):
        want = np.broadcast_to(getattr(got.model, name), getattr(drawn, name).shape)
        np.testing.assert_allclose(getattr(drawn, name), want, rtol=1e-4, err_msg=name)
    if as_entries:  # nor may it be part of another model
        scene = mujoco.MjSpec.from_string("<mujoco><worldbody/></mujoco>")
        inner = mujoco.MjSpec.from_string(got.xml)
        scene.attach(inner, prefix="r_", frame=scene.worldbody.add_frame())
        with mujoco_warnings():
            both = scene.compile()
        with pytest.raises(UserError, match="is attached; give that one alone"):
            undone(both)
    np.testing.assert_allclose(drawn.opt.gravity[0], got.model.opt.gravity, rtol=1e-4)
    np.testing.assert_allclose(drawn.dof_invweight0[0], got.model.dof_invweight0, 1e-4)


def test_parameters_and_effects_of_a_machine_are_all_written(tmp_path: Path) -> None:
    """A pattern that covers a refitted number holds it; an effect without an entry is
    a parameter of the model."""
    path = tmp_path / "m.xml"
    path.write_text(
        '<mujoco><worldbody><body name="b"><joint name="j" damping="0.1"/>'
        '<geom size=".1"/></body></worldbody><actuator><motor name="a" joint="j"/>'
        "</actuator></mujoco>"
    )
    m = mujoco.MjModel.from_xml_path(str(path))
    parameters = [
        declare(m, "damping", "joint.*.damping"),
        declare(m, "rotor", "effect.armature.j", nominal=0.1, initial=(0.01, 1.0)),
        declare(m, "late", "effect.delay.a", nominal=0.01, initial=(0.001, 0.1)),
    ]
    values = {"damping": 0.3, "rotor": 0.2, "late": 0.02}
    own = FoundEffects((), {"joint.j.damping": 0.5})
    got = written_machine(path, m, None, parameters, values, own)
    written = mujoco.MjModel.from_xml_string(got.xml)
    assert written.dof_damping[0] == pytest.approx(0.3)
    assert written.dof_armature[0] == pytest.approx(0.2) or "rotor" in got.left
    assert written.actuator_delay[0] == pytest.approx(0.02) or "late" in got.left
