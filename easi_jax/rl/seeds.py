"""Several trainings at once, over all devices.

With a seed or more for each device the seeds are split over the devices. With fewer,
PPO's environments are split; SAC's updates, which take most of its time, stay together.

Distributions are shared by all seeds, or with ``dist_axis=0`` (``eval_axis=0``)
each seed has its own and every leaf has a leading axis ``seeds``. ``mesh`` is all
devices where None. Call these inside ``jax.jit``.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.sharding import Mesh

from easi_jax.devices.mesh import make_mesh, sharded_map
from easi_jax.rl.learner import Info
from easi_jax.rl.trainer import Trainer


def init_seeds(
    trainer: Trainer,
    keys: jax.Array,
    dist: Any,
    dist_axis: int | None = None,
    mesh: Mesh | None = None,
) -> Any:
    """``trainer.init`` for each of ``keys`` ``(seeds,)``; leaves ``(seeds, ...)``."""
    inputs = (keys, _per_seed(dist, dist_axis, len(keys)))
    return _over_seeds(lambda trainer: trainer.init, trainer, inputs, mesh)


def run_seeds(
    trainer: Trainer,
    states: Any,
    dist: Any,
    n: int,
    eval_dist: Any = None,
    dist_axis: int | None = None,
    eval_axis: int | None = None,
    mesh: Mesh | None = None,
) -> tuple[Any, Info]:
    """``trainer.run_chunk`` for each seed; history ``(seeds, n)``.

    All seeds must have done the same number of steps.
    """
    seeds = states.iteration.shape[0]

    def local(trainer: Trainer, inputs: Any) -> Any:
        states, dist, eval_dist = inputs
        clock = jax.tree.map(lambda x: x[0], trainer.clock(states))

        def run(args: Any) -> Any:
            state, dist, eval_dist = args
            # Counters are the same for all seeds; as such they keep conditionals
            # real and writes to the memory contiguous under vmap.
            return trainer.run_chunk(
                trainer.with_clock(state, clock), dist, n, eval_dist
            )

        return _map(run, (states, dist, eval_dist))

    inputs = (
        states,
        _per_seed(dist, dist_axis, seeds),
        _per_seed(eval_dist, eval_axis, seeds),
    )
    return _spread(local, trainer, inputs, mesh)


def train_seeds(
    trainer: Trainer,
    keys: jax.Array,
    dist: Any,
    eval_dist: Any = None,
    dist_axis: int | None = None,
    eval_axis: int | None = None,
    mesh: Mesh | None = None,
) -> tuple[Any, Info]:
    """``trainer.train`` for each of ``keys`` ``(seeds,)``; history ``(seeds, n)``."""
    seeds = len(keys)
    inputs = (
        keys,
        _per_seed(dist, dist_axis, seeds),
        _per_seed(eval_dist, eval_axis, seeds),
    )
    return _over_seeds(lambda trainer: trainer.train, trainer, inputs, mesh)


def _over_seeds(
    method: Callable[[Trainer], Callable[..., Any]],
    trainer: Trainer,
    inputs: Any,
    mesh: Mesh | None,
) -> Any:
    def local(trainer: Trainer, inputs: Any) -> Any:
        return _map(lambda args: method(trainer)(*args), inputs)

    return _spread(local, trainer, inputs, mesh)


def _spread(
    fun: Callable[[Trainer, Any], Any], trainer: Trainer, inputs: Any, mesh: Mesh | None
) -> Any:
    mesh = mesh or make_mesh()
    if jax.tree.leaves(inputs)[0].shape[0] < mesh.size:
        split = trainer.over(mesh)
        if split is not None:
            return fun(split, inputs)
    return sharded_map(lambda local: fun(trainer, local), mesh, inputs)


def _map(fun: Callable[[Any], Any], inputs: Any) -> Any:
    """``fun`` over the leading axis; a single entry needs no batching."""
    if jax.tree.leaves(inputs)[0].shape[0] > 1:
        return jax.vmap(fun)(inputs)
    out = fun(jax.tree.map(lambda x: x[0], inputs))
    return jax.tree.map(lambda x: x[None], out)


def _per_seed(dist: Any, axis: int | None, seeds: int) -> Any:
    if axis is not None:
        return dist
    return jax.tree.map(lambda x: jnp.broadcast_to(x, (seeds, *jnp.shape(x))), dist)
