"""Limits in dips that noise may have dug: with numbers in place of a simulation."""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import pytest

from easi_jax.data.segments import Segments
from easi_jax.estimation.normal_equations import PairedFit
from easi_jax.estimation.polish import _Steps, polish
from easi_jax.estimation.posterior import polished
from easi_jax.model.parameters import ParameterSpace
from easi_jax.simulation import slopes
from easi_jax.simulation.simulator import Simulator
from envs.cartpole import Cartpole

PIECES, STD, EDGE = 4, 1e-3, 0.3
# Half the squared error of all pieces that a limit at the edge leaves, in nats: far
# below and far above what a dip of this width (5e-4) has to be deep.
SHALLOW, DEEP = 4.0, 40.0


@pytest.fixture()
def paired(monkeypatch: pytest.MonkeyPatch, cartpole: Cartpole) -> Any:
    """Takes how deep the dip is, and where above 0.6, if at all, the limit is met
    again. The drive's gain is told by numbers of its own."""
    space = cartpole.space.select(["cart_kp", "cart_force_limit"])
    simulator = Simulator(cartpole.mj_model, space, cartpole.dt)

    def bare(simulator: Simulator, space: Any, unit: jax.Array, *rest: Any) -> Any:
        (gain, limit), s = unit, rest[1]
        again = jnp.where(s.next_qvel[0, 0] > 0, jnp.maximum(limit, 0.6), 0.0)
        seen = jnp.stack([jnp.minimum(limit, EDGE), gain, again, 0.0])
        measured = jnp.concatenate([s.next_qpos, s.next_qvel], 1)
        return seen * jnp.ones((3, 1)) - measured

    monkeypatch.setattr(slopes, "_residuals", bare)

    def paired(depth: float, again: float = 0.0) -> PairedFit:
        below = (2.0 * depth / (3 * PIECES)) ** 0.5 * STD
        measured = jnp.array([EDGE - below, 0.6, again, 0.0])
        measured = jnp.broadcast_to(measured, (PIECES, 3, 4))
        pieces = Segments(
            qpos=jnp.zeros((PIECES, 2)),
            qvel=jnp.zeros((PIECES, 2)),
            ctrl=jnp.zeros((PIECES, 3, 1)),
            next_qpos=measured[..., :2],
            next_qvel=measured[..., 2:],
            weight=jnp.ones(PIECES),
        )
        return PairedFit(simulator, space, pieces, jnp.full(4, STD))

    return paired


def ended(fit: PairedFit, begin: float) -> Any:
    """From a limit of ``begin``."""
    return jax.jit(lambda u: polish(fit, u))(jnp.array([0.55, begin]))


@pytest.mark.parametrize(("depth", "met"), [(SHALLOW, False), (DEEP, True)])
def test_a_limit_is_known_where_its_dip_is_deep(
    paired: Any, depth: float, met: bool
) -> None:
    found = ended(paired(depth), 0.29)
    assert float(found.unit[0]) == pytest.approx(0.6, abs=1e-4)
    assert (float(found.hessian[1, 1]) > 1e3) == met
    assert (float(found.unit[1]) < EDGE) == met
    assert float(found.hessian[0, 0]) == pytest.approx(3 * PIECES / STD**2, rel=1e-3)


def test_a_limit_beyond_a_kink_is_looked_for_nearby(paired: Any) -> None:
    """By costs alone: the nearest to the dip of what halves of a quarter lead to."""
    fit = paired(DEEP)
    steps = _Steps(fit, fit.weight, jnp.zeros(2), 8, (1,))
    begun = steps.begin(jnp.array([0.6, 0.2]), fit.unmoved)
    near, _ = jax.jit(steps.nearby)(begun)
    assert near.tolist() == pytest.approx([0.6, 0.2 + 0.125])


def test_a_better_place_where_it_is_met_is_taken(paired: Any) -> None:
    found = ended(paired(0.0, again=0.7), 0.29)
    assert float(found.unit[1]) == pytest.approx(0.7, abs=1e-4)
    assert float(found.hessian[1, 1]) > 1e3


def test_what_nothing_meets_stays_where_it_is(paired: Any) -> None:
    found = ended(paired(DEEP), 0.5)
    assert float(found.unit[1]) == 0.5 and float(found.hessian[1, 1]) == 0.0


def test_a_limit_that_is_surely_met_costs_no_looks_at_its_plateau(paired: Any) -> None:
    """The cost there, with all else held, says so beforehand."""
    looks = [float(ended(paired(depth), 0.29).simulated) for depth in (20.0, 60.0)]
    assert looks[1] < looks[0]
    fit = paired(DEEP)
    steps = _Steps(fit, fit.weight, jnp.zeros(2), 8, (1,))
    begun = steps.begin(jnp.array([0.6, EDGE]), fit.unmoved)
    _, rise = jax.jit(steps.nearby)(begun)
    assert rise.tolist() == pytest.approx([0.0, 0.0], abs=1e-3)  # at its edge
    low = replace(begun, best=(begun.unit.at[1].set(EDGE - STD), *begun.best[1:]))
    _, rise = jax.jit(steps.nearby)(low)
    off = (2.0 * DEEP / (3 * PIECES)) ** 0.5 - 1.0
    assert float(rise[1]) == pytest.approx(DEEP - 0.5 * 3 * PIECES * off**2, rel=0.01)


@pytest.mark.parametrize("bend", [0.0, 20.0])
def test_the_mean_stays_in_a_bent_valley(
    monkeypatch: pytest.MonkeyPatch, cartpole: Cartpole, bend: float
) -> None:
    """Where data know a sum of two parameters, the mean goes along it to the middle of
    the range; where they know a bent line, only as far as that predicts."""
    space = cartpole.space.select(["cart_kp", "cart_kv", "cart_force_limit"])
    simulator = Simulator(cartpole.mj_model, space, cartpole.dt)

    def bare(simulator: Simulator, space: ParameterSpace, unit: Any, *rest: Any) -> Any:
        gain, damping, _ = unit - jnp.array([0.8, 0.2, 0.0])
        known = gain + damping + bend * (gain - damping) ** 2
        return jnp.full((3, 4), known)

    monkeypatch.setattr(slopes, "_residuals", bare)
    pieces = Segments(
        qpos=jnp.zeros((PIECES, 2)),
        qvel=jnp.zeros((PIECES, 2)),
        ctrl=jnp.zeros((PIECES, 3, 1)),
        next_qpos=jnp.zeros((PIECES, 3, 2)),
        next_qvel=jnp.zeros((PIECES, 3, 2)),
        weight=jnp.ones(PIECES),
    )
    fit = PairedFit(simulator, space, pieces, jnp.full(4, STD))
    fitted = jnp.array([0.8, 0.2, 0.9])
    found = jax.jit(lambda u: polished(fit, u, 0.01 * jnp.eye(3)))(fitted)
    mean = found.distribution.mean
    assert float(mean[2]) == pytest.approx(0.5, abs=0.01)  # nobody knows the limit
    if bend:
        off = mean[0] + mean[1] - 1.0 + bend * (mean[0] - mean[1] - 0.6) ** 2
        assert float(off) ** 2 * 3 * 4 * PIECES / 2 < 4.0 * STD**2
        assert mean[:2].tolist() == pytest.approx([0.8, 0.2], abs=0.05)
    else:
        assert mean[:2].tolist() == pytest.approx([0.5, 0.5], abs=0.01)
