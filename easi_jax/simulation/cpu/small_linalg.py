"""Small dense algebra as elementwise code, so that a batch of it vectorizes.

XLA's CPU backend runs a batch of tiny products and factorizations one matrix at a
time, through a general routine for each. For the 2 to 20 degrees of freedom of a
robot that costs far more than the arithmetic. ``unroll_small(f)`` traces ``f``
unbatched and replays it with small ``dot_general``, ``cholesky`` and
``triangular_solve`` written out, before any ``vmap`` is applied. It also takes
batched LAPACK calls, which can deadlock on few cores, out of the program.
"""

from collections.abc import Callable
from functools import wraps
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend import core as jex_core

MAX_PRODUCT = 8192
MAX_FACTOR = 24


def unroll_small(fun: Callable[..., Any]) -> Callable[..., Any]:
    """Returns ``fun`` with its small products and factorizations written out.

    Same inputs, outputs and values up to rounding. Works under ``jit``, ``vmap``,
    ``jvp`` and inside ``scan``.
    """

    @wraps(fun)
    def wrapped(*args: Any) -> Any:
        closed, out_shape = jax.make_jaxpr(fun, return_shape=True)(*args)
        flat = jax.tree.leaves(args)
        outs = _replay(closed.jaxpr, closed.consts, flat)
        return jax.tree.unflatten(jax.tree.structure(out_shape), outs)

    return wrapped


def _replay(jaxpr: Any, consts: Any, args: Any) -> list[Any]:
    env: dict[Any, Any] = {}

    def read(v: Any) -> Any:
        return v.val if isinstance(v, jex_core.Literal) else env[v]

    for var, val in zip(jaxpr.constvars, consts, strict=True):
        env[var] = val
    for var, val in zip(jaxpr.invars, args, strict=True):
        env[var] = val
    for eqn in jaxpr.eqns:
        vals = [read(v) for v in eqn.invars]
        outs = _apply(eqn, vals)
        for var, val in zip(eqn.outvars, outs, strict=True):
            env[var] = val
    return [read(v) for v in jaxpr.outvars]


def _closed(closed: Any) -> Callable[..., list[Any]]:
    return lambda *a: _replay(closed.jaxpr, closed.consts, list(a))


def _apply(eqn: Any, vals: list[Any]) -> list[Any]:
    name, p = eqn.primitive.name, eqn.params
    if name == "dot_general" and _small_product(eqn):
        dtype = eqn.outvars[0].aval.dtype
        return [_product(vals[0], vals[1], p["dimension_numbers"], dtype)]
    if name == "cholesky" and vals[0].ndim == 2 and vals[0].shape[-1] <= MAX_FACTOR:
        return [_cholesky(vals[0])]
    if (
        name == "triangular_solve"
        and vals[0].ndim == 2
        and vals[0].shape[-1] <= MAX_FACTOR
    ):
        return [_triangular_solve(vals[0], vals[1], p)]
    if name in ("jit", "pjit", "closed_call", "core_call", "remat", "checkpoint"):
        inner = p.get("jaxpr") or p["call_jaxpr"]
        if hasattr(inner, "consts"):
            return _replay(inner.jaxpr, inner.consts, vals)
        return _replay(inner, [], vals)
    if name == "while":
        return _while(p, vals)
    if name == "scan":
        return _scan(p, vals)
    if name == "cond":
        branches = [_closed(b) for b in p["branches"]]
        return jax.lax.switch(vals[0], branches, *vals[1:])
    outs = eqn.primitive.bind(*vals, **eqn.primitive.get_bind_params(eqn.params))
    return outs if eqn.primitive.multiple_results else [outs]


def _while(p: dict[str, Any], vals: list[Any]) -> list[Any]:
    nc, nb = p["cond_nconsts"], p["body_nconsts"]
    cc, bc, init = vals[:nc], vals[nc : nc + nb], vals[nc + nb :]
    cond, body = _closed(p["cond_jaxpr"]), _closed(p["body_jaxpr"])
    return jax.lax.while_loop(
        lambda c: cond(*cc, *c)[0], lambda c: body(*bc, *c), list(init)
    )


def scan_sizes(p: dict[str, Any]) -> tuple[int, int]:
    """Numbers of constants and of carried values of a ``scan``."""
    if "ft_in" in p:  # from jax 0.11 on
        consts, carry, _ = p["ft_in"].unpack()
        return len(consts), len(carry)
    return p["num_consts"], p["num_carry"]


