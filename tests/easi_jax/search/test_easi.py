"""The search finds parameters, and each of its switches does something.

Most tests run on a mass on a servo written out in a few lines (`Servo`), which
compiles in seconds; one runs on Cartpole.
"""

import dataclasses
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from easi_jax.data.segments import Segments
from easi_jax.devices.mesh import make_mesh
from easi_jax.errors import UserError
from easi_jax.model.parameters import Parameter, ParameterSpace
from easi_jax.search.config import PAPER, SearchConfig, preset
from easi_jax.search.easi import Search, SearchData, _only_finite
from easi_jax.simulation import rollout
from easi_jax.simulation.env import EnvState
from easi_jax.simulation.simulator import Simulator
from easi_jax.simulation.step import Physics
from envs.cartpole import Cartpole

XML = """<mujoco><worldbody><body name="m"><joint name="x" type="slide" axis="1 0 0"/>
<geom size="0.1" mass="1"/></body></worldbody>
<actuator><position name="x" joint="x" kp="8" kv="1"/></actuator></mujoco>"""
TRUTH = np.array([8.0, 1.0])


def servo_space() -> ParameterSpace:
    names = (("kp", 8.0), ("kv", 1.0))
    return ParameterSpace(
        tuple(
            Parameter(n, (f"actuator.x.{n}",), v, (v / 3, 3 * v), (0.01 * v, 1e3))
            for n, v in names
        )
    )


class Servo(Simulator):
    """x'' = kp (u - x) - kv x', not finite for kp above ``explodes``."""

    explodes = np.inf

    def model(self, theta: jax.Array) -> Any:
        return theta

    def start(self, qpos: jax.Array, qvel: jax.Array, **_: Any) -> Physics:
        return Physics(qpos, qvel, jnp.zeros(0), jnp.zeros(1))

    def step(self, model: Any, state: Physics, ctrl: jax.Array) -> Physics:
        kp, kv = model
        push = kp * (ctrl - state.qpos) - kv * state.qvel
        qvel = state.qvel + 0.05 * jnp.where(kp > self.explodes, jnp.nan, push)
        return state.replace(qpos=state.qpos + 0.05 * qvel, qvel=qvel)


class ServoEnv:
    """Fails beyond 0.22 m."""

    obs_size = 2

    def __init__(self, simulator: Simulator) -> None:
        self.simulator = simulator

    def control(self, state: Any, action: jax.Array) -> jax.Array:
        return jnp.clip(action, -1, 1)

    def reset(self, model: Any, key: jax.Array) -> EnvState:
        s = jax.random.uniform(key, (2,), minval=-0.2, maxval=0.2)
        physics, zero = self.simulator.start(s[:1], s[1:]), jnp.zeros(())
        return EnvState(physics, s, zero, zero, zero, jnp.zeros((), jnp.int32))

    def step(self, model: Any, state: EnvState, action: jax.Array) -> EnvState:
        p = self.simulator.step(model, state.physics, self.control(state, action))
        obs = jnp.concatenate([p.qpos, p.qvel])
        done = (jnp.abs(p.qpos[0]) > 0.22).astype(float)
        zero = jnp.zeros(())
        return EnvState(p, obs, zero, done, zero, state.count + 1)


def servo(explodes: float = np.inf, space: ParameterSpace | None = None) -> Servo:
    m = Servo(mujoco.MjModel.from_xml_string(XML), space or servo_space(), 0.05)
    m.explodes = explodes
    return m


def act(policy: Any, obs: jax.Array, key: jax.Array) -> jax.Array:
    return policy @ obs + 0.5 * jax.random.normal(key, (1,))


POLICY = jnp.array([[-1.0, -0.2]])


@cache
def measured() -> Segments:
    """60 single steps of the servo at the truth."""
    rng = np.random.default_rng(0)
    simulator = servo()
    s = jnp.asarray(rng.normal(size=(60, 2)) * 0.3, jnp.float32)
    u = jnp.asarray(rng.normal(size=(60, 1)), jnp.float32)
    after = jax.vmap(
        lambda s, u: simulator.step(
            jnp.asarray(TRUTH), simulator.start(s[:1], s[1:]), u
        )
    )(s, u)
    return Segments(
        qpos=s[:, :1],
        qvel=s[:, 1:],
        ctrl=u[:, None],
        next_qpos=after.qpos[:, None],
        next_qvel=after.qvel[:, None],
        weight=jnp.ones(60),
        seen=jnp.concatenate([s, u, after.qpos, after.qvel], 1),
    )


