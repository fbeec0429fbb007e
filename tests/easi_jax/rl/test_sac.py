"""SAC on probes whose values are known, and the state that it carries."""

import dataclasses

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from easi_jax.errors import UserError
from easi_jax.rl import Sac, SacConfig, act
from easi_jax.rl.episodes import Episodes
from easi_jax.simulation.env import EnvState
from tests.easi_jax.rl.probes import Probe, probe_models

OBS = jnp.array([[-1.0], [1.0]])
GAMMA = 0.8


def values_and_actions(trained, name):
    """Q of both critics ``(2, 2)`` and the best action ``(2,)``, at obs -1 and 1."""
    state = trained.states[name]
    best = act(trained.sac.policy(state), OBS, deterministic=True)
    return trained.sac.q_values(state, OBS, best), best[:, 0]


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("constant", (1.0, 1.0)),
        ("observation", (-1.0, 1.0)),
        ("discount", (GAMMA, 1.0)),
        ("action", (0.0, 0.0)),
        ("both", (0.0, 0.0)),
    ],
)
def test_values(trained, name, expected):
    q, _ = values_and_actions(trained, name)
    np.testing.assert_allclose(q, np.array(expected)[:, None] * [1, 1], atol=0.04)


@pytest.mark.parametrize(
    ("name", "expected"), [("action", (0.5, 0.5)), ("both", (-0.5, 0.5))]
)
def test_actions(trained, name, expected):
    _, best = values_and_actions(trained, name)
    np.testing.assert_allclose(best, expected, atol=0.07)


def test_time_limit_bootstraps_from_the_terminal_observation(trained):
    """Ended instead: (0.8, 1). From the next reset: (2.2, 2.8). Masked: untrained."""
    q, _ = values_and_actions(trained, "time_limit")
    expected = np.array([GAMMA, 1.0])[:, None] / (1 - GAMMA)
    np.testing.assert_allclose(q, expected * [1, 1], rtol=0.03)


def test_finished_episodes_are_reported(trained):
    names = list(trained.states)
    constant, discount = names.index("constant"), names.index("discount")
    history = trained.history
    assert (history["episodes"][constant] == 16).all()
    np.testing.assert_array_equal(history["return"][constant], 1.0)
    # Two steps an episode: none ends in the first, third, ... step.
    np.testing.assert_array_equal(history["episodes"][discount][:4], [0, 16, 0, 16])
    assert np.isnan(history["return"][discount][0])


def test_nonfinite_simulations_are_counted_and_kept_from_the_critics(trained):
    broken = list(trained.states).index("broken")
    assert (trained.history["nonfinite"][broken] == 16).all()
    assert (trained.history["nonfinite"][:broken] == 0).all()
    assert np.isnan(trained.history["return"][broken]).all()
    learner = trained.states["broken"].learner
    chex.assert_tree_all_finite((learner, trained.states["broken"].buffer))
    # Masked transitions teach the critics nothing: they are as at the start.
    start = jax.tree.map(lambda x: x[broken], trained.start.learner.critics)
    chex.assert_trees_all_equal(learner.critics, start)


def test_updates_wait_for_the_random_steps(trained):
    loss = trained.history["critic_loss"]
    assert np.isnan(loss[:, :4]).all()
    assert np.isfinite(loss[:, 4:]).all()


def test_state_is_made_of_ordinary_arrays(trained):
    for leaf in jax.tree.leaves(trained.final):
        assert isinstance(leaf, jax.Array)
        assert not jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
        assert leaf.size


def test_memory_keeps_the_newest(trained):
    """The ring holds the last transitions where more were inserted than fit."""
    small = dataclasses.replace(
        trained.sac.config, env_steps=160, buffer_size=40, random_steps=0
    )
    assert small.capacity == 48
    sac = Sac(Counter(), small, bind=lambda t: t, draw=lambda d, k: d)
    state = sac.init(jax.random.key(0), jnp.zeros(()))
    move = jax.jit(lambda s, k: sac._move(s, k, jnp.bool_(False))[0])
    state = dataclasses.replace(
        state,
        envs=dataclasses.replace(
            state.envs, terminated=jnp.zeros(16), count=jnp.zeros(16, jnp.int32)
        ),
    )
    for i in range(5):
        state = move(state, jax.random.key(i))
    np.testing.assert_array_equal(
        np.sort(state.buffer.data[:, 0]), np.repeat([2.0, 3.0, 4.0], 16)
    )
    _, rows = sac._buffer.sample_internal(state.buffer)
    assert set(np.unique(rows.observation)) == {2.0, 3.0, 4.0}


class Counter(Probe):
    """Observes how many steps it has done."""

    name = "counter"
    obs_size = action_size = 1
    episode_length = 1000

    def reset(self, model, key):
        zero = jnp.zeros(())
        count = jnp.zeros((), jnp.int32)
        return EnvState((), zero[None], zero, zero, zero, count)

    def step(self, model, state, action):
        count = state.count + 1
        return dataclasses.replace(state, obs=count[None] * 1.0, count=count)


def test_parameters_are_redrawn_for_each_episode():
    """Every fresh episode takes its model from the distribution of that moment."""
    two_steps = probe_models()["discount"]
    episodes = Episodes(
        Probe(),
        bind=lambda theta: dataclasses.replace(two_steps, constant=theta),
        draw=lambda dist, key: dist + jax.random.uniform(key),
        num_envs=8,
        eval_envs=1,
    )
    reset = jax.jit(episodes.reset_finished)
    k1, k2, k3 = jax.random.split(jax.random.key(3), 3)
    low, high = jnp.float32(0.0), jnp.float32(5.0)
    envs, theta = episodes.unborn(low, k1)
    envs, first, _ = reset(envs, theta, jnp.zeros(8), low, k2)
    assert len(np.unique(first)) == 8
    assert (envs.terminated == 0).all()
    half = dataclasses.replace(envs, truncated=jnp.arange(8) % 2 * 1.0)
    envs, second, returns = reset(half, first, jnp.ones(8), high, k3)
    np.testing.assert_array_equal(second[::2], first[::2])
    assert (second[1::2] >= 5.0).all()
    np.testing.assert_array_equal(returns, 1.0 - np.arange(8) % 2)
    assert (envs.truncated == 0).all()


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"num_envs": 0}, "num_envs=0"),
        ({"learning_rate": 0.0}, "learning_rate=0.0"),
        ({"discount": 1.5}, "discount=1.5"),
        ({"hidden": ()}, "hidden"),
        ({"random_steps": 1000, "env_steps": 1000}, "random_steps=1000"),
    ],
)
def test_settings_that_cannot_work(change, named):
    with pytest.raises(UserError, match=named) as error:
        SacConfig(**change)
    assert "\n" not in str(error.value)


def test_the_learning_rate_falls_linearly_until_the_last_update():
    from easi_jax.rl.learner import _learning_rate

    config = SacConfig(learning_rate=1e-2, learning_rate_decay=0.1)
    rate = _learning_rate(config)
    assert callable(rate)
    last = (config.iterations - config.random_iterations) * config.updates_per_step
    np.testing.assert_allclose(rate(0), 1e-2)
    np.testing.assert_allclose(rate(last // 2), 5.5e-3, rtol=1e-3)
    np.testing.assert_allclose(rate(last), 1e-3, rtol=1e-6)
    assert _learning_rate(SacConfig(learning_rate=1e-2)) == 1e-2
