"""`benchmarks.imitation` and `benchmarks.circles`: what they measure and show."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from benchmarks import circles, imitation
from benchmarks.circles import RADII, circle, off_path
from easi_jax.rl.demonstrations import windows_of
from envs import make

VERSIONS = {"commit": "1234567890"}


def test_a_demonstration_is_a_circle() -> None:
    for radius in RADII:
        qpos, qvel, ctrl = circle(radius, None)
        np.testing.assert_allclose(
            np.linalg.norm(qpos - [0.0, radius], axis=1), radius, atol=1e-3
        )
        np.testing.assert_allclose(np.diff(qpos, axis=0), qvel[1:], atol=1e-9)
        assert np.abs(ctrl).max() <= 1
    noisy = circle(1.0, np.random.default_rng(0))[0]
    assert 0.0 < np.abs(np.linalg.norm(noisy - [0.0, 1.0], axis=1) - 1).mean() < 0.05


def test_distance_from_the_path_counts_standing_still() -> None:
    qpos, qvel, ctrl = circle(1.0, None)
    windows = windows_of(np.concatenate([qpos, qvel], 1), ctrl, 1)
    assert off_path([windows], [1.0]) == pytest.approx(0.0, abs=1e-9)
    assert off_path([0 * windows], [1.0]) > 0.8
    assert off_path([windows], [2.0]) > 0.5


def test_a_classifier_knows_the_circles() -> None:
    assert circles.judge_of_circles(0)[1] > 0.95


@pytest.mark.parametrize("form", circles.FORMS)
def test_what_is_left_out_is_left_out(form: str) -> None:
    given = circles.demonstrations(0)
    whole, *less = (circles.settings(form, x, given) for x in circles.LEFT_OUT)
    assert whole.conditional_cost > 0 and whole.prior != "fixed"
    _, prior, terms = less
    labels = {
        left_out: (circles.shown(circles.Cell(form, left_out, 0)).labels >= 0).sum()
        for left_out in circles.LEFT_OUT
    }
    assert labels.pop("labels") == 0 and set(labels.values()) == {67}
    assert prior.prior == "fixed" and prior.prior_cost == 0
    assert terms.conditional_cost == terms.marginal_cost == terms.prior_cost == 0
    assert whole.double_softmax == (form == "paper")


def test_circles_on_the_page() -> None:
    row = {
        **{"form": "default", "left_out": "nothing", "seed": 0, "versions": VERSIONS},
        **{"nmi": 1.0, "ent": 0.0, "prior": 0.03, "off_path": 0.5, "seconds": 60.0},
    }
    text = "\n".join(circles._shown([row, row | {"seed": 1, "nmi": 0.91}]))
    assert "| default | nothing | 2 | 1.00, 0.91 |" in text
    assert "44%, 44%, 10%, 2%" in text


def test_walks_and_skills_on_the_page() -> None:
    speeds = [
        {
            "speed": v,
            "error": 0.05,
            "rate": 0.98,
            "duty": 1.0,
            "phase": 0.04,
            "fallen": 0,
        }
        for v in imitation.SPEEDS
    ]
    shared = {"seed": 0, "seconds": 1200.0, "versions": VERSIONS}
    walk = shared | {"method": imitation.ESS, "speeds": speeds, "told_apart": 0.8}
    text = "\n".join(imitation._walks([walk]))
    assert "| Ess-InfoGAIL | 0 | +0.05, +0.05, +0.05, +0.05 |" in text
    assert "| 0.04, 0.04, 0.04, 0.04 | 80% | 0 | 20 |" in text
    fell = [*speeds[:3], {"speed": 1.6, "fallen": 10}]
    text = "\n".join(imitation._walks([walk | {"speeds": fell}]))
    assert "| +0.05, +0.05, +0.05, - |" in text and "| 80% | 10 | 20 |" in text
    skills = shared | {
        **{"method": imitation.THREE, "nmi": 0.95, "ent": 0.1, "prior": 0.06},
        **{"skills": ["trot", "pace"], "found_prior": [0.7, 0.3]},
        "true_prior": [0.8, 0.2],
    }
    text = "\n".join(imitation._skills([skills]))
    assert "one step in 200" in text and "| 0 | 0.95 | 0.10 | 0.06 |" in text


def test_windows_of_episodes_that_ended() -> None:
    """Steps beyond an episode's end are no windows, and one step alone is none."""
    env = make("go2")
    rng = np.random.default_rng(0)
    qpos = np.tile(env.mj_model.key_qpos[0], (2, 3, 10, 1))
    qpos[..., 7:] += 0.1 * rng.standard_normal(qpos[..., 7:].shape)
    weight = np.ones((2, 3, 10))
    weight[0, 1, 4:], weight[1, 2, 1:] = 0, 0
    rows: Any = SimpleNamespace(qpos=qpos, qvel=np.zeros((2, 3, 10, 18)), weight=weight)
    windows, episodes = imitation.windows_and_episodes(env, rows)
    assert np.bincount(episodes).tolist() == [9, 3, 9, 9, 9]
    assert windows.shape == (39, 84)
    np.testing.assert_allclose(
        windows[9, :12], qpos[0, 1, 0, 7:] - env.mj_model.key_qpos[0, 7:], atol=1e-6
    )
