"""Limits that data may not meet, and jumps over what has no slope.

A speed limit that no simulation reaches has no slope, yet the data may show that it is
lower. Noise digs a dip into the edge of such a plateau: what fits hardly better there
is put back onto the plateau, where nothing is known of it
(`easi_jax.estimation.polish`). The common scale of all masses and forces jumps as well.
"""

from collections.abc import Callable

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from easi_jax.estimation.identifiability import forces
from easi_jax.model.parameters import ParameterSpace

EDGE = 4.0  # of the cost, that a place beyond a plateau's edge has to be better by
_UNSEEN = 1.0  # information of a unit coordinate: nothing
_FARTHEST = 0.8, 2.5  # jump that is tried, in initial ranges, in log ratios
_SURE = 0.95  # probability that a limit is in a dip: less, and it may not be met at all
_NARROW = 0.05  # initial ranges: no plateau is taken for narrower
# Fields and effects, beside limits and all kinds of friction, that hold still or do
# nothing below their value.
_HOLDING = frozenset({"coulomb", "static", "slip", "width", "deadband"})
_INSIDE = 0.4  # initial ranges beyond the edge, where a plateau is entered


def jumps(space: ParameterSpace) -> tuple[np.ndarray, np.ndarray]:
    """Directions of jumps, ``(k, n)``, and how far each may go, ``(k,)``: parameters
    that may have no slope (`_thresholds`), in unit coordinates, and the common scale of
    all masses and forces, along which motion changes least, in log ratios."""
    # A start range may be narrow, and wrong.
    wide = np.maximum(_FARTHEST[0], _FARTHEST[1] / space.log_width)
    far, which = np.where(space.log, wide, _FARTHEST[0]), _thresholds(space)
    single = np.eye(space.size)[which], far[which]
    scaled = forces(space) * space.log
    if scaled.sum() < 2:
        return single
    common = scaled / space.log_width
    return np.vstack([single[0], common]), np.append(single[1], _FARTHEST[1])


@flax.struct.dataclass
class Reach:
    """How far jumps go, up and down each of k directions: bisected between where a
    change has left the cost as it was and where it has raised it, ``(2, k)`` each. At
    the edge of a plateau it may fall."""

    unchanged: jax.Array
    raised: jax.Array

    @classmethod
    def fresh(cls, space: ParameterSpace) -> "Reach":
        """Nothing was tried."""
        farthest = jumps(space)[1]
        return cls(
            jnp.zeros((2, len(farthest))), jnp.tile(jnp.asarray(farthest), (2, 1))
        )

    @property
    def tried(self) -> jax.Array:
        """What is tried next."""
        return 0.5 * (self.unchanged + self.raised)

    def ends(self, space: ParameterSpace, unit: jax.Array) -> jax.Array:
        """Where that leads from ``unit (n,)``, ``(2, k, n)``."""
        sides = jnp.array([[1.0], [-1.0]])
        return space.clip(unit + (self.tried * sides)[..., None] * jumps(space)[0])

    def down(self, space: ParameterSpace, unit: jax.Array) -> jax.Array:
        """``unit (n,)`` with each parameter that jumps as low as it was raised by."""
        which = np.array(_thresholds(space), int)
        return space.clip(unit.at[which].add(-self.raised[1, : len(which)]))

    def after(self, data: jax.Array, here: jax.Array, taken: jax.Array) -> "Reach":
        """After a look: ``data (2, k)`` are costs of the jumps, ``here`` that without,
        ``taken (2, k)`` the jump that was made."""
        worse = ~(data <= here) | taken
        still = jnp.where(taken.any(0), 0.0, self.unchanged)
        return Reach(
            jnp.where(data == here, self.tried, still),
            jnp.where(worse, self.tried, self.raised),
        )


def unmet(hessian: jax.Array) -> jax.Array:
    """Parameters on a plateau, of which the data say nothing, ``(n,)``."""
    return jnp.diag(hessian) < _UNSEEN


def of(space: ParameterSpace) -> list[int]:
    """Which parameters are limits of a force, a speed or a command."""
    return _named(space, lambda field: field.endswith("limit"))


def _thresholds(space: ParameterSpace) -> list[int]:
    """Limits, and other parameters beyond whose value nothing need change: friction
    that holds, free play, commands that are ignored."""

    def holds(field: str) -> bool:
        return "limit" in field or "friction" in field or field in _HOLDING

    return _named(space, holds)


def _named(space: ParameterSpace, wanted: Callable[[str], bool]) -> list[int]:
    """Parameters with an address whose field, or effect, is ``wanted``."""

    def field(address: str) -> str:
        parts = address.split(".")
        return parts[1] if parts[0] == "effect" else parts[-1]

    return [
        i
        for i, p in enumerate(space.parameters)
        if any(wanted(field(a)) for a in p.addresses)
    ]


def edge(unit: jax.Array, information: jax.Array) -> jax.Array:
    """By how much the cost of a dip must be less than that of the plateau beyond for
    the limit to be sure to be in the dip, with a probability of `_SURE`, ``()``.

    Both are weighed by the evidence (Laplace's approximation, all else held): a dip is
    narrow, and has to make up for that.

    Args:
        unit: where the dip is, in the initial range.
        information: of the limit there.
    """
    plateau = jnp.maximum(1.0 - unit, _NARROW)
    dip = jnp.sqrt(2.0 * jnp.pi / jnp.maximum(information, _UNSEEN))
    return np.log(_SURE / (1.0 - _SURE)) + jnp.maximum(jnp.log(plateau / dip), 0.0)


def beyond_edge(unit: jax.Array, limits: jax.Array, most: jax.Array) -> jax.Array:
    """``unit (n,)`` with ``limits (n,)`` on the plateau beyond the edge of a dip, at
    ``most (n,)``."""
    middle = jnp.minimum(most, jnp.maximum(0.5, unit + _INSIDE))
    return jnp.where(limits, middle, unit)
