"""Our robots in brax's own programs."""

from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from brax.envs import Env
from brax.envs.wrappers import training
from brax.training import acting
from brax.training.acme import running_statistics, specs
from brax.training.agents.ppo import losses as ppo_losses
from brax.training.agents.ppo import networks as ppo_networks
from brax.training.agents.sac import losses as sac_losses
from brax.training.agents.sac import networks as sac_networks

from easi_jax.errors import UserError
from easi_jax.rl.brax_env import BraxEnv
from envs import REGISTRY, make
from tests.tiny_robot.env import Tiny

ENVS, STEPS, LIMIT = 4, 6, 5
DISCOUNT = 0.95
# Brax's hints of its own functions and classes do not fit each other.
NORMALIZE: Any = running_statistics.normalize
PARAMS: Any = ppo_losses.PPONetworkParams


@pytest.fixture(scope="module")
def unroll() -> Any:
    """An unroll of brax's, with brax's wrappers and a policy of brax's networks."""
    env = BraxEnv(Tiny())
    wrapped = training.AutoResetWrapper(
        training.EpisodeWrapper(training.VmapWrapper(env), LIMIT, 1)
    )
    net = ppo_networks.make_ppo_networks(
        env.observation_size,
        env.action_size,
        preprocess_observations_fn=NORMALIZE,
        policy_hidden_layer_sizes=(8,),
        value_hidden_layer_sizes=(8,),
    )
    keys = jax.random.split(jax.random.PRNGKey(0), 4)
    params = PARAMS(
        policy=net.policy_network.init(keys[0]), value=net.value_network.init(keys[1])
    )
    statistics = running_statistics.init_state(
        specs.Array((env.observation_size,), jnp.dtype("float32"))
    )

    @jax.jit
    def run(key: jax.Array) -> Any:
        policy = ppo_networks.make_inference_fn(net)((statistics, params.policy))
        first = wrapped.reset(jax.random.split(key, ENVS))
        _, data = acting.generate_unroll(
            wrapped, first, policy, key, STEPS, extra_fields=("truncation",)
        )
        return first, jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), data)

    first, data = run(keys[2])
    return SimpleNamespace(
        env=env, net=net, params=params, statistics=statistics, first=first, data=data
    )


def test_it_is_a_brax_env(unroll: Any) -> None:
    env = unroll.env
    assert isinstance(env, Env)
    assert env.unwrapped is env
    assert (env.observation_size, env.action_size, env.backend) == (2, 1, "mjx")
    assert unroll.first.obs.shape == (ENVS, 2)
    assert len({tuple(x) for x in np.asarray(unroll.first.obs).tolist()}) == ENVS


def test_the_time_limit_truncates_and_the_next_step_starts_anew(unroll: Any) -> None:
    data = unroll.data
    truncated = np.asarray(data.extras["state_extras"]["truncation"])
    assert (truncated == (np.arange(STEPS) == LIMIT - 1)).all()
    first = np.asarray(unroll.first.obs)
    np.testing.assert_array_equal(data.observation[:, LIMIT], first)
    assert not np.allclose(data.observation[:, LIMIT - 1], first)


def test_steps_are_those_of_the_environment(unroll: Any) -> None:
    env, model = unroll.env.env, unroll.env.sys
    key = jax.random.split(jax.random.split(jax.random.PRNGKey(0), 4)[2], ENVS)[0]
    state = env.reset(model, key)
    step = jax.jit(env.step)
    for k in range(3):
        np.testing.assert_allclose(state.obs, unroll.data.observation[0, k], atol=1e-6)
        state = step(model, state, unroll.data.action[0, k])
        np.testing.assert_allclose(state.reward, unroll.data.reward[0, k], atol=1e-6)


def changed(before: Any, after: Any) -> float:
    moves = jax.tree.map(lambda a, b: jnp.abs(a - b).max(), before, after)
    assert all(np.isfinite(x) for x in jax.tree.leaves(moves))
    return float(max(jax.tree.leaves(moves)))


