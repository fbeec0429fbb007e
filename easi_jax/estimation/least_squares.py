"""One bounded least-squares step, for every fit of parameters and of effects.

The damped Gauss-Newton step within bounds, the rules of damping and of stopping, and
the code of a result. What a fit is special by (jumps over limits, weights of pieces,
several starts, derivatives by differences or followed) stands beside it. Functions are
pure; any of their arrays may have leading batch axes. Those of ``A`` take arrays of
NumPy, in double precision, as well as those of a jax program.
"""

from dataclasses import dataclass
from typing import Any, TypeVar, get_args

import jax
import jax.numpy as jnp
import numpy as np

from easi_jax.model.parameters import ParameterSpace
from easi_jax.model.results import Outcome

A = TypeVar("A", np.ndarray, jax.Array)

OUTCOMES: tuple[Outcome, ...] = get_args(Outcome)
CONVERGED, AT_BOUND, NOT_DETERMINED, DIVERGED = range(len(OUTCOMES))


def array_module(x: Any) -> Any:
    """jax's or NumPy's functions, by an array."""
    return jnp if isinstance(x, jax.Array) else np


def held_back(x: A, gradient: A, low: A, high: A) -> A:
    """Which entries a bound holds back from a step downhill, ``(..., n)``."""
    return (x <= low) & (gradient > 0) | (x >= high) & (gradient < 0)


def bounded_step(
    hessian: A,
    gradient: A,
    free: A,
    damping: float | A = 0.0,
    *,
    within: tuple[A, A] | None = None,
    dim: float = 0.0,
) -> A:
    """Damped Gauss-Newton step, ``(..., n)``.

    By powers of ten, Fisher information spans more than single precision has, so the
    system is solved with a unit diagonal.

    Args:
        hessian: of the data and of what is known before, ``(..., n, n)``; its diagonal
            is above zero.
        gradient: of the cost, ``(..., n)``.
        free: what takes part, ``(..., n)``; the step is zero elsewhere.
        damping: of each step, ``(...)``, relative to the diagonal.
        within: bounds of the step, below and above zero, ``(..., n)`` each. Entries
            that would leave them stop there, and the others are solved for anew; n
            systems at most. Without it, one system.
        dim: least diagonal that damping assumes, relative to the largest: differences
            of no slope would make steps of any length.
    """
    xp = array_module(hessian)
    seen = xp.diagonal(hessian, axis1=-2, axis2=-1)
    scale = xp.where(free, 1.0 / xp.sqrt(seen), 0.0)
    lift = xp.asarray(damping)[..., None]
    if dim:
        lift = lift * xp.maximum(1.0, dim * seen.max(-1, keepdims=True) / seen)
    scaled, one = (
        hessian * scale[..., None] * scale[..., None, :],
        xp.eye(scale.shape[-1]),
    )

    def solved(free: Any, pull: Any) -> Any:
        among = free[..., None] & free[..., None, :]
        matrix = xp.where(among, scaled, one) + lift[..., None] * one
        right = xp.where(free, scale * pull, 0.0)
        return -scale * xp.linalg.solve(matrix, right[..., None])[..., 0]

    def beyond(step: Any) -> Any:
        return (step < low) | (step > high)

    def stop(state: Any) -> Any:
        step, stopped = state
        stopped = stopped | beyond(step)
        still = xp.where(stopped, xp.clip(step, low, high), 0.0)
        pull = gradient + (hessian @ still[..., None])[..., 0]
        return xp.where(stopped, still, solved(free & ~stopped, pull)), stopped

    step = solved(free, gradient)
    if within is None:
        return step
    low, high = within
    loop = jax.lax.while_loop if xp is jnp else _while
    return loop(lambda s: beyond(s[0]).any(), stop, (step, xp.zeros(step.shape, bool)))[
        0
    ]


def _while(going: Any, body: Any, state: Any) -> Any:
    while going(state):
        state = body(state)
    return state


