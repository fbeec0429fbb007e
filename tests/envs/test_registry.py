"""What every robot must do, by being registered."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from easi_jax.simulation import engine
from easi_jax.simulation.rollout import policy_rollout
from tests.envs.robots import CASES, Case, c_rollout, converged
from train._robots import search_config

CHANGE = 1.4  # of a parameter, against C
CORNERS = 12

pytestmark = pytest.mark.timeout(900)


@dataclass(frozen=True)
class Runs:
    """Rollouts of one robot at nominal values and with each parameter changed.

    Attributes:
        env: the robot.
        thetas: parameters, ``(1 + n, n)``, the first nominal.
        ours, theirs: states ``(1 + n, T, nq + nv)`` of a simulator and of MuJoCo C.
    """

    env: Any
    thetas: np.ndarray
    ours: np.ndarray
    theirs: np.ndarray


QUICK = ("cartpole", "two_link")  # MJX compiles them in seconds, others in a minute


def engines(names: Iterable[str]) -> list[Any]:
    """Each of ``names`` with each engine."""
    return [
        pytest.param(
            (name, which),
            id=f"{name}-{which}",
            marks=[pytest.mark.slow] if which == "mjx" and name not in QUICK else [],
        )
        for name in names
        for which in ("mujoco", "mjx")
    ]


def made(case: Case, which: str) -> Any:
    """Its robot. MJX is the default, and then compared with MuJoCo C only here."""
    if which == "mjx":
        return case.make()
    with engine.using(which):
        return case.make()


@pytest.fixture(scope="module", params=engines(CASES))
def runs(request: pytest.FixtureRequest) -> Runs:
    name, which = request.param
    case = CASES[name]
    env = made(case, which)
    rng = np.random.default_rng(1)
    hold = max(1, round(0.1 / env.dt))
    count = -(-case.steps // hold)
    moves = [case.commands(env, rng) for _ in range(count)]
    ctrl = np.repeat(moves, hold, axis=0)[: case.steps]
    nominal = env.space.nominal
    factors = 1 + (CHANGE - 1) * np.eye(env.space.size)
    thetas = np.concatenate([nominal[None], nominal * factors])
    first = env.reset(env.model(), jax.random.key(2)).physics
    start = case.start or (first.qpos, first.qvel)
    qpos, qvel = (np.asarray(x, float) for x in start)
    with jax.enable_x64(True):
        simulator = converged(env)

        @jax.jit
        def simulate(thetas: jax.Array, ctrl: jax.Array) -> jax.Array:
            def one(theta: jax.Array) -> jax.Array:
                model = simulator.model(theta)

                def step(state: Any, u: jax.Array) -> Any:
                    state = simulator.step(model, state, u)
                    return state, jnp.concatenate([state.qpos, state.qvel])

                first = simulator.start(jnp.asarray(qpos), jnp.asarray(qvel))
                return jax.lax.scan(step, first, ctrl)[1]

            return jax.vmap(one)(thetas)

        ours = np.asarray(simulate(jnp.asarray(thetas), jnp.asarray(ctrl)))
    theirs = [
        c_rollout(env, dict(zip(env.space.names, t, strict=True)), (qpos, qvel), ctrl)
        for t in thetas
    ]
    return Runs(env, thetas, ours, np.array(theirs))


def test_equals_mujoco_c_over_an_episode(runs: Runs) -> None:
    np.testing.assert_allclose(runs.ours[0], runs.theirs[0], atol=1e-6)


def test_equals_a_model_compiled_with_each_parameter(runs: Runs) -> None:
    for name, ours, theirs in zip(
        runs.env.space.names, runs.ours[1:], runs.theirs[1:], strict=True
    ):
        np.testing.assert_allclose(ours, theirs, atol=1e-6, err_msg=name)


def test_every_parameter_moves_the_rollout(runs: Runs) -> None:
    for name, moved in zip(runs.env.space.names, runs.ours[1:], strict=True):
        assert np.abs(moved - runs.ours[0]).max() > 1e-4, name


# Go2's 25 parameters reach no further than its 8 do.
@pytest.fixture(scope="module", params=engines(c for c in CASES if c != "go2_full"))
def episodes(request: pytest.FixtureRequest) -> Any:
    """Random actions from a reset, at random corners of the parameter box."""
    name, which = request.param
    case = CASES[name]
    env = made(case, which)
    steps = min(case.steps, 60)

    def act(obs: jax.Array, key: jax.Array) -> jax.Array:
        return jax.random.uniform(key, (env.action_size,), minval=-1.0)

    @jax.jit
    def run(thetas: jax.Array, keys: jax.Array) -> Any:
        def one(theta: jax.Array, key: jax.Array) -> Any:
            model = env.model(theta)
            first = env.reset(model, key)
            k_run, k_act = jax.random.split(key)

            def step(state: Any, k: jax.Array) -> Any:
                new = env.step(model, state, act(state.obs, k))
                return new, (new.obs, new.reward, new.terminated, new.physics.qvel)

            last, out = jax.lax.scan(step, first, jax.random.split(k_act, steps))
            rows = policy_rollout(env, model, act, k_run, steps)
            return first, last, out, rows

        return jax.vmap(one)(thetas, keys)

    rng = np.random.default_rng(0)
    low, high = env.space.initial
    pick = rng.integers(0, 2, (CORNERS, env.space.size)).astype(bool)
    thetas = np.where(pick, low, high)
    out = run(
        jnp.asarray(thetas, jnp.float32), jax.random.split(jax.random.key(0), CORNERS)
    )
    return env, jax.device_get(out)


def test_sizes_are_as_declared(episodes: Any) -> None:
    env, (first, last, (obs, _, _, _), _) = episodes
    assert first.obs.shape == last.obs.shape == (CORNERS, env.obs_size)
    assert obs.shape[-1] == env.obs_size
    assert last.count.tolist() == [obs.shape[1]] * CORNERS
    for x in (first.reward, first.terminated, first.truncated, first.count):
        assert not x.any()


@pytest.mark.fault("simulations that explode, parameters at absurd corners")
def test_finite_at_the_corners_of_the_parameter_box(episodes: Any) -> None:
    _, (_, _, (obs, reward, _, speed), _) = episodes
    assert np.isfinite(obs).all() and np.isfinite(reward).all()
    assert np.abs(speed).max() < 500


def test_no_transition_crosses_a_reset(episodes: Any) -> None:
    env, (_, _, _, rows) = episodes
    on = rows.weight > 0
    assert on[:, 0].all()
    # Where one transition ends the next begins, and nothing comes after the end.
    follows = on[:, 1:]
    assert (on[:, :-1] | ~follows).all()
    a, b = rows.next_qpos[:, :-1, 0], rows.qpos[:, 1:]
    assert (a == b)[follows].all()
    # A state moves no further in a step than its speed can take it.
    nq = rows.qpos.shape[-1]
    assert np.abs(rows.next_qpos[:, :, 0] - rows.qpos)[on].max() < 50 * env.dt * nq


def test_the_paper_preset_is_that_of_the_robot() -> None:
    updates = {
        robot: search_config("paper", (), robot).discriminator_updates
        for robot in ("", "cartpole", "ant", "ballbalance", "go2")
    }
    assert updates == {
        **dict.fromkeys(("", "cartpole", "go2"), 10),
        **dict.fromkeys(("ant", "ballbalance"), 20),
    }
    set_by_hand = search_config("paper", ("discriminator_updates=5",), "ant")
    assert set_by_hand.discriminator_updates == 5
    assert search_config("default", (), "ant") == search_config("default", ())
