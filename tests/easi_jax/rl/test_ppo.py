"""PPO on probes whose values are known, and the state that it carries."""

from dataclasses import replace
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import Mesh

from easi_jax.devices.mesh import make_mesh
from easi_jax.errors import UserError
from easi_jax.rl import Ppo, PpoConfig, act, init_seeds, run_seeds
from tests.easi_jax.rl.probes import Probe, probe_models

OBS = jnp.array([[-1.0], [1.0]])
GAMMA = 0.8
HALF = 60


class Trained(NamedTuple):
    """Probes after training, all by one program."""

    ppo: Ppo
    names: list[str]
    keys: jax.Array
    dist: Any
    final: Any
    history: dict[str, jax.Array]


@pytest.fixture(scope="module")
def ppo() -> Ppo:
    config = PpoConfig(
        env_steps=2 * HALF * 64 * 8,
        num_envs=64,
        unroll=8,
        minibatches=4,
        epochs=4,
        hidden=(32, 32),
        learning_rate=3e-3,
        learning_rate_decay=0.1,
        discount=GAMMA,
        entropy_cost=0.01,  # without, half of the seeds stop exploring beside the best
        normalize_observations=False,
        evaluate_every=HALF,
        eval_envs=4,
    )
    return Ppo(Probe(), config, bind=lambda theta: theta, draw=lambda dist, key: dist)


@pytest.fixture(scope="module")
def trained(ppo: Ppo) -> Trained:
    probes = probe_models()
    probes["broken"] = replace(probes["constant"], constant=jnp.float32(jnp.nan))
    dist = jax.tree.map(lambda *x: jnp.stack(x), *probes.values())
    keys = jax.random.split(jax.random.key(0), len(probes))
    start = jax.jit(lambda k, d: init_seeds(ppo, k, d, dist_axis=0))(keys, dist)
    run = jax.jit(lambda s, d: run_seeds(ppo, s, d, HALF, dist_axis=0))
    half, first = run(start, dist)
    final, second = run(half, dist)
    history = jax.tree.map(lambda *x: jnp.concatenate(x, axis=1), first, second)
    return Trained(ppo, list(probes), keys, dist, final, history)


def state_of(trained: Trained, name: str) -> Any:
    i = trained.names.index(name)
    return jax.tree.map(lambda x: x[i], trained.final)


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("constant", (1.0, 1.0)),
        ("observation", (-1.0, 1.0)),
        ("discount", (GAMMA, 1.0)),
    ],
)
def test_values(trained: Trained, name: str, expected: tuple[float, float]) -> None:
    got = trained.ppo.values(state_of(trained, name), OBS)
    np.testing.assert_allclose(got, expected, atol=0.04)


@pytest.mark.parametrize(
    ("name", "expected"), [("action", (0.5, 0.5)), ("both", (-0.5, 0.5))]
)
def test_actions(ppo: Ppo, name: str, expected: tuple[float, float]) -> None:
    """The middle of 16 seeds.

    Of 32 seeds a fifth stop exploring 0.2 and more beside the best action at one of
    the observations, other ones on each processor. A policy that does not see the
    observation is 0.5 off.
    """
    model, keys = probe_models()[name], jax.random.split(jax.random.key(1), 16)

    @jax.jit
    def best(keys: jax.Array) -> jax.Array:
        final, _ = run_seeds(ppo, init_seeds(ppo, keys, model), model, 2 * HALF)
        acted = jax.vmap(lambda s: act(ppo.policy(s), OBS, deterministic=True))
        return acted(final)[..., 0]

    np.testing.assert_allclose(np.median(best(keys), 0), expected, atol=0.03)


def test_time_limit_bootstraps_from_the_terminal_observation(trained: Trained) -> None:
    """Ended instead: (0.8, 1). From the next reset: (2.2, 2.8)."""
    got = trained.ppo.values(state_of(trained, "time_limit"), OBS)
    expected = np.array([GAMMA, 1.0]) / (1 - GAMMA)
    np.testing.assert_allclose(got, expected, rtol=0.05)


def test_finished_episodes_are_reported(trained: Trained) -> None:
    i = trained.names.index("constant")
    assert (trained.history["episodes"][i] == 64 * 8).all()
    np.testing.assert_array_equal(trained.history["return"][i], 1.0)
    j = trained.names.index("discount")
    assert (trained.history["episodes"][j] == 64 * 4).all()