def test_a_step_of_ppo_lowers_its_loss(unroll: Any) -> None:
    def loss(params: Any) -> Any:
        return ppo_losses.compute_ppo_loss(
            params,
            unroll.statistics,
            unroll.data,
            jax.random.PRNGKey(1),
            unroll.net,
            discounting=DISCOUNT,
        )[0]

    optimizer = optax.sgd(1e-3)

    @jax.jit
    def step(params: Any) -> Any:
        value, gradient = jax.value_and_grad(loss)(params)
        update, _ = optimizer.update(gradient, optimizer.init(params))
        new = optax.apply_updates(params, update)
        return value, new, loss(new)

    before, params, after = step(unroll.params)
    assert changed(unroll.params, params) > 0
    assert float(after) < float(before)


def test_a_step_of_sac_lowers_the_critics_loss(unroll: Any) -> None:
    net = sac_networks.make_sac_networks(
        2,
        1,
        preprocess_observations_fn=NORMALIZE,
        hidden_layer_sizes=(8,),
    )
    keys = jax.random.split(jax.random.PRNGKey(2), 3)
    policy, critics = net.policy_network.init(keys[0]), net.q_network.init(keys[1])
    _, critic_loss, actor_loss = sac_losses.make_losses(net, 1.0, DISCOUNT, 1)
    flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), unroll.data)
    flat = flat._replace(
        extras={"state_extras": flat.extras["state_extras"], "policy_extras": {}}
    )
    alpha = jnp.float32(0.1)

    @jax.jit
    def step(critics: Any, policy: Any) -> Any:
        def loss(q: Any) -> Any:
            given = policy, unroll.statistics, critics, alpha, flat, keys[2]
            return critic_loss(q, *given)

        def acted(p: Any) -> Any:
            return actor_loss(p, unroll.statistics, critics, alpha, flat, keys[2])

        value, gradient = jax.value_and_grad(loss)(critics)
        new = jax.tree.map(lambda x, g: x - 1e-3 * g, critics, gradient)
        return value, new, loss(new), jax.grad(acted)(policy)

    before, new, after, slope = step(critics, policy)
    assert changed(critics, new) > 0
    assert float(after) < float(before)
    assert changed(jax.tree.map(jnp.zeros_like, slope), slope) > 0


def test_brax_draws_physics_of_its_own_for_each() -> None:
    """By the wrapper that replaces ``sys``."""
    env = BraxEnv(Tiny())
    gears = jnp.array([[0.5, 0.1], [4.0, 0.1]])

    def randomized(model: Any) -> Any:
        return jax.jit(jax.vmap(env.env.model))(gears), 0

    wrapped = training.DomainRandomizationVmapWrapper(env, randomized)

    @jax.jit
    def run(key: jax.Array) -> Any:
        state = wrapped.reset(jnp.stack([key, key]))
        return wrapped.step(state, jnp.ones((2, 1))).obs, state.obs

    after, before = run(jax.random.PRNGKey(0))
    np.testing.assert_array_equal(before[0], before[1])
    assert abs(float(after[1, 1])) > 0 and float(after[1, 1]) > float(after[0, 1])


def test_theta_is_checked() -> None:
    env = Tiny()
    with pytest.raises(UserError, match=r"theta has shape \(1,\), needed is \(2\)"):
        BraxEnv(env, [1.0])
    with pytest.raises(UserError, match=r"theta is not finite: entry \[1\] is nan"):
        BraxEnv(env, [1.0, np.nan])
    with pytest.raises(UserError, match="not an array of numbers"):
        BraxEnv(env, "heavy")
    strong = BraxEnv(env, [4.0, 0.1]).sys.mjx.actuator_gear[0, 0]
    assert float(strong) == pytest.approx(4.0)


@pytest.mark.parametrize(
    "robot",
    [
        "cartpole",
        *(pytest.param(r, marks=pytest.mark.slow) for r in REGISTRY if r != "cartpole"),
    ],
)
def test_every_robot_has_brax_s_shapes(robot: str) -> None:
    """Traced, not compiled."""
    env = BraxEnv(make(robot))
    key = jax.ShapeDtypeStruct((3, 2), jnp.uint32)
    wrapped = training.wrap(env, env.episode_length)
    first = jax.eval_shape(wrapped.reset, key)
    action = jax.ShapeDtypeStruct((3, env.action_size), jnp.float32)
    after = jax.eval_shape(wrapped.step, first, action)
    assert first.obs.shape == (3, env.observation_size)
    assert jax.tree.structure(first) == jax.tree.structure(after)
    same = jax.tree.map(
        lambda a, b: (a.shape, a.dtype) == (b.shape, b.dtype), first, after
    )
    assert all(jax.tree.leaves(same))
