"""Trajectories end where their episode ends; noise is measured once per row."""

from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from easi_jax.data.segments import Segments
from easi_jax.model.joint_space import Configuration
from easi_jax.simulation import rollout
from easi_jax.simulation.env import EnvState
from easi_jax.simulation.step import Physics


class Walker:
    """Moves by the action; ends beyond 1. The model is the length of a step."""

    def reset(self, model: Any, key: jax.Array) -> EnvState:
        x = jax.random.uniform(key, (1,), maxval=0.2)
        return self._state(x, jnp.zeros((), jnp.int32))

    def _state(self, x: jax.Array, count: jax.Array) -> EnvState:
        zero = jnp.zeros(())
        physics = Physics(x, x * 0, jnp.zeros(0), jnp.zeros(1))
        done = (x[0] > 1.0).astype(jnp.float32)
        return EnvState(physics, x, zero, done, zero, count)

    def control(self, state: Any, action: jax.Array) -> jax.Array:
        return 2 * action

    def step(self, model: Any, state: EnvState, action: jax.Array) -> EnvState:
        return self._state(state.physics.qpos + model * action, state.count + 1)


def forward(obs: jax.Array, key: jax.Array) -> jax.Array:
    return jax.random.uniform(key, (1,), minval=0.5, maxval=1.0)


STEPS = 30


@pytest.fixture(scope="module")
def ended() -> Segments:
    env: Any = Walker()
    return rollout.collect(env, jnp.asarray(0.2), forward, jax.random.key(0), 20, STEPS)


def test_shapes(ended: Segments) -> None:
    assert ended.qpos.shape == (20, STEPS, 1)
    assert ended.ctrl.shape == ended.next_qpos.shape == (20, STEPS, 1, 1)
    assert ended.weight.shape == (20, STEPS)


def test_no_transition_that_counts_crosses_a_reset(ended: Segments) -> None:
    counts = np.asarray(ended.weight) > 0
    x, after = np.asarray(ended.qpos[..., 0]), np.asarray(ended.next_qpos[..., 0, 0])
    u = np.asarray(ended.ctrl[..., 0, 0])
    np.testing.assert_allclose((after - x)[counts], 0.1 * u[counts], atol=1e-6)
    # Every trajectory ends within the steps and nothing counts afterwards.
    length = counts.sum(1)
    assert (length < STEPS).all() and (length >= 4).all()
    assert all(c[:n].all() for c, n in zip(counts, length, strict=True))
    assert (x[counts] <= 1.0).all()


def test_the_terminal_state_is_kept(ended: Segments) -> None:
    last = np.asarray(ended.weight.sum(1), int) - 1
    after = np.asarray(ended.next_qpos)[np.arange(20), last, 0, 0]
    assert (after > 1.0).all()


def test_auto_reset_keeps_the_transition_across() -> None:
    seg = rollout.policy_rollout(
        Walker(), jnp.asarray(0.2), forward, jax.random.key(0), STEPS, auto_reset=True
    )
    jump = np.asarray(seg.next_qpos[:, 0, 0] - seg.qpos[:, 0])
    crossing = jump < -0.5
    assert crossing.sum() >= 2
    np.testing.assert_array_equal(seg.weight, ~crossing)
    np.testing.assert_array_equal(seg.qpos[1:, 0], seg.next_qpos[:-1, 0, 0])
    assert (seg.next_qpos[crossing, 0, 0] <= 0.2).all()


