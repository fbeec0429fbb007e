"""Oracle, FineTune and GARAT on a cart whose drive is half as strong as simulated."""

from dataclasses import replace
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from easi_jax.baselines import Budget, FineTune, Garat, Oracle, Practice, Udr
from easi_jax.baselines.garat import inputs
from easi_jax.baselines.policies import trained_at
from easi_jax.errors import UserError
from easi_jax.rl.config import PpoConfig, SacConfig
from easi_jax.rl.networks import act
from easi_jax.rl.trainer import make_trainer
from easi_jax.simulation.env import EnvState, advance, start
from easi_jax.simulation.rollout import collect

LENGTH = 20
SIMULATED, REAL = 0.2, 0.1
TRAINING = SacConfig(
    env_steps=3_000,
    num_envs=20,
    random_steps=200,
    updates_per_step=4,
    batch_size=64,
    buffer_size=3_000,
    hidden=(32, 32),
    learning_rate=3e-3,
)


@flax.struct.dataclass
class Point:
    qpos: jax.Array
    qvel: jax.Array
    act: jax.Array = flax.struct.field(default_factory=lambda: jnp.zeros(0))


class Push:
    """A point moved by the action times the model; near zero it earns most."""

    name, obs_size, action_size, episode_length, dt = "push", 1, 1, LENGTH, 0.1

    def model(self, gain: Any) -> Any:
        return gain

    def reset(self, model: Any, key: jax.Array) -> EnvState:
        x = jax.random.uniform(key, (1,), minval=-1.0, maxval=1.0)
        return start(Point(x, jnp.zeros(1)), x)

    def control(self, state: EnvState, action: jax.Array) -> jax.Array:
        return action

    def step(self, model: Any, state: EnvState, action: jax.Array) -> EnvState:
        move = model * jnp.clip(action, -1.0, 1.0)
        x = state.physics.qpos + move
        reward = 1.0 - jnp.abs(x[0] - 0.5)
        return advance(state, Point(x, move), x, reward, jnp.zeros((), bool), LENGTH)


def trained_for(steps: int) -> Practice:
    """A policy of so many steps in the simulation."""
    env, training = Push(), replace(TRAINING, env_steps=steps)
    trainer = make_trainer(env, training, env.model, lambda given, _: given)
    gain = jnp.asarray(SIMULATED)
    state, _ = jax.jit(lambda key: trainer.train(key, gain))(jax.random.key(0))
    return Practice(
        env, gain, env, jnp.asarray(REAL), TRAINING, state, trainer.policy(state)
    )


@pytest.fixture(scope="module")
def practice() -> Practice:
    return trained_for(TRAINING.env_steps)


@pytest.fixture(scope="module")
def poor() -> Practice:
    return trained_for(300)


def mean_return(practice: Practice, policy: Any) -> float:
    def one(key: jax.Array) -> jax.Array:
        state = practice.real.reset(practice.target, key)

        def step(s: EnvState, _: Any) -> tuple[EnvState, jax.Array]:
            action = act(policy, s.obs, deterministic=True)
            new = practice.real.step(practice.target, s, action)
            return new, new.reward

        return jax.lax.scan(step, state, None, length=LENGTH)[1].sum()

    return float(jax.vmap(one)(jax.random.split(jax.random.key(5), 50)).mean())


@pytest.mark.parametrize("method", [Oracle(), FineTune(2_000, 200)])
def test_training_in_the_target_mends_a_poor_policy(
    method: Any, poor: Practice
) -> None:
    none: Any = None
    got = method.fit(poor, none, Budget(), jax.random.key(1))
    assert got.simulated == 0
    assert got.measured == (3_000 if isinstance(method, Oracle) else 2_000)
    assert mean_return(poor, got.policy) > mean_return(poor, poor.policy) + 2.0


@pytest.mark.slow
def test_a_range_that_holds_the_target_mends_a_poor_policy(poor: Practice) -> None:
    none: Any = None
    got = Udr(2.0).fit(poor, none, Budget(), jax.random.key(1))
    assert (got.simulated, got.measured) == (3_000, 0)
    assert mean_return(poor, got.policy) > mean_return(poor, poor.policy) + 2.0
    fixed = Udr(1.0).fit(poor, none, Budget(), jax.random.key(1))
    same = trained_at(poor.env, TRAINING, poor.theta, jax.random.key(1))
    for a, b in zip(jax.tree.leaves(fixed.policy), jax.tree.leaves(same), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-6)
    with pytest.raises(UserError, match="at least 1"):
        Udr(0.5).fit(poor, none, Budget(), jax.random.key(1))


