"""Methods of other packages; skipped where those are not installed."""

from collections.abc import Callable
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from easi_jax.baselines import Budget, MujocoSysid, NeuralPosterior, Task
from easi_jax.baselines.mujoco_sysid import toolbox
from easi_jax.baselines.npe import summary
from easi_jax.baselines.replay_cma_es import some_pieces
from easi_jax.data.segments import Segments
from easi_jax.errors import UserError
from easi_jax.model.distribution import covariance
from easi_jax.simulation.rollout import measured
from tests.easi_jax.baselines.small import NAMES, log_ratios

BUDGET = Budget(300_000)
NOISE = jnp.array([5e-4, 2e-3, 1e-2, 2e-2])


def needs(*modules: str) -> Callable[[], None]:
    def skip() -> None:
        for name in modules:
            pytest.importorskip(name, reason=f"{name} (easi-jax[peers]) is missing")

    return skip


needs_sysid = needs("colorama", "tabulate", "plotly", "imageio")


def test_sysid_finds_the_truth_where_nothing_is_noisy(
    task: Task, demonstrations: Segments
) -> None:
    needs_sysid()
    method = MujocoSysid(pieces=8, horizon=20)
    found = method.fit(task, demonstrations, BUDGET, jax.random.key(1))
    # From three times the truth, by another simulator in double precision.
    np.testing.assert_allclose(log_ratios(task, found), 0.0, atol=1e-4)
    assert 0 < found.simulated <= BUDGET.simulated
    assert np.diag(covariance(found.distribution)).max() < 1e-6


def test_sysid_says_how_sure_it_is(task: Task, demonstrations: Segments) -> None:
    needs_sysid()
    noisy = measured(
        demonstrations, NOISE, jax.random.key(2), task.simulator.configuration
    )
    method = MujocoSysid(pieces=8, horizon=20)
    found = method.fit(replace(task, noise=NOISE), noisy, BUDGET, jax.random.key(1))
    assert np.abs(log_ratios(task, found)[:2]).max() < 0.1
    spread = np.sqrt(np.diag(covariance(found.distribution)))
    assert (spread > 1e-4).all() and (spread < 12.0**-0.5).all()


def test_sysid_leaves_what_mujoco_has_no_word_for(
    task: Task, demonstrations: Segments
) -> None:
    needs_sysid()
    names = (*NAMES[:2], "cart_speed_limit")
    space = task.env.space.select(names).scaled(1.5, 6.0)
    other = replace(task, simulator=task.simulator.rebuilt(space=space, fixed={}))
    method = MujocoSysid(pieces=8, horizon=20)
    found = method.fit(other, demonstrations, BUDGET, jax.random.key(1))
    assert found.distribution.mean[2] == 0.5
    assert found.unreached == ("cart_speed_limit",)
    assert covariance(found.distribution)[2, 2] == pytest.approx(1 / 12)
    error = found.space.to_si(found.distribution.mean)[:2] / np.array([20.0, 0.3])
    assert np.abs(np.log(error)).max() < 0.2


def test_a_missing_toolbox_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    from mujoco import sysid

    monkeypatch.delattr(sysid, "optimize", raising=False)
    with pytest.raises(UserError, match=r"easi-jax\[peers\]"):
        toolbox()


def test_a_budget_that_buys_no_step_is_refused(
    task: Task, demonstrations: Segments
) -> None:
    needs_sysid()
    with pytest.raises(UserError, match="does not pay"):
        MujocoSysid().fit(task, demonstrations, Budget(100), jax.random.key(0))


def test_npe_learns_the_posterior(task: Task, demonstrations: Segments) -> None:
    needs("sbi", "torch")()
    noisy = measured(
        demonstrations, NOISE, jax.random.key(2), task.simulator.configuration
    )
    method = NeuralPosterior(pieces=4, horizon=10, density="mdn")
    budget = Budget(16_000)
    found = method.fit(replace(task, noise=NOISE), noisy, budget, jax.random.key(1))
    error = log_ratios(task, found)
    # The prior's mean is three times the truth, its spread a factor of e^0.4.
    assert abs(error[0]) < 0.5 and abs(error[1]) < 1.0, error
    assert found.simulated == 16_000
    spread = np.sqrt(np.diag(covariance(found.distribution)))
    assert (spread < 12.0**-0.5 + 0.1).all() and spread[0] < 0.5 * 12.0**-0.5


def test_summary_is_of_all_steps_that_count(
    task: Task, demonstrations: Segments
) -> None:
    pieces = some_pieces(task, demonstrations, 10, 4)
    pieces = replace(pieces, weight=pieces.weight.at[0].set(0.0))
    noise = jnp.zeros((4, 10, 4))
    got = summary(task.simulator, pieces, pieces.next_qpos, pieces.next_qvel, noise)
    q = np.concatenate([pieces.qpos[:, None], pieces.next_qpos], 1)[1:]
    v = np.concatenate([pieces.qvel[:, None], pieces.next_qvel], 1)[1:]
    d = np.diff(np.concatenate([q, v], -1), axis=1).reshape(-1, 4)
    a = np.asarray(pieces.ctrl[1:]).reshape(-1)
    want = np.concatenate([(d * a[:, None]).mean(0), d.mean(0), d.var(0)])
    np.testing.assert_allclose(got, want, rtol=1e-3, atol=1e-6)


def test_missing_sbi_is_one_line(
    task: Task, demonstrations: Segments, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("easi_jax.baselines.npe.find_spec", lambda name: None)
    with pytest.raises(UserError, match=r"easi-jax\[peers\]"):
        NeuralPosterior().fit(task, demonstrations, BUDGET, jax.random.key(0))
