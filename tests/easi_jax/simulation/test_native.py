"""The engine `mujoco`: native MuJoCo, called from compiled programs."""

import dataclasses
import itertools
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from easi_jax.data.segments import Segments
from easi_jax.errors import EngineError, UserError
from easi_jax.io.files import atomic_write
from easi_jax.io.runs.folder import RunFolder, engine_of
from easi_jax.model.addresses import describe, split
from easi_jax.model.contact_pairs import pair_ids
from easi_jax.model.effect_catalog import CATALOG
from easi_jax.model.effect_numbers import EFFECT_TABLE
from easi_jax.model.mjx_model import for_every_effect
from easi_jax.model.parameters import ParameterSpace, declare
from easi_jax.simulation import engine, native, open_loop
from easi_jax.simulation.simulator import Simulator

_ARM = """<mujoco>
  <compiler angle="radian"/>
  <option timestep="0.005" integrator="{integrator}"/>
  <worldbody>
    <geom name="floor" type="plane" size="3 3 .1" pos="0 0 -.4"/>
    <body name="upper">
      <joint name="shoulder" axis="0 1 0" damping=".05" frictionloss=".02"
             armature=".01" stiffness=".3" springref=".2"/>
      <geom name="bar" type="capsule" size=".03" fromto="0 0 0 .4 0 0" mass="1"
            contype="0" conaffinity="0"/>
      <body name="fore" pos=".4 0 0">
        <joint name="elbow" axis="0 1 0" damping=".05" armature=".01"/>
        <geom name="rod" type="capsule" size=".02" fromto="0 0 0 .3 .05 0" mass=".4"
              contype="0" conaffinity="0"/>
        <geom name="tip" type="sphere" size=".05" pos=".3 0 0" mass=".1"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="shoulder" joint="shoulder" gear="2" ctrlrange="-3 3"/>
    <position name="elbow" joint="elbow" kp="4" kv=".3"/>
  </actuator>
</mujoco>"""
# A strength that changes the motion, of each number that one effect consists of.
_EFFECTS: dict[str, dict[str, float]] = {
    "none": {},
    "coulomb": {"effect.coulomb.shoulder": 0.2},
    "stribeck": {"effect.static.shoulder": 0.3, "effect.stribeck.shoulder": 0.5},
    "damping": {"effect.damping.elbow": 0.2},
    "drag": {"effect.drag.elbow": 0.05},
    "spring": {"effect.stiffness.shoulder": 2.0, "effect.spring.shoulder": 0.5},
    "constant": {"effect.constant.elbow": 0.3},
    "ripple": {"effect.ripple.elbow": 0.2, "effect.cycles.elbow": 8.0},
    "armature": {"effect.armature.elbow": 0.02},
    "gain": {"effect.gain.shoulder": 0.6},
    "kp": {"effect.kp.elbow": 0.3},
    "kv": {"effect.kv.elbow": 3.0},
    "strength": {"effect.strength.elbow": 0.3},
    "delay": {"effect.delay.shoulder": 0.03},
    "lag": {"effect.lag.elbow": 0.04},
    "limit": {"effect.limit.shoulder": 0.8},
    "deadband": {"effect.deadband.shoulder": 0.4},
    "payload": {"effect.mass.fore": 0.3},
    "center": {"effect.com.fore.0": 0.05},
    "force": {"effect.force.fore.0": 2.0},
    "resistance": {"effect.resistance.fore": 1.0},
    "tilt": {"effect.tilt.1": 0.2},
    "backlash": {"effect.width.elbow": 0.05, "effect.rotor.elbow": 0.005},
    "friction": {"effect.friction": 0.3},
    "softness": {"effect.softness.0": 0.3},
    "slip": {"effect.slip.floor/tip": 0.3},
    "give": {"effect.give.floor/tip.0": 0.3},
    "several": {
        "effect.coulomb.elbow": 0.1,
        "effect.drag.shoulder": 0.1,
        "effect.mass.fore": 0.2,
        "effect.delay.elbow": 0.02,
        "effect.slip.floor/tip": 0.5,
    },
}
# Every two of them that share no number.
_PAIRS = [
    (a, b)
    for a, b in itertools.combinations(list(_EFFECTS)[1:-1], 2)
    if not {*_EFFECTS[a]} & {*_EFFECTS[b]}
]
_ROWS = [*_EFFECTS.values(), *({**_EFFECTS[a], **_EFFECTS[b]} for a, b in _PAIRS)]


