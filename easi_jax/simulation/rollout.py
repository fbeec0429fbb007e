"""Trajectories of a controller in an environment, as segments of one step."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from easi_jax.data.segments import Segments
from easi_jax.model.joint_space import Configuration
from easi_jax.simulation.env import Env

Act = Callable[[jax.Array, jax.Array], jax.Array]


def policy_rollout(
    env: Any,
    model: Any,
    act: Act,
    key: jax.Array,
    steps: int,
    auto_reset: bool = False,
    past: int = 0,
    sees: bool = False,
    stale: jax.Array | None = None,
) -> Segments:
    """One trajectory of ``act(obs, key) -> action`` from a reset.

    Args:
        past: how many commands before each step the segments hold; those before an
            episode's first are that one.
        sees: the segments hold what the controller saw and did, too.
        stale: what the controller sees at the first step in place of the state there,
            ``(obs_size,)``.

    Returns:
        Segments with horizon 1, ``(steps, 1, ...)``, weight 1 where the transition
        counts, with what sensors read where each step begins, where the simulator
        reads some (`easi_jax.simulation.reading`). Without ``auto_reset`` the
        trajectory ends at termination and later weights are 0. With it, as in EASI's
        reference, the state after a termination or the time limit is that of the next
        episode; the transition across has weight 0.
    """
    k_reset, k_run = jax.random.split(key)

    def step(carry: Any, k: jax.Array) -> Any:
        state, alive, (sent, begun) = carry
        k_act, k_again = jax.random.split(k)
        action = act(state.obs, k_act)
        ctrl = env.control(state, action)
        sent = jnp.where(begun, sent, ctrl)
        new = env.step(model, state, action)
        done, weight, after = new.terminated > 0, alive, new
        if auto_reset:
            done |= new.truncated > 0
            weight = 1.0 - done
            fresh = env.reset(model, k_again)
            after = jax.tree.map(lambda a, b: jnp.where(done, a, b), fresh, new)
        seg = Segments(
            qpos=state.physics.qpos,
            qvel=state.physics.qvel,
            ctrl=ctrl[None],
            next_qpos=after.physics.qpos[None],
            next_qvel=after.physics.qvel[None],
            weight=weight,
            past=sent if past else (),
            act=state.physics.act if state.physics.act.size else (),
            sensed=_read(new.physics),
            time=state.physics.time,
            hidden=state.physics.hidden,
            seen=jnp.concatenate([state.obs, action, after.obs]) if sees else (),
        )
        sent = jnp.concatenate([sent, ctrl[None]])[1:]
        if auto_reset:
            return (after, alive, (sent, ~done)), seg
        # A finished episode stands still instead of running on into nonsense.
        held = jax.tree.map(lambda a, b: jnp.where(alive > 0, a, b), after, state)
        return (held, alive * (1.0 - done), (sent, jnp.ones((), bool))), seg

    first = env.reset(model, k_reset)
    if stale is not None:
        first = dataclasses.replace(first, obs=stale)
    ctrl = jax.eval_shape(lambda s: env.control(s, act(s.obs, k_run)), first)
    sent = jnp.zeros((past, *ctrl.shape))
    init = (first, jnp.ones(()), (sent, jnp.zeros((), bool)))
    _, out = jax.lax.scan(step, init, jax.random.split(k_run, steps))
    return out


def _read(physics: Any) -> Any:
    """What sensors read at the beginning of the step that led here, ``(1, N)``."""
    read = getattr(physics, "read", ())
    return () if isinstance(read, tuple) else read[None]


def collect(
    env: Env,
    model: Any,
    act: Act,
    key: jax.Array,
    trajectories: int,
    steps: int,
    past: int = 0,
    auto_reset: bool = False,
    sees: bool = False,
    stale: jax.Array | None = None,
) -> Segments:
    """``trajectories`` rollouts of one model: leaves ``(B, steps, ...)``; other
    arguments as for `policy_rollout`, ``stale`` ``(B, obs_size)``."""

    def one(key: jax.Array, stale: jax.Array | None) -> Segments:
        return policy_rollout(
            env, model, act, key, steps, auto_reset, past, sees, stale
        )

    return jax.vmap(one)(jax.random.split(key, trajectories), stale)


def last_seen(seen: jax.Array, obs_size: int) -> jax.Array:
    """The last observation of trajectories, ``(B, obs_size)``, from what was seen and
    done in them, ``(B, T, obs_size + action_size + obs_size)``."""
    return seen[:, -1, -obs_size:]


def measured(
    trajectories: Segments,
    noise: jax.Array,
    key: jax.Array,
    configuration: Configuration,
) -> Segments:
    """What sensors would have recorded of trajectories ``(B, T, 1, ...)``.

    Noise ``(2 nv,)`` [standard deviations of positions and velocities] is drawn once
    per row: the end of a step and the start of the next are one measurement. That of
    an orientation is a rotation vector.
    """
    t = trajectories
    b, steps = t.weight.shape
    nv = t.qvel.shape[-1]
    z = noise * jax.random.normal(key, (b, steps + 1, 2 * nv))
    pos, vel = z[..., :nv], z[..., nv:]
    start, end = slice(0, steps), slice(1, steps + 1)
    move = configuration.integrate
    return Segments(
        qpos=move(t.qpos, pos[:, start]),
        qvel=t.qvel + vel[:, start],
        ctrl=t.ctrl,
        next_qpos=move(t.next_qpos, pos[:, end, None]),
        next_qvel=t.next_qvel + vel[:, end, None],
        weight=t.weight,
        past=t.past,
        act=t.act,
        time=t.time,
        hidden=t.hidden,
        seen=t.seen,
    )
