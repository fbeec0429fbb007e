"""A robot with a task, as brax's programs take it: one model bound to it."""

from typing import Any

import jax
from brax.envs.base import Env as BraxBase
from brax.envs.base import State

from easi_jax.simulation.env import EnvState, bound_model


class BraxEnv(BraxBase):
    """An environment of this project as a `brax.envs.Env`.

    For brax's wrappers and for training loops that are written for brax. A state's
    ``done`` is 1 where the task ended; the time limit is left to brax's
    ``EpisodeWrapper``, which is given `episode_length`. brax 0.14.2 takes raw keys
    alone: make them by ``jax.random.PRNGKey``.

    Attributes:
        env: the environment that is wrapped.
        sys: the model that is bound, a pytree. ``DomainRandomizationVmapWrapper``
            replaces it by a batch of `env.model(theta)`.
        dt: control step [s].
        episode_length: control steps of an episode.

    Args:
        env: a built-in robot (``envs.make``) or an environment of your own
            (``envs.load``).
        theta: physical parameters in SI units, ``(n,)`` in the order of
            ``env.space.names``; nominal ones where None.

    Raises:
        UserError: ``theta`` of another size, or not finite.
    """

    def __init__(self, env: Any, theta: Any = None) -> None:
        self.env = env
        self.sys = bound_model(env, theta)
        self.dt = float(env.dt)
        self.episode_length = int(env.episode_length)

    def reset(self, rng: jax.Array) -> State:
        """A new episode; ``rng`` is one key."""
        return _state(self.env.reset(self.sys, rng))

    def step(self, state: State, action: jax.Array) -> State:
        """One control step; ``action (action_size,)`` in [-1, 1]."""
        inner: Any = state.pipeline_state
        new = self.env.step(self.sys, inner, action)
        # Wrappers keep their own entries in `info` and `metrics`.
        return _state(new).replace(info=state.info, metrics=state.metrics)

    @property
    def observation_size(self) -> int:
        """Entries of an observation."""
        return self.env.obs_size

    @property
    def action_size(self) -> int:
        """Entries of an action."""
        return self.env.action_size

    @property
    def backend(self) -> str:
        """Of the physics."""
        return "mjx"


def _state(inner: EnvState) -> Any:
    carried: Any = inner
    return State(
        pipeline_state=carried,
        obs=inner.obs,
        reward=inner.reward,
        done=inner.terminated,
    )
