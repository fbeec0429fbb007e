"""Jumps over limits, and what pieces count: without any simulation."""

import jax.numpy as jnp
import numpy as np

from easi_jax.estimation import weights
from easi_jax.estimation.limits import Reach, beyond_dips, jumps, unmet
from easi_jax.model.parameters import Parameter, ParameterSpace


def space(*units: str) -> ParameterSpace:
    wide = (0.5, 2.0), (0.01, 100.0)
    given = [(f"p{i}", (f"joint.j{i}.damping",), 1.0, *wide) for i in range(len(units))]
    return ParameterSpace(
        tuple(Parameter(*g, unit=u) for g, u in zip(given, units, strict=True))
    )


def test_masses_and_forces_jump_together_as_well() -> None:
    assert jumps(space("kg", "m"))[0].tolist() == np.eye(2).tolist()
    ways, farthest = jumps(space("kg", "N", "m"))
    assert ways.shape == (4, 3) and farthest.shape == (4,)
    np.testing.assert_allclose(ways[3] * space("kg").log_width, [1, 1, 0])


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


def test_a_dip_that_noise_may_have_dug_is_left_for_the_plateau() -> None:
    hessian = jnp.diag(jnp.array([1e4, 1e4, 1e-3]))
    unit, up = jnp.array([0.2, 0.2, 0.2]), jnp.array([1.2, 1.2, 1.2])
    rise = jnp.array([3.0, 2e3, 0.0])
    found = beyond_dips(unit, up, rise, hessian)
    assert found[0] > 0.5 and found[1:].tolist() == unit[1:].tolist()
    assert unmet(hessian).tolist() == [False, False, True]


def test_what_fits_far_worse_counts_less() -> None:
    used = jnp.ones((20, 10, 2))
    costs = jnp.full(20, 10.0).at[3].set(900.0).at[4].set(jnp.inf)
    trust = np.asarray(weights.robust(costs, used[:, 0, 0] > 0))
    assert trust[3] < 0.1 and trust[4] == 0 and (np.delete(trust, [3, 4]) > 0.85).all()
    far = np.asarray(weights.far_worse(costs, used))
    assert np.flatnonzero(far).tolist() == [3, 4]
    # Half the weighted squared error that noise makes is no excess.
    assert weights.excess(costs.at[3].set(10.0), used) == 0.0
    assert weights.excess(costs, used) > 1000.0
    size = np.array([1.0, 1.0, 4.0])
    assert weights.huber(size, 2.0).tolist() == [1.0, 1.0, 0.5]
