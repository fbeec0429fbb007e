"""Go2's clocked expert, its rewards, and the gait that is read off its positions."""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from easi_jax.errors import UserError
from envs.go2 import FOOT, Go2, feet_in_world, forward_only
from envs.go2_expert import GAITS, Clocked, Go2Expert, stride
from envs.go2_gait import Gait, gait_of, mean_gait, phase_distance

DT = 0.02


def walked(
    offsets: tuple[float, ...], rate: float, duty: float, speed: float = 1.0
) -> np.ndarray:
    """Positions of a Go2 whose feet stand and swing by a clock, 10 s, ``(500, 19)``."""
    stand = Go2().mj_model.key_qpos[0].copy()
    stand[7:] = np.tile([0.0, 0.9, -1.8], 4)  # rad, all feet at one height
    rows = np.tile(stand, (500, 1))
    t = DT * np.arange(500)
    rows[:, 0] = speed * t
    # Calves bend in swing; the base is so high that the others touch.
    foot = np.asarray(feet_in_world(jnp.asarray(stand)))[:, 2].min()
    rows[:, 2] += FOOT - foot
    for leg, offset in enumerate(offsets):
        phase = (rate * t - offset) % 1.0
        rows[:, 7 + 3 * leg + 2] -= np.where(phase < duty, 0.0, 0.4)
    return rows


@pytest.mark.parametrize("gait", GAITS)
@pytest.mark.parametrize(("rate", "duty"), [(1.7, 0.6), (2.5, 0.5)])
def test_a_gait_is_read_off(gait: str, rate: float, duty: float) -> None:
    offsets = GAITS[gait]
    found = gait_of(walked(offsets, rate, duty, 0.8), DT)
    assert found.rate == pytest.approx(rate, rel=0.02)
    assert found.speed == pytest.approx(0.8, rel=0.01)
    np.testing.assert_allclose(found.duty, duty, atol=0.03)
    asked = (np.array(offsets) - offsets[0]) % 1.0
    assert phase_distance(found.phase, asked) < 0.04


def test_a_robot_that_stands_has_no_rhythm() -> None:
    still = gait_of(walked((0.0,) * 4, 1.0, 1.1, 0.0), DT)
    assert np.isnan(still.rate) and np.isnan(still.phase).all()
    np.testing.assert_array_equal(still.duty, 1.0)
    both = mean_gait([still, gait_of(walked(GAITS["trot"], 2.0, 0.5), DT)])
    assert both.rate == pytest.approx(2.0, rel=0.02)
    assert np.isnan(mean_gait([still]).rate)


def test_phases_are_means_around_the_circle() -> None:
    gaits = [
        Gait(2.0, np.full(4, 0.5), np.array([0.0, 0.98, 0.5, p]), 1.0, 0.3)
        for p in (0.99, 0.03)
    ]
    assert phase_distance(mean_gait(gaits).phase, np.array([0, 0.98, 0.5, 0.01])) < 1e-6
    assert phase_distance(np.array([0.95]), np.array([0.05])) == pytest.approx(0.1)


def test_the_clock_runs_with_the_command() -> None:
    env = Go2Expert("pace", forward_only("0.4:1.6"))
    model = env.model()
    state = env.reset(model, jax.random.key(0))
    assert isinstance(state.memory, Clocked) and state.obs.shape == (52,)
    state = env.begun(state, jnp.array([1.5, 0.0, 0.0]))
    rate, duty = stride(jnp.float32(1.5)).rate, stride(jnp.float32(1.5)).duty
    np.testing.assert_allclose(state.obs[50:], [rate, duty], rtol=1e-6)
    after = jax.jit(env.step)(model, state, jnp.zeros(12))
    moved = (after.memory.phase - state.memory.phase) % 1.0
    assert float(moved) == pytest.approx(float(rate) * env.dt, rel=1e-3)
    turn = 2 * np.pi * after.memory.phase
    np.testing.assert_allclose(
        after.obs[48:50], [np.sin(turn), np.cos(turn)], atol=1e-5
    )


def test_feet_that_keep_to_the_clock_are_paid() -> None:
    env = Go2Expert("trot", forward_only("1:1"))
    model = env.model()
    state = env.reset(model, jax.random.key(0))
    qpos = walked(GAITS["trot"], 1.0, 0.5)[5]  # FR and RL in stance
    physics = replace(state.physics, qpos=jnp.asarray(qpos, jnp.float32))
    feet = feet_in_world(physics.qpos)
    touching = feet[:, 2] < FOOT + 0.004
    np.testing.assert_array_equal(touching, [False, True, True, False])
    rewards = {}
    for phase in (0.25, 0.75):
        memory = state.memory._replace(
            phase=jnp.float32(phase), feet=feet, command=jnp.array([1.0, 0.0, 0.0])
        )
        rewards[phase] = float(env.reward(model, physics, memory, memory, touching))
    assert rewards[0.25] > rewards[0.75] + 0.2


def test_a_reward_for_the_command_alone() -> None:
    own, plain = Go2(), Go2(rewarded="command", forward="0.5:1.0")
    model = own.model()
    state = plain.reset(model, jax.random.key(0))
    command = state.memory.command
    assert 0.5 <= float(command[0]) <= 1.0 and not command[1:].any()
    v = state.physics.qvel.at[:6].set(jnp.array([0.0, 0, 0, 0, 0, 0]))
    upright = state.physics.qpos.at[3:7].set(jnp.array([1.0, 0, 0, 0]))
    physics = replace(state.physics, qpos=upright, qvel=v.at[0].set(command[0]))
    none = jnp.zeros(4, bool)
    args = physics, state.memory, state.memory, none
    assert float(plain.reward(model, *args)) == pytest.approx(1.0)
    assert float(own.reward(model, *args)) < 1.0
    slow = replace(physics, qvel=v)
    assert float(plain.reward(model, slow, *args[1:])) < 0.9


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"rewarded": "comand"}, 'unknown rewarded "comand".*command'),
        ({"forward": "fast"}, 'forward is "fast"'),
        ({"forward": "2:1"}, 'forward is "2:1"'),
        ({"forward": "0:nan"}, 'forward is "0:nan"'),
    ],
)
def test_options_that_do_not_exist(options: dict[str, Any], said: str) -> None:
    with pytest.raises(UserError, match=said):
        Go2(**options)
    with pytest.raises(UserError, match="unknown gait"):
        Go2Expert("gallop")
