"""Contacts of single pairs of geoms, against MuJoCo C with ``<pair>``."""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from easi_jax.errors import UserError
from easi_jax.io.models.repaired_mjcf import repaired_model
from easi_jax.model.contact_pairs import contact_pairs, pair_names
from easi_jax.model.found_effects import EffectEntry, FoundEffects
from easi_jax.model.parameters import ParameterSpace, declare
from easi_jax.simulation.simulator import Simulator
from easi_jax.simulation.with_effects import simulator_with

BALL = """<body name="{0}" pos="0 {1} 0.05"><joint name="{0}x" type="slide"
axis="1 0 0"/><joint name="{0}z" type="slide" axis="0 0 1"/>
<geom size="0.05" mass="1" {2}/></body>"""
# Equal priorities, another priority, and a pair that the model states.
BALLS = (
    ("a", 0, 'name="foot" friction="0.5" solmix="3" solref="0.03 1"'),
    ("b", 1, 'friction="0.9" priority="1" solref="0.03 0.8"'),
    ("c", 2, 'name="third" solref="0.04 1" contype="2" conaffinity="2"'),
)
XML = f"""<mujoco><option timestep="0.002" integrator="implicitfast" iterations="20"/>
<worldbody><geom name="floor" type="plane" size="5 5 .1" friction="0.7"/>
{"".join(BALL.format(*ball) for ball in BALLS)}</worldbody>
<contact><pair geom1="third" geom2="floor" friction="0.4 0.4 .005 .0001 .0001"
solref="0.025 1"/></contact>
<actuator><motor name="a" joint="ax"/><motor name="b" joint="bx"/>
<motor name="c" joint="cx"/></actuator></mujoco>"""
STEPS, SUBSTEPS, DT = 150, 5, 0.01
START = np.array([0, -0.01, 0, 0.01, 0, 0.02])
FOUND = [
    ("contact_friction", "floor/foot", {"slip": 0.4}),
    ("contact_softness", "floor/foot", {"give.0": 0.3, "give.1": 0.5}),
    ("contact_friction", "floor/geom2", {"slip": 1.3}),
    ("contact_friction", "floor/third", {"slip": 0.5}),
]
EFFECTS = [EffectEntry(e, at, "geom", columns, {}) for e, at, columns in FOUND]


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(XML)


@pytest.fixture(scope="module")
def ctrl() -> np.ndarray:
    t = DT * np.arange(STEPS)
    return np.stack([8 * np.sin(7 * t), 10 * np.sin(9 * t), 6 * np.sin(8 * t)], 1)


def simulated(simulator: Simulator, ctrl: np.ndarray, theta: Any = ()) -> np.ndarray:
    model = simulator.model(jnp.asarray(theta, jnp.float32))

    @jax.jit
    def run() -> jax.Array:
        def step(s: Any, u: jax.Array) -> Any:
            s = simulator.step(model, s, u)
            return s, s.qpos

        first = simulator.start(jnp.asarray(START, jnp.float32), jnp.zeros(6), model)
        return jax.lax.scan(step, first, jnp.asarray(ctrl, jnp.float32))[1]

    return np.asarray(run())


def native(m: mujoco.MjModel, ctrl: np.ndarray) -> np.ndarray:
    d, out = mujoco.MjData(m), []
    d.qpos[:] = START
    for u in ctrl:
        d.ctrl[:] = u
        for _ in range(SUBSTEPS):
            mujoco.mj_step(m, d)
        out.append(d.qpos.copy())
    return np.array(out)


def test_numbers_are_those_of_mujoco(model: mujoco.MjModel) -> None:
    """Those of the contacts that MuJoCo C makes where all touch."""
    d = mujoco.MjData(model)
    d.qpos[1::2] = -0.01
    mujoco.mj_forward(model, d)
    told = {frozenset(p.geoms): p for p in contact_pairs(model)}
    assert d.ncon == 3
    for c in d.contact:
        p = told[frozenset(c.geom.tolist())]
        np.testing.assert_allclose(p.friction, c.friction)
        np.testing.assert_allclose(p.solref, c.solref)
        np.testing.assert_allclose(p.solimp, c.solimp)
        assert (p.dim, p.margin) == (c.dim, c.includemargin)


def test_as_mujoco_c(model: mujoco.MjModel, ctrl: np.ndarray, tmp_path: Path) -> None:
    """What acts in the step is what ``model.xml`` says."""
    path = tmp_path / "robot.xml"
    path.write_text(XML)
    found = FoundEffects(tuple(EFFECTS))
    simulator = simulator_with(Simulator(model, ParameterSpace(()), DT), found)
    # All are searched: the address language writes them.
    assert simulator.space.names[0] == "contact_friction@floor/foot.friction_factor"
    got = simulated(simulator, ctrl, simulator.space.nominal)
    repaired = repaired_model(path, EFFECTS)
    assert repaired.left == []
    want = native(mujoco.MjModel.from_xml_string(repaired.xml), ctrl)
    np.testing.assert_allclose(got, want, atol=2e-5)
    moved = np.abs(want - native(model, ctrl)).max(0)
    assert (moved[::2] > 0.01).all()


def test_beside_a_geom_that_varies(model: mujoco.MjModel, ctrl: np.ndarray) -> None:
    """The factor is on whatever friction the pair has."""
    space = ParameterSpace(
        (declare(model, "floor", "geom.floor.friction", bounds=(0.1, 2.0)),)
    )
    fixed = {"effect.slip.floor/foot": 0.4}
    got = simulated(Simulator(model, space, DT, fixed=fixed), ctrl, [1.5])
    m = mujoco.MjModel.from_xml_string(XML)
    m.geom_friction[0, 0] = 1.5 * 0.4  # still above that of the foot
    np.testing.assert_allclose(got[:, :2], native(m, ctrl)[:, :2], atol=2e-5)


def test_names_that_are_none(model: mujoco.MjModel) -> None:
    assert list(pair_names(model)) == [
        *("floor/third", "floor/foot", "floor/geom2", "foot/geom2")
    ]
    with pytest.raises(UserError, match=r"names no pair of geoms.*floor/foot"):
        Simulator(model, ParameterSpace(()), DT, fixed={"effect.slip.floor/fot": 0.4})
    rk4 = mujoco.MjModel.from_xml_string(XML.replace("implicitfast", "RK4"))
    with pytest.raises(UserError, match="RK4"):
        Simulator(rk4, ParameterSpace(()), DT, fixed={"effect.slip.floor/foot": 0.4})


def test_factors_of_all_contacts_reach_stated_pairs(
    model: mujoco.MjModel, ctrl: np.ndarray, tmp_path: Path
) -> None:
    path = tmp_path / "robot.xml"
    path.write_text(XML)
    entries = [
        EffectEntry("contact_friction", "", "model", {"friction": 0.6}, {}),
        EffectEntry(
            *("contact_softness", "", "model"),
            *({"softness.0": 0.4, "softness.1": 0.7}, {}),
        ),
    ]
    found = FoundEffects(tuple(entries))
    simulator = simulator_with(Simulator(model, ParameterSpace(()), DT), found)
    got = simulated(simulator, ctrl, simulator.space.nominal)
    repaired = repaired_model(path, entries)
    assert repaired.left == []
    want = native(mujoco.MjModel.from_xml_string(repaired.xml), ctrl)
    np.testing.assert_allclose(got, want, atol=2e-5)
    assert (np.abs(want - native(model, ctrl)).max(0)[::2] > 0.01).all()
