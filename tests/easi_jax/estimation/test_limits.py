"""Jumps over limits, and what pieces count: without any simulation."""

import jax.numpy as jnp
import numpy as np
import pytest

from easi_jax.estimation import weights
from easi_jax.estimation.limits import Reach, beyond_edge, edge, jumps, of, unmet
from easi_jax.estimation.prediction_error import outlier_weights, white_noise
from easi_jax.model.parameters import Parameter, ParameterSpace


def space(*units: str, field: str = "frictionloss") -> ParameterSpace:
    wide = (0.5, 2.0), (0.01, 100.0)
    given = [(f"p{i}", (f"joint.j{i}.{field}",), 1.0, *wide) for i in range(len(units))]
    return ParameterSpace(
        tuple(Parameter(*g, unit=u) for g, u in zip(given, units, strict=True))
    )


def test_masses_and_forces_jump_together_as_well() -> None:
    assert jumps(space("kg", "m"))[0].tolist() == np.eye(2).tolist()
    ways, farthest = jumps(space("kg", "N", "m"))
    assert ways.shape == (4, 3) and farthest.shape == (4,)
    np.testing.assert_allclose(ways[3] * space("kg").log_width, [1, 1, 0])
    # What always has a slope does not jump by itself.
    assert len(jumps(space("kg", "m", field="damping"))[0]) == 0
    assert len(jumps(space("kg", "N", field="armature"))[0]) == 1
    assert len(jumps(space("m", field="speed_limit"))[0]) == 1


def test_what_met_no_limit_goes_down_by_itself() -> None:
    two = ParameterSpace(
        (*space("m", field="damping").parameters, *space("m", "m").parameters[1:])
    )
    reach = Reach.fresh(two)
    at = jnp.array([0.5, 0.6])
    by = float(jumps(two)[1][0])
    assert reach.down(two, at).tolist() == pytest.approx([0.5, 0.6 - by])


def test_a_jump_is_bisected_to_the_edge_of_a_plateau() -> None:
    """The cost falls in a narrow well 1.37 below, and hardly changes before it."""
    one, edge, found = space("m"), 1.37, False
    reach, at = Reach.fresh(one), jnp.array([0.5])
    for _ in range(12):
        ends = np.asarray(reach.ends(one, at))[:, 0, 0]
        off = 0.5 - ends
        cost = np.where(off > edge + 1e-2, 5.0, np.where(off > edge, -1.0, 0.0))
        if cost[1] < 0:
            found = True
            break
        reach = reach.after(
            jnp.asarray(cost[:, None]), jnp.zeros(1), jnp.zeros((2, 1), bool)
        )
    assert found
    # Upwards nothing changes: it goes as far as it may.
    assert float(reach.tried[0, 0]) > 0.9 * float(jumps(one)[1][0])
    # What was taken is an end: from there nothing is known of the near side.
    taken = jnp.array([[False], [True]])
    new = reach.after(jnp.zeros((2, 1)) - 1.0, jnp.zeros(1), taken)
    assert float(new.raised[1, 0]) == float(reach.tried[1, 0])
    assert not new.unchanged.any()


def test_limits_are_known_by_their_addresses() -> None:
    named = ParameterSpace(
        tuple(
            Parameter(name, (name,), 1.0, (0.5, 2.0), (0.01, 100.0), unit="N")
            for name in (
                "actuator.drive.force_limit",
                "joint.upper_limit.damping",
                "effect.limit.drive",
            )
        )
    )
    assert of(named) == [0, 2]
    here = jnp.array([0.2, 0.9, 0.2])
    most = named.unit_bounds[1]
    assert beyond_edge(here, jnp.arange(3) == 0, most).tolist() > here.tolist()
    assert (beyond_edge(here, jnp.arange(3) == -1, most) == here).all()


def test_a_narrow_dip_has_to_be_deeper() -> None:
    """Against the evidence by brute force: a plateau of 0, a Gaussian dip."""
    unit, log_odds = 0.2, np.log(0.95 / 0.05)
    for std in (0.001, 0.02):
        depth = float(edge(jnp.asarray(unit), jnp.asarray(std**-2.0)))
        x = np.linspace(unit - 6 * std, unit + 6 * std, 4001)
        dip = np.exp(depth - 0.5 * ((x - unit) / std) ** 2).sum() * (x[1] - x[0])
        assert np.log(dip / (1.0 - unit)) == pytest.approx(log_odds, abs=0.01)
    assert unmet(jnp.diag(jnp.array([1e4, 1e-3]))).tolist() == [False, True]


def test_what_fits_far_worse_counts_less() -> None:
    used = jnp.ones((20, 10, 2))
    costs = jnp.full(20, 10.0).at[3].set(900.0).at[4].set(jnp.inf)
    trust = np.asarray(weights.robust(costs, used))
    assert trust[3] < 0.1 and trust[4] == 0 and (np.delete(trust, [3, 4]) > 0.85).all()
    far = np.asarray(weights.far_worse(costs, used))
    assert np.flatnonzero(far).tolist() == [3, 4]
    # Half the weighted squared error that noise makes is no excess.
    assert weights.excess(costs.at[3].set(10.0), used) == 0.0
    assert weights.excess(costs, used) > 1000.0
    size = np.array([1.0, 1.0, 4.0])
    assert weights.huber(size, 2.0).tolist() == [1.0, 1.0, 0.5]


def test_pieces_at_rest_do_not_make_those_that_move_outliers() -> None:
    """A machine rests in most pieces, and its encoders with it: nothing is left there,
    and no more than the noise where it moves."""
    moves, numbers = np.arange(20) % 3 == 0, jnp.ones((20, 10, 2))
    costs = jnp.asarray(np.where(moves, 10.0, 0.0))
    assert (np.asarray(weights.robust(costs, numbers)) > 0.85).all()
    rng = np.random.default_rng(0)
    for rest in (0.0, 0.05):
        size = np.where(moves, 1.0, rest)[:, None, None]
        error = jnp.asarray(size * rng.normal(size=(20, 30, 2)))
        weight = outlier_weights(error, jnp.ones(2), jnp.zeros((30, 2)), 2.5)
        np.testing.assert_allclose(weight, 1.0)
        np.testing.assert_allclose(white_noise(error), 1.0, rtol=0.1)
