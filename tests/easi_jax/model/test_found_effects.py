"""Effects as parameters of a machine: against MuJoCo C and the gap's predictions."""

import copy
import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from easi_jax.data.recording import Run
from easi_jax.data.scales import scales_of
from easi_jax.data.segments import to_device, windows
from easi_jax.data.windows import fitted_velocity
from easi_jax.errors import UserError
from easi_jax.estimation.pieces import segments_from_runs
from easi_jax.gap.candidates import places
from easi_jax.gap.effect_vector import Layout
from easi_jax.gap.predictor import Predictor
from easi_jax.gap.window_set import window_set
from easi_jax.model.effect_numbers import EFFECT_TABLE, fields_that_act
from easi_jax.model.found_effects import EffectEntry, FoundEffects, joined
from easi_jax.model.joint_space import Configuration
from easi_jax.model.parameters import Parameter, ParameterSpace
from easi_jax.rl.episodes import Episodes
from easi_jax.search.config import SearchConfig
from easi_jax.search.easi import Search, SearchData
from easi_jax.simulation import open_loop
from easi_jax.simulation.rollout import policy_rollout
from easi_jax.simulation.simulator import Simulator
from easi_jax.simulation.with_effects import env_with, simulator_with
from envs.cartpole import Cartpole
from tests.easi_jax.model.test_effects import ARM, DT, STEPS, changed, native

NAMES = {"joint": "elbow", "actuator": "p", "body": "lower", "model": ""}


def entry(column: str, value: float, std: float = 0.0, at: str | None = None) -> Any:
    kind = EFFECT_TABLE[column].on
    effect = "coulomb_friction"  # the name is for people
    place = NAMES[kind] if at is None else at
    return EffectEntry(
        f"{effect}_{column}", place, kind, {column: value}, {column: std}
    )


@pytest.fixture(scope="module")
def arm() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(ARM)


@pytest.fixture(scope="module")
def simulator(arm: mujoco.MjModel) -> Simulator:
    """Every effect of the arm is a parameter."""
    # Shapes, and contacts, which the arm does not have.
    left = ("spread", "jump", "friction", *fields_that_act("contacts"))
    found = [entry(c, 0.1) for c in EFFECT_TABLE if c.split(".")[0] not in left]
    found.append(entry("lag", 0.02, at="m"))
    base = Simulator(arm, ParameterSpace(()), DT)
    return simulator_with(base, FoundEffects(tuple(found)))


@pytest.fixture(scope="module")
def ctrl() -> np.ndarray:
    t = DT * np.arange(STEPS)
    return np.stack([4 * np.sin(9 * t) + 2.5, 0.8 * np.sin(14 * t)], 1)


@pytest.fixture(scope="module")
def none(simulator: Simulator) -> np.ndarray:
    out = []
    for p in simulator.space.parameters:
        parts = p.addresses[0].split(".")
        column = parts[1] if parts[1] in EFFECT_TABLE else f"{parts[1]}.{parts[-1]}"
        out.append(min(EFFECT_TABLE[column].neutral, 1e9))
    return np.array(out)


@pytest.fixture(scope="module")
def simulate(simulator: Simulator, ctrl: np.ndarray) -> Any:
    @jax.jit
    def run(theta: jax.Array) -> jax.Array:
        model = simulator.model(theta)

        def step(s: Any, u: jax.Array) -> Any:
            s = simulator.step(model, s, u)
            return s, s.qpos

        first = simulator.start(jnp.zeros(2), jnp.zeros(2))
        return jax.lax.scan(step, first, jnp.asarray(ctrl, jnp.float32))[1]

    return run


def at(simulator: Simulator, none: np.ndarray, **values: float) -> jax.Array:
    theta = none.copy()
    for column, value in values.items():
        address = entry(column.replace("_", "."), value).address(
            column.replace("_", ".")
        )
        index = [p.addresses[0] for p in simulator.space.parameters].index(address)
        theta[index] = value
    return jnp.asarray(theta, jnp.float32)


