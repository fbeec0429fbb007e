"""The functional environment: the model is an argument, nothing resets itself."""

from typing import Any, Protocol

import flax.struct
import jax
import jax.numpy as jnp

from easi_jax.model.checks import checked_array

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
        memory: what else the environment carries (a pytree of arrays).
    """

    physics: Any
    obs: jax.Array
    reward: jax.Array
    terminated: jax.Array
    truncated: jax.Array
    count: jax.Array
    memory: Any = ()


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

    def control(self, state: EnvState, action: jax.Array) -> jax.Array:
        """What ``step`` would send to the actuators, ``(nu,)``."""
        ...


def bound_model(env: Any, theta: Any = None) -> Model:
    """The model of ``env`` at ``theta (n,)``, SI units; nominal where None.

    Raises:
        UserError: ``theta`` of another size, or not finite.
    """
    given = env.space.nominal if theta is None else theta
    names = ", ".join(env.space.names)
    values = checked_array("theta", given, (env.space.size,), names)
    # Compiled: one by one, its many small operations take a minute.
    return jax.jit(env.model)(jnp.asarray(values, jnp.result_type(float)))


def start(physics: Any, obs: jax.Array, memory: Any = ()) -> EnvState:
    """The first state of an episode."""
    zero = jnp.zeros(())
    return EnvState(physics, obs, zero, zero, zero, jnp.zeros((), jnp.int32), memory)


def advance(
    state: EnvState,
    physics: Any,
    obs: jax.Array,
    reward: jax.Array,
    failed: jax.Array,
    limit: int,
    memory: Any = (),
) -> EnvState:
    """The state after a step; ``failed`` ends the task, ``limit`` steps the episode."""
    terminated = failed.astype(jnp.float32)
    count = state.count + 1
    truncated = (count >= limit) * (1.0 - terminated)
    return EnvState(physics, obs, reward, terminated, truncated, count, memory)