def _model(integrator: str = "implicitfast", xml: str = _ARM) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(xml.format(integrator=integrator))


def _segments(m: mujoco.MjModel, count: int, steps: int) -> Segments:
    rng = np.random.default_rng(0)
    qpos = rng.uniform(0.2, 0.9, (count, m.nq))
    qvel = rng.normal(0.0, 1.0, (count, m.nv))
    ctrl = rng.uniform(-1.5, 1.5, (count, steps, m.nu))
    return Segments(
        jnp.asarray(qpos, jnp.float32),
        jnp.asarray(qvel, jnp.float32),
        jnp.asarray(ctrl, jnp.float32),
        jnp.zeros((count, steps, m.nq)),
        jnp.zeros((count, steps, m.nv)),
        jnp.ones(count),
        (),
    )


def _predicted(simulator: Simulator, seg: Segments, theta: np.ndarray) -> Any:
    """Positions and velocities of every row of parameters, ``(P, M, H, ...)``."""

    def one(t: jax.Array) -> Any:
        return open_loop.predict(simulator, simulator.model(t), seg)

    found = jax.jit(jax.vmap(one))(jnp.asarray(theta, jnp.float32))
    return tuple(np.asarray(x) for x in found)


def test_a_foot_that_slides_stands_as_firmly_as_in_mujoco() -> None:
    """MuJoCo weighs contacts of a body that only slides by its mass, also where any
    effect may change it."""
    m = mujoco.MjModel.from_xml_string("""<mujoco>
      <option timestep="0.01" integrator="implicitfast"/><worldbody>
      <geom type="plane" size="1 1 1"/><body name="foot" pos="0 0 0.05">
      <joint name="x" type="slide" axis="1 0 0"/>
      <joint name="z" type="slide" axis="0 0 1"/>
      <geom size="0.05" mass="1" solref="0.1 1"/></body></worldbody></mujoco>""")
    fixed = {"body.foot.mass": 1.0}
    sim = Simulator(m, ParameterSpace(()), 0.01, fixed=fixed, engine="mujoco")
    model = sim.model(jnp.zeros(0))
    model = model.replace(mjx=for_every_effect(model.mjx))
    state = sim.start(jnp.array([0.0, -0.007]), jnp.array([0.04, 0.01]), model)
    d = mujoco.MjData(m)
    d.qpos[:], d.qvel[:] = state.qpos, state.qvel
    for _ in range(5):
        state = sim.step(model, state, jnp.zeros(0))
        mujoco.mj_step(m, d)
    np.testing.assert_allclose(state.qvel, d.qvel, rtol=1e-5)


@pytest.mark.parametrize("integrator", ["Euler", "implicitfast", "RK4"])
def test_a_replay_is_a_loop_of_steps(integrator: str) -> None:
    m = _model(integrator)
    space = ParameterSpace((declare(m, "mass", "body.fore.mass"),))
    simulator = Simulator(m, space, 0.02, engine="mujoco")
    seg = _segments(m, 3, 10)
    masses = np.array([0.3, 0.5, 1.2])
    qpos, qvel = _predicted(simulator, seg, masses[:, None])
    for p, mass in enumerate(masses):
        own = _model(integrator)
        ratio = mass / own.body("fore").mass[0]
        own.body("fore").inertia[:] *= ratio
        own.body("fore").mass[:] = mass
        mujoco.mj_setConst(own, mujoco.MjData(own))
        for i in range(3):
            d = mujoco.MjData(own)
            d.qpos[:], d.qvel[:] = seg.qpos[i], seg.qvel[i]
            for k in range(10):
                d.ctrl[:] = seg.ctrl[i, k]
                mujoco.mj_step(own, d, 4)
                np.testing.assert_allclose(qpos[p, i, k], d.qpos, rtol=1e-5, atol=1e-6)
                np.testing.assert_allclose(qvel[p, i, k], d.qvel, rtol=1e-4, atol=1e-5)


