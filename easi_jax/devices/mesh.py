"""One mesh over all devices: CPU cores, GPUs or hosts alike."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from easi_jax.devices import distributed

AXIS = "device"


def make_mesh(devices: int | None = None) -> Mesh:
    """A one-dimensional mesh over the first ``devices`` devices (default: all)."""
    found = jax.devices()
    return Mesh(np.array(found[: devices or len(found)]), (AXIS,))


def own_device() -> Any:
    """This process's first device; mjx takes the first of all, another host's."""
    return jax.local_devices()[0]


def sharded_map(
    fun: Callable[..., Any],
    mesh: Mesh,
    sharded: Any,
    *shared: Any,
    multiple: int = 1,
) -> Any:
    """``fun(sharded, *shared)`` with the leading axis of ``sharded`` split.

    ``fun`` sees a slice of the leading axis and returns arrays with the same one;
    ``shared`` goes whole to every device. The axis is padded by repetition where it
    does not divide, so that no device count is a special case; each slice has a
    multiple of ``multiple`` rows. A device whose slice is nothing but padding idles.
    With several processes the result is gathered on all: each can read only its own.
    """
    n = jax.tree.leaves(sharded)[0].shape[0]
    pad = -n % (mesh.size * multiple)

    def padded(x: jax.Array) -> jax.Array:
        return jnp.concatenate([x, jnp.repeat(x[-1:], pad, axis=0)]) if pad else x

    def working(local: Any, *shared: Any) -> Any:
        rows = jax.tree.leaves(local)[0].shape[0]
        shapes = jax.eval_shape(fun, local, *shared)

        def idle(*_: Any) -> Any:
            return jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), shapes)

        busy = jax.lax.axis_index(AXIS) * rows < n
        return jax.lax.cond(busy, fun, idle, local, *shared)

    split, whole = PartitionSpec(AXIS), PartitionSpec()
    some_idle = pad >= (n + pad) // mesh.size
    mapped = jax.shard_map(
        working if some_idle else fun,
        mesh=mesh,
        in_specs=(split, *(whole for _ in shared)),
        out_specs=split,
        check_vma=False,
    )
    out = mapped(jax.tree.map(padded, sharded), *shared)
    if distributed.count() > 1:
        out = replicated(out, mesh)
    return jax.tree.map(lambda x: x[:n], out) if pad else out


def replicated(tree: Any, mesh: Mesh) -> Any:
    """Inside a compiled function: arrays as wholes on every device of the mesh."""
    if mesh.size == 1:
        return tree
    return jax.lax.with_sharding_constraint(tree, NamedSharding(mesh, PartitionSpec()))


def placed(tree: Any) -> Any:
    """Arrays on every device, of types of their own, wherever they came from.

    A compiled program is found again only where both are the same, so without this the
    second call of a loop that feeds on its results compiles anew.
    """

    def strong(x: Any) -> Any:
        x = jnp.asarray(x)
        return x.astype(x.dtype) if jnp.issubdtype(x.dtype, jnp.number) else x

    everywhere = NamedSharding(make_mesh(), PartitionSpec())
    tree = jax.tree.map(strong, tree)
    if distributed.count() > 1:
        return distributed.everywhere(tree, everywhere)
    return jax.device_put(tree, everywhere)
