"""From an action in [-1, 1] to what the actuators are sent."""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np


@dataclass(frozen=True)
class ActionMap:
    """``clip(offset + observation[added] + scale * clip(action, -1, 1), low, high)``.

    The environment's own ``control``, as numbers that can be taken elsewhere.

    Attributes:
        scale, offset, low, high: ``(nu,)`` or plain numbers, units of the actuators.
        added: entries of the observation that the action is added to, ``(nu,)``; none
            where empty.
    """

    scale: Any = 1.0
    offset: Any = 0.0
    low: Any = -np.inf
    high: Any = np.inf
    added: tuple[int, ...] = ()

    def __call__(self, obs: jax.Array | None, action: jax.Array) -> jax.Array:
        """Commands ``(..., nu)`` of observations, where ``added`` needs them, and
        actions."""
        to = self.offset + self.scale * jnp.clip(action, -1.0, 1.0)
        if self.added:
            assert obs is not None
            to = to + obs[..., np.array(self.added)]
        return jnp.clip(to, self.low, self.high)
