"""Scalar code equals the arrays it came from, operation by operation."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from easi_jax.simulation import step as physics
from easi_jax.simulation.cpu.unroll import _Replay, entries, scalarized
from envs.cartpole import Cartpole

A = np.array([[2.0, 0.3, 0.1], [0.3, 1.5, -0.2], [0.1, -0.2, 1.1]], np.float32)
X = np.array([0.4, -1.3, 2.2], np.float32)

PROGRAMS: dict[str, Callable[..., Any]] = {
    "product": lambda a, x: a @ x,
    "products": lambda a, x: jnp.einsum("ij,jk,k->i", a, a, x),
    "outer": lambda a, x: jnp.outer(x, x) + a.T,
    "cholesky": lambda a, x: jax.scipy.linalg.cho_solve(
        jax.scipy.linalg.cho_factor(a), x
    ),
    "triangular, from the right": lambda a, x: jax.lax.linalg.triangular_solve(
        a, x[None], left_side=False, lower=True, transpose_a=True
    ),
    "sums": lambda a, x: (a.sum(), a.sum(0), a.max(1), a.min(), jnp.cumsum(x)),
    "any": lambda a, x: jnp.any(a > x, axis=0) & ~jnp.all(a < x, axis=1),
    "select": lambda a, x: jnp.where(x > 0, jnp.sin(x), x**3) / (1 + x * x),
    "clip": lambda a, x: jnp.clip(x, -1.0, jnp.inf),
    "gather": lambda a, x: a[jnp.array([2, 0])][:, jnp.array([1, 1, 2])],
    "gather outside": lambda a, x: x.at[jnp.array([1, 7])].get(
        mode="fill", fill_value=9.0
    ),
    "gather at a traced place": lambda a, x: x[jnp.argmax(x)],
    "set": lambda a, x: a.at[jnp.array([0, 2]), 1].set(x[:2]),
    "add twice": lambda a, x: x.at[jnp.array([1, 1, 0])].add(x),
    "pad and shift": lambda a, x: jnp.roll(jnp.pad(x, (1, 2)), 2)[::-1],
    "stack": lambda a, x: jnp.stack([x, 2 * x, jnp.tile(x[:1], 3)], axis=1),
    "sort": lambda a, x: jnp.sort(x),
    "integers": lambda a, x: x[(jnp.arange(3) * 7 - 4) // 3 % 3],
    "short loop": lambda a, x: jax.lax.fori_loop(0, 3, lambda i, y: a @ y * 0.5, x),
    "long loop": lambda a, x: jax.lax.fori_loop(0, 30, lambda i, y: a @ y * 0.4, x),
    "scan": lambda a, x: jax.lax.scan(
        lambda c, r: (c + r @ x, c * r), 0.0, a, reverse=True
    ),
    "while": lambda a, x: jax.lax.while_loop(
        lambda y: y.sum() < 9, lambda y: y * y + 1, x
    ),
    "branch": lambda a, x: jax.lax.cond(x[0] > 0, jnp.sin, jnp.cos, x),
    "known branch": lambda a, x: jax.lax.switch(1, [jnp.sin, jnp.cos], x),
    "known alone": lambda a, x: jnp.arange(4.0) ** 2,
    "zeros": lambda a, x: (0 * x + 1 * x - 0) * jnp.array([0.0, 1.0, 2.0]),
    "nothing": lambda a, x: x[:0],
}


@pytest.mark.parametrize("name", PROGRAMS)
def test_equals_the_arrays(name: str) -> None:
    fun = PROGRAMS[name]
    expected = fun(jnp.asarray(A), jnp.asarray(X))
    found = jax.jit(scalarized(fun))(A, X)
    jax.tree.map(_same, found, expected)
    many = np.stack([X, X + 0.1, X[::-1]])
    batch = jax.jit(jax.vmap(scalarized(fun), (None, 0)))(A, many)
    jax.tree.map(_same, batch, jax.vmap(fun, (None, 0))(jnp.asarray(A), many))


def _same(a: jax.Array, b: jax.Array) -> None:
    assert (a.shape, a.dtype) == (b.shape, b.dtype)
    np.testing.assert_allclose(a, b, rtol=2e-5, atol=2e-6)


@pytest.mark.parametrize("name", ["cholesky", "select", "sums", "scan", "add twice"])
def test_derivatives_are_the_same(name: str) -> None:
    fun = PROGRAMS[name]
    for known in (jax.jacfwd, jax.jacrev):
        expected = known(fun, 1)(jnp.asarray(A), jnp.asarray(X))
        found = jax.jit(known(scalarized(fun), 1))(jnp.asarray(A), jnp.asarray(X))
        jax.tree.map(_same, found, expected)


def test_what_is_known_leaves_no_code() -> None:
    rotation = np.eye(3, dtype=np.float32)

    def fun(known: jax.Array, x: jax.Array) -> jax.Array:
        return (known @ x)[jnp.array([2, 1, 0])] + known[0] * 0

    found = jax.make_jaxpr(lambda x: scalarized(fun)(rotation, x))(X)
    names = {e.primitive.name for e in _inside(found.jaxpr)}
    assert not names & {"mul", "add", "dot_general", "gather"}
    np.testing.assert_array_equal(
        jax.jit(lambda x: scalarized(fun)(rotation, x))(X), X[::-1]
    )


def _inside(jaxpr: Any) -> list[Any]:
    out = []
    for eqn in jaxpr.eqns:
        inner = eqn.params.get("jaxpr")
        out += _inside(inner.jaxpr) if inner is not None else [eqn]
    return out


def test_another_known_value_is_another_program() -> None:
    fun = scalarized(lambda scale, x: scale * x)
    for scale in (2.0, 3.0, 2.0):
        found = jax.jit(lambda x, s=scale: fun(np.float32(s), x))(X)
        np.testing.assert_array_equal(found, np.float32(scale) * X)


def test_long_programs_go_the_other_way(monkeypatch: pytest.MonkeyPatch) -> None:
    called = []

    def other(x: jax.Array) -> jax.Array:
        called.append(x)
        return jnp.cos(x)

    monkeypatch.setattr("easi_jax.simulation.cpu.unroll.MAX_ENTRIES", 2)
    jax.jit(scalarized(jnp.cos, otherwise=other))(X)
    assert called
    assert entries(jax.make_jaxpr(jnp.cos)(X).jaxpr) == 3


def test_one_step_of_cartpole_is_all_scalar(
    cartpole: Cartpole, monkeypatch: pytest.MonkeyPatch
) -> None:
    left = []
    whole = _Replay.whole

    def spy(self: _Replay, eqn: Any, xs: Any) -> Any:
        if not all(isinstance(e, np.generic) for x in xs for e in x.flat):
            left.append(eqn.primitive.name)
        return whole(self, eqn, xs)

    monkeypatch.setattr(_Replay, "whole", spy)
    simulator, n = cartpole.simulator, 16
    keys = jax.random.split(jax.random.key(0), n)
    unit = jax.vmap(lambda k: jax.random.uniform(k, (cartpole.space.size,)))(keys)
    qpos, qvel = (
        jax.random.normal(jax.random.key(i), (n, 2)) * jnp.array([0.2, 0.5])
        for i in (1, 2)
    )
    ctrl = jax.random.uniform(jax.random.key(3), (n, 1), minval=-0.3, maxval=0.3)

    def one(step: Any, u: Any, q: Any, v: Any, c: Any) -> Any:
        model = simulator.model(cartpole.space.to_si(u))
        return step(model, simulator.start(q, v), c)

    def batch(step: Any) -> Any:
        return jax.jit(jax.vmap(lambda *a: one(step, *a)))(unit, qpos, qvel, ctrl)

    found = batch(scalarized(physics.substep))
    assert left == []
    expected = batch(physics.substep)
    np.testing.assert_allclose(found.qpos, expected.qpos, atol=1e-6)
    np.testing.assert_allclose(found.qvel, expected.qvel, atol=2e-5)


_GATHER = {
    "rows": jax.lax.GatherDimensionNumbers((1,), (0,), (0,)),
    "windows": jax.lax.GatherDimensionNumbers((0, 2), (), (1, 0)),
    "along": jax.lax.GatherDimensionNumbers((1,), (), (1,), (0,), (0,)),
}
_SIZES = {"rows": (1, 2), "windows": (2, 3), "along": (1, 2)}
_INDEX = {
    "rows": [[0], [3], [4], [-1]],
    "windows": [[1, 0], [2, 3], [3, 2], [-1, 1]],
    "along": [[0], [3], [4], [-2]],
}
_MODES = ("clip", "fill")


@pytest.mark.parametrize("mode", _MODES)
@pytest.mark.parametrize("kind", _GATHER)
def test_windows_are_read_and_written_where_they_are(kind: str, mode: str) -> None:
    """Some lie outside, in whole or in part."""
    dims, index = _GATHER[kind], jnp.array(_INDEX[kind])
    x = np.arange(20.0, dtype=np.float32).reshape(4, 5) + 1

    def read(x: jax.Array) -> jax.Array:
        return jax.lax.gather(x, index, dims, _SIZES[kind], mode=mode, fill_value=7)

    def write(x: jax.Array, new: jax.Array) -> tuple[jax.Array, ...]:
        at = jax.lax.ScatterDimensionNumbers(
            dims.offset_dims,
            dims.collapsed_slice_dims,
            dims.start_index_map,
            dims.operand_batching_dims,
            dims.start_indices_batching_dims,
        )
        return tuple(
            f(x, index, new, at, mode=mode)
            for f in (jax.lax.scatter_add, jax.lax.scatter_mul)
        )

    found = read(jnp.asarray(x))
    _same(jax.jit(scalarized(read))(x), found)
    new = np.random.default_rng(0).normal(size=found.shape).astype(np.float32)
    expected = write(jnp.asarray(x), jnp.asarray(new))
    jax.tree.map(_same, jax.jit(scalarized(write))(x, new), expected)


@pytest.mark.parametrize("windows", [0, 2])
def test_windows_of_an_array_without_entries(windows: int) -> None:
    """A model that lacks a kind of object still has that kind's arrays."""
    x, index = jnp.zeros((0, 2)), jnp.zeros((windows, 1), int)
    dims = jax.lax.ScatterDimensionNumbers((1,), (0,), (0,))

    def write(x: jax.Array, new: jax.Array) -> tuple[jax.Array, ...]:
        found = jax.lax.scatter_add(x, index, new, dims, mode="fill")
        return found, jnp.sum(new, initial=1.0)

    new = jnp.ones((windows, 2))
    jax.tree.map(_same, jax.jit(scalarized(write))(x, new), write(x, new))
