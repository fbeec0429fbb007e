"""The small machine that methods are tried on."""

import jax
import jax.numpy as jnp
import numpy as np

from easi_jax.baselines import Identified, Task
from easi_jax.data.segments import Segments
from easi_jax.simulation.rollout import collect, policy_rollout
from easi_jax.simulation.simulator import Simulator
from envs import make

NAMES = ("cart_kp", "cart_kv", "pole_damping")
STEPS = 40


def controller(policy: jax.Array, obs: jax.Array, key: jax.Array) -> jax.Array:
    u = obs @ jnp.array([3.75, 1.5, 7.5, 1.375])
    return jnp.clip(u + policy * jax.random.normal(key), -1.0, 1.0)[None]


def best(policy: jax.Array, obs: jax.Array, key: jax.Array) -> jax.Array:
    return controller(0.0 * policy, obs, key)


def make_task() -> Task:
    """Three parameters of Cartpole; the search starts at 1.5 to 6 times the truth."""
    env = make("cartpole")
    env.episode_length = STEPS
    space = env.space.select(NAMES).scaled(1.5, 6.0)
    limit = {"joint.cart.speed_limit": 0.6}  # MJCF has no word for it
    simulator = Simulator(env.mj_model, space, env.dt, fixed=limit)
    truth = env.model()

    @jax.jit
    def record(policy: jax.Array, keys: jax.Array) -> Segments:
        def one(key: jax.Array) -> Segments:
            return policy_rollout(
                env, truth, lambda o, k: best(policy, o, k), key, STEPS
            )

        return jax.vmap(one)(keys)

    return Task(
        simulator,
        jnp.zeros(4),
        env=env,
        act=controller,
        act_best=best,
        policy=jnp.asarray(0.25),
        record=record,
        train=lambda space, distribution, key: jnp.asarray(0.25),
    )


def demonstrate(task: Task) -> Segments:
    """40 trajectories of the truth."""
    run = jax.jit(
        lambda key: collect(
            task.env,
            task.env.model(),
            lambda obs, k: controller(task.policy, obs, k),
            key,
            40,
            STEPS,
        )
    )
    return run(jax.random.key(0))


def log_ratios(task: Task, found: Identified) -> np.ndarray:
    """Of what was found to the truth."""
    si = np.asarray(found.space.to_si(found.distribution.mean))
    return np.log(si / np.asarray(task.env.space.select(NAMES).nominal))
