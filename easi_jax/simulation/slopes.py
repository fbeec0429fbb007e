"""Residuals of a measured piece and their slopes, from either engine.

Slopes are forward-mode derivatives of MJX, or differences of native MuJoCo: all
simulations of a piece in one call, in double precision from the parameters to the
difference. Starts of parts that nothing couples (legs in a stand) are moved at once
(Curtis, Powell and Reid, J. Inst. Maths Applics 13, 1974).
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from easi_jax.data.segments import Segments
from easi_jax.model.parameters import ParameterSpace
from easi_jax.model.separate_trees import start_parts, turns
from easi_jax.simulation import open_loop
from easi_jax.simulation.simulator import Simulator

# Of an initial range, and along a start [m, rad, m/s, rad/s, activations]: what a
# one-sided difference leaves out is in proportion to it, and the constraint solver's
# rest, 1e-9, over it.
_STEP = 2e-5
_MOVE = 1e-5


def shift_start(simulator: Simulator, seg: Segments, delta: jax.Array) -> Segments:
    """Segments, or one, with starts moved by tangent vectors ``(..., 2 nv)``, or by
    these and changes of their activations, ``(..., 2 nv + na)``."""
    nv = simulator.mj_model.nv
    along, speed, act = jnp.split(delta, (nv, 2 * nv), axis=-1)
    return replace(
        seg,
        qpos=simulator.move(seg.qpos, along),
        qvel=seg.qvel + speed,
        act=seg.act + act if act.size else seg.act,
    )


def shift_readings(simulator: Simulator, seg: Segments, error: jax.Array) -> Segments:
    """Segments, or one, with what was measured after each step moved by tangents
    ``(..., H, 2 nv)``."""
    along, speed = jnp.split(error, 2, axis=-1)
    return replace(
        seg,
        next_qpos=simulator.move(seg.next_qpos, along),
        next_qvel=seg.next_qvel + speed,
    )


def residuals(
    simulator: Simulator,
    space: ParameterSpace,
    unit: jax.Array,
    shift: jax.Array,
    piece: Segments,
    steps: int | jax.Array | None = None,
) -> jax.Array:
    """Predicted minus measured, ``(H, 2 nv)``; pure.

    Args:
        unit: parameters, unit coordinates, ``(n,)``.
        shift: of the measured start, ``(S,)``, as in `shift_start`.
        piece: one segment, without an axis for it.
        steps: control steps that are simulated; all H where None.
    """
    run = partial(_residuals, simulator, space)
    return _precisely(simulator, run, unit, shift, piece, steps)


def linearized(
    simulator: Simulator,
    space: ParameterSpace,
    unit: jax.Array,
    shift: jax.Array,
    piece: Segments,
    steps: int | jax.Array | None = None,
    free_start: bool = True,
) -> tuple[jax.Array, jax.Array]:
    """`residuals`, and their slopes along the parameters and, where it is free, the
    start, ``(H, 2 nv, n + S or n)``; pure."""
    run = partial(_linearized, simulator, space, free_start)
    return _precisely(simulator, run, unit, shift, piece, steps)


def _linearized(
    simulator: Simulator,
    space: ParameterSpace,
    free_start: bool,
    unit: jax.Array,
    shift: jax.Array,
    piece: Segments,
    steps: int | jax.Array | None,
) -> tuple[jax.Array, jax.Array]:
    n, along_start = space.size, len(shift) if free_start else 0

    def at(x: jax.Array) -> jax.Array:
        moved = shift + x[n:] if free_start else shift
        return _residuals(simulator, space, unit + x[:n], moved, piece, steps)

    if simulator.engine == "mjx":
        # One simulation for residuals and slopes.
        zero = jnp.zeros(n + along_start)
        pushed = jax.vmap(lambda v: jax.jvp(at, (zero,), (v,)), out_axes=(None, -1))
        return pushed(jnp.eye(len(zero)))
    parts, turn = parts_and_turns(simulator, piece, along_start)
    most = int(turn.max(initial=-1)) + 1
    moves = np.eye(n + most, n + along_start)
    moves[n:, n:] = turn == np.arange(most)[:, None]
    low, high = space.unit_bounds
    # Inwards; between bounds a parameter may have less than its step to go.
    up, down = jnp.minimum(high - unit, _STEP), jnp.maximum(low - unit, -_STEP)
    step = jnp.concatenate([jnp.where(up >= -down, up, down), jnp.full(most, _MOVE)])
    # Where dry friction holds, a speed leads on one side only: starts go both ways.
    back = jnp.concatenate([jnp.zeros(n), jnp.full(most, -_MOVE)])
    ways = jnp.concatenate(
        [jnp.diag(step), jnp.diag(back)[n:], jnp.zeros((1, len(step)))]
    )
    every = jax.vmap(at)(ways @ moves)
    on, under, here = jnp.split(every, (n + most, n + 2 * most))
    gone = on - jnp.concatenate([jnp.broadcast_to(here, on[:n].shape), under])
    width = step - back
    slopes = jnp.moveaxis(gone, 0, -1) / jnp.where(width != 0, width, 1.0)
    along, start = slopes[..., :n], slopes[..., n + turn]
    if most < along_start:
        start = jnp.where(parts[: start.shape[-2], None] == parts, start, 0.0)
    return here[0], jnp.concatenate([along, start], -1)


def parts_and_turns(
    simulator: Simulator, piece: Segments, size: int
) -> tuple[np.ndarray, np.ndarray]:
    """Part of the machine that each number of a start belongs to, ``(size,)``, the
    first of them those of the channels, and its `turns`. All are one part where sensors
    are read."""
    parts = np.zeros(size, int)
    if isinstance(piece.sensed, tuple):
        parts = start_parts(simulator.mj_model)[:size]
    return parts, turns(parts)


def _residuals(
    simulator: Simulator,
    space: ParameterSpace,
    unit: jax.Array,
    shift: jax.Array,
    piece: Segments,
    steps: int | jax.Array | None,
) -> jax.Array:
    moved = shift_start(simulator, piece, shift)
    model = simulator.model(space.to_si(unit))
    return -open_loop.error_from(simulator, model, moved, piece, steps)


def _precisely(simulator: Simulator, run: Callable[..., Any], *args: Any) -> Any:
    """``run(*args)``; of a native engine in doubles, whether jax's are on or off."""
    if simulator.engine == "mjx":
        return run(*args)
    dtype = args[0].dtype

    def cast(tree: Any, dtype: Any) -> Any:
        return jax.tree.map(
            lambda x: x.astype(dtype) if jnp.issubdtype(x.dtype, jnp.floating) else x,
            tree,
        )

    with jax.enable_x64(True):
        return cast(run(*cast(args, jnp.float64)), dtype)