@pytest.mark.parametrize(
    "method",
    [Udr(), pytest.param(Oracle(), marks=pytest.mark.slow), FineTune(2_000, 200)],
)
def test_a_training_takes_what_the_budget_says(method: Any, poor: Practice) -> None:
    none: Any = None
    got = method.fit(poor, none, Budget(trained=600), jax.random.key(1))
    spent = (600, 0) if isinstance(method, Udr) else (0, 600)
    assert (got.simulated, got.measured) == spent
    # As if its own settings said so.
    cut = replace(poor, training=replace(TRAINING, env_steps=600))
    if isinstance(method, FineTune):
        method = replace(method, env_steps=600)
    same = method.fit(cut, none, Budget(), jax.random.key(1))
    jax.tree.map(np.testing.assert_array_equal, got.policy, same.policy)


def test_a_fine_tuning_takes_no_more_than_its_own_steps(poor: Practice) -> None:
    none: Any = None
    method = FineTune(400, 200)
    got = method.fit(poor, none, Budget(trained=600), jax.random.key(1))
    assert (got.simulated, got.measured) == (0, 400)
    with pytest.raises(UserError, match="200 random actions do not go into 100 steps"):
        method.fit(poor, none, Budget(trained=100), jax.random.key(1))


@pytest.mark.parametrize("budget", [{"simulated": 0}, {"trained": 0}])
def test_a_budget_that_buys_nothing_is_refused(budget: dict[str, int]) -> None:
    with pytest.raises(UserError, match="0 control steps buys nothing"):
        Budget(**budget)


def test_random_actions_are_for_sac_alone(practice: Practice) -> None:
    none: Any = None
    ppo = replace(practice, training=PpoConfig(env_steps=1_000))
    with pytest.raises(UserError, match="random_steps=0"):
        FineTune().fit(ppo, none, Budget(), jax.random.key(1))


@pytest.mark.slow
def test_garat_learns_what_the_drive_does(practice: Practice) -> None:
    """The simulation with the transformer moves like the machine, half as far."""
    demonstrations = jax.jit(
        lambda key: collect(
            practice.real,
            practice.target,
            lambda obs, k: act(practice.policy, obs, k),
            key,
            50,
            LENGTH,
        )
    )(jax.random.key(2))
    method = Garat(
        grounding_steps=1, iterations=100, transitions=5_000, learning_rate=1e-3
    )
    with pytest.raises(UserError, match="one round of 10000"):
        method.ground(practice, demonstrations, Budget(9_999), jax.random.key(3))
    # One step short of a hundred iterations and one.
    budget = Budget(101 * (5_000 + 5_000) - 1)
    method = replace(method, iterations=200)
    transformer, simulated = method.ground(
        practice, demonstrations, budget, jax.random.key(3)
    )
    assert simulated == 100 * (5_000 + 5_000)
    rows, weight = inputs(demonstrations)
    assert (np.asarray(weight) == 1).all()
    seen, action = rows[:, :1], rows[:, 2:3]
    changed = action + act(
        transformer, jnp.concatenate([seen, action], 1), deterministic=True
    )
    moved = SIMULATED * jnp.clip(changed, -1.0, 1.0)
    before = float(jnp.abs(SIMULATED * action - REAL * action).mean())
    after = float(jnp.abs(moved - REAL * action).mean())
    assert after < 0.5 * before, (before, after)


def test_a_training_goes_on_from_where_another_ended(practice: Practice) -> None:
    short = replace(TRAINING, env_steps=40, random_steps=20)
    went_on, fresh = (
        trained_at(practice.env, short, practice.theta, jax.random.key(1), state)
        for state in (practice.state, None)
    )
    best = mean_return(practice, practice.policy)
    assert abs(mean_return(practice, went_on) - best) < 1.0
    assert mean_return(practice, fresh) < best - 2.0