def test_nonfinite_simulations_are_counted_and_kept_from_the_losses(
    trained: Trained,
) -> None:
    i = trained.names.index("broken")
    assert (trained.history["nonfinite"][i] == 64 * 8).all()
    assert (np.delete(trained.history["nonfinite"], i, 0) == 0).all()
    chex.assert_tree_all_finite(state_of(trained, "broken").params)


def test_evaluations_come_when_due(trained: Trained) -> None:
    told = np.asarray(trained.history["eval_return"])[trained.names.index("constant")]
    due = np.flatnonzero(np.isfinite(told))
    np.testing.assert_array_equal(due, [HALF - 1, 2 * HALF - 1])


def test_chunks_and_devices_do_not_matter(ppo: Ppo, trained: Trained) -> None:
    mesh = make_mesh(1)
    dist, keys = trained.dist, trained.keys

    @jax.jit
    def alone(keys: jax.Array, dist: Any) -> Any:
        start = init_seeds(ppo, keys, dist, 0, mesh)
        return run_seeds(ppo, start, dist, 2, dist_axis=0, mesh=mesh)

    @jax.jit
    def parts(keys: jax.Array, dist: Any) -> Any:
        state = init_seeds(ppo, keys, dist, 0)
        state, _ = run_seeds(ppo, state, dist, 1, dist_axis=0)
        return run_seeds(ppo, state, dist, 1, dist_axis=0)

    a, b = alone(keys, dist)[0], parts(keys, dist)[0]
    chex.assert_trees_all_close(a.params, b.params, atol=1e-4)
    np.testing.assert_array_equal(a.iteration, b.iteration)


def test_one_seed_uses_all_devices(ppo: Ppo, trained: Trained) -> None:
    """Its environments are split; on one device the same comes out."""
    dist, key = jax.tree.map(lambda x: x[:1], (trained.dist, trained.keys))
    asked = replace(ppo.config, evaluate_every=1)
    small = Ppo(Probe(), asked, bind=lambda theta: theta, draw=lambda dist, key: dist)

    def run(mesh: Mesh) -> Any:
        @jax.jit
        def go(key: jax.Array, dist: Any) -> Any:
            start = init_seeds(small, key, dist, 0, mesh)
            return run_seeds(small, start, dist, 2, dist_axis=0, mesh=mesh)

        return go(key, dist)

    assert len(jax.devices()) > 1, "the tests run with a device for each core"
    (one, told), (both, also) = run(make_mesh(1)), run(make_mesh())
    chex.assert_trees_all_close(one.params, both.params, atol=1e-4)
    chex.assert_trees_all_close(told, also, atol=1e-4)
    assert np.isfinite(told["eval_return"]).all()
    assert not both.returns.sharding.is_fully_replicated


@pytest.mark.parametrize("apart", [True, False])
def test_a_policy_clipped_apart_does_not_hear_of_the_value(ppo: Ppo, apart: bool):
    """A value that errs by much, once, takes the policy's next step away with it."""
    config = replace(ppo.config, clip_apart=apart)
    other = Ppo(ppo.env, config, bind=lambda theta: theta, draw=lambda dist, key: dist)
    shapes: Any = jax.eval_shape(
        lambda key: other.init(key, probe_models()["constant"]).params,
        jax.random.key(0),
    )

    def filled(policy: float, value: float) -> Any:
        return shapes.replace(
            policy=jax.tree.map(lambda x: jnp.full(x.shape, policy), shapes.policy),
            value=jax.tree.map(lambda x: jnp.full(x.shape, value), shapes.value),
        )

    update: Any = other._optimizer.update

    def steps(*errors: float) -> Any:
        params = filled(0.0, 0.0)
        state, moved = other._optimizer.init(params), []
        for error in errors:
            given = filled(1e-4, error)
            change, state = update(given, state, params, kl=jnp.zeros(()))
            moved.append(jax.tree.leaves(change.policy)[0])
        return moved

    small, large = steps(0.0, 0.0), steps(1e3, 0.0)
    alike = [np.allclose(a, b, rtol=1e-3) for a, b in zip(small, large, strict=True)]
    assert alike[1] == apart


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"unroll": 0}, "unroll=0"),
        ({"minibatches": 3}, "minibatches=3"),
        ({"clipping": 2.0}, "clipping=2.0"),
        ({"hidden": ()}, "hidden=()"),
        ({"learning_rate": 0.0}, "learning_rate=0.0"),
    ],
)
def test_settings_that_cannot_work(change: dict[str, Any], named: str) -> None:
    with pytest.raises(UserError, match="PPO setting") as error:
        PpoConfig(**change)
    assert named in str(error.value)
