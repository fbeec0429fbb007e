"""Training settings of the built-in robots, chosen by measurement on two cores."""

from easi_jax.errors import UserError, nearest
from easi_jax.rl.config import SacConfig

CARTPOLE = SacConfig(
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

PRESETS = {"cartpole": CARTPOLE}


def sac_preset(robot: str) -> SacConfig:
    """Settings of a built-in robot.

    Raises:
        UserError: no robot of that name.
    """
    if robot not in PRESETS:
        known = ", ".join(sorted(PRESETS))
        raise UserError(
            f'unknown robot "{robot}" (known: {known}){nearest(robot, PRESETS)}'
        )
    return PRESETS[robot]
