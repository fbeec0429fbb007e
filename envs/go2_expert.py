"""Go2 that is told when each foot should stand: the expert that demonstrates gaits.

The expert sees a clock and is paid for keeping its feet to it, as in periodic rewards
for legged gaits (Siekmann et al., *Sim-to-Real Learning of All Common Bipedal Gaits via
Periodic Reward Composition*, 2021). Who learns from its demonstrations sees neither.
"""

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from easi_jax.errors import UserError, nearest
from easi_jax.model.mjx_model import Model
from easi_jax.simulation.env import EnvState
from easi_jax.simulation.step import Physics
from envs.go2 import FOOT, SWING, Commands, Go2

# Phase at which each foot (FL, FR, RL, RR) touches down, in strides. Trot: diagonal
# pairs; pace: pairs of a side; bound: front and rear pairs.
GAITS = {
    "trot": (0.5, 0.0, 0.0, 0.5),
    "pace": (0.5, 0.0, 0.5, 0.0),
    "bound": (0.0, 0.0, 0.5, 0.5),
}
# Strides a second: the slope of a trotting Go2 of published controllers, 1.4 Hz up to
# 0.5 m/s and 0.7 Hz more for each further m/s, raised so that a stride stays below the
# 0.5 m or so that these legs reach.
_SLOW_RATE, _SLOW, _RATE_SLOPE = 1.7, 0.5, 0.9  # Hz, m/s, Hz s/m
_DUTY = (0.6, 0.5)  # share of a stride on the ground, at `_DUTY_AT`
_DUTY_AT = (0.4, 1.6)  # m/s
_HEIGHT = 0.29  # m, of the base
_BLUR = 0.04  # strides, over which a foot may touch down or lift off early or late


class Clocked(NamedTuple):
    """What an episode carries: `envs.go2.Memory`, and the clock.

    Attributes:
        command, last, feet, air: as there.
        phase: of the stride, from 0 to 1, ``()``.
    """

    command: jax.Array
    last: jax.Array
    feet: jax.Array
    air: jax.Array
    phase: jax.Array


@dataclass(frozen=True)
class Stride:
    """A stride at some speed.

    Attributes:
        rate: strides a second.
        duty: share of it that a foot stands.
    """

    rate: jax.Array
    duty: jax.Array


def stride(speed: jax.Array) -> Stride:
    """The stride that goes with a speed [m/s]."""
    rate = _SLOW_RATE + _RATE_SLOPE * jnp.maximum(speed - _SLOW, 0.0)
    return Stride(rate, jnp.interp(speed, jnp.array(_DUTY_AT), jnp.array(_DUTY)))


class Go2Expert(Go2):
    """Go2 with a clock: observation ``(52,)`` is that of `Go2`, then the stride's sine
    and cosine, its rate [Hz] and its duty."""

    obs_size = 52
    obs_names = (*Go2.obs_names, "clock.sin", "clock.cos", "clock.rate", "clock.duty")

    def __init__(
        self,
        gait: str = "trot",
        commands: Commands | None = None,
        episode_length: int = 200,
    ) -> None:
        """Builds the robot with its nominal parameters.

        Raises:
            UserError: unknown gait.
        """
        if gait not in GAITS:
            raise UserError(
                f'unknown gait "{gait}" (known: {", ".join(GAITS)})'
                f"{nearest(gait, GAITS)}"
            )
        super().__init__("default", commands, episode_length)
        self.gait = gait
        self._offset = jnp.asarray(np.array(GAITS[gait]))

    def reset(self, model: Model, key: jax.Array) -> EnvState:
        """As `Go2.reset`, at any phase of the stride."""
        k_go2, k_phase = jax.random.split(key)
        state = super().reset(model, k_go2)
        memory = Clocked(*state.memory, phase=jax.random.uniform(k_phase))
        return self.begun(replace(state, memory=memory), memory.command)

    def step(self, model: Model, state: EnvState, action: jax.Array) -> EnvState:
        """As `Go2.step`; the clock goes on."""
        memory = state.memory
        rate = stride(memory.command[0]).rate
        phase = (memory.phase + rate * self.dt) % 1.0
        state = replace(state, memory=memory._replace(phase=phase))
        return super().step(model, state, action)

    def observe(self, physics: Physics, memory: Any) -> jax.Array:
        """Observation ``(52,)``."""
        own = super().observe(physics, memory)
        if not isinstance(memory, Clocked):
            return jnp.concatenate([own, jnp.zeros(4)])  # `reset` puts the clock in
        now, turn = stride(memory.command[0]), 2 * jnp.pi * memory.phase
        clock = jnp.stack([jnp.sin(turn), jnp.cos(turn), now.rate, now.duty])
        return jnp.concatenate([own, clock])

    def reward(
        self,
        model: Model,
        physics: Physics,
        memory: Any,
        before: Any,
        touching: jax.Array,
    ) -> jax.Array:
        """At most 1: the command followed, feet that keep to the clock, little else."""
        duty = stride(memory.command[0]).duty
        phase = (memory.phase - self._offset) % 1.0
        standing = phase < duty
        edge = jnp.minimum(jnp.abs(phase - duty), jnp.minimum(phase, 1.0 - phase))
        kept = jnp.where(edge < _BLUR, 0.5, touching == standing)
        lift = jnp.sin(jnp.pi * jnp.clip((phase - duty) / (1.0 - duty), 0.0, 1.0))
        height = FOOT + SWING * lift
        above = jnp.exp(-(((memory.feet[:, 2] - height) / 0.03) ** 2))
        speed = self.foot_speed(memory, before)
        slip = jnp.sum(speed**2 * standing * touching)
        base = jnp.exp(-(((physics.qpos[2] - _HEIGHT) / 0.04) ** 2))
        hips = jnp.sum((physics.qpos[7::3] - self._pose[::3]) ** 2)
        cost = self.unsteadiness(model, physics, memory, before, touching)
        gait = jnp.mean(kept) + 0.5 * jnp.mean(above) + 0.2 * base
        track = self.tracking(physics, memory.command)
        total = track + gait - cost - 0.05 * slip - 1.0 * hips
        return jnp.maximum(0.0, total / 3.2)
