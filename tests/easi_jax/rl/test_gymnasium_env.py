"""Our robots in loops that people write for gymnasium."""

import sys
from typing import Any

import numpy as np
import pytest

gymnasium = pytest.importorskip("gymnasium")
from gymnasium.utils.env_checker import check_env  # noqa: E402

from easi_jax.errors import UserError  # noqa: E402
from easi_jax.rl.gymnasium_env import GymnasiumEnv  # noqa: E402
from tests.tiny_robot.env import Tiny  # noqa: E402


@pytest.fixture(scope="module")
def env() -> Any:
    return GymnasiumEnv(Tiny())


def test_gymnasium_finds_no_fault(env: Any) -> None:
    # It warns of spaces without bounds, which observations of a robot have.
    with pytest.warns(UserWarning, match="Box observation space"):
        check_env(env, skip_render_check=True)


def test_an_episode_ends_by_the_time_limit(env: Any) -> None:
    first, _ = env.reset(seed=1)
    again, _ = env.reset(seed=1)
    other, _ = env.reset()
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)
    for k in range(1, Tiny.episode_length + 1):
        obs, reward, terminated, truncated, _ = env.step(env.action_space.sample())
        assert env.observation_space.contains(obs)
        assert 0 < reward <= 1 and not terminated
        assert truncated == (k == Tiny.episode_length)


def test_mistakes_are_one_line(env: Any) -> None:
    with pytest.raises(UserError, match="call reset"):
        GymnasiumEnv(Tiny()).step([0.0])
    env.reset(seed=0)
    with pytest.raises(UserError, match=r"action has shape \(2,\), needed is \(1\)"):
        env.step([0.0, 0.0])
    with pytest.raises(UserError, match="action is not finite"):
        env.step([np.nan])


def test_without_the_package_it_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delitem(sys.modules, "easi_jax.rl.gymnasium_env")
    monkeypatch.setitem(sys.modules, "gymnasium", None)
    with pytest.raises(UserError, match=r"pip install easi-jax\[gym\]"):
        import easi_jax.rl.gymnasium_env  # noqa: F401
