"""Each method moves from a wrong start towards the truth, within its budget."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.rigs import RIGS
from easi_jax.baselines import (
    Budget,
    Dropo,
    Easi,
    Method,
    PairedCmaEs,
    RandomSearch,
    SimOpt,
    Task,
)
from easi_jax.baselines.replay_cma_es import affordable, paired_cost, some_pieces
from easi_jax.baselines.simopt import reps_weights
from easi_jax.data.segments import Segments
from easi_jax.errors import UserError
from easi_jax.model.distribution import covariance
from easi_jax.search.config import preset
from easi_jax.simulation.rollout import measured
from tests.easi_jax.baselines.small import log_ratios

BUDGET = Budget(300_000)
NOISE = jnp.array([5e-4, 2e-3, 1e-2, 2e-2])
EASI = preset("default", population=100, segments=64)
# Largest |log ratio| of the drive's stiffness, and of its damping.
METHODS: dict[str, tuple[Method, tuple[float, float]]] = {
    "cma_es": (PairedCmaEs(population=16, pieces=8, horizon=20), (0.02, 0.05)),
    # It cannot leave where it starts, at 1.5 times the truth.
    "random": (RandomSearch(pieces=8, horizon=20), (0.6, 1.5)),
    "dropo": (Dropo(transitions=40, epsilon=1e-3), (0.05, 0.1)),
    "simopt": (SimOpt(iterations=2, trajectories=4), (0.3, 1.0)),
    "easi": (Easi(EASI), (0.1, 0.3)),
    "easi_refined": (Easi(EASI, refine=True), (0.01, 0.01)),
}


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(n, marks=pytest.mark.slow)
        if n in ("simopt", "easi_refined", "cma_es", "dropo")
        else n
        for n in METHODS
    ],
)
def test_the_truth_is_approached_from_a_start_that_excludes_it(
    name: str, task: Task, demonstrations: Segments
) -> None:
    method, most = METHODS[name]
    found = method.fit(task, demonstrations, BUDGET, jax.random.key(1))
    assert 0.5 * BUDGET.simulated < found.simulated
    # The finish is counted, and not in the budget.
    assert (found.simulated > BUDGET.simulated) == (name == "easi_refined")
    error = log_ratios(task, found)
    # The middle of 1.5 to 6 times the truth is 3 times.
    assert abs(error[0]) < most[0] < np.log(3), error
    assert abs(error[1]) < most[1], error
    spread = np.sqrt(np.diag(covariance(found.distribution)))
    assert np.isfinite(spread).all() and (spread < 12.0**-0.5 + 0.1).all()
    assert (found.measured > 0) == (name == "simopt")
    # Who times a method waits for its arrays, not for its dispatch.
    assert any(leaf is found.distribution.mean for leaf in jax.tree.leaves(found))


def test_noise_widens_what_is_likely(task: Task, demonstrations: Segments) -> None:
    """DROPO's spread holds what the sensors add; without a floor it would vanish."""
    noisy = measured(
        demonstrations, NOISE, jax.random.key(2), task.simulator.configuration
    )
    method = Dropo(transitions=40)
    found = method.fit(replace(task, noise=NOISE), noisy, BUDGET, jax.random.key(1))
    assert np.abs(log_ratios(task, found)[:2]).max() < 0.4


def test_a_budget_that_buys_no_round_is_refused(
    task: Task, demonstrations: Segments
) -> None:
    for method, _ in METHODS.values():
        with pytest.raises(UserError, match="does not pay"):
            method.fit(task, demonstrations, Budget(100), jax.random.key(0))
    with pytest.raises(UserError, match="buys nothing"):
        Budget(0)


def test_pieces_know_what_was_sent_before_them() -> None:
    """A drive that obeys late still follows it when a piece begins."""
    rig = RIGS["cartpole"]()
    late = rig.late(0.03)
    theta = jnp.asarray(late.space.nominal, jnp.float32)
    demos = jax.jit(lambda k: rig.record(late, theta, k, 4, 1.0))(jax.random.key(0))
    task = Task(late, jnp.zeros(4))
    pieces = some_pieces(task, demos, 10, 16)
    cost = jax.jit(paired_cost(task, pieces, pieces.count))
    costs = lambda x: cost(x, jax.random.key(0))  # noqa: E731
    right, wrong = costs(jnp.stack([late.space.to_unit(theta), jnp.full(7, 0.4)]))
    assert right < 1e-7 < 1e-4 < wrong


def test_every_generation_draws_its_pieces_from_all(
    task: Task, demonstrations: Segments
) -> None:
    pieces = some_pieces(task, demonstrations, 20)
    assert pieces.count == 80
    unit = jnp.full((1, task.space.size), 0.5)
    some, everything = (jax.jit(paired_cost(task, pieces, n)) for n in (8, 80))
    keys = [jax.random.key(k) for k in range(20)]
    drawn = [float(some(unit, k)[0]) for k in keys]
    assert len(set(drawn)) == 20
    (whole,) = {float(everything(unit, k)[0]) for k in keys[:2]}
    assert np.mean(drawn) == pytest.approx(whole, rel=0.2)


def test_a_budget_says_how_much_is_replayed_at_once(
    task: Task, demonstrations: Segments
) -> None:
    pieces = some_pieces(task, demonstrations, 20)
    for steps, count in ((100, 1), (64 * 20 * 60 * 7, 7), (10**9, 80)):
        assert affordable(Budget(steps), 64 * 20 * 60, pieces, None) == count
    assert affordable(Budget(1), 10, some_pieces(task, demonstrations, 20, 5), 5) == 5
    found = RandomSearch(horizon=20).fit(
        task, demonstrations, Budget(64 * 20 * 60 * 7), jax.random.key(0)
    )
    # What comes first is judged on 7 pieces, its best on all 80.
    assert found.simulated <= 64 * 20 * 60 * 7
    assert found.simulated > 0.9 * 64 * 20 * 60 * 7


def test_reps_keeps_to_its_bound() -> None:
    cost = jnp.asarray(np.random.default_rng(0).exponential(size=500))
    for bound in (0.1, 1.0):
        w = reps_weights(cost, bound, 1e-3)
        divergence = float((w * jnp.log(jnp.maximum(w * len(cost), 1e-30))).sum())
        assert divergence == pytest.approx(bound, rel=0.1)
        assert float(w @ cost) < float(cost.mean())
    even = reps_weights(jnp.ones(10), 1.0, 1e-3)
    assert np.allclose(even, 0.1), "nothing to choose between"
