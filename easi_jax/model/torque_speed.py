"""What a motor can give at which speed."""

from typing import Any

import flax.struct
import jax
import jax.numpy as jnp


@flax.struct.dataclass
class TorqueSpeed:
    """Torque-speed curve of each actuator; every array is ``(nu,)``.

    Attributes:
        corner: speed up to which the full torque is there [rad/s].
        free: speed at which no torque is left [rad/s].
        driving: most torque with the motion [N m].
        braking: most torque against the motion [N m].
        dof: degree of freedom that the actuator drives.
    """

    corner: jax.Array
    free: jax.Array
    driving: jax.Array
    braking: jax.Array
    dof: jax.Array

    def limits(self, qvel: jax.Array) -> jax.Array:
        """Least and most torque ``(nu, 2)`` at joint speeds ``qvel`` ``(nv,)``."""
        speed = qvel[self.dof]
        left = (self.free - jnp.abs(speed)) / (self.free - self.corner)
        drive = self.driving * jnp.clip(left, 0.0, 1.0)
        most = jnp.where(speed > 0, drive, self.braking)
        least = jnp.where(speed < 0, drive, self.braking)
        return jnp.stack([-least, most], axis=1)

    def limited(self, m: Any, qvel: jax.Array) -> Any:
        """The model, of either engine, whose force limits are no wider than these."""
        own, limits = m.actuator_forcerange, self.limits(qvel)
        low = jnp.maximum(own[:, 0], limits[:, 0])
        high = jnp.minimum(own[:, 1], limits[:, 1])
        return m.replace(actuator_forcerange=jnp.stack([low, high], axis=1))
