"""Small matrices written out give what the library routines give."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from jax.scipy.linalg import cho_factor, cho_solve, solve_triangular

from easi_jax.simulation.cpu.small_linalg import unroll_small

RNG = np.random.default_rng(0)
A = RNG.normal(size=(4, 5))
B = RNG.normal(size=(5, 3))
X = RNG.normal(size=5)
T = RNG.normal(size=(2, 4, 5))
U = RNG.normal(size=(2, 5, 6))


def spd(n: int) -> np.ndarray:
    a = RNG.normal(size=(n, n))
    return a @ a.T + n * np.eye(n)


S4, S9 = spd(4), spd(9)
PRODUCTS: dict[str, tuple[Callable[..., Any], tuple[np.ndarray, ...]]] = {
    "matrix_matrix": (jnp.matmul, (A, B)),
    "matrix_vector": (jnp.matmul, (A, X)),
    "inner": (jnp.dot, (X, X)),
    "outer": (jnp.outer, (X, X)),
    "batched": (jnp.matmul, (T, U)),
    "two_contracted": (lambda a, b: jnp.einsum("bij,bij->b", a, b), (T, T)),
    "all_contracted": (lambda a, b: jnp.tensordot(a, b, 3), (T, T)),
    "transposed": (lambda a, b: jnp.einsum("ji,kj->ik", a, b), (B, A)),
    "long_sum": (jnp.matmul, (RNG.normal(size=(3, 40)), RNG.normal(size=(40, 2)))),
}
FACTORS: dict[str, tuple[Callable[..., Any], tuple[np.ndarray, ...]]] = {
    "cholesky_written": (jnp.linalg.cholesky, (S4,)),
    "cholesky_columns": (jnp.linalg.cholesky, (S9,)),
    "solve_spd": (lambda a, b: cho_solve(cho_factor(a), b), (S9, RNG.normal(size=9))),
}
for _side in (True, False):
    for _lower in (True, False):
        for _transpose in (True, False):
            for _unit in (True, False):
                FACTORS[f"tri_{_side:d}{_lower:d}{_transpose:d}{_unit:d}"] = (
                    lambda a, b, s=_side, lo=_lower, t=_transpose, u=_unit: (
                        lax.linalg.triangular_solve(
                            a, b, left_side=s, lower=lo, transpose_a=t, unit_diagonal=u
                        )
                    ),
                    (S4, RNG.normal(size=(4, 3) if _side else (3, 4))),
                )
CASES = {**PRODUCTS, **FACTORS}
LIBRARY = ("dot_general", "cholesky", "triangular_solve")


@pytest.mark.parametrize("name", CASES)
def test_equals_the_library(name: str) -> None:
    f, args = CASES[name]
    with jax.enable_x64(True):
        want, got = f(*map(jnp.asarray, args)), unroll_small(f)(*map(jnp.asarray, args))
        text = str(jax.make_jaxpr(unroll_small(f))(*args))
    assert got.shape == want.shape and got.dtype == want.dtype
    np.testing.assert_allclose(got, want, rtol=1e-12, atol=1e-12)
    assert not any(p in text for p in LIBRARY)


def nested(a: jax.Array, x: jax.Array) -> jax.Array:
    """Products and a solve inside scan, while and cond."""

    def body(carry: jax.Array, s: jax.Array) -> Any:
        y = cho_solve(cho_factor(a + s * jnp.eye(4)), carry)
        y = lax.cond(y[0] > 0.05, lambda v: a @ v / 20, lambda v: v - 1.0, y)
        return y, y @ y

    y, norms = lax.scan(body, x, jnp.arange(5.0), reverse=True)
    start = (0, solve_triangular(a, y, lower=True))
    _, z = lax.while_loop(
        lambda c: c[0] < 3, lambda c: (c[0] + 1, jnp.tanh(a @ c[1])), start
    )
    return jnp.concatenate([z, norms])


def test_control_flow_vmap_and_jvp() -> None:
    with jax.enable_x64(True):
        a = jnp.asarray(S4)
        xs = jnp.asarray(RNG.normal(size=(6, 4)))
        unrolled = unroll_small(nested)
        assert not any(p in str(jax.make_jaxpr(unrolled)(a, xs[0])) for p in LIBRARY)
        want = jnp.stack([nested(a, x) for x in xs])
        got = jax.jit(jax.vmap(unrolled, (None, 0)))(a, xs)
        np.testing.assert_allclose(got, want, rtol=1e-10, atol=1e-12)
        tangent = jnp.eye(4) + 0.1
        slopes = [
            jax.jvp(lambda m, f=f: f(m, xs[0]), (a,), (tangent,))[1]
            for f in (nested, unrolled)
        ]
        assert np.abs(slopes[0]).max() > 1e-4
        np.testing.assert_allclose(slopes[1], slopes[0], rtol=1e-9, atol=1e-12)


def test_large_and_whole_number_products_stay_with_the_library() -> None:
    big = jnp.ones((64, 64))
    assert "dot_general" in str(jax.make_jaxpr(unroll_small(jnp.matmul))(big, big))
    whole = jnp.ones((3, 3), jnp.int32)
    assert "dot_general" in str(jax.make_jaxpr(unroll_small(jnp.matmul))(whole, whole))
    np.testing.assert_array_equal(unroll_small(jnp.matmul)(whole, whole), 3)


def test_trees_in_and_out() -> None:
    def f(tree: dict[str, jax.Array]) -> dict[str, Any]:
        return {"y": (tree["a"] @ tree["b"], tree["a"])}

    out = unroll_small(f)({"a": jnp.asarray(A), "b": jnp.asarray(B)})
    assert set(out) == {"y"} and out["y"][1].shape == (4, 5)
    np.testing.assert_allclose(out["y"][0], A @ B, rtol=1e-5)
