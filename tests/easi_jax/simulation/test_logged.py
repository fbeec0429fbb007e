"""What a log says of the simulation: pairs that never meet, states to compare at."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from easi_jax.errors import UserError
from easi_jax.model.contact_pairs import never_near, pair_ids, pair_names, without_pairs
from easi_jax.model.parameters import ParameterSpace, declare
from easi_jax.simulation import engine
from easi_jax.simulation.logged import Logged, apart_in
from easi_jax.simulation.simulator import Simulator

LINK = """<body name="{0}" pos="0 0 {1}"><joint name="{0}" axis="0 1 0" damping="0.3"/>
<geom name="{0}" type="capsule" size="0.03" fromto="0 0 0 0 0 0.3"/>
<geom name="{0}_motor" type="box" size="0.05 0.05 0.05" contype="{2}"/>"""
WORLD = """<mujoco><option timestep="0.004"/><worldbody>
<geom name="floor" type="plane" size="3 3 1"/>{0}</worldbody><actuator>{1}</actuator>
</mujoco>"""


def arm(links: int = 3, motors: int = 1) -> mujoco.MjModel:
    """Links upwards, of many pairs; the first one stands above the floor."""
    bodies = "".join(
        LINK.format(f"l{i}", 0.5 if i == 0 else 0.3, motors) for i in range(links)
    )
    drives = "".join(
        f'<position name="a{i}" joint="l{i}" kp="20"/>' for i in range(links)
    )
    return mujoco.MjModel.from_xml_string(
        WORLD.format(bodies + "</body>" * links, drives)
    )


def log_of(m: mujoco.MjModel, bend: float, steps: int = 60) -> Logged:
    """A simulation by MuJoCo C whose joints are all sent to ``bend`` [rad]."""
    d, rows = mujoco.MjData(m), []
    d.ctrl[:] = bend
    for _ in range(steps):
        rows.append((d.qpos.copy(), d.qvel.copy(), d.ctrl.copy()))
        mujoco.mj_step(m, d)
    return Logged(*(np.array(x) for x in zip(*rows, strict=True)))


def test_any_pairs_can_be_taken_out() -> None:
    m, rng = arm(), np.random.default_rng(0)
    every = pair_ids(m)
    assert len(every) == 10
    for share in rng.random(30):
        apart = frozenset(p for p in every if rng.random() < share)
        left = without_pairs(m, apart)
        assert set(pair_ids(left)) == set(every) - apart
    assert pair_ids(m) == every


def test_a_pair_that_is_near_once_stays() -> None:
    m = arm()
    qpos = np.zeros((3000, 3))
    numbers, every = pair_names(m), pair_ids(m)
    pair = every[numbers["l0/l2"]]
    assert never_near(m, qpos) == set(every)
    qpos[1234, 1] = 2.9  # the arm folds
    assert pair not in never_near(m, qpos)
    assert every[numbers["floor/l1"]] in never_near(m, qpos)
    qpos[77, 0] = 3.0  # it hangs down
    assert every[numbers["floor/l1"]] not in never_near(m, qpos)


def test_the_floor_stays_for_what_is_free_and_a_named_pair_always() -> None:
    text = """<mujoco><worldbody><geom name="floor" type="plane" size="1 1 1"/>
    <body pos="0 0 50"><freejoint/><geom name="ball" size="0.1"/></body>
    <body pos="9 0 50"><joint axis="0 1 0"/><geom name="arm" size="0.1" pos="1 0 0"/>
    </body></worldbody>
    <contact><pair geom1="arm" geom2="floor"/></contact></mujoco>"""
    m = mujoco.MjModel.from_xml_string(text)
    every, names = pair_ids(m), pair_names(m)
    apart = never_near(m, np.array([[0, 0, 50, 1, 0, 0, 0, 0.0]]))
    assert apart == {every[names["ball/arm"]]}
    assert set(pair_ids(without_pairs(m, apart))) == set(every) - apart


def test_a_geom_that_may_grow_reaches_further() -> None:
    m = mujoco.MjModel.from_xml_string(
        """<mujoco><worldbody><geom name="wall" type="box" size="0.1 1 1" pos="1 0 0"/>
        <body name="rod"><joint axis="0 1 0"/>
        <geom name="rod" type="box" size="0.2 0.02 0.02" pos="0.2 0 0"/></body>
        </worldbody></mujoco>"""
    )
    logged = Logged(np.zeros((4, 1)), np.zeros((4, 1)), np.zeros((4, 0)))
    address = ["geom.rod.length"]
    assert apart_in(logged, m, [(address, (0.3, 0.45))]) == set(pair_ids(m))
    assert apart_in(logged, m, [(address, (0.3, 0.85))]) == frozenset()


def test_mjx_without_the_pairs_moves_as_mujoco_with_all() -> None:
    m = arm()
    logged = log_of(m, 0.3)
    space = ParameterSpace((declare(m, "damping", "joint.l0.damping"),))
    simulator = Simulator(m, space, logged=logged)
    assert simulator.base.mjx.geom_contype.any() == 0
    assert len(simulator.base.pairs) == len(pair_ids(m))
    assert f"{len(pair_ids(m))} of {len(pair_ids(m))} pairs" in simulator.notes[0]
    model = simulator.model(jnp.asarray(space.nominal))
    start = simulator.start(logged.qpos[0], logged.qvel[0])

    def step(s: object, u: jax.Array) -> tuple[object, jax.Array]:
        s = simulator.step(model, s, u)  # type: ignore[arg-type]
        return s, s.qpos

    got = jax.jit(lambda: jax.lax.scan(step, start, jnp.asarray(logged.ctrl[:-1]))[1])()
    np.testing.assert_allclose(got, logged.qpos[1:], atol=1e-4)


def test_what_touches_in_the_log_is_compiled_and_the_engine_mujoco_keeps_all() -> None:
    m = arm()
    qpos = np.zeros((50, 3))
    qpos[20, 1] = 2.9
    logged = Logged(qpos, np.zeros((50, 3)), np.zeros((50, 3)))
    simulator = Simulator(m, ParameterSpace(()), logged=logged)
    kept = pair_ids(simulator.base.mjx)
    assert 0 < len(kept) < len(pair_ids(m))
    assert pair_ids(m)[pair_names(m)["l0/l2"]] in kept
    assert "l0/l2" in simulator.notes[0]
    again = simulator.rebuilt()
    assert pair_ids(again.base.mjx) == kept
    native = Simulator(m, ParameterSpace(()), engine="mujoco", logged=logged)
    assert not native.apart and not native.notes
    assert pair_ids(native.base.mjx.template.mj) == pair_ids(m)
    np.testing.assert_array_equal(native.mj_model.geom_contype, m.geom_contype)


CYLINDER = """<mujoco><worldbody><geom type="box" size="1 1 0.1" pos="0 0 -0.1"/>
<body pos="0 0 2"><joint axis="0 1 0" damping="0.1"/>
<geom type="cylinder" size="0.1 0.3"/></body></worldbody></mujoco>"""


def test_the_guard_looks_where_the_log_is() -> None:
    """MJX has no contacts of cylinder and box; this one hangs above the box."""
    high = mujoco.MjModel.from_xml_string(CYLINDER)
    low = mujoco.MjModel.from_xml_string(CYLINDER.replace("0 0 2", "0 0 0.27"))
    qpos = np.linspace(-1, 1, 30)[:, None]
    logged = Logged(qpos, np.ones((30, 1)), np.zeros((30, 0)))
    with engine.using("mjx"):
        Simulator(high, ParameterSpace(()), logged=logged)
        with pytest.raises(UserError, match="CYLINDER"):
            Simulator(low, ParameterSpace(()), logged=logged)
        with pytest.raises(UserError, match="CYLINDER"):
            Simulator(high, ParameterSpace(()))