def data(noise: float = 0.0) -> SearchData:
    return SearchData(measured(), jnp.full(2, noise), POLICY)


BASE = SearchConfig(
    population=24,
    segments=16,
    real_batch=32,
    fake_per_individual=4,
    discriminator_updates=3,
    hidden=(16,),
    rollout_steps=12,
)


def make(
    config: SearchConfig, simulator: Simulator | None = None, **more: Any
) -> Search:
    simulator = simulator or servo()
    return Search(simulator, config, ServoEnv(simulator), act, **more)


def one_generation(config: SearchConfig, simulator: Simulator | None = None) -> Any:
    search = make(config, simulator)
    state = search.init(jax.random.key(0), data())
    return jax.jit(lambda s: search.run(s, data(), 1))(state)


@cache
def reference(config: SearchConfig) -> Any:
    return one_generation(config)


PLAIN = dataclasses.replace(BASE, innovation_inputs=False)
ROLL = dataclasses.replace(BASE, source="policy")
SEEN = dataclasses.replace(
    ROLL, innovation_inputs=False, delta_inputs=False, observation_inputs=True
)
SWITCHES: tuple[tuple[SearchConfig, dict[str, Any]], ...] = (
    (BASE, {"innovation_inputs": False}),
    (PLAIN, {"delta_inputs": False}),
    (PLAIN, {"standardize_inputs": False}),
    (BASE, {"steady_learning": False}),
    (BASE, {"clip_after_update": False}),
    (BASE, {"epsilon_in_root": False}),
    (BASE, {"half_loss": True}),
    (dataclasses.replace(BASE, elite_ratio=0.8), {"positive_weights": False}),
    (SEEN, {"observation_inputs": False}),
    (SEEN, {"stale_first_observation": True}),
    (SEEN, {"standardize_inputs": False}),
    (BASE, {"uniform_first_generation": False}),
    (BASE, {"last_evaluation": False}),
    (ROLL, {"mask_resets": False}),
    (ROLL, {"common_random_numbers": False}),
    (BASE, {"spread_about": "new_mean"}),
    (BASE, {"log_scale": False}),
    (BASE, {"source": "policy"}),
    (BASE, {"segments": 8}),
    (BASE, {"elite_ratio": 0.2}),
    (BASE, {"discriminator_updates": 5}),
    (BASE, {"fake_per_individual": 8}),
    (BASE, {"real_batch": 8}),
    (BASE, {"learning_rate": 1e-2}),
    (BASE, {"loss": "gan"}),
    (BASE, {"regularizer": "none"}),
    (BASE, {"regularizer": "gradient_penalty"}),
    (ROLL, {"rollout_steps": 5}),
    (BASE, {"strategy": "CMA_ES"}),
)


def program(config: SearchConfig) -> tuple[str, list[bytes]]:
    """What a generation does, and the numbers it does it with."""
    search = make(config)
    state = search.init(jax.random.key(0), data())
    found = jax.make_jaxpr(search.step)(state, data())
    return str(found), [x.tobytes() for x in raw((found.consts, state))]


@cache
def plain_program(config: SearchConfig) -> tuple[str, list[bytes]]:
    return program(config)


@pytest.mark.parametrize(("base", "change"), SWITCHES, ids=lambda c: str(c)[:40])
def test_every_switch_changes_the_program(
    base: SearchConfig, change: dict[str, Any]
) -> None:
    """Which compiles nothing; the slow tests run each of them."""
    assert program(dataclasses.replace(base, **change)) != plain_program(base)


# Those that bring code of their own.
RUN = ("loss", "regularizer", "strategy", "source", "delta_inputs")


@pytest.mark.parametrize(
    ("base", "change"),
    [
        pytest.param(*s, marks=[] if set(s[1]) <= set(RUN) else [pytest.mark.slow])
        for s in SWITCHES
    ],
    ids=lambda c: str(c)[:40],
)
def test_every_switch_changes_the_result(
    base: SearchConfig, change: dict[str, Any]
) -> None:
    state, info = reference(base)
    other, other_info = one_generation(dataclasses.replace(base, **change))
    a, b = (
        (s.result_mean, s.result_cov, i.loss)
        for s, i in ((state, info), (other, other_info))
    )
    assert all(np.isfinite(x).all() for x in (*a, *b))
    assert any(not np.array_equal(x, y) for x, y in zip(a, b, strict=True))


