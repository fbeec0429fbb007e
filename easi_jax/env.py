"""The functional environment: the model is an argument, nothing resets itself."""

from typing import Any, Protocol

import flax.struct
import jax

Model = Any


@flax.struct.dataclass
class EnvState:
    """One environment at one control step (unbatched; use ``jax.vmap``).

    Attributes:
        physics: whatever the environment carries from step to step (a pytree of
            ordinary arrays, so that it can be saved in a checkpoint).
        obs: observation, ``(obs_size,)``.
        reward: of the step that led here, ``()``.
        terminated: 1.0 where the task ended in this state, ``()`` float.
        truncated: 1.0 where the time limit was reached without ending, ``()``.
        count: control steps since reset, ``()`` int32.
    """

    physics: Any
    obs: jax.Array
    reward: jax.Array
    terminated: jax.Array
    truncated: jax.Array
    count: jax.Array


class Env(Protocol):
    """What training and search need from an environment."""

    name: str
    obs_size: int
    action_size: int
    episode_length: int

    def reset(self, model: Model, key: jax.Array) -> EnvState:
        """A fresh episode: reward, terminated, truncated and count are zero."""
        ...

    def step(self, model: Model, state: EnvState, action: jax.Array) -> EnvState:
        """One control step; ``action`` in [-1, 1], ``(action_size,)``.

        Never resets: the state returned at the end of an episode is the terminal
        one, and its ``obs`` the terminal observation.
        """
        ...
