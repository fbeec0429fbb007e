"""Networks of the policy and the critics: brax's, with saveable policy parameters."""

from collections.abc import Callable
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
from brax.training import distribution, networks
from brax.training.acme import running_statistics
from brax.training.agents.sac import networks as sac_networks


@flax.struct.dataclass
class PolicyParams:
    """All that is needed to act; a pytree of arrays, sizes are read off them.

    Attributes:
        mean: subtracted from observations, ``(obs_size,)``.
        std: observations are then divided by it, ``(obs_size,)``.
        network: weights of the ReLU network (flax's nested dict).
    """

    mean: jax.Array
    std: jax.Array
    network: Any


def standardize(observation: Any, preprocessor_params: Any) -> Any:
    """Observations less their mean, over their standard deviation."""
    return running_statistics.normalize(observation, preprocessor_params)


def make_networks(
    obs_size: int,
    action_size: int,
    hidden: tuple[int, ...],
    critic_layer_norm: bool = False,
    scaled: Any = standardize,
) -> sac_networks.SACNetworks:
    """Tanh-normal policy and twin critics, ReLU; they take what ``scaled`` makes of
    observations and their statistics, as `standardize` does."""
    return sac_networks.make_sac_networks(
        obs_size,
        action_size,
        preprocess_observations_fn=scaled,
        hidden_layer_sizes=hidden,
        q_network_layer_norm=critic_layer_norm,
        # brax hands its keyword dict over as the first argument.
        policy_network_kernel_init_fn=lambda _: jax.nn.initializers.lecun_uniform(),
    )


def noisy(
    policy: PolicyParams, noise: float
) -> Callable[[jax.Array, jax.Array], jax.Array]:
    """``act(obs, key)``: the policy's mode with Gaussian noise of this standard
    deviation, cut to [-1, 1]."""

    def acts(obs: jax.Array, key: jax.Array) -> jax.Array:
        mode = act(policy, obs, deterministic=True)
        return jnp.clip(mode + noise * jax.random.normal(key, mode.shape), -1.0, 1.0)

    return acts


def act(
    policy: PolicyParams,
    obs: jax.Array,
    key: jax.Array | None = None,
    deterministic: bool = False,
) -> jax.Array:
    """Action in (-1, 1), ``(..., action_size)``, for ``obs`` ``(..., obs_size)``.

    Args:
        policy: from a trainer's ``policy`` or a checkpoint.
        obs: observations.
        key: for the sample; not needed where ``deterministic``.
        deterministic: the mode instead of a sample.

    Raises:
        ValueError: a sample is asked for without a key.
    """
    layers = policy.network["params"]
    *hidden, param_size = (
        layers[f"hidden_{i}"]["kernel"].shape[-1] for i in range(len(layers))
    )
    network = networks.make_policy_network(
        param_size,
        policy.mean.shape[-1],
        preprocess_observations_fn=standardize,
        hidden_layer_sizes=hidden,
    )
    statistics = running_statistics.NestedMeanStd(policy.mean, policy.std)
    logits = network.apply(statistics, policy.network, obs)
    actions = distribution.NormalTanhDistribution(param_size // 2)
    if deterministic:
        return jnp.asarray(actions.mode(logits))
    if key is None:
        raise ValueError("a stochastic action needs a key")
    return actions.sample(logits, key)