def test_bounds_are_respected_or_not() -> None:
    tight = servo_space().with_initial([4.0, 0.5], [16.0, 2.0])
    tight = ParameterSpace(
        tuple(dataclasses.replace(p, bounds=p.initial) for p in tight.parameters)
    )
    config = dataclasses.replace(BASE, uniform_first_generation=False)
    low, high = (np.asarray(x) for x in tight.unit_bounds)
    for respect in (True, False):
        config = dataclasses.replace(config, respect_bounds=respect)
        state, info = one_generation(config, servo(space=tight))
        assert (np.asarray(info.at_bound[0]) > 0).all() == respect
        assert (state.mean >= low).all() and (state.mean <= high).all()


def test_a_trajectory_begins_with_the_end_of_the_one_before() -> None:
    search = make(dataclasses.replace(SEEN, stale_first_observation=True))
    state = search.init(jax.random.key(0), data())
    assert state.observed.shape == (24, 2) and not state.observed.any()
    step = jax.jit(search.step)
    first, _ = step(state, data())
    second, _ = step(first, data())
    assert first.observed.any(1).all()
    assert not np.isclose(first.observed, second.observed).all(1).any()
    # What comes first is what the policy acts on: another end, another trajectory.
    other, _ = step(dataclasses.replace(first, observed=-first.observed), data())
    assert not np.isclose(other.observed, second.observed).all(1).any()


@pytest.fixture(scope="module")
def chunked() -> Any:
    search = make(dataclasses.replace(BASE, population=31), mesh=make_mesh(1))
    d = data(1e-3)
    run = jax.jit(search.run, static_argnums=2)
    return search, d, run, search.init(jax.random.key(4), d)


def raw(tree: Any) -> list[np.ndarray]:
    def plain(x: Any) -> np.ndarray:
        x = jnp.asarray(x)
        typed = jnp.issubdtype(x.dtype, jax.dtypes.prng_key)
        return np.asarray(jax.random.key_data(x) if typed else x)

    return [plain(x) for x in jax.tree.leaves(tree)]


def test_the_result_does_not_depend_on_the_chunk(chunked: Any) -> None:
    _, d, run, state = chunked
    whole, _ = run(state, d, 9)
    part, _ = run(state, d, 3)
    part, _ = run(part, d, 3)
    part, info = run(part, d, 3)
    assert info.mean.shape == (3, 2) and int(part.generation) == 9
    for a, b in zip(raw(whole), raw(part), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.skipif(len(jax.devices()) < 2, reason="one device here")
def test_two_devices_agree_with_one(chunked: Any) -> None:
    one, d, run, state = chunked
    two = make(one.config, mesh=make_mesh(2))
    a, _ = run(state, d, 3)
    b, _ = jax.jit(two.run, static_argnums=2)(state, d, 3)
    np.testing.assert_allclose(a.mean, b.mean, atol=1e-3)
    np.testing.assert_allclose(a.cov, b.cov, atol=1e-3)


@pytest.mark.fault("simulations that explode, parameters at absurd corners")
def test_exploding_individuals_are_counted_and_ranked_last() -> None:
    simulator = servo(explodes=10.0)
    config = dataclasses.replace(BASE, population=64)
    search = make(config, simulator)
    state = search.init(jax.random.key(0), data())
    new, info = jax.jit(search.step)(state, data())
    # Uniform on [8/3, 24] in the logarithm: 39.8 % are above 10.
    assert 12 <= int(info.non_finite) <= 40
    assert all(np.isfinite(x).all() for x in raw((new.mean, new.cov, info)))
    limit = float(search.space.to_unit(jnp.array([10.0, 1.0]))[0])
    assert new.mean[0] < limit
    for leaf in raw(new.critic):
        assert np.isfinite(leaf).all()


@pytest.mark.fault("simulations that explode, parameters at absurd corners")
def test_lost_ones_pull_nothing_where_the_last_weigh_less_than_nothing() -> None:
    population = jnp.array([[0.0], [1.0], [2.0], [jnp.nan]])
    finite = jnp.array([True, True, True, False])
    cost = jnp.array([3.0, 1.0, 2.0, jnp.nan])
    neutral = jnp.array([0.25])
    told, ranks = _only_finite(population, cost, finite, neutral)
    np.testing.assert_array_equal(told[:, 0], [0.0, 1.0, 2.0, 0.25])
    assert ranks[3] > ranks[:3].max()
    told, _ = _only_finite(population, cost, finite)
    assert told[3, 0] in (0.0, 1.0, 2.0)


def test_what_a_controller_saw_has_to_be_recorded() -> None:
    bare = dataclasses.replace(measured(), seen=())
    with pytest.raises(UserError, match="sees=True"):
        make(SEEN).init(jax.random.key(0), SearchData(bare, jnp.zeros(2), POLICY))


@pytest.mark.fault("simulations that explode, parameters at absurd corners")
def test_a_generation_without_a_finite_one_changes_nothing() -> None:
    search = make(BASE, servo(explodes=0.0))
    state = search.init(jax.random.key(0), data())
    new, info = jax.jit(search.step)(state, data())
    assert int(info.non_finite) == BASE.population
    kept = (state.strategy, state.critic, state.mean, state.cov)
    after = (new.strategy, new.critic, new.mean, new.cov)
    for a, b in zip(raw(after), raw(kept), strict=True):
        if np.isfinite(b).all():
            np.testing.assert_array_equal(a, b)
    assert np.isfinite(new.mean).all() and np.isfinite(new.cov).all()


@pytest.mark.parametrize("source", ["replay", "policy"])
def test_the_servo_is_found(source: str) -> None:
    config = SearchConfig(source=source, population=64, segments=32, rollout_steps=12)
    simulator = servo()
    search = make(config, simulator)
    d = data()
    if source == "policy":  # what the same controller does in the target
        env: Any = ServoEnv(simulator)
        truth = jnp.asarray(TRUTH)
        seg = rollout.collect(
            env, truth, lambda o, k: act(POLICY, o, k), jax.random.key(9), 40, 12
        )
        seg = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), seg)
        d = dataclasses.replace(d, segments=seg)
    state = search.init(jax.random.key(1), d)
    state, info = jax.jit(lambda s: search.run(s, d, 25))(state)
    found = np.asarray(search.space.to_si(state.mean))
    if source == "replay":
        np.testing.assert_allclose(found, TRUTH, rtol=0.02)
        assert info.std[-1].max() < 0.1 * info.std[0].min()
    else:  # unpaired, kv leaves next to no trace
        assert found[0] == pytest.approx(TRUTH[0], rel=0.1)
        assert info.std[-1, 0] < 0.5 * info.std[0, 0]


