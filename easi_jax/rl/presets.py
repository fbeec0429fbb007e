"""Training settings of the built-in robots, chosen for two CPU cores.

The first algorithm of a robot is its default.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import jax

from easi_jax.errors import UserError, nearest
from easi_jax.rl.config import (
    EssInfoGailConfig,
    PaperEssInfoGailConfig,
    PaperSacConfig,
    PpoConfig,
    SacConfig,
)
from easi_jax.rl.demonstrations import read_demonstrations
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
# Control steps of the reference; those of `SacConfig` for others.
_PAPER_STEPS = {"ant": 10_000_000, "ballbalance": 6_000_000}
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
    steps = _PAPER_STEPS.get(env.name, PaperSacConfig.env_steps)
    more = {**_IMITATION, "sac_paper": PaperSacConfig(env_steps=steps)}
    mine = {**own, **{k: v for k, v in more.items() if k not in own}}
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
    return next(_NAMES[kind] for kind in type(config).__mro__ if kind in _NAMES)


def imitating(
    config: EssInfoGailConfig,
    env: Any,
    path: Path,
    labelled: float = 1.0,
    skills: int | None = None,
    skill: str = "",
) -> EssInfoGailConfig:
    """Settings with what is imitated.

    Args:
        config: settings without.
        env: the robot.
        path: log of demonstrations.
        labelled: share of the labelled steps whose label is used.
        skills: of the policy; None: as many as there are labels, or one.
        skill: label, or number from 0, of the one that a finished policy plays; the
            first where empty.

    Raises:
        UserError: a file that cannot be imitated, or options that do not go with it.
    """
    if skills is not None and skills < 1:
        raise UserError(f"skills is {skills}: give at least 1")
    state = jax.eval_shape(lambda k: env.reset(env.model(), k), jax.random.key(0))
    if not hasattr(state.physics, "qpos"):
        raise UserError(
            f"{env.name}: imitation needs an environment whose state has physics with "
            "qpos and qvel, as those of easi_jax.simulation have"
        )
    given = read_demonstrations(path, env, config.frames).some(_MOST_WINDOWS)
    given = given.labelled(labelled)
    count = max(1, len(given.skills)) if skills is None else skills
    number = given.skills.index(skill) if skill in given.skills else -1
    if number < 0:
        name = skill or "0"
        number = int(name) if name.isdecimal() else given.skill(name)
    if number >= count:
        plural = "s" * (count > 1)
        raise UserError(
            f"skill {skill}: the policy has {count} skill{plural}, counted from 0"
        )
    return replace(config, demonstrations=given, skills=count, skill=number)


# Windows of demonstrations that are kept: 36 MB for a Go2, part of each program.
_MOST_WINDOWS = 100_000


_NAMES: dict[type[TrainingConfig], str] = {
    SacConfig: "sac",
    PaperSacConfig: "sac_paper",
    PpoConfig: "ppo",
    EssInfoGailConfig: "ess_infogail",
    PaperEssInfoGailConfig: "ess_infogail_paper",
}
