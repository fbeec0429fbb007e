"""Prediction errors on motion that no search has seen."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from easi_jax.data.segments import Segments, windows
from easi_jax.devices import distributed
from easi_jax.estimation.posterior import Estimate
from easi_jax.model.results import Shares
from easi_jax.rl.networks import act
from easi_jax.simulation import open_loop
from easi_jax.simulation.rollout import collect

OPEN_LOOP = 0.2  # s
TRAJECTORIES = 20


def errors_by_step(
    simulator: Any, model: Any, pieces: Segments, speed_limit: Any
) -> jax.Array:
    """RMS error after each step of a piece, as a share of the RMS motion,
    ``(H, 2 nv)``.

    Pieces that touch a joint's speed limit ``(nv,)`` are left out: there the share
    says whether the limit was met, not how good the model is. NaN where none is left.
    """
    error = open_loop.errors(simulator, model, pieces)
    moved = open_loop.motion(simulator, pieces)
    fast = jnp.concatenate([pieces.qvel[:, None], pieces.next_qvel], 1)
    slow = (jnp.abs(fast) < 0.98 * speed_limit).all((1, 2))
    w = (pieces.weight * slow)[:, None, None]
    share = (w * error**2).sum(0) / jnp.maximum((w * moved**2).sum(0), 1e-30)
    return jnp.where(w.sum() > 0, jnp.sqrt(share), jnp.nan)


def shares(
    pipe: Any, policies: Any, target: jax.Array, theta: jax.Array, keys: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Relative errors of models ``theta (S, n)`` in the target, noise-free.

    Returns:
        Errors after the first step and at the end of pieces of 0.2 s, one after the
        other along each trajectory; ``(S, 2 nv)`` each.
    """
    env, real = pipe.env, pipe.real
    truth = real.model(target)
    steps = min(max(1, round(OPEN_LOOP / env.dt)), env.episode_length)

    def one(item: Any) -> tuple[jax.Array, jax.Array]:
        policy, t, key = item
        trajectories = collect(
            real,
            truth,
            lambda obs, k: act(policy, obs, k),
            key,
            TRAJECTORIES,
            env.episode_length,
            env.simulator.past_steps,
        )
        pieces = windows(trajectories, steps, steps)
        limit = truth.speed_limit
        error = errors_by_step(env.simulator, env.model(t), pieces, limit)
        return error[0], error[-1]

    return jax.lax.map(one, (policies, theta, keys))


def held_out_shares(
    pipe: Any, estimate: Estimate, theta: np.ndarray, policies: Any, keys: jax.Array
) -> Shares:
    """`shares` of the nominal model and of what was found, on fresh demonstrations.

    Args:
        theta: of the robot that stands for the real one, SI.
        policies: that move it, ``(S, ...)``.
        keys: of the evaluation, ``(S,)``.
    """
    env = pipe.env
    fresh = jax.vmap(lambda k: jax.random.fold_in(k, 7))(keys)
    target = jnp.asarray(theta, jnp.float32)
    nominal = jnp.asarray(env.space.nominal, jnp.float32)
    means = jax.vmap(pipe.space.to_si)(estimate.distribution.mean)
    models = {"nominal": jnp.broadcast_to(nominal, means.shape), "EASI": means}
    compute = jax.jit(lambda m: shares(pipe, policies, target, m, fresh))
    out = {name: distributed.local(compute(m)) for name, m in models.items()}
    return Shares(
        channels=tuple(env.simulator.state_names),
        one_step={k: np.asarray(v[0]) for k, v in out.items()},
        open_loop={k: np.asarray(v[1]) for k, v in out.items()},
    )