@pytest.mark.parametrize(
    "start", [(2.0, 4.0), pytest.param((0.1, 0.15), marks=pytest.mark.slow)]
)
def test_the_servo_is_found_from_far_away(start: tuple[float, float]) -> None:
    """All that is measured is then beyond the population's own spread."""
    space = ParameterSpace(
        tuple(
            dataclasses.replace(p, initial=tuple(x * p.nominal for x in start))
            for p in servo_space().parameters
        )
    )
    config = SearchConfig(population=64, segments=60, real_batch=960)
    search = make(config, servo(space=space))
    run = jax.jit(lambda s: search.run(s, data(), 40)[0])
    for seed in range(3):
        state = run(search.init(jax.random.key(seed), data()))
        found = np.asarray(search.space.to_si(state.mean))
        assert found[0] == pytest.approx(TRUTH[0], rel=0.1)


@pytest.mark.fault("a discriminator that has won, or has no opinion")
def test_a_discriminator_that_wins_at_once() -> None:
    """Many large steps, against simulations that start far from the truth; the
    Wasserstein score is linear, and cannot saturate."""
    space = ParameterSpace(
        tuple(
            dataclasses.replace(p, initial=(2 * v, 6 * v))
            for p, v in zip(servo_space().parameters, TRUTH, strict=True)
        )
    )
    config = SearchConfig(
        population=64,
        segments=32,
        real_batch=64,
        loss="gan",
        regularizer="none",
        learning_rate=0.1,
        discriminator_updates=100,
    )
    search, d = make(config, servo(space=space)), data()
    # Farther from every simulation than they are from each other.
    apart = dataclasses.replace(d.segments, next_qvel=d.segments.next_qvel + 5.0)
    apart = dataclasses.replace(d, segments=apart)
    state = search.init(jax.random.key(1), d)
    won, info = jax.jit(search.step)(state, apart)
    ranked = info.best - info.score
    assert ranked > 0 and np.isfinite(won.mean).all()
    state, info = jax.jit(lambda s: search.run(s, d, 30))(state)
    found = np.asarray(search.space.to_si(state.mean))
    np.testing.assert_allclose(found, TRUTH, rtol=0.05)