def _scan(p: dict[str, Any], vals: list[Any]) -> list[Any]:
    nc, nk = scan_sizes(p)
    consts, init, xs = vals[:nc], vals[nc : nc + nk], vals[nc + nk :]
    body = _closed(p["jaxpr"])

    def step(carry: Any, x: Any) -> Any:
        out = body(*consts, *carry, *x)
        return out[:nk], out[nk:]

    carry, ys = jax.lax.scan(
        step,
        list(init),
        list(xs),
        length=p["length"],
        reverse=p["reverse"],
        unroll=p["unroll"],
    )
    return [*carry, *ys]


def _small_product(eqn: Any) -> bool:
    a, b = (v.aval for v in eqn.invars)
    (ca, _), (ba, _) = eqn.params["dimension_numbers"]
    inner = int(np.prod([a.shape[i] for i in ca], dtype=int))
    batch = int(np.prod([a.shape[i] for i in ba], dtype=int))
    if not inner or not a.size or not b.size:
        return False
    flops = a.size * b.size // (inner * batch)
    return flops <= MAX_PRODUCT and jnp.issubdtype(a.dtype, jnp.floating)


def _product(a: Any, b: Any, dims: Any, dtype: Any) -> jax.Array:
    (ca, cb), (ba, bb) = dims
    fa = [i for i in range(a.ndim) if i not in (*ca, *ba)]
    fb = [i for i in range(b.ndim) if i not in (*cb, *bb)]
    a = jnp.transpose(a, (*ba, *fa, *ca))
    b = jnp.transpose(b, (*bb, *fb, *cb))
    nb, na, nf, nk = len(ba), len(fa), len(fb), len(ca)
    a = jnp.reshape(a, (*a.shape[: nb + na], *(1,) * nf, *a.shape[nb + na :]))
    b = jnp.reshape(b, (*b.shape[:nb], *(1,) * na, *b.shape[nb:]))
    out = a * b
    if nk:
        # One contracted axis of a few entries: explicit sums fuse, a reduce may not.
        k = int(np.prod(out.shape[out.ndim - nk :]))
        out = out.reshape((*out.shape[: out.ndim - nk], k))
        if k <= 8:
            total = out[..., 0]
            for i in range(1, k):
                total = total + out[..., i]
            out = total
        else:
            out = out.sum(-1)
    return out.astype(dtype)


def _cholesky(a: jax.Array) -> jax.Array:
    n = a.shape[-1]
    cols: list[list[Any]] = [[None] * n for _ in range(n)]
    zero = jnp.zeros((), a.dtype)
    if n <= 6:
        for j in range(n):
            d = a[j, j]
            for k in range(j):
                d = d - cols[k][j] * cols[k][j]
            d = jnp.sqrt(d)
            r = 1.0 / d
            for i in range(j):
                cols[j][i] = zero
            cols[j][j] = d
            for i in range(j + 1, n):
                s = a[i, j]
                for k in range(j):
                    s = s - cols[k][i] * cols[k][j]
                cols[j][i] = s * r
        return jnp.stack([jnp.stack(c) for c in cols], axis=1)
    rows = jnp.arange(n)
    done = []
    for j in range(n):
        c = jnp.where(rows >= j, a[:, j] / jnp.sqrt(a[j, j]), 0.0)
        done.append(c)
        a = a - c[:, None] * c[None, :]
    return jnp.stack(done, axis=1)


def _triangular_solve(a: jax.Array, b: jax.Array, p: dict[str, Any]) -> jax.Array:
    if not p["left_side"]:
        # x a = b  <=>  a' x' = b'
        q = {**p, "left_side": True, "transpose_a": not p["transpose_a"]}
        return _triangular_solve(a, b.T, q).T
    lower = p["lower"]
    if p["transpose_a"]:
        a, lower = a.T, not lower
    n = a.shape[0]
    order = range(n) if lower else range(n - 1, -1, -1)
    x: list[Any] = [None] * n
    done: list[int] = []
    for i in order:
        s = b[i]
        for k in done:
            s = s - a[i, k] * x[k]
        x[i] = s if p["unit_diagonal"] else s / a[i, i]
        done.append(i)
    return jnp.stack(x)


__all__ = ["unroll_small"]
