"""Seeds at once, alone, in chunks and on fewer devices: the same training."""

from dataclasses import replace

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from easi_jax.devices.mesh import make_mesh
from easi_jax.io.runs import checkpoints
from easi_jax.rl import Sac, SacConfig, act, evaluate, train_seeds
from tests.easi_jax.rl.probes import Probe, probe_models


@pytest.fixture(scope="module")
def small():
    config = SacConfig(
        env_steps=80,
        num_envs=8,
        random_steps=16,
        updates_per_step=2,
        batch_size=8,
        hidden=(8, 8),
        learning_rate=1e-2,
        evaluate_every=4,
        eval_envs=3,
    )
    return Sac(Probe(), config, bind=lambda theta: theta, draw=lambda dist, key: dist)


@pytest.fixture(scope="module")
def whole(small):
    dist = probe_models()["both"]
    keys = jax.random.split(jax.random.key(1), 3)
    state, history = jax.jit(lambda k, d: train_seeds(small, k, d))(keys, dist)
    return keys, dist, state, history


def test_chunks_equal_the_whole(small, whole):
    keys, dist, state, history = whole
    chunk = jax.jit(lambda s, d: small.run_chunk(s, d, 5))
    part = jax.jit(small.init)(keys[1], dist)
    part, first = chunk(part, dist)
    part, second = chunk(part, dist)
    chex.assert_trees_all_close(part, jax.tree.map(lambda x: x[1], state), atol=1e-5)
    joined = jax.tree.map(lambda *x: jnp.concatenate(x), first, second)
    expected = jax.tree.map(lambda x: x[1], history)
    chex.assert_trees_all_close(joined, expected, atol=1e-5)


def test_seeds_differ(whole):
    _, _, state, _ = whole
    kernel = state.learner.policy["params"]["hidden_0"]["kernel"]
    assert not np.allclose(kernel[0], kernel[1])


def test_device_count_does_not_matter(small, whole):
    keys, dist, state, _ = whole
    mesh = make_mesh(1)
    alone, _ = jax.jit(lambda k, d: train_seeds(small, k, d, mesh=mesh))(keys, dist)
    chex.assert_trees_all_close(alone, state, atol=1e-5)


def test_evaluations_come_when_due(whole):
    _, _, _, history = whole
    due = np.arange(1, 11) % 4 == 0
    np.testing.assert_array_equal(
        np.isfinite(history["eval_return"]), np.broadcast_to(due, (3, 10))
    )
    assert (history["eval_nonfinite"] == 0).all()


@pytest.mark.fault("killed (signal 9), then resumed")
def test_killed_and_resumed_equals_uninterrupted(trained, tmp_path):
    half, _ = trained.run(trained.start, trained.dist)
    checkpoints.save(tmp_path, 1, half, config_hash="")
    read = checkpoints.restore(tmp_path, jax.eval_shape(lambda: half))
    assert read is not None
    final, _ = trained.run(read.state, trained.dist)
    chex.assert_trees_all_equal(final, trained.final)


def test_act_and_evaluate(trained):
    policy = trained.sac.policy(trained.states["both"])
    obs = jnp.array([[-1.0], [1.0]])
    key = jax.random.key(0)
    sampled = act(policy, jnp.broadcast_to(obs, (500, 2, 1)), key)
    best = act(policy, obs, deterministic=True)
    assert (jnp.abs(sampled) < 1).all()
    assert sampled.std(axis=0).min() > 0
    np.testing.assert_allclose(sampled.mean(axis=0), best, atol=0.1)
    with pytest.raises(ValueError, match="key"):
        act(policy, obs)


def test_evaluate_returns_one_episode_per_environment(trained):
    policy = trained.sac.policy(trained.states["both"])
    probes = probe_models()
    names = ("constant", "discount", "time_limit")
    models = jax.tree.map(lambda *x: jnp.stack(x), *(probes[n] for n in names))
    key, split = jax.random.key(0), jax.random.split
    env = LongProbe()
    batched = evaluate(env, models, policy, act, split(key, 3), batched=True)
    np.testing.assert_array_equal(batched, [1.0, 1.0, 1.0])
    one = evaluate(env, probes["observation"], policy, act, split(key, 16))
    assert set(np.unique(one)) == {-1.0, 1.0}
    broken = replace(probes["constant"], constant=jnp.float32(jnp.nan))
    assert jnp.isnan(evaluate(env, broken, policy, act, split(key, 2))).all()


class LongProbe(Probe):
    """Stepped on long after its episode has ended, it has to stand still."""

    episode_length = 6