@pytest.mark.fault("a discriminator that has won, or has no opinion")
def test_a_discriminator_without_an_opinion_teaches_nothing() -> None:
    search = make(dataclasses.replace(BASE, learning_rate=0.0))
    state = search.init(jax.random.key(0), data())
    flat = jax.tree.map(jnp.zeros_like, state.critic.params)
    critic = dataclasses.replace(state.critic, params=flat)
    state = dataclasses.replace(state, critic=critic)
    new, info = jax.jit(search.step)(state, data())
    assert info.best == info.score
    np.testing.assert_array_equal(new.mean, state.mean)
    np.testing.assert_array_equal(new.cov, state.cov)


def test_transitions_of_no_weight_are_never_picked() -> None:
    d = data()
    bad = jnp.arange(60) >= 30
    spoilt = dataclasses.replace(
        d.segments,
        weight=jnp.where(bad, 0.0, 1.0),
        next_qvel=jnp.where(bad[:, None, None], jnp.nan, d.segments.next_qvel),
    )
    search = make(dataclasses.replace(BASE, real_batch=8))
    state = search.init(jax.random.key(0), d)
    d = dataclasses.replace(d, segments=spoilt)
    new, info = jax.jit(search.step)(state, d)
    assert np.isfinite(info.loss) and np.isfinite(new.mean).all()


def test_policy_training_goes_along() -> None:
    def trainer(state: jax.Array, dist: Any) -> tuple[jax.Array, jax.Array]:
        return state + 1, dist.mean[0]

    config = dataclasses.replace(BASE, policy_updates_per_generation=3)
    search = make(config, trainer=trainer)
    state = search.init(jax.random.key(0), data(), jnp.zeros(()))
    state, info = jax.jit(search.step)(state, data())
    assert float(state.training) == 3.0
    np.testing.assert_allclose(info.training, np.full(3, state.mean[0]))


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"observation_inputs": True}, "observation_inputs shows what a controller"),
        (
            {"stale_first_observation": True},
            "stale_first_observation goes with observation_inputs",
        ),
        ({"source": "relpay"}, 'source is "relpay".*did you mean "replay"'),
        ({"loss": "wgan"}, "wasserstein, gan"),
        ({"regularizer": "l2"}, "gradient_penalty"),
        ({"spread_about": "mean"}, "old_mean"),
        ({"population": 3}, "at least 4"),
        ({"segments": 0}, "segments is 0"),
        ({"elite_ratio": 1.5}, "elite_ratio is 1.5"),
    ],
)
def test_bad_settings_are_told(change: dict[str, Any], told: str) -> None:
    with pytest.raises(UserError, match=told):
        SearchConfig(**change)


def test_presets() -> None:
    assert preset("paper", population=8) == dataclasses.replace(PAPER, population=8)
    with pytest.raises(UserError, match='did you mean "paper"'):
        preset("papre")


def test_cartpole_is_found_from_a_start_that_excludes_it() -> None:
    env = Cartpole()
    key = jax.random.key(0)

    def stabilize(obs: jax.Array, k: jax.Array) -> jax.Array:
        x, v, angle, rate = obs
        u = (1.5 * x + 0.6 * v + 3.0 * angle + 0.55 * rate) / 0.4
        return jnp.clip(u[None] + 0.25 * jax.random.normal(k, (1,)), -1, 1)

    trajectories = jax.jit(
        lambda k: rollout.collect(env, env.model(), stabilize, k, 8, 40)
    )(key)
    seg = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), trajectories)
    space = env.space.select(["cart_kp", "cart_friction"]).scaled(0.2, 0.7)
    simulator = Simulator(env.mj_model, space, env.dt)
    config = SearchConfig(population=32, segments=32, hidden=(32,))
    search = Search(simulator, config)
    d = SearchData(seg, jnp.zeros(4))

    @jax.jit
    def run(k: jax.Array) -> Any:
        return search.run(search.init(k, d), d, 45)

    state, info = run(key)
    found = np.asarray(search.space.to_si(state.mean))
    assert int(info.non_finite.sum()) == 0
    assert found[0] == pytest.approx(20.0, rel=0.05)


def test_a_search_needs_parameters() -> None:
    simulator = Cartpole().simulator.rebuilt(space=ParameterSpace(()))
    with pytest.raises(UserError, match="name at least one"):
        Search(simulator, SearchConfig())
