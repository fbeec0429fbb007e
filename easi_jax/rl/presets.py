"""Training settings of the built-in robots, chosen for two CPU cores.

The first algorithm of a robot is its default.
"""

from dataclasses import replace
from typing import Any

from easi_jax.errors import UserError, nearest
from easi_jax.rl.config import (
    EssInfoGailConfig,
    PaperEssInfoGailConfig,
    PpoConfig,
    SacConfig,
)
from easi_jax.rl.trainer import TrainingConfig

_SAC = SacConfig(
    env_steps=100_000,
    num_envs=100,
    random_steps=2_000,
    updates_per_step=10,
    batch_size=128,
    buffer_size=100_000,
    hidden=(64, 64),
    critic_layer_norm=True,
    learning_rate=2e-3,
    learning_rate_decay=0.05,
    tau=0.05,
    discount=0.99,
    evaluate_every=100,
)
_PPO = PpoConfig(
    env_steps=2_000_000,
    num_envs=256,
    unroll=20,
    minibatches=4,
    epochs=4,
    hidden=(64, 64),
    learning_rate=1e-3,
    learning_rate_decay=0.1,
    evaluate_every=20,
)

# Imitation of a machine with a task: style and task count alike, and the discriminator
# is so smooth that it does not win before the policy has learned to stand (Go2: with a
# gradient penalty of 0.1, the authors', it tells 99 % right after 300,000 steps and the
# policy is paid nothing).
_ESS = EssInfoGailConfig(
    env_steps=4_000_000,
    learning_rate_decay=0.1,
    evaluate_every=20,
    gradient_penalty=20.0,
    style_reward=0.5,
    task_reward=1.0,
    reward_scaling=0.3,
)
_PAPER_ESS = PaperEssInfoGailConfig(env_steps=4_000_000, evaluate_every=20)
_IMITATION: dict[str, TrainingConfig] = {
    "ess_infogail": _ESS,
    "ess_infogail_paper": _PAPER_ESS,
}
_GENERAL: dict[str, TrainingConfig] = {"sac": _SAC, "ppo": _PPO}
PRESETS: dict[str, dict[str, TrainingConfig]] = {
    "cartpole": _GENERAL,
    "ant": {
        "ppo": replace(_PPO, hidden=(128, 64), env_steps=4_000_000),
        "sac": replace(_SAC, hidden=(128, 128), env_steps=400_000),
    },
    "ballbalance": {
        "sac": replace(_SAC, hidden=(128, 128), env_steps=300_000),
        "ppo": replace(_PPO, env_steps=1_000_000),
    },
    "go2": {
        "ppo": replace(
            _PPO,
            hidden=(128, 128),
            env_steps=8_000_000,
            minibatches=8,
            discount=0.97,
            entropy_cost=5e-3,
        ),
        "sac": replace(_SAC, hidden=(128, 128), env_steps=500_000),
        "ess_infogail": replace(
            _ESS,
            hidden=(128, 128),
            env_steps=5_000_000,
            minibatches=8,
            discount=0.97,
            entropy_cost=5e-3,
        ),
    },
}


def training_preset(env: Any, algorithm: str | None = None) -> TrainingConfig:
    """Settings of a robot, for its own or another algorithm.

    An environment may bring its own as ``training``; what is neither built in nor
    brings any gets general ones.

    Raises:
        UserError: no algorithm of that name.
    """
    own = getattr(env, "training", None) or PRESETS.get(env.name, _GENERAL)
    mine = {**own, **{k: v for k, v in _IMITATION.items() if k not in own}}
    if algorithm is None:
        return next(iter(mine.values()))
    if algorithm not in mine:
        raise UserError(
            f'unknown algorithm "{algorithm}" (known: {", ".join(mine)})'
            f"{nearest(algorithm, mine)}"
        )
    return mine[algorithm]


def algorithm_of(config: TrainingConfig) -> str:
    """The name under which presets know an algorithm."""
    return _NAMES[type(config)]


_NAMES: dict[type[TrainingConfig], str] = {
    SacConfig: "sac",
    PpoConfig: "ppo",
    EssInfoGailConfig: "ess_infogail",
    PaperEssInfoGailConfig: "ess_infogail_paper",
}
