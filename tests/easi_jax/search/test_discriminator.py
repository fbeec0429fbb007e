"""The discriminator learns, and its regularizers do what they promise."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from easi_jax.search import discriminator as critic
from easi_jax.search.config import LOSSES, REGULARIZERS
from easi_jax.search.discriminator import CriticConfig, CriticState

FEATURES, BATCH = 3, 128


def train(config: CriticConfig, steps: int = 300, shift: float = 1.5) -> CriticState:
    """Trained on N(+shift, 1) as measured against N(-shift, 1) as simulated."""

    def step(state: CriticState, key: jax.Array) -> Any:
        k1, k2, k3 = jax.random.split(key, 3)
        real = shift + jax.random.normal(k1, (BATCH, FEATURES))
        fake = -shift + jax.random.normal(k2, (BATCH, FEATURES))
        return critic.update(config, state, k3, real, fake, jnp.ones(BATCH))

    @jax.jit
    def run(key: jax.Array) -> CriticState:
        state = critic.init(config, key, FEATURES)
        return jax.lax.scan(step, state, jax.random.split(key, steps))[0]

    return run(jax.random.key(0))


def largest(state: CriticState) -> float:
    return max(float(jnp.abs(w).max()) for w in jax.tree.leaves(state.params))


@pytest.mark.parametrize("loss", LOSSES)
@pytest.mark.parametrize("regularizer", REGULARIZERS)
def test_separates_two_gaussians(loss: str, regularizer: str) -> None:
    config = CriticConfig(
        hidden=(16, 16), loss=loss, regularizer=regularizer, learning_rate=1e-3
    )
    before = critic.init(config, jax.random.key(0), FEATURES)
    state = train(config)
    real = 1.5 + jax.random.normal(jax.random.key(5), (500, FEATURES))
    fake = -1.5 + jax.random.normal(jax.random.key(6), (500, FEATURES))

    def ranked(s: CriticState) -> float:
        a, b = critic.score(config, s, real), critic.score(config, s, fake)
        return float((a[:, None] > b).mean())

    assert ranked(state) > 0.95 and ranked(state) >= ranked(before) - 1e-3
    if regularizer == "clip":
        assert largest(state) <= config.clip * (1 + 1e-6)
    else:
        assert largest(state) > 10 * config.clip
    if loss == "gan":
        scores = critic.score(config, state, jnp.concatenate([real, fake]))
        assert scores.min() >= 0 and scores.max() <= 1


def test_clip_before_the_update_leaves_the_last_step() -> None:
    config = CriticConfig(hidden=(8,), clip_after_update=False, learning_rate=1e-3)
    state = train(config, steps=5)
    assert config.clip < largest(state) < config.clip + 0.02


def test_gradient_penalty_pulls_the_slope_to_one() -> None:
    config = CriticConfig(
        hidden=(32, 32), regularizer="gradient_penalty", learning_rate=1e-3
    )
    free = CriticConfig(hidden=(32, 32), regularizer="none", learning_rate=1e-3)
    between = jax.random.uniform(
        jax.random.key(2), (100, FEATURES), minval=-1.5, maxval=1.5
    )

    def slope(c: CriticConfig) -> np.ndarray:
        state = train(c, steps=400)
        g = jax.vmap(jax.grad(lambda x: critic.score(c, state, x)))(between)
        return np.linalg.norm(g, axis=1)

    held, loose = slope(config), slope(free)
    assert abs(held.mean() - 1) < 0.25
    assert loose.mean() > 2


@pytest.mark.parametrize("loss", LOSSES)
def test_samples_of_no_weight_do_not_count(loss: str) -> None:
    config = CriticConfig(hidden=(8,), loss=loss, regularizer="none")
    state = critic.init(config, jax.random.key(1), FEATURES)
    rng = np.random.default_rng(0)
    real = jnp.asarray(rng.normal(size=(16, FEATURES)))
    fake = jnp.asarray(rng.normal(size=(16, FEATURES)))
    weight = jnp.asarray(rng.integers(0, 2, 16).astype(float)).at[:2].set([0.0, 1.0])
    other = jnp.where(weight[:, None] > 0, fake, 1000.0)
    update = jax.jit(
        lambda f, w: critic.update(config, state, jax.random.key(0), real, f, w)
    )
    (a, loss_a), (b, loss_b) = update(fake, weight), update(other, weight)
    assert float(loss_a) == float(loss_b)
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_array_equal(x, y)
    # Those that count, count alike however many there are.
    chosen = fake[np.asarray(weight) > 0]
    alone = critic.update(
        config, state, jax.random.key(0), real, chosen, jnp.ones(len(chosen))
    )[1]
    assert float(loss_a) == pytest.approx(float(alone), rel=1e-5)
    assert float(update(fake, jnp.ones(16))[1]) != float(loss_a)
