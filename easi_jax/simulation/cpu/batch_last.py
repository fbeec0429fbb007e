"""Batches in the last axis, where a compiled loop over them is pure SIMD.

`jax.vmap` puts the batch first, and XLA's CPU backend then works through small
matrices one at a time. A function for `lanes` sees arrays ``(..., lanes)`` instead and
computes on whole rows of a batch; every loop that XLA makes of it has the batch inside.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap

Hold = Callable[[jax.Array], jax.Array]


def lanes(fun: Callable[..., Any]) -> Callable[..., Any]:
    """Returns ``fun``, written for arrays with a trailing batch axis, for arrays
    without one.

    ``fun`` takes and returns pytrees of arrays ``(..., lanes)``; arguments that are the
    same for the whole batch have one lane, results must have all. `jax.vmap`, also
    nested, then adds lanes.
    """

    @custom_vmap
    def call(*args: Any) -> Any:
        return fun(*args)

    def rule(size: int, batched: Any, *args: Any) -> tuple[Any, Any]:
        leaves, tree = jax.tree.flatten(args)
        width = max(x.shape[-1] for x in leaves)

        def merge(x: jax.Array, with_batch: bool) -> jax.Array:
            if not with_batch:
                return x if x.shape[-1] == 1 else jnp.repeat(x, size, -1)
            x = jnp.moveaxis(x, 0, -1)
            x = jnp.broadcast_to(x, (*x.shape[:-2], width, size))
            return x.reshape(*x.shape[:-2], width * size)

        flags = jax.tree.leaves(batched)
        merged = [merge(x, b) for x, b in zip(leaves, flags, strict=True)]
        out = call(*jax.tree.unflatten(tree, merged))

        def split(y: jax.Array) -> jax.Array:
            return jnp.moveaxis(y.reshape(*y.shape[:-1], width, size), -1, 0)

        return jax.tree.map(split, out), jax.tree.map(lambda _: True, out)

    call.def_vmap(rule)

    def wrapped(*args: Any) -> Any:
        out = call(*jax.tree.map(lambda x: jnp.asarray(x)[..., None], args))
        return jax.tree.map(lambda y: y[..., 0], out)

    return wrapped


def from_stored(fun: Callable[..., Any], args: Sequence[Any], alive: jax.Array) -> Any:
    """``fun(*args)`` with its arguments stored first, and all with all lanes.

    Without it XLA fuses what makes an argument into each of its uses.

    Args:
        fun: of arrays ``(..., lanes)``.
        args: arrays with one or all lanes.
        alive: condition ``(lanes,)`` that holds wherever there is a result; where it
            holds in no lane, the results are NaN.
    """
    width = max(x.shape[-1] for x in args)
    given = [jnp.broadcast_to(x, (*x.shape[:-1], width)) for x in args]
    shapes = jax.eval_shape(fun, *given)

    def nothing(*_: Any) -> Any:
        return jax.tree.map(lambda s: jnp.full(s.shape, jnp.nan, s.dtype), shapes)

    # Operands of a branch are stored, and what is inside it stays inside.
    return jax.lax.cond(jnp.any(alive), fun, nothing, *given)


def holding(ones: jax.Array) -> Hold:
    """Returns the identity, through which XLA does not fuse what came before.

    XLA's CPU backend computes a fused value again for each row that it is spread
    over, unless its last operation counts as expensive; a division does.

    Args:
        ones: ``(rows, lanes)``, all one, but not so that XLA could know. Values of up
            to ``rows`` rows can be held.
    """

    def hold(x: jax.Array) -> jax.Array:
        return x / (ones[0] if x.ndim == 1 else ones[: x.shape[0]])

    return hold


def secret_ones(x: jax.Array) -> jax.Array:
    """Ones of the shape of ``x``, which XLA cannot fold."""
    return jnp.minimum(jnp.abs(x), 0.0) + 1.0


def total(terms: Sequence[jax.Array]) -> jax.Array:
    """A sum written out: XLA's reductions do not vectorize over lanes."""
    out = terms[0]
    for term in terms[1:]:
        out = out + term
    return out


def row_sum(x: jax.Array) -> jax.Array:
    """``(rows, lanes)`` to ``(lanes,)``."""
    return total([x[i] for i in range(x.shape[0])])


def product(a: jax.Array, x: Sequence[jax.Array] | jax.Array) -> jax.Array:
    """``a @ x`` for ``a`` ``(rows, n, lanes)`` and ``x`` ``(n, lanes)``."""
    return total([a[:, k] * x[k] for k in range(a.shape[1])])


def transposed_product(a: jax.Array, x: jax.Array) -> jax.Array:
    """``a.T @ x`` for ``a`` ``(n, columns, lanes)`` and ``x`` ``(n, lanes)``."""
    return total([a[r] * x[r] for r in range(a.shape[0])])


def factor(
    column: Callable[[int], jax.Array], size: int, hold: Hold
) -> list[jax.Array]:
    """Cholesky factor, left-looking.

    Args:
        column: ``column(j)`` is the lower part of column j, ``(size - j, lanes)``.
        size: rows.
        hold: see `holding`.

    Returns:
        The factor's columns, ``(size - j, lanes)`` each.
    """
    done: list[jax.Array] = []
    for j in range(size):
        c = hold(column(j))
        if j:
            c = hold(c - total([done[k][j - k :] * done[k][j - k] for k in range(j)]))
        done.append(hold(c / hold(jnp.sqrt(c[0]))))
    return done


def solve_lower(
    columns: list[jax.Array], b: Sequence[jax.Array] | jax.Array, hold: Hold
) -> list[jax.Array]:
    """Solves ``L y = b``; rows of ``y``, ``(lanes,)`` each."""
    y: list[jax.Array] = []
    for j in range(len(columns)):
        terms = [columns[k][j - k] * y[k] for k in range(j)]
        y.append(hold((b[j] - total(terms) if terms else b[j]) / columns[j][0]))
    return y


def solve_upper(
    columns: list[jax.Array], y: Sequence[jax.Array] | jax.Array, hold: Hold
) -> list[jax.Array]:
    """Solves ``L.T x = y``; rows of ``x``, ``(lanes,)`` each."""
    n = len(columns)
    x: list[Any] = [None] * n
    for j in range(n - 1, -1, -1):
        terms = [columns[j][i - j] * x[i] for i in range(j + 1, n)]
        x[j] = hold((y[j] - total(terms) if terms else y[j]) / columns[j][0])
    return x