@dataclass(frozen=True)
class Damping:
    """How damping goes on after a step.

    Attributes:
        falls, rises: factors after a step that helped, and after one that did not.
        least, most: of the damping.
        wakes: least damping after a step that did not help.
    """

    falls: float
    rises: float
    least: float = 0.0
    most: float = np.inf
    wakes: float = 0.0

    def after(self, damping: Any, helped: Any) -> Any:
        """The next damping, ``(...)``, after a step with this one."""
        xp = array_module(damping)
        risen = xp.maximum(self.rises * damping, self.wakes)
        new = xp.where(helped, self.falls * damping, risen)
        return xp.clip(new, self.least, self.most)


def is_settled(gain: Any, cost: Any, least: float, share: Any) -> Any:
    """Whether a fit's last ``gain`` in cost, ``(...)``, says that there is no more to
    gain: by less than ``least`` data cannot tell two results apart, by less than a
    ``share`` of the ``cost`` the fit cannot."""
    return gain <= least + share * cost


def flag_codes(x: A, low: A, high: A, determined: A, near: Any = 0.0) -> A:
    """Code of each entry ``(..., n)``: at a bound, to within ``near``; else whether the
    data determine it."""
    xp = array_module(x)
    at_bound = (x <= low + near) | (x >= high - near)
    known = xp.where(determined, CONVERGED, NOT_DETERMINED)
    return xp.where(at_bound, AT_BOUND, known)


def result_code(flags: A, finite: Any = True) -> A:
    """Code of a result ``(...)``, of which every number is ``finite``, by the codes of
    its entries ``(..., n)``: not determined where all are, at a bound where one is."""
    xp = array_module(flags)
    lost = (flags == NOT_DETERMINED).all(-1)
    bound = xp.where((flags == AT_BOUND).any(-1), AT_BOUND, CONVERGED)
    return xp.where(finite, xp.where(lost, NOT_DETERMINED, bound), DIVERGED)


def inverted(information: A, prior: A, resolved: float) -> tuple[A, A]:
    """Covariance ``(n, n)`` of what ``information (n, n)`` and a ``prior (n,)`` of each
    entry know, and the variance along what the information shows alone, ``(n,)``.

    Information spans ten decades, and rounding leaves noise where it should be zero
    that a plain inverse would take for knowledge. So it is scaled to a unit diagonal,
    what is at most ``resolved`` there counts as not seen, and seen and unseen are
    inverted apart.
    """
    xp = array_module(information)
    size = xp.sqrt(xp.maximum(xp.diag(information), prior))
    scaled = information / size[:, None] / size
    values, vectors = xp.linalg.eigh(0.5 * (scaled + scaled.T))
    seen = values > resolved
    known = vectors.T @ (vectors * (prior / size**2)[:, None])
    total = xp.where(seen[:, None] == seen, known, 0.0)
    total = total + xp.diag(xp.where(seen, values, 0.0))
    root = xp.sqrt(xp.diag(total))
    back = vectors / size[:, None] / root
    inverse = xp.linalg.inv(total / root[:, None] / root)
    shown = xp.sum((back * seen) @ inverse * (back * seen), 1)
    return back @ inverse @ back.T, shown


def moved(space: ParameterSpace, unit: jax.Array, du: jax.Array) -> jax.Array:
    """``unit`` moved by ``du (..., n)`` along the SI values themselves.

    On a logarithmic scale a parameter near zero has no slope, and a step that
    overshoots towards zero would never come back: it moves by a factor of ten at most.
    From below its initial range it may return by more, for steps of all others count
    on it: to ten times the low end.
    """
    most = 10.0 * jnp.exp(-space.log_width * jnp.minimum(unit, 0.0))
    ratio = jnp.clip(1.0 + space.log_width * du, 0.1, most)
    return unit + jnp.where(space.log, jnp.log(ratio) / space.log_width, du)


def raised_to_range(space: ParameterSpace, unit: jax.Array) -> jax.Array:
    """``unit`` with logarithms raised to the low end of their initial range: further
    down they have no slope, and no way back."""
    return jnp.where(space.log, jnp.maximum(unit, 0.0), unit)
