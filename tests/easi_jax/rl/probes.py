"""Tiny environments, each solvable only if one more part of an algorithm works.

The idea is Andy Jones's (*Debugging RL, Without the Agonizing Pain*). All probes
are one environment whose model says which, so one compiled program trains them all.
Where a probe fails and those before it pass, its part is the broken one:

===================  ===================================================
``constant``         value loss: Q = 1
``observation``      Q follows the observation: Q = obs
``discount``         reward a step later: Q = discount, then 1
``action``           policy loss: best action 0.5
``both``             policy follows the observation: best action obs / 2
``time_limit``       as ``discount``, but cut by a time limit: the value goes on
===================  ===================================================
"""

import flax.struct
import jax
import jax.numpy as jnp

from easi_jax.simulation.env import EnvState


@flax.struct.dataclass
class ProbeModel:
    """Which probe; scalars, so that probes can be stacked and vmapped.

    The reward of an episode's last step is ``constant + by_obs obs
    - penalty (action - target - target_by_obs obs)^2``; others give 0.

    Attributes:
        steps: steps of an episode, 1 or 2.
        terminates: 1 where the last step ends the task, 0 where a time limit cuts it.
        constant: reward.
        by_obs: reward per observation.
        penalty: reward lost per squared action error.
        target: best action.
        target_by_obs: best action per observation.
    """

    steps: jax.Array
    terminates: jax.Array
    constant: jax.Array
    by_obs: jax.Array
    penalty: jax.Array
    target: jax.Array
    target_by_obs: jax.Array


def _probe(
    *,
    steps: int = 1,
    terminates: float = 1.0,
    constant: float = 0.0,
    by_obs: float = 0.0,
    penalty: float = 0.0,
    target: float = 0.0,
    target_by_obs: float = 0.0,
) -> ProbeModel:
    values = (terminates, constant, by_obs, penalty, target, target_by_obs)
    return ProbeModel(jnp.int32(steps), *map(jnp.float32, values))


def probe_models() -> dict[str, ProbeModel]:
    """The probes by name, in the order in which to read their failures."""
    return {
        "constant": _probe(constant=1.0),
        "observation": _probe(by_obs=1.0),
        "discount": _probe(steps=2, constant=1.0),
        "action": _probe(penalty=1.0, target=0.5),
        "both": _probe(penalty=1.0, target_by_obs=0.5),
        "time_limit": _probe(steps=2, constant=1.0, terminates=0.0),
    }


class Probe:
    """The environment of all probes.

    Observation ``(1,)``: -1 or 1, by chance in episodes of one step; in longer ones
    -1 until a step is done and 1 after it. Action ``(1,)``.
    """

    name = "probe"
    obs_size = 1
    action_size = 1
    episode_length = 2

    def reset(self, model: ProbeModel, key: jax.Array) -> EnvState:
        """A fresh episode."""
        sign = jnp.where(jax.random.bernoulli(key), 1.0, -1.0)
        obs = jnp.where(model.steps > 1, -1.0, sign)[None]
        zero = jnp.zeros(())
        return EnvState(
            physics=(),
            obs=obs,
            reward=zero,
            terminated=zero,
            truncated=zero,
            count=jnp.zeros((), jnp.int32),
        )

    def control(self, state: EnvState, action: jax.Array) -> jax.Array:
        """Nothing lies between an action and the task."""
        return action

    def step(self, model: ProbeModel, state: EnvState, action: jax.Array) -> EnvState:
        """One step; never resets."""
        obs, count = state.obs[0], state.count + 1
        last = (count >= model.steps).astype(jnp.float32)
        error = action[0] - model.target - model.target_by_obs * obs
        reward = model.constant + model.by_obs * obs - model.penalty * error**2
        return EnvState(
            physics=(),
            obs=jnp.where(model.steps > 1, 1.0, obs)[None],
            reward=last * reward,
            terminated=last * model.terminates,
            truncated=last * (1.0 - model.terminates),
            count=count,
        )
