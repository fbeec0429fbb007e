"""A watched episode is the one that is counted."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from easi_jax.rl.evaluate import evaluate, play
from envs.cartpole import Cartpole


def test_returns_are_those_of_evaluate_and_motion_ends_with_the_episode() -> None:
    env = Cartpole()

    def act(policy: Any, obs: jax.Array, key: jax.Array, deterministic: bool) -> Any:
        del obs, key
        assert deterministic
        return policy

    def run(key: jax.Array) -> Any:
        args = (
            env,
            env.model(),
            jnp.zeros(1),
            act,
            jax.random.split(key, 3),
        )  # nothing holds the pole
        return evaluate(*args), play(*args)  # type: ignore[arg-type]

    counted, (returns, qpos) = jax.device_get(jax.jit(run)(jax.random.key(0)))
    np.testing.assert_array_equal(counted, returns)
    assert qpos.shape == (env.episode_length + 1, 2)
    moves = np.abs(np.diff(qpos, axis=0)).max(1) > 0
    fell = int(np.argmin(moves))
    assert 5 < fell < 150 and moves[:fell].all() and not moves[fell:].any()
    assert abs(qpos[-1, 1]) > np.pi / 2