def test_steps_agree_with_the_replay_and_any_number_of_threads(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    m = _model()
    space = ParameterSpace((declare(m, "kp", "actuator.elbow.kp"),))
    seg = _segments(m, 4, 8)
    theta = np.array([[3.0], [5.0]])
    found = []
    for threads in (1, 3):
        monkeypatch.setattr(native, "_threads", lambda n=threads: n)
        simulator = Simulator(m, space, 0.01, engine="mujoco")
        found.append(_predicted(simulator, seg, theta))
    np.testing.assert_array_equal(found[0][0], found[1][0])
    np.testing.assert_array_equal(found[0][1], found[1][1])

    def stepped(t: jax.Array, q: jax.Array, v: jax.Array, u: jax.Array) -> Any:
        model = simulator.model(t)

        def step(s: Any, u: jax.Array) -> Any:
            s = simulator.step(model, s, u)
            return s, (s.qpos, s.qvel)

        return jax.lax.scan(step, simulator.start(q, v), u)[1]

    each = jax.vmap(jax.vmap(stepped, (None, 0, 0, 0)), (0, None, None, None))
    qpos, qvel = jax.jit(each)(jnp.asarray(theta), seg.qpos, seg.qvel, seg.ctrl)
    # States are rounded to float32 after each control step.
    np.testing.assert_allclose(qpos, found[0][0], atol=1e-5)
    np.testing.assert_allclose(qvel, found[0][1], atol=1e-4)


@pytest.mark.parametrize("slip", [(), ("effect.slip.floor/tip",)])
def test_speed_limits_clip_each_physics_step(slip: tuple[str, ...]) -> None:
    """By one call for a replay, also where contacts of a pair differ."""
    m = _model()
    limit = declare(
        m, "limit", "joint.elbow.speed_limit", nominal=2.0, initial=(0.5, 9.0)
    )
    space = ParameterSpace((limit, *(declare(m, "slip", a) for a in slip)))
    simulator = Simulator(m, space, 0.02, engine="mujoco")
    seg = _segments(m, 3, 5)
    seg = dataclasses.replace(seg, qvel=seg.qvel.at[2].set(jnp.nan))
    limits, still = np.array([0.5, 2.0, 99.0]), np.ones((3, len(slip)))
    rows = np.concatenate([limits[:, None], still], 1)
    qpos, qvel = _predicted(simulator, seg, rows)
    fastest = np.zeros(3)
    for p, edge in enumerate(limits):
        for i in range(2):
            d = mujoco.MjData(m)
            d.qpos[:], d.qvel[:] = seg.qpos[i], seg.qvel[i]
            for k in range(5):
                d.ctrl[:] = seg.ctrl[i, k]
                for _ in range(4):
                    mujoco.mj_step(m, d)
                    fastest[p] = max(fastest[p], abs(d.qvel[1]))
                    d.qvel[1] = np.clip(d.qvel[1], -edge, edge)
                np.testing.assert_allclose(qpos[p, i, k], d.qpos, rtol=1e-5, atol=1e-5)
                np.testing.assert_allclose(qvel[p, i, k], d.qvel, rtol=1e-4, atol=1e-4)
    assert (fastest > limits).tolist() == [True, True, False]
    assert np.isnan(qvel[:, 2]).all()

    def replay(t: jax.Array) -> Any:
        return open_loop.predict(simulator, simulator.model(t), seg)

    calls = str(jax.make_jaxpr(replay)(jnp.asarray(rows[0])))
    assert "scan" not in calls


class _Read:
    """Reads accelerations and forces of a step."""

    fields = ("qacc", "qfrc_constraint")
    size = 4

    def __call__(self, *given: np.ndarray) -> np.ndarray:
        return np.concatenate(given, 1)


@pytest.mark.parametrize(
    ("each", "address"),
    [
        (False, "body.fore.mass"),
        (True, "body.fore.mass"),
        (True, "joint.elbow.damping"),
    ],
)
def test_simulations_one_by_one_are_those_at_once(each: bool, address: str) -> None:
    """Contacts of pairs by neutral factors: positions, speeds and what is read.
    Other fields follow from a mass, none from damping."""
    m = _model()
    space = ParameterSpace((declare(m, "value", address),))
    simulator = Simulator(m, space, 0.02, engine="mujoco")
    seg = _segments(m, 3, 60)

    def run(pairs: Any, value: Any, q: jax.Array, v: jax.Array, u: jax.Array) -> Any:
        state = simulator.start(q, v)
        return native.run(
            *(simulator.model(value[None]).mjx, state, u),
            every=20 if each else None,
            read=_Read(),
            pairs=pairs,
            each=each,
        )

    neutral = jnp.ones((len(pair_ids(m)), 3))
    at_once, one_by_one = (jax.jit(jax.vmap(partial(run, p))) for p in (None, neutral))
    found = []
    for value in jnp.array([[0.5, 0.6, 0.7], [1.2, 0.9, 0.8]]):
        # Nothing of it is left to the next.
        given = value, seg.qpos, seg.qvel, seg.ctrl
        a, b = at_once(*given), one_by_one(*given)
        # Only a contact holds the elbow.
        assert np.abs(a[2][..., 3]).max() > 0.1
        for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
            np.testing.assert_allclose(y, x, rtol=2e-4, atol=2e-4)
        found.append(a[1][0])
    assert np.abs(found[0] - found[1]).max() > 1e-3


def test_models_leave_nothing_to_the_next_ones() -> None:
    """Where a model is nominal, nothing that follows from it has a row of its own."""
    m = _model()
    space = ParameterSpace((declare(m, "mass", "body.fore.mass"),))
    simulator = Simulator(m, space, 0.02, engine="mujoco")
    seg = _segments(m, 3, 4)
    nominal, other = (np.array([[mass]]) for mass in (m.body("fore").mass[0], 2.0))
    run = jax.jit(lambda t: open_loop.predict(simulator, simulator.model(t), seg))
    found = [np.asarray(run(jnp.asarray(t[0]))[1]) for t in (nominal, other, nominal)]
    np.testing.assert_array_equal(found[0], found[2])
    assert np.abs(found[1] - found[0]).max() > 0.1
    (fresh,) = native._host(simulator.base.mjx.template)._free
    assert "body_subtreemass" in fresh.expanded()
    rows = fresh.expanded()["body_subtreemass"]
    np.testing.assert_allclose(rows, np.tile(m.body_subtreemass, (3, 1)), rtol=1e-6)


@pytest.fixture(scope="module")
def effects_on_both() -> dict[str, Any]:
    """Predictions by engine, a row for each of `_ROWS`."""
    m = _model()
    places = sorted({a for numbers in _EFFECTS.values() for a in numbers})
    spread = [f"effect.spread.{a.split('.')[2]}" for a in places if ".mass." in a]
    places += [a for a in sorted(set(spread)) if a not in places]

    def neutral(a: str) -> float:
        # A limit that is off is beyond all bounds; a rotor's inertia is above zero.
        low = describe(m, (a,))[1][0]
        return max(low, min(EFFECT_TABLE[split(a)[2]].neutral, 50.0))

    parameters = tuple(
        declare(
            *(m, a.replace(".", "_").replace("/", "_"), a),
            nominal=neutral(a),
            initial=(0.01, 0.4),
        )
        for a in places
    )
    space = ParameterSpace(parameters)
    rows = np.tile(np.asarray(space.nominal, float), (len(_ROWS), 1))
    for row, numbers in zip(rows, _ROWS, strict=True):
        for address, value in numbers.items():
            row[places.index(address)] = value
    seg = _segments(m, 4, 6)
    out: dict[str, Any] = {}
    for name in ("mjx", "mujoco"):
        simulator = Simulator(m, space, 0.02, engine=name)  # type: ignore[arg-type]
        out[name] = _predicted(simulator, seg, rows)
    return out


def test_every_effect_is_compared() -> None:
    compared = {split(a)[2] for numbers in _EFFECTS.values() for a in numbers}
    for row in CATALOG.values():
        for site in row.sites.values():
            columns = {p.column for p in site.parts} & {*EFFECT_TABLE}
            assert not columns or columns & compared, row.name


@pytest.mark.parametrize("effect", [e for e in _EFFECTS if e != "none"])
def test_every_effect_is_the_same_on_both(
    effects_on_both: dict[str, Any], effect: str
) -> None:
    row = list(_EFFECTS).index(effect)
    moved, apart, apart_q = _differences(effects_on_both, row)
    assert moved > 0.01, "the effect changes too little to be compared"
    assert apart < 0.02 * moved + 2e-3
    assert apart_q < 5e-4


def test_every_pair_of_effects_is_the_same_on_both(
    effects_on_both: dict[str, Any],
) -> None:
    apart = []
    for row, pair in enumerate(_PAIRS, len(_EFFECTS)):
        moved, v, q = _differences(effects_on_both, row)
        if not (v < 0.02 * moved + 2e-3 and q < 5e-4):
            apart.append((pair, moved, v, q))
    assert not apart
    assert len(_PAIRS) > 200


def _differences(both: dict[str, Any], row: int) -> tuple[float, float, float]:
    """How far effects move velocities; between the engines, velocities and positions:
    the largest."""
    (q, v), (q_c, v_c) = both["mjx"], both["mujoco"]
    pairs = ((v_c[row], v_c[0]), (v[row], v_c[row]), (q[row], q_c[row]))
    moved, apart, apart_q = (float(np.abs(a - b).max()) for a, b in pairs)
    return moved, apart, apart_q


def test_what_diverges_is_not_a_number_and_alone() -> None:
    m = _model()
    space = ParameterSpace((declare(m, "kv", "actuator.elbow.kv"),))
    simulator = Simulator(m, space, 0.02, engine="mujoco")
    seg = _segments(m, 2, 10)
    seg = dataclasses.replace(seg, qvel=seg.qvel.at[1].set(jnp.nan))
    qpos, _ = _predicted(simulator, seg, np.array([[0.3]]))
    assert np.isfinite(qpos[0, 0]).all()
    assert np.isnan(qpos[0, 1]).all()


def test_auto_takes_mujoco_where_mjx_lacks_something(tmp_path: Path) -> None:
    small = _model()
    lacking = _model(xml=_ARM.replace("<motor ", '<motor delay="0.02" nsample="8" '))
    said: list[str] = []
    with engine.using("auto", said.append):
        assert Simulator(small, ParameterSpace(())).engine == "mjx"
        assert not said
    with engine.using("auto", said.append):
        assert Simulator(lacking, ParameterSpace(())).engine == "mujoco"
        assert len(said) == 1 and "MJX" in said[0]
        with RunFolder.open(tmp_path / "run", {"a": 1}, command="x"):
            pass
    name, why = engine_of(tmp_path / "run") or ("", "")
    assert name == "mujoco" and why in said[0]
    assert engine_of(tmp_path) is None
    assert Simulator(small, ParameterSpace(())).engine == "mjx"


def test_what_auto_takes_later_is_stored_too(tmp_path: Path) -> None:
    """A command may open its folder before it makes its simulator."""
    parts = [
        _model(),
        _model(xml=_ARM.replace("<motor ", '<motor delay="0.02" nsample="8" ')),
    ]
    with engine.using("auto"), RunFolder.open(tmp_path / "run", {}, command="x"):
        assert engine_of(tmp_path / "run") is None
        assert Simulator(parts[0], ParameterSpace(())).engine == "mjx"
        assert engine_of(tmp_path / "run") == ("mjx", "a small robot")
        assert Simulator(parts[1], ParameterSpace(())).engine == "mujoco"
        name, why = engine_of(tmp_path / "run") or ("", "")
        assert name == "auto" and "mjx: a small robot; mujoco: " in why
    given = RunFolder.open(tmp_path / "given", {}, command="x")
    with given, engine.using("mujoco"):
        engine.recorded(given._write_engine)
    assert engine_of(tmp_path / "given") == ("mujoco", "--engine mujoco")


class _Failing:
    """Reads nothing: it raises, as a plugin may, or numpy without memory."""

    fields = ("qpos",)
    size = 1

    def __call__(self, *given: np.ndarray) -> np.ndarray:
        raise MemoryError("no room for\n 300 simulations")


def test_a_call_that_fails_is_one_line() -> None:
    m = _model()
    line = "the engine mujoco failed in a simulation: MemoryError: no room for\n 300"
    with pytest.raises(EngineError, match=line), engine.using("mujoco"):
        simulator = Simulator(m, ParameterSpace(()), 0.02)
        model, state = simulator.base.mjx, simulator.start(*jnp.zeros((2, 2)))
        run = jax.jit(lambda u: native.run(model, state, u, read=_Failing())[2])
        jax.block_until_ready(run(jnp.zeros((1, 2))))
    # What fails next is not taken for it, and where nobody asks it is raised.
    with pytest.raises(jax.errors.JaxRuntimeError), engine.using("mujoco"):
        raise jax.errors.JaxRuntimeError("something else")
    raised = jax.errors.JaxRuntimeError, ValueError  # by another thread or our own
    with pytest.raises(raised, match="MemoryError"):
        jax.block_until_ready(run(jnp.zeros((1, 2))))


def test_after_a_call_that_failed_nothing_is_written(tmp_path: Path) -> None:
    """Results are no numbers, at once and on every device; only a file would show
    them."""
    m = _model()
    with pytest.raises(EngineError, match="300"), engine.using("mujoco"):
        simulator = Simulator(m, ParameterSpace(()), 0.02)
        model, state = simulator.base.mjx, simulator.start(*jnp.zeros((2, 2)))

        def run(u: jax.Array) -> jax.Array:
            physics, _, seen = native.run(model, state, u, read=_Failing())
            return seen + physics[0].sum()

        assert jax.local_device_count() > 1
        mesh = jax.make_mesh((2,), ("seed",), axis_types=(jax.sharding.AxisType.Auto,))
        spread = jax.NamedSharding(mesh, jax.P("seed"))
        given = jax.device_put(jnp.zeros((2, 1, 2)), spread)
        got = jax.jit(lambda u: jax.vmap(run)(u).sum())(given)
        assert np.isnan(jax.device_get(got))
        with pytest.raises(EngineError):
            atomic_write(tmp_path / "result.json", "NaN")
        assert not list(tmp_path.iterdir())


def test_outside_of_a_choice_auto_chooses_and_says() -> None:
    lacking = _model(xml=_ARM.replace("<motor ", '<motor delay="0.02" nsample="8" '))
    with engine.chosen("auto") as said:
        assert Simulator(lacking, ParameterSpace(())).engine == "mujoco"
    assert len(said) == 1 and "MJX" in said[0]
    with engine.using("mjx"), engine.chosen("auto"):
        assert engine.of_built_in(lacking) == "mjx"


def test_a_delay_of_mujoco_is_simulated_over_steps() -> None:
    """What is under way is part of the state."""
    m = _model(xml=_ARM.replace("<motor ", '<motor delay="0.02" nsample="8" '))
    simulator = Simulator(m, ParameterSpace(()), 0.01, engine="mujoco")
    seg = _segments(m, 1, 8)
    model = simulator.model(jnp.zeros(0))
    state = simulator.start(seg.qpos[0], seg.qvel[0])
    d = mujoco.MjData(m)
    d.qpos[:], d.qvel[:] = seg.qpos[0], seg.qvel[0]
    for u in seg.ctrl[0]:
        state = simulator.step(model, state, u)
        d.ctrl[:] = u
        mujoco.mj_step(m, d, 2)
    np.testing.assert_allclose(state.qvel, d.qvel, atol=1e-4)


def test_unknown_engine_is_refused() -> None:
    with pytest.raises(UserError, match="one of auto, mjx, mujoco"), engine.using("c"):
        pass
