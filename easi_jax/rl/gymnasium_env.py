"""A robot with a task as a `gymnasium.Env`, for people's own loops."""

from typing import Any

import jax
import numpy as np

from easi_jax.errors import UserError
from easi_jax.model.checks import checked_array
from easi_jax.simulation.env import EnvState, bound_model

try:
    import gymnasium
except ImportError as error:
    raise UserError(
        "GymnasiumEnv needs the package gymnasium: pip install easi-jax[gym]"
    ) from error


class GymnasiumEnv(gymnasium.Env[np.ndarray, np.ndarray]):
    """An environment of this project as a `gymnasium.Env`.

    One simulation, stepped from Python; its step is compiled at the first call. To
    train with many at once, use `easi_jax.train_policy` or `easi_jax.BraxEnv`.

    Observations are ``(obs_size,)`` float32; actions ``(action_size,)`` in [-1, 1],
    such as ``env.action_map`` turns into commands. ``terminated``: the task ended;
    ``truncated``: ``episode_length`` control steps are over.

    Args:
        env: a built-in robot (``envs.make``) or an environment of your own
            (``envs.load``).
        theta: physical parameters in SI units, ``(n,)`` in the order of
            ``env.space.names``; nominal ones where None.

    Raises:
        UserError: ``theta`` of another size, or not finite.
    """

    metadata = {"render_modes": []}  # noqa: RUF012 - gymnasium's own declaration

    def __init__(self, env: Any, theta: Any = None) -> None:
        self.env = env
        self.dt = float(env.dt)
        self.observation_space = gymnasium.spaces.Box(
            -np.inf, np.inf, (env.obs_size,), np.float32
        )
        self.action_space = gymnasium.spaces.Box(
            -1.0, 1.0, (env.action_size,), np.float32
        )
        self._model = bound_model(env, theta)
        self._state: EnvState | None = None
        self._reset, self._step = jax.jit(env.reset), jax.jit(env.step)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """A new episode: observation and an empty dict.

        Args:
            seed: of this and all later episodes; None: go on with the last one.
            options: not used.
        """
        super().reset(seed=seed, options=options)
        key = jax.random.key(int(self.np_random.integers(2**32)))
        first = self._state = self._reset(self._model, key)
        return np.asarray(first.obs, np.float32), {}

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """One control step: observation, reward, terminated, truncated, empty dict.

        Raises:
            UserError: an action of another size, or not finite; no `reset` before.
        """
        if self._state is None:
            raise UserError("step before reset: call reset() first")
        given = checked_array("action", action, (self.env.action_size,))
        self._state = self._step(self._model, self._state, given.astype(np.float32))
        s = jax.device_get(self._state)
        return (
            np.asarray(s.obs, np.float32),
            float(s.reward),
            bool(s.terminated),
            bool(s.truncated),
            {},
        )
