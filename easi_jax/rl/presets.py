"""Training settings of the built-in robots, chosen by measurement on two cores."""

from easi_jax.errors import UserError, nearest
from easi_jax.rl.config import SacConfig

CARTPOLE = SacConfig(
    env_steps=200_000,
    num_envs=200,
    random_steps=2_000,
    updates_per_step=10,
    batch_size=256,
    buffer_size=200_000,
    hidden=(64, 64),
    critic_layer_norm=True,
    learning_rate=2e-3,
    tau=0.05,
    discount=0.98,
    evaluate_every=50,
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