def test_what_is_seen_and_done_is_kept() -> None:
    env: Any = Walker()

    def act(obs: jax.Array, key: jax.Array) -> jax.Array:
        return 1.0 + obs

    def run(stale: jax.Array | None) -> np.ndarray:
        given = env, jnp.asarray(0.1), act, jax.random.key(1), 3, 6
        return np.asarray(rollout.collect(*given, sees=True, stale=stale).seen)

    seen = run(None)
    assert seen.shape == (3, 6, 3)
    before, action, after = seen[..., 0], seen[..., 1], seen[..., 2]
    np.testing.assert_array_equal(before[:, 1:], after[:, :-1])
    np.testing.assert_allclose(action, 1 + before, rtol=1e-6)
    stale = run(jnp.full((3, 1), 0.7))
    np.testing.assert_allclose(stale[:, 0, :2], [[0.7, 1.7]] * 3, rtol=1e-6)
    # It moves from where it is, by what it does about what it sees.
    np.testing.assert_allclose(stale[:, 0, 2], before[:, 0] + 0.17, rtol=1e-5)
    np.testing.assert_allclose(
        rollout.last_seen(jnp.asarray(stale), 1), stale[:, -1, 2:]
    )


def test_trajectories_are_independent(ended: Segments) -> None:
    assert len(np.unique(ended.qpos[:, 0])) == 20
    assert len(np.unique(ended.ctrl[:, 0])) == 20


def test_noise_is_drawn_once_per_row(ended: Segments) -> None:
    noise = jnp.array([0.5, 2.0])
    joints = Configuration(1, 1, (0,), (0,), ())
    seen = rollout.measured(ended, noise, jax.random.key(3), joints)
    dq = np.asarray(seen.qpos - ended.qpos)[..., 0]
    dv = np.asarray(seen.qvel - ended.qvel)[..., 0]
    dq_next = np.asarray(seen.next_qpos - ended.next_qpos)[..., 0, 0]
    dv_next = np.asarray(seen.next_qvel - ended.next_qvel)[..., 0, 0]
    np.testing.assert_allclose(dq[:, 1:], dq_next[:, :-1], atol=1e-5)
    np.testing.assert_allclose(dv[:, 1:], dv_next[:, :-1], atol=1e-5)
    assert dq.std() == pytest.approx(0.5, rel=0.15)
    assert dv.std() == pytest.approx(2.0, rel=0.15)
    assert abs(np.corrcoef(dq[:, :-1].ravel(), dq_next[:, :-1].ravel())[0, 1]) < 0.2
    np.testing.assert_array_equal(seen.ctrl, ended.ctrl)


def test_noise_on_a_free_joint_is_a_rotation_vector() -> None:
    """Unit quaternions stay, and off by the stated deviations; hinges get theirs."""
    m = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><body><freejoint/><geom size=".1"/><body>'
        '<joint/><geom size=".1"/></body></body></worldbody></mujoco>'
    )
    joints = Configuration.of(m)
    rng = np.random.default_rng(0)
    qpos = rng.normal(size=(30, 41, m.nq))
    qpos[..., 3:7] /= np.linalg.norm(qpos[..., 3:7], axis=-1, keepdims=True)
    truth = Segments(
        qpos=jnp.asarray(qpos[:, :-1]),
        qvel=jnp.zeros((30, 40, m.nv)),
        ctrl=jnp.zeros((30, 40, 1, 0)),
        next_qpos=jnp.asarray(qpos[:, 1:, None]),
        next_qvel=jnp.zeros((30, 40, 1, m.nv)),
        weight=jnp.ones((30, 40)),
    )
    std = np.array([0.1, 0.2, 0.3, 0.01, 0.02, 0.05, 0.4, *[0.0] * m.nv])
    seen = rollout.measured(truth, jnp.asarray(std), jax.random.key(0), joints)
    np.testing.assert_allclose(
        np.linalg.norm(seen.qpos[..., 3:7], axis=-1), 1.0, atol=1e-6
    )
    off = joints.difference(truth.qpos, seen.qpos)
    np.testing.assert_allclose(np.std(off, (0, 1)), std[: m.nv], rtol=0.1)
    # The end of a step and the start of the next are one measurement.
    np.testing.assert_allclose(seen.qpos[:, 1:], seen.next_qpos[:, :-1, 0], atol=1e-6)