CASES: dict[str, tuple[dict[str, float], dict[str, Any], Any]] = {
    "none": ({}, {}, None),
    "coulomb": ({"coulomb": 0.2}, {"dof_frictionloss": (1, 0.2)}, None),
    "damping": ({"damping": 0.1}, {"dof_damping": (1, 0.1)}, None),
    "armature": ({"armature": 0.05}, {"dof_armature": (1, 0.06)}, None),
    "gain": ({"gain": 0.7}, {"actuator_gainprm": ((1, 0), 7.0)}, None),
    "limit": (
        {"limit": 0.5},
        {"actuator_forcerange": (1, [-0.5, 0.5]), "actuator_forcelimited": (1, 1)},
        None,
    ),
    "payload": ({"mass": 0.4}, {"body_mass": (2, 0.9)}, None),
    "com": (
        {"com_0": 0.02, "com_2": 0.03},
        {"body_ipos": (2, [0.12, 0.0, 0.03])},
        None,
    ),
    "constant": ({"constant": 0.3}, {}, 0.3),
}


@pytest.mark.parametrize("name", list(CASES))
def test_a_machine_with_an_effect_is_mujoco_c_with_it(
    name: str, simulator: Simulator, none: Any, simulate: Any, arm: Any, ctrl: Any
) -> None:
    values, change, torque = CASES[name]

    def push(m: mujoco.MjModel, d: mujoco.MjData) -> None:
        d.qfrc_applied[1] = torque

    want = native(changed(arm, **change), ctrl, push if torque else None)
    np.testing.assert_allclose(simulate(at(simulator, none, **values)), want, atol=1e-3)


def test_every_effect_moves_the_motion(
    simulator: Simulator, none: np.ndarray, simulate: Any
) -> None:
    # These do nothing by themselves.
    still = ("stribeck", "cycles", "phase", "width", "rotor")
    with_these = at(
        simulator, none, static=0.1, ripple=0.1, stribeck=0.5, width=0.05, rotor=0.004
    )
    for i, p in enumerate(simulator.space.parameters):
        field = p.addresses[0].split(".")[1]
        base = with_these if field in still else jnp.asarray(none, jnp.float32)
        value = {"limit": 0.3, "rotor": 0.008}.get(field, base[i] + 0.2)
        moved = simulate(base.at[i].set(value)) - simulate(base)
        sideways = p.addresses[0] in ("effect.com.lower.1", "effect.force.lower.1")
        if field == "tilt" and p.addresses[0].endswith("0"):
            sideways = True  # rolls about x; the arm turns about y
        assert sideways or float(jnp.abs(moved).max()) > 1e-4, p.name


def log_of(arm: mujoco.MjModel, ctrl: np.ndarray) -> Run:
    qpos = np.concatenate([np.zeros((1, 2)), native(arm, ctrl)])[:-1]
    c = Configuration.of(arm)
    time = DT * np.arange(len(qpos))
    qvel = fitted_velocity(qpos, DT, c)
    return Run("run", "run.csv", DT, time, qpos, qvel, False, ctrl, c)


