"""Simulating measured segments under a model: logged commands, logged starts."""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from easi_jax.data.segments import Segments
from easi_jax.model import effects
from easi_jax.simulation.simulator import Simulator


def predict(
    simulator: Simulator,
    model: Any,
    segments: Segments,
    steps: int | jax.Array | None = None,
) -> tuple[jax.Array, jax.Array]:
    """Open-loop prediction: ``qpos (M, H, nq)``, ``qvel (M, H, nv)``.

    Commands on their way at the start are those that the segments know of; before
    them, the first one counts as sent for ever. Activations are the segments', or zero.
    ``steps``: how many control steps are simulated, all H by default; the others hold
    the start.
    """
    # Nothing but a controller reads it.
    model = simulator.without_sense(model)
    return jax.vmap(lambda s: _predicted(simulator, model, s, steps, False)[:2])(
        segments
    )


def predict_sensed(
    simulator: Simulator,
    model: Any,
    segments: Segments,
    steps: int | jax.Array | None = None,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """`predict`, and what is sensed in the first and the last physics step of each
    control step, ``(M, H, 2, N)``; zero where nothing is simulated."""
    return jax.vmap(lambda s: _predicted(simulator, model, s, steps, True))(segments)


def _predicted(
    simulator: Simulator,
    model: Any,
    s: Segments,
    steps: int | jax.Array | None,
    senses: bool,
) -> tuple[jax.Array, jax.Array, Any]:
    """Of one segment ``s``, without an axis for it."""
    ctrl, act, past = s.ctrl, s.act, s.past

    def step(state: Any, u: jax.Array) -> Any:
        if senses:
            state, sensed = simulator.sensed_step(model, state, u)
        else:
            state, sensed = simulator.step(model, state, u), ()
        return state, (state.qpos, state.qvel, sensed)

    known = None if isinstance(act, tuple) else act
    first = simulator.start(s.qpos, s.qvel, act=known)
    if not isinstance(first.time, tuple) and not isinstance(s.time, tuple):
        first = dataclasses.replace(first, time=s.time, hidden=s.hidden)
    if not senses:
        first = dataclasses.replace(first, sensed=())
    if not isinstance(past, tuple):
        first = simulator.after(model, first, past)
    at_once = simulator.replay(model, first, ctrl, steps)
    if at_once is not None:
        return at_once
    nothing = jnp.zeros((2, *first.sensed.shape)) if senses else ()
    still = first.qpos, first.qvel, nothing
    return first_steps(step, first, ctrl, still, steps)


def first_steps(
    step: Callable[[Any, jax.Array], tuple[Any, Any]],
    first: Any,
    inputs: jax.Array,
    still: Any,
    steps: int | jax.Array | None,
) -> Any:
    """`jax.lax.scan` over so many of the ``inputs (H, ...)``, all of them where None:
    what ``step`` returns beside the next state, ``(H, ...)``; ``still`` for others."""
    if steps is None:
        return jax.lax.scan(step, first, inputs)[1]
    rows = jax.tree.map(lambda x: jnp.broadcast_to(x, (len(inputs), *x.shape)), still)

    def at(i: jax.Array, carry: Any) -> Any:
        state, seen = step(carry[0], inputs[i])
        put = jax.tree.map(lambda row, x: row.at[i].set(x), carry[1], seen)
        return state, put

    end = jnp.asarray(steps)
    return jax.lax.fori_loop(jnp.zeros_like(end), end, at, (first, rows))[1]


def prediction_residuals(
    simulator: Simulator,
    reference: tuple[jax.Array, jax.Array],
    states: tuple[jax.Array, jax.Array],
) -> jax.Array:
    """States minus the reference prediction, ``(M, H, 2 nv)``."""
    return jax.vmap(lambda a, b: _between(simulator, a, b))(reference, states)


def _between(simulator: Simulator, reference: Any, states: Any) -> jax.Array:
    """Of one segment, ``(H, 2 nv)``."""
    return jax.vmap(simulator.difference)(*reference, *states)


def errors(simulator: Simulator, model: Any, segments: Segments) -> jax.Array:
    """Measured minus predicted, ``(M, H, 2 nv)``, and of N numbers of sensors where the
    segments have readings, ``(M, H, 2 nv + N)``; zero where there is none."""
    return errors_from(simulator, model, segments, segments)


def errors_from(
    simulator: Simulator,
    model: Any,
    starts: Segments,
    measured: Segments,
    steps: int | jax.Array | None = None,
) -> jax.Array:
    """`errors` of what is predicted from other starts; ``steps`` as in `predict`."""

    def one(start: Segments, seen: Segments) -> jax.Array:
        return error_from(simulator, model, start, seen, steps)

    return jax.vmap(one)(starts, measured)


def error_from(
    simulator: Simulator,
    model: Any,
    start: Segments,
    measured: Segments,
    steps: int | jax.Array | None = None,
) -> jax.Array:
    """`errors_from` of one segment, without an axis for it.

    Where readings of joints have an offset, the start is where the joints are, and what
    is predicted is what would be read.
    """
    where = measured.next_qpos
    if model.effects is not None and effects.has_bias(model.present):
        true = partial(simulator.move, tangent=-model.effects.bias)
        start = dataclasses.replace(start, qpos=true(start.qpos))
        where = true(where)
    target = (where, measured.next_qvel)
    if not _senses(measured):
        model = simulator.without_sense(model)
        states = _predicted(simulator, model, start, steps, False)[:2]
        return _between(simulator, states, target)
    *states, each = _predicted(simulator, model, start, steps, True)
    reading: Any = simulator.base.sense
    sensed = reading.alike(reading.chosen(each), measured.sensed)
    off = measured.sensed - sensed
    if not isinstance(measured.read, tuple):
        off = jnp.where(measured.read > 0, off, 0.0)
    return jnp.concatenate([_between(simulator, states, target), off], -1)


def _senses(segments: Segments) -> bool:
    return not isinstance(segments.sensed, tuple)


def motion(simulator: Simulator, segments: Segments) -> jax.Array:
    """Measured change since the segment's start, ``(M, H, 2 nv)``; of readings of
    sensors since the first, ``(M, H, 2 nv + N)``."""

    def one(s: Segments) -> jax.Array:
        diff = jax.vmap(simulator.difference, in_axes=(None, None, 0, 0))
        return diff(s.qpos, s.qvel, s.next_qpos, s.next_qvel)

    moved = jax.vmap(one)(segments)
    if not _senses(segments):
        return moved
    change = segments.sensed - segments.sensed[:, :1]
    return jnp.concatenate([moved, change], -1)


def features(simulator: Simulator, segments: Segments) -> jax.Array:
    """Start state and commands of each segment, past ones where they matter, flat,
    ``(M, nq + nv + (H + D) nu)``."""
    m = segments.qpos.shape[0]
    commands = [
        x.reshape(m, -1) for x in jax.tree.leaves((segments.ctrl, segments.past))
    ]
    return jnp.concatenate([segments.qpos, segments.qvel, *commands], axis=1)
