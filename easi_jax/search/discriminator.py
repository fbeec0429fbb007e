"""The discriminator: tells measured transitions from simulated ones.

EASI (NeurIPS 2024), Eq. 3 (GAN) and Eq. 4 (Wasserstein with clipped weights); the
gradient penalty is that of Gulrajani et al. 2017, Eq. 3.
"""

from collections.abc import Sequence
from typing import Any

import flax.linen as nn
import flax.struct
import jax
import jax.numpy as jnp
import optax


class Discriminator(nn.Module):
    """MLP with ReLU layers, ``(..., features) -> (...)`` scores."""

    hidden: Sequence[int] = (128, 128)

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        for width in self.hidden:
            x = nn.relu(nn.Dense(width)(x))
        return nn.Dense(1)(x)[..., 0]


@flax.struct.dataclass
class CriticConfig:
    """How the discriminator is trained (static: hashable)."""

    hidden: tuple[int, ...] = flax.struct.field(pytree_node=False, default=(128, 128))
    loss: str = flax.struct.field(pytree_node=False, default="wasserstein")
    regularizer: str = flax.struct.field(pytree_node=False, default="clip")
    clip: float = flax.struct.field(pytree_node=False, default=0.01)
    clip_after_update: bool = flax.struct.field(pytree_node=False, default=True)
    penalty: float = flax.struct.field(pytree_node=False, default=10.0)
    learning_rate: float = flax.struct.field(pytree_node=False, default=3e-4)
    epsilon_in_root: bool = flax.struct.field(pytree_node=False, default=True)
    loss_scale: float = flax.struct.field(pytree_node=False, default=1.0)


@flax.struct.dataclass
class CriticState:
    """Parameters and optimizer state; persists over the generations."""

    params: Any
    opt: Any


def _optimizer(config: CriticConfig) -> optax.GradientTransformation:
    return optax.rmsprop(
        config.learning_rate, decay=0.99, eps_in_sqrt=config.epsilon_in_root
    )


def init(config: CriticConfig, key: jax.Array, features: int) -> CriticState:
    """A fresh discriminator for ``features`` inputs."""
    params = Discriminator(config.hidden).init(key, jnp.zeros(features))
    return CriticState(params=params, opt=_optimizer(config).init(params))


def score(config: CriticConfig, state: CriticState, x: jax.Array) -> jax.Array:
    """Scores ``(...)`` of inputs ``(..., features)``; high looks measured."""
    out = Discriminator(config.hidden).apply(state.params, x)
    assert isinstance(out, jax.Array)
    return jax.nn.sigmoid(out) if config.loss == "gan" else out


def fitness(
    config: CriticConfig, state: CriticState, x: jax.Array, weight: jax.Array
) -> jax.Array:
    """Weighted mean of the scores of ``x (P, C, features)``, ``(P,)``; ``weight`` is
    ``(P, C)``.

    For ``gan`` its logarithm, of the same order: where the discriminator has won, all
    scores themselves are zero in single precision, and no individual the better one.
    """
    out = Discriminator(config.hidden).apply(state.params, x)
    assert isinstance(out, jax.Array)
    count = jnp.maximum(weight.sum(1), 1.0)
    if config.loss != "gan":
        return (out * weight).sum(1) / count
    return jax.nn.logsumexp(jax.nn.log_sigmoid(out), 1, weight) - jnp.log(count)


def _clip(config: CriticConfig, params: Any) -> Any:
    if config.regularizer != "clip":
        return params
    return jax.tree.map(lambda w: jnp.clip(w, -config.clip, config.clip), params)


def update(
    config: CriticConfig,
    state: CriticState,
    key: jax.Array,
    real: jax.Array,
    fake: jax.Array,
    fake_weight: jax.Array,
) -> tuple[CriticState, jax.Array]:
    """One gradient step on batches ``real (B, F)`` and ``fake (C, F)``.

    ``fake_weight (C,)`` is zero for transitions that do not count (beyond an
    episode's end, or not finite). Returns the state and the loss.
    """
    net = Discriminator(config.hidden)
    weight = fake_weight / jnp.maximum(fake_weight.sum(), 1.0)

    def loss_fn(params: Any) -> jax.Array:
        on_real, on_fake = net.apply(params, real), net.apply(params, fake)
        assert isinstance(on_real, jax.Array) and isinstance(on_fake, jax.Array)
        if config.loss == "gan":
            loss = -jnp.mean(jax.nn.log_sigmoid(on_real))
            loss -= jnp.sum(weight * jax.nn.log_sigmoid(-on_fake))
        else:
            loss = jnp.sum(weight * on_fake) - jnp.mean(on_real)
        loss *= config.loss_scale
        if config.regularizer == "gradient_penalty":
            n = min(real.shape[0], fake.shape[0])
            mix = jax.random.uniform(key, (n, 1))
            between = mix * real[:n] + (1 - mix) * fake[:n]
            slope = jax.vmap(jax.grad(lambda x: net.apply(params, x)))(between)  # type: ignore[arg-type]
            norm = jnp.sqrt(jnp.sum(slope**2, -1) + 1e-12)
            loss += config.penalty * jnp.mean((norm - 1) ** 2)
        return loss

    params = state.params
    if not config.clip_after_update:
        params = _clip(config, params)
    loss, grads = jax.value_and_grad(loss_fn)(params)
    steps, opt = _optimizer(config).update(grads, state.opt, params)
    params = optax.apply_updates(params, steps)
    if config.clip_after_update:
        params = _clip(config, params)
    return CriticState(params=params, opt=opt), loss
