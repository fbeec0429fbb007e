"""`benchmarks.brax_beside`: both train, and the page shows each seed."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from benchmarks import brax_beside
from benchmarks._page import shown
from benchmarks.brax_beside import Cell, by_brax, ours
from easi_jax.baselines.policies import quiet
from easi_jax.rl.config import PpoConfig
from tests.commands import refused
from tests.tiny_robot.env import Tiny

SMALL = PpoConfig(env_steps=4_000, num_envs=20, unroll=10, minibatches=2, hidden=(8,))


@pytest.mark.parametrize(
    "algorithm", ["ppo", pytest.param("sac", marks=pytest.mark.slow)]
)
@pytest.mark.parametrize("train", [ours, by_brax])
def test_both_train_the_same_robot(train: Any, algorithm: str) -> None:
    env = Tiny()
    settings = SMALL if algorithm == "ppo" else quiet(env.training["sac"])
    act, policy, speed, steps = train(env, settings, 0)
    action = act(policy, np.zeros(env.obs_size, np.float32), jax.random.key(0), True)
    assert action.shape == (1,) and np.abs(action).max() <= 1
    assert speed > 0 and steps >= settings.env_steps
    assert not hasattr(jax, "device_put_replicated") or train is ours


def test_the_page_shows_every_seed(tmp_path: Path) -> None:
    rows = [
        {
            **dataclasses.asdict(Cell("cartpole", "ppo", way, seed)),
            **{"key": f"{way} {seed}", "return": 100.0 + seed, "steps": 2_000_000},
            **{"steps_per_s": 1000.0, "seconds": 1.0},
            "versions": {"commit": "0123456", "runtime": {"device_kind": "cpu"}},
        }
        for seed in (1, 0)
        for way in brax_beside.WAYS
    ]
    text = "".join(json.dumps(r) + "\n" for r in rows)
    (tmp_path / "brax_beside.jsonl").write_text(text)
    page = "\n".join(shown(brax_beside.SECTIONS, tmp_path))
    for way in brax_beside.WAYS:
        line = f"| cartpole, ppo | {way} | 2,000,000 | 100.5 (100.0, 101.0) | 1,000 |"
        assert line in page


@pytest.mark.fault("wrong options and files")
@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--robots", "cartpol"], 'did you mean "cartpole"'),
        (["--algorithms", "ppp"], "sac, ppo"),
        (["--env-steps", 0], "env-steps"),
    ],
)
def test_mistakes_are_one_line(words: list[Any], said: str, capsys: Any) -> None:
    assert said in refused(capsys, brax_beside, *words)
