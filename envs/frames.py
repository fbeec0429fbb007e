"""Rotations of a floating base; quaternions are MuJoCo's (w x y z), base to world."""

import jax
import jax.numpy as jnp


def matrix(quat: jax.Array) -> jax.Array:
    """Rotation matrix ``(3, 3)`` of a unit quaternion ``(4,)``: base to world."""
    w, x, y, z = quat
    return jnp.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def roll_yaw(rotation: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Roll about x and yaw about z [rad] of a rotation matrix."""
    roll = jnp.arctan2(rotation[2, 1], rotation[2, 2])
    return roll, jnp.arctan2(rotation[1, 0], rotation[0, 0])


def from_yaw(yaw: jax.Array) -> jax.Array:
    """Unit quaternion ``(4,)`` of a turn about z."""
    zero = jnp.zeros_like(yaw)
    return jnp.stack([jnp.cos(yaw / 2), zero, zero, jnp.sin(yaw / 2)])