@pytest.mark.slow
def test_replay_predicts_what_the_gap_analysis_does(
    simulator: Simulator, none: np.ndarray, arm: mujoco.MjModel, ctrl: np.ndarray
) -> None:
    """Late and lagging commands too: those before a piece are known."""
    run = log_of(arm, ctrl)
    horizon = 10
    past = window_set(arm, [run], horizon * DT, simulator.past_steps * DT)
    assert past is not None
    layout = Layout(arm, places(arm, scales_of(arm, [run])))
    predictor = Predictor(arm, ParameterSpace(()), layout, past, DT)
    values = {"delay": 0.017, "lag": 0.02, "coulomb": 0.1}
    x = predictor.neutral.copy()
    for i, c in enumerate(layout.columns):
        if c.index == (1,) and c.field in values:
            x[i] = values[c.field]
    want = predictor.errors(x[None])[0][:, 1:]

    steps = predictor.steps
    segments = segments_from_runs(simulator, [run], steps, horizon // 2)
    theta = at(simulator, none, **values)
    errors = jax.jit(lambda s: open_loop.errors(simulator, simulator.model(theta), s))
    segments = to_device(segments)
    got = -np.asarray(errors(segments))[..., :2]
    np.testing.assert_allclose(got, want, atol=2e-5)
    unknown = jnp.broadcast_to(segments.ctrl[:, :1], segments.past.shape)
    alone = dataclasses.replace(segments, past=unknown)
    other = -np.asarray(errors(alone))[..., :2]
    assert np.abs(other - want)[1:].max() > 1e-3, "past commands count"


DELAYED = FoundEffects((entry("delay", 0.04, at="cart"),))


def test_an_episode_starts_without_commands_of_the_one_before() -> None:
    env = env_with(Cartpole(), DELAYED)
    theta = jnp.asarray(env.space.nominal, jnp.float32)
    model = env.model(theta)
    reset = jax.jit(jax.vmap(env.reset, (None, 0)))
    envs = reset(model, jax.random.split(jax.random.key(0), 2))
    episodes = Episodes(env, env.model, lambda dist, key: dist, 2, 1)
    many = jnp.broadcast_to(theta, (2, len(theta)))
    step = jax.jit(episodes.step)
    for _ in range(3):
        envs = step(envs, many, jnp.ones((2, 1)))
    assert np.asarray(envs.physics.memory.past).max() > 0.1
    ended = dataclasses.replace(envs, terminated=jnp.array([1.0, 0.0]))
    fresh, _, _ = jax.jit(episodes.reset_finished)(
        ended, many, jnp.zeros(2), theta, jax.random.key(1)
    )
    memory = fresh.physics.memory
    assert memory.known.tolist() == [False, True]
    assert np.asarray(memory.past[0]).max() == 0.0
    np.testing.assert_array_equal(memory.past[1], envs.physics.memory.past[1])


def test_recorded_commands_begin_with_each_episode() -> None:
    env = env_with(Cartpole(), DELAYED)
    model = env.model(jnp.asarray(env.space.nominal, jnp.float32))
    count = env.simulator.past_steps

    def act(obs: jax.Array, key: jax.Array) -> jax.Array:
        return jax.random.uniform(key, (1,), minval=-1.0)

    def run(auto: bool) -> Any:
        key = jax.random.key(0)
        return policy_rollout(env, model, act, key, 150, auto, count)

    seg = jax.jit(lambda: run(True))()
    sent, past = np.asarray(seg.ctrl)[:, 0], np.asarray(seg.past)
    gone = np.abs(np.asarray(seg.next_qpos)[:, 0] - np.asarray(seg.qpos)).max(1) > 0.3
    starts = [0, *(np.flatnonzero(gone) + 1)]
    assert len(starts) > 2, "an episode ended"
    for first, last in zip(starts, [*starts[1:], 150], strict=True):
        for t in range(first, last):
            rows = np.maximum(np.arange(t - count, t), first)
            np.testing.assert_array_equal(past[t], sent[rows])
    pieces = windows(jax.tree.map(lambda x: x[None], seg), 4, 2)
    np.testing.assert_array_equal(pieces.past[3], past[6])


@pytest.mark.slow
def test_a_search_recovers_a_hidden_friction_from_a_wrong_file() -> None:
    env = Cartpole()
    found = FoundEffects((entry("coulomb", 0.25, 0.03, at="cart"),))
    theta = jnp.asarray(env.space.nominal, jnp.float32)
    truth = 0.33
    real = env_with(env, FoundEffects((entry("coulomb", truth, at="cart"),)))

    def act(obs: jax.Array, key: jax.Array) -> jax.Array:
        x, v, angle, rate = obs
        u = (1.5 * x + 0.6 * v + 3.0 * angle + 0.55 * rate) / 0.4
        return jnp.clip(u[None] + 0.5 * jax.random.normal(key, (1,)), -1.0, 1.0)

    model = real.model(jnp.append(theta, truth))
    keys = jax.random.split(jax.random.key(3), 4)
    demos = jax.jit(jax.vmap(lambda k: policy_rollout(real, model, act, k, 60)))(keys)
    known = [(p.addresses[0], p.nominal) for p in env.space.parameters]
    alone = env.simulator.rebuilt(space=ParameterSpace(()), fixed=dict(known))
    search = Search(
        simulator_with(alone, found),
        SearchConfig(population=32, segments=32, hidden=(32,)),
    )
    (p,) = search.space.parameters
    assert p.initial == pytest.approx((0.16, 0.34)) and p.bounds[0] == -0.01
    data = SearchData(segments=windows(demos, 1, 1), noise=jnp.zeros(4))
    state = search.init(jax.random.key(0), data)
    state, info = jax.jit(lambda s: search.run(s, data, 45))(state)
    got = float(search.space.to_si(state.result_mean)[0])
    assert got == pytest.approx(truth, rel=0.05)
    assert int(info.non_finite.sum()) == 0


def test_refitted_values_become_nominal() -> None:
    env = Cartpole()
    own = {"joint.pole.damping": 4e-3, "joint.cart.damping": 0.7}
    space, fixed = joined(env.mj_model, env.space, FoundEffects((), own))
    i = space.index("pole_damping")
    assert space.nominal[i] == 4e-3
    assert space.parameters[i].initial == pytest.approx((4e-3 / 3, 1.2e-2))
    assert fixed == {"joint.cart.damping": 0.7}
    other = env_with(env, FoundEffects((), own))
    model = other.model(jnp.asarray(other.space.nominal, jnp.float32))
    np.testing.assert_allclose(model.mjx.dof_damping, [0.7, 4e-3], rtol=1e-6)
    assert env.space.nominal[i] == 2e-3 and env.simulator.fixed == {}


def test_a_tied_parameter_gets_the_mean_of_its_places(arm: mujoco.MjModel) -> None:
    both = Parameter("armature", ("joint.*.armature",), 0.01, (0.005, 0.02), (0, 1))
    own = {"joint.elbow.armature": 0.03}
    space, fixed = joined(arm, ParameterSpace((both,)), FoundEffects((), own))
    assert space.nominal[0] == pytest.approx(0.02) and fixed == {}


@pytest.mark.parametrize("other", [0.02, 0.03])
def test_what_drives_have_alike_is_one_parameter(
    arm: mujoco.MjModel, other: float
) -> None:
    late = [
        EffectEntry("actuator_delay", at, "actuator", {"delay": x}, {"delay": 1e-3})
        for at, x in (("m", 0.02), ("p", other))
    ]
    space, _ = joined(arm, ParameterSpace(()), FoundEffects(tuple(late)))
    each = [[f"effect.delay.{at}"] for at in ("m", "p")]
    if other == 0.02:
        assert space.names == ("actuator_delay@all.delay",)
        each = [[*each[0], *each[1]]]
    assert [list(p.addresses) for p in space.parameters] == each


class Elsewhere(Cartpole):
    """Simulates with a machine of its own."""

    def __init__(self) -> None:
        super().__init__()
        self.hidden = self.simulator

    def model(self, theta: Any = None) -> Any:
        return self.hidden.model(jnp.asarray(Cartpole().space.nominal))


def test_bad_effects_get_one_line() -> None:
    env = Cartpole()
    coulomb = entry("coulomb", 0.2, at="cart")

    def refused(*found: EffectEntry, env: Any = env) -> str:
        with pytest.raises(UserError) as caught:
            env_with(env, FoundEffects(found))
        text = str(caught.value)
        assert "\n" not in text
        return text

    assert "names no joint" in refused(entry("coulomb", 0.2, at="hinge"))
    late = EffectEntry("sensor_delay", "cart", "joint", {"late": 0.01}, {})
    assert env_with(env, FoundEffects((late,))) is env  # in the readings
    wrong = EffectEntry("armature", "cart", "actuator", {"armature": 1.0}, {})
    assert "of kind joint, not actuator" in refused(wrong)
    assert "no column" in refused(EffectEntry("x", "cart", "joint", {"com": 1.0}, {}))
    assert "outside its bounds" in refused(entry("coulomb", -0.2, at="cart"))
    assert "there twice" in refused(coulomb, copy.copy(coulomb))
    assert "model()" in refused(coulomb, env=Elsewhere())
    bare = copy.copy(env)
    bare.simulator = None  # type: ignore[assignment]
    assert "simulator" in refused(coulomb, env=bare)
