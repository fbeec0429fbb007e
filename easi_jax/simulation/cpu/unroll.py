"""Small array programs as scalar code, so that a batch of them is pure SIMD.

A step of a small robot works on arrays of two to ten entries. Batched, XLA's CPU
backend walks them row by row, and most of the work is done on entries that are known:
zeros of a rotation about one axis, constraint rows of fixed kind, index arithmetic.
``scalarized(f)`` traces ``f`` unbatched and replays it with one value per *entry*:
what is known is computed once in NumPy and folded away (``0 * x``, ``select`` on a
known condition, gathers at known indices, repeated subexpressions), what is left is
elementwise code over the batch. Same values up to rounding.
"""

import math
import operator
from collections import OrderedDict
from collections.abc import Callable, Iterable, Sequence
from functools import wraps
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.extend import core as jex_core

MAX_ENTRIES = 60_000  # computed by all operations together: beyond, code gets too long
_REMEMBERED = 32  # programs
_UNROLLED = 8  # steps of an inner scan that are written out

Entries = np.ndarray  # of objects: NumPy scalars (known) or traced scalars


def scalarized(
    fun: Callable[..., Any], otherwise: Callable[..., Any] | None = None
) -> Callable[..., Any]:
    """Returns ``fun`` with every entry of its arrays a value of its own.

    Arguments that are concrete when it is called are taken as known. Works under
    ``jit``, ``vmap``, ``jvp`` and inside ``scan``; what has no scalar form (a sort, a
    loop) runs as it is. Where ``fun`` computes more than `MAX_ENTRIES`, ``otherwise``
    (default ``fun`` itself) is called instead.
    """

    programs: OrderedDict[Any, Callable[..., Any]] = OrderedDict()

    @wraps(fun)
    def wrapped(*args: Any) -> Any:
        leaves, tree = jax.tree.flatten(args)
        if not any(isinstance(x, Tracer) for x in leaves):
            return fun(*args)
        key = (tree, jax.dtypes.canonicalize_dtype(float), *(_token(x) for x in leaves))
        if key not in programs:
            programs[key] = _build(fun, otherwise or fun, args)
            if len(programs) > _REMEMBERED:
                programs.popitem(last=False)
        programs.move_to_end(key)
        return programs[key](*args)

    return wrapped


def _token(x: Any) -> Any:
    """What a program depends on: the type of an argument, or its value if known."""
    if isinstance(x, Tracer):
        return jax.typeof(x)
    value = np.asarray(x)
    return value.dtype.str, value.shape, value.tobytes()


def _build(
    fun: Callable[..., Any], otherwise: Callable[..., Any], args: Any
) -> Callable[..., Any]:
    closed, shapes = jax.make_jaxpr(fun, return_shape=True)(*args)
    if entries(closed.jaxpr) > MAX_ENTRIES:
        return otherwise
    known = [
        None if isinstance(x, Tracer) else _split(np.asarray(x, v.dtype))
        for x, v in zip(jax.tree.leaves(args), closed.in_avals, strict=True)
    ]

    def replay(*unknown: Any) -> Any:
        given = iter(unknown)
        inputs = [_split(next(given)) if k is None else k for k in known]
        consts = [_split(x) for x in closed.consts]
        outs = _Replay().run(closed.jaxpr, consts, inputs)
        return [
            _join(out, v.aval)
            for out, v in zip(outs, closed.jaxpr.outvars, strict=True)
        ]

    # Under jit, what vmap and jvp make of it is remembered as well.
    program = jax.jit(replay)

    def call(*args: Any) -> Any:
        leaves = jax.tree.leaves(args)
        out = program(*(x for x, k in zip(leaves, known, strict=True) if k is None))
        return jax.tree.unflatten(jax.tree.structure(shapes), out)

    return call


def entries(jaxpr: Any) -> int:
    """Entries that all operations of ``jaxpr`` compute together."""
    total = 0
    for eqn in jaxpr.eqns:
        inner = _inner(eqn)
        if inner is not None:
            total += entries(inner.jaxpr)
        else:
            total += sum(getattr(v.aval, "size", 1) for v in eqn.outvars)
    return total


def _inner(eqn: Any) -> Any:
    name = eqn.primitive.name
    if name in ("jit", "pjit", "closed_call", "core_call", "custom_jvp_call"):
        return eqn.params.get("jaxpr") or eqn.params["call_jaxpr"]
    return None


def scan_sizes(p: dict[str, Any]) -> tuple[int, int]:
    """Numbers of constants and of carried values of a ``scan``."""
    if "ft_in" in p:  # from jax 0.11 on
        consts, carry, _ = p["ft_in"].unpack()
        return len(consts), len(carry)
    return p["num_consts"], p["num_carry"]


def _known(x: Any) -> bool:
    return isinstance(x, np.generic)


def _all_known(x: Entries) -> bool:
    return all(_known(e) for e in x.flat)


def _split(x: Any) -> Entries:
    """An array as an array of its entries."""
    out = np.empty(np.shape(x), object)
    if isinstance(x, Tracer):
        for i in np.ndindex(out.shape):
            out[i] = x[i] if i else x
    else:
        values = np.asarray(x)
        for i in np.ndindex(out.shape):
            out[i] = values[i]
    return out


def _values(x: Entries, dtype: Any) -> np.ndarray:
    return np.array([e for e in x.flat], dtype).reshape(x.shape)


def _join(x: Entries, aval: Any) -> Any:
    """The array of ``x``'s entries."""
    if _all_known(x):
        return jnp.asarray(_values(x, aval.dtype))
    flat = [jnp.asarray(e, aval.dtype) for e in x.flat]
    return flat[0] if not x.shape else jnp.stack(flat).reshape(x.shape)


def _map(fun: Callable[..., Any], *xs: Entries) -> Entries:
    shape = np.broadcast_shapes(*(x.shape for x in xs))
    xs = tuple(np.broadcast_to(x, shape) for x in xs)
    out = np.empty(shape, object)
    for i in np.ndindex(shape):
        out[i] = fun(*(x[i] for x in xs))
    return out


_NUMPY: dict[str, Callable[..., Any]] = {
    "add": operator.add,
    "add_any": operator.add,
    "sub": operator.sub,
    "mul": operator.mul,
    "max": np.maximum,
    "min": np.minimum,
    "neg": operator.neg,
    "sign": np.sign,
    "abs": np.abs,
    "sin": np.sin,
    "cos": np.cos,
    "tan": np.tan,
    "sqrt": np.sqrt,
    "exp": np.exp,
    "log": np.log,
    "pow": np.power,
    "floor": np.floor,
    "ceil": np.ceil,
    "square": np.square,
    "tanh": np.tanh,
    "is_finite": np.isfinite,
    "rem": np.fmod,
    "eq": operator.eq,
    "ne": operator.ne,
    "lt": operator.lt,
    "le": operator.le,
    "gt": operator.gt,
    "ge": operator.ge,
    "not": np.invert,
    "and": np.bitwise_and,
    "or": np.bitwise_or,
    "xor": np.bitwise_xor,
    "stop_gradient": lambda x: x,
}
_ELEMENTWISE = {
    *_NUMPY,
    "div",
    "integer_pow",
    "select_n",
    "convert_element_type",
    "clamp",
    "rsqrt",
    "atan2",
    "asin",
    "acos",
    "atan",
    "log1p",
    "expm1",
    "logistic",
    "round",
    "cbrt",
    "erf",
}


class _Replay:
    """One replay of a program; remembers what it has computed."""

    def __init__(self) -> None:
        self.seen: dict[Any, Any] = {}
        self.alive: list[Any] = []  # ids in `seen` stay valid

    # -- the program ---------------------------------------------------------

    def run(
        self, jaxpr: Any, consts: list[Entries], args: list[Entries]
    ) -> list[Entries]:
        env: dict[Any, Entries] = {}

        def read(v: Any) -> Entries:
            if isinstance(v, jex_core.Literal):
                aval: Any = v.aval
                return _split(np.asarray(v.val, aval.dtype))
            return env[v]

        for names, given in ((jaxpr.constvars, consts), (jaxpr.invars, args)):
            env.update(zip(names, given, strict=True))
        for eqn in jaxpr.eqns:
            outs = self.apply(eqn, [read(v) for v in eqn.invars])
            env.update(zip(eqn.outvars, outs, strict=True))
        return [read(v) for v in jaxpr.outvars]

    def apply(self, eqn: Any, xs: list[Entries]) -> list[Entries]:
        inner = _inner(eqn)
        if inner is not None:
            consts = [_split(c) for c in getattr(inner, "consts", ())]
            return self.run(getattr(inner, "jaxpr", inner), consts, xs)
        name, p = eqn.primitive.name, eqn.params
        if name in ("device_put", "copy", "copy_p"):
            return xs
        if name in _ELEMENTWISE:
            return [self.elementwise(eqn, xs)]
        rule = getattr(self, "_" + name.replace("-", "_"), None)
        if rule is not None:
            out = rule(p, *xs)
            if out is not NotImplemented:
                return [out]
        if name in ("cond", "scan"):
            outs = self.control(name, p, xs)
            if outs is not NotImplemented:
                return outs
        return self.whole(eqn, xs)

    def whole(self, eqn: Any, xs: list[Entries]) -> list[Entries]:
        """The operation as it is, on arrays."""
        params = eqn.primitive.get_bind_params(eqn.params)

        def run() -> Any:
            vals = [_join(x, v.aval) for x, v in zip(xs, eqn.invars, strict=True)]
            return eqn.primitive.bind(*vals, **params)

        if all(_all_known(x) for x in xs):
            with jax.ensure_compile_time_eval():
                outs = run()
        else:
            outs = run()
        outs = outs if eqn.primitive.multiple_results else [outs]
        return [_split(out) for out in outs]

    def control(self, name: str, p: dict[str, Any], xs: list[Entries]) -> Any:
        if name == "cond":
            if not _all_known(xs[0]):
                return NotImplemented
            which = int(np.clip(int(xs[0][()]), 0, len(p["branches"]) - 1))
            branch = p["branches"][which]
            return self.run(branch.jaxpr, [_split(c) for c in branch.consts], xs[1:])
        if p["length"] > _UNROLLED:
            return NotImplemented
        (nc, nk), length = scan_sizes(p), p["length"]
        consts, carry, rest = xs[:nc], xs[nc : nc + nk], xs[nc + nk :]
        body, steps = p["jaxpr"], range(length)
        kept: list[Any] = [None] * length
        for i in reversed(steps) if p["reverse"] else steps:
            out = self.run(
                body.jaxpr,
                [_split(c) for c in body.consts],
                [*consts, *carry, *(_cell(x[i]) for x in rest)],
            )
            carry, kept[i] = out[:nk], out[nk:]
        ys = []
        for k, v in enumerate(body.jaxpr.outvars[nk:]):
            y = np.empty((length, *v.aval.shape), object)
            for i in steps:
                y[i] = kept[i][k] if v.aval.shape else kept[i][k][()]
            ys.append(y)
        return [*carry, *ys]

    # -- one operation on entries ---------------------------------------------

    def elementwise(self, eqn: Any, xs: list[Entries]) -> Entries:
        name, p = eqn.primitive.name, eqn.params
        dtype = eqn.outvars[0].aval.dtype
        tag = (name, str(sorted(p.items(), key=str)) if p else "")
        prim = eqn.primitive

        def one(*e: Any) -> Any:
            folded = _fold(name, p, dtype, e)
            if folded is not None:
                return folded
            return self.bind(tag, prim, p, e)

        return _map(one, *xs)

    def bind(self, tag: Any, prim: Any, params: dict[str, Any], e: Any) -> Any:
        if tag[0] == "stop_gradient":
            return self.once(tag, jax.lax.stop_gradient, e)
        bound = prim.get_bind_params(params)
        return self.once(tag, lambda *x: prim.bind(*x, **bound), e)

    def once(self, tag: Any, fun: Callable[..., Any], e: Any) -> Any:
        """``fun(*e)``, computed where it was not before."""
        key = (tag, *(_identity(x) for x in e))
        if key not in self.seen:
            self.alive.extend(e)
            self.seen[key] = fun(*e)
        return self.seen[key]

    def _op(self, name: str, *e: Any) -> Any:
        dtype = e[0].dtype
        folded = _fold(name, {}, dtype, e)
        return self.once(name, _LAX[name], e) if folded is None else folded

    def _sum(self, terms: Any, name: str = "add") -> Any:
        total = terms[0]
        for t in terms[1:]:
            total = self._op(name, total, t)
        return total

    # -- sums and products ------------------------------------------------------

    def _reduced(self, p: dict[str, Any], x: Entries, name: str) -> Any:
        axes = p["axes"]
        keep = [i for i in range(x.ndim) if i not in axes]
        count = math.prod(x.shape[i] for i in axes)
        if not count:
            return NotImplemented
        y = x.transpose([*keep, *axes]).reshape(*(x.shape[i] for i in keep), count)
        out = np.empty(y.shape[:-1], object)
        for i in np.ndindex(out.shape):
            out[i] = self._sum(list(y[i]), name)
        return out

    def _reduce_sum(self, p: dict[str, Any], x: Entries) -> Any:
        return self._reduced(p, x, "add")

    def _reduce_max(self, p: dict[str, Any], x: Entries) -> Any:
        return self._reduced(p, x, "max")

    def _reduce_min(self, p: dict[str, Any], x: Entries) -> Any:
        return self._reduced(p, x, "min")

    def _reduce_and(self, p: dict[str, Any], x: Entries) -> Any:
        return self._reduced(p, x, "and")

    def _reduce_or(self, p: dict[str, Any], x: Entries) -> Any:
        return self._reduced(p, x, "or")

    def _cumsum(self, p: dict[str, Any], x: Entries) -> Any:
        y = np.moveaxis(x, p["axis"], 0)
        out = np.empty(y.shape, object)
        order = range(len(y))
        total = None
        for i in reversed(order) if p["reverse"] else order:
            row = _cell(y[i])
            total = row if total is None else self._add(total, row)
            out[i] = total if total.shape else total[()]
        return np.moveaxis(out, 0, p["axis"])

    def _add(self, a: Entries, b: Entries) -> Entries:
        return _map(lambda x, y: self._op("add", x, y), a, b)

    def _dot_general(self, p: dict[str, Any], a: Entries, b: Entries) -> Any:
        (ca, cb), (ba, bb) = p["dimension_numbers"]
        fa = [i for i in range(a.ndim) if i not in (*ca, *ba)]
        fb = [i for i in range(b.ndim) if i not in (*cb, *bb)]
        batch, rows = [a.shape[i] for i in ba], [a.shape[i] for i in fa]
        cols, inner = [b.shape[i] for i in fb], [a.shape[i] for i in ca]
        size = (int(np.prod(s, dtype=int)) for s in (batch, rows, cols, inner))
        n, r, c, k = size
        if not k or any(e.dtype.kind != "f" for e in (*a.flat, *b.flat)):
            return NotImplemented
        left = a.transpose([*ba, *fa, *ca]).reshape(n, r, k)
        right = b.transpose([*bb, *fb, *cb]).reshape(n, c, k)
        out = np.empty((n, r, c), object)
        for i in np.ndindex(out.shape):
            x, y = left[i[0], i[1]], right[i[0], i[2]]
            out[i] = self._sum(
                [self._op("mul", u, v) for u, v in zip(x, y, strict=True)]
            )
        return out.reshape([*batch, *rows, *cols])

    # -- structure --------------------------------------------------------------

    def _slice(self, p: dict[str, Any], x: Entries) -> Entries:
        steps = p["strides"] or (1,) * x.ndim
        bounds = zip(p["start_indices"], p["limit_indices"], steps, strict=True)
        return x[tuple(slice(*b) for b in bounds)]

    def _squeeze(self, p: dict[str, Any], x: Entries) -> Entries:
        return np.squeeze(x, tuple(p["dimensions"]))

    def _expand_dims(self, p: dict[str, Any], x: Entries) -> Entries:
        return np.expand_dims(x, tuple(p["dimensions"]))

    def _reshape(self, p: dict[str, Any], x: Entries, *_: Any) -> Any:
        if p.get("dimensions") is not None:
            return NotImplemented
        return x.reshape(p["new_sizes"])

    def _transpose(self, p: dict[str, Any], x: Entries) -> Entries:
        return x.transpose(p["permutation"])

    def _rev(self, p: dict[str, Any], x: Entries) -> Entries:
        return np.flip(x, tuple(p["dimensions"]))

    def _broadcast_in_dim(self, p: dict[str, Any], x: Entries, *_: Any) -> Entries:
        shape = [1] * len(p["shape"])
        for i, d in enumerate(p["broadcast_dimensions"]):
            shape[d] = x.shape[i]
        return np.broadcast_to(x.reshape(shape), p["shape"])

    def _concatenate(self, p: dict[str, Any], *xs: Entries) -> Entries:
        return np.concatenate(xs, axis=p["dimension"])

    def _stack(self, p: dict[str, Any], *xs: Entries) -> Entries:
        return np.stack(xs, axis=p["axis"])

    def _tile(self, p: dict[str, Any], x: Entries) -> Entries:
        return np.tile(x, p["reps"])

    def _iota(self, p: dict[str, Any]) -> Entries:
        shape = [1] * len(p["shape"])
        shape[p["dimension"]] = -1
        line = np.arange(p["shape"][p["dimension"]], dtype=p["dtype"])
        return _split(np.broadcast_to(line.reshape(shape), p["shape"]))

    def _pad(self, p: dict[str, Any], x: Entries, value: Entries) -> Any:
        config = p["padding_config"]
        if any(low < 0 or high < 0 or gap for low, high, gap in config):
            return NotImplemented
        shape = [
            n + low + high for n, (low, high, _) in zip(x.shape, config, strict=True)
        ]
        out = _filled(shape, value[()])
        spans = zip(x.shape, config, strict=True)
        out[tuple(slice(low, low + n) for n, (low, _, _) in spans)] = x
        return out

    def _gather(self, p: dict[str, Any], x: Entries, index: Entries) -> Any:
        if not _all_known(index) or not x.size:
            return NotImplemented
        d, drops = p["dimension_numbers"], jax.lax.GatherScatterMode.FILL_OR_DROP
        gone = (*d.collapsed_slice_dims, *d.operand_batching_dims)
        picked = _window_places(
            *(x.shape, p["slice_sizes"], _values(index, np.int64)),
            d.start_index_map,
            zip(d.operand_batching_dims, d.start_indices_batching_dims, strict=True),
            *(gone, d.offset_dims, p["mode"] == drops),
        )
        dtype = x.flat[0].dtype
        blank = np.nan if dtype.kind == "f" else 0
        missing = dtype.type(blank if p["fill_value"] is None else p["fill_value"])
        out = np.empty(picked.shape, object)
        for i in np.ndindex(out.shape):
            out[i] = missing if picked[i] < 0 else x.flat[picked[i]]
        return out

    def _dynamic_slice(self, p: dict[str, Any], x: Entries, *start: Entries) -> Any:
        if not all(_all_known(s) for s in start):
            return NotImplemented
        spans = zip(x.shape, p["slice_sizes"], start, strict=True)
        firsts = [(int(np.clip(int(s[()]), 0, n - k)), k) for n, k, s in spans]
        return x[tuple(slice(f, f + k) for f, k in firsts)]

    def _scatter(self, p: dict[str, Any], x: Any, index: Any, new: Any) -> Any:
        return self._scattered(p, x, index, new, None)

    def _scatter_add(self, p: dict[str, Any], x: Any, index: Any, new: Any) -> Any:
        return self._scattered(p, x, index, new, "add")

    def _scatter_mul(self, p: dict[str, Any], x: Any, index: Any, new: Any) -> Any:
        return self._scattered(p, x, index, new, "mul")

    def _scattered(
        self, p: dict[str, Any], x: Any, index: Any, new: Any, op: Any
    ) -> Any:
        if not _all_known(index):
            return NotImplemented
        if not x.size:  # no window lies inside
            return x
        d, clips = p["dimension_numbers"], jax.lax.GatherScatterMode.CLIP
        gone = (*d.inserted_window_dims, *d.operand_batching_dims)
        lengths = iter([new.shape[i] for i in d.update_window_dims])
        sizes = [1 if i in gone else next(lengths) for i in range(x.ndim)]
        places = _window_places(
            *(x.shape, sizes, _values(index, np.int64)),
            d.scatter_dims_to_operand_dims,
            zip(d.operand_batching_dims, d.scatter_indices_batching_dims, strict=True),
            *(gone, d.update_window_dims, p["mode"] != clips),
        )
        out = np.array(x, object, copy=True)
        flat = out.reshape(-1)
        for i, value in zip(places.flat, new.flat, strict=True):
            if i >= 0:
                flat[i] = value if op is None else self._op(op, flat[i], value)
        return flat.reshape(x.shape)

    # -- factorizations -----------------------------------------------------------

    def _cholesky(self, p: dict[str, Any], a: Entries) -> Any:
        if a.ndim != 2:
            return NotImplemented
        n, op = len(a), self._op
        zero, one = np.zeros((), a[0, 0].dtype)[()], np.ones((), a[0, 0].dtype)[()]
        low = _filled((n, n), zero)
        for j in range(n):
            d = a[j, j]
            for k in range(j):
                d = op("sub", d, op("mul", low[j, k], low[j, k]))
            low[j, j] = op("sqrt", d)
            r = op("div", one, low[j, j])
            for i in range(j + 1, n):
                s = a[i, j]
                for k in range(j):
                    s = op("sub", s, op("mul", low[i, k], low[j, k]))
                low[i, j] = op("mul", s, r)
        return low

    def _triangular_solve(self, p: dict[str, Any], a: Entries, b: Entries) -> Any:
        if a.ndim != 2 or b.ndim != 2:
            return NotImplemented
        if not p["left_side"]:
            q = {**p, "left_side": True, "transpose_a": not p["transpose_a"]}
            return self._triangular_solve(q, a, b.T).T
        lower = p["lower"]
        if p["transpose_a"]:
            a, lower = a.T, not lower
        n, op = len(a), self._op
        order = range(n) if lower else range(n - 1, -1, -1)
        x = np.empty(b.shape, object)
        for c in range(b.shape[1]):
            done: list[int] = []
            for i in order:
                s = b[i, c]
                for k in done:
                    s = op("sub", s, op("mul", a[i, k], x[k, c]))
                x[i, c] = s if p["unit_diagonal"] else op("div", s, a[i, i])
                done.append(i)
        return x


_LAX: dict[str, Callable[..., Any]] = {
    "add": jax.lax.add,
    "sub": jax.lax.sub,
    "mul": jax.lax.mul,
    "div": jax.lax.div,
    "max": jax.lax.max,
    "min": jax.lax.min,
    "and": jax.lax.bitwise_and,
    "or": jax.lax.bitwise_or,
    "sqrt": jax.lax.sqrt,
}


def _identity(x: Any) -> Any:
    return (x.dtype.str, x.tobytes()) if _known(x) else id(x)


def _filled(shape: Any, value: Any) -> Entries:
    # np.full would turn a NumPy scalar into a Python number.
    out = np.empty(shape, object)
    for i in np.ndindex(out.shape):
        out[i] = value
    return out


def _cell(x: Any) -> Entries:
    """What indexing an array of entries gives, as an array again."""
    if isinstance(x, np.ndarray):
        return x
    out = np.empty((), object)
    out[()] = x
    return out


def _window_places(
    shape: Sequence[int],
    sizes: Sequence[int],
    index: np.ndarray,
    axes: Sequence[int],
    batching: Iterable[tuple[int, int]],
    gone: Sequence[int],
    window: Sequence[int],
    drops: bool,
) -> np.ndarray:
    """Which entries of an array the windows of a gather or scatter hold.

    Args:
        shape: of the array.
        sizes: of a window along each axis of the array.
        index: where the windows begin, ``(..., len(axes))``.
        axes: of the array that ``index`` is about.
        batching: axes of the array and those of ``index`` that run along with them.
        gone: axes of the array that the result lacks.
        window: axes of the result that run within a window.
        drops: a window that is not all inside counts as outside; else it is moved in.

    Returns:
        Places in the flattened array; -1 outside.
    """
    many = index.shape[:-1]
    begin = np.zeros((*many, len(shape)), int)
    begin[..., list(axes)] = index
    for axis, along in batching:
        begin[..., axis] = np.indices(many)[along]
    last = np.subtract(shape, sizes)
    inside = ((begin >= 0) & (begin <= last)).all(-1)
    begin = np.clip(begin, 0, last)
    flat = np.arange(math.prod(shape)).reshape(shape)
    first = flat[tuple(np.moveaxis(begin, -1, 0))]
    within = flat[tuple(map(slice, sizes))]  # of the window at the origin
    places = first.reshape(*many, *[1] * len(shape)) + within
    if drops:
        places[~inside] = -1
    places = places.squeeze(tuple(len(many) + axis for axis in gone))
    return np.moveaxis(places, range(len(many), places.ndim), window)


def _fold(name: str, p: dict[str, Any], dtype: Any, e: tuple[Any, ...]) -> Any:
    """The value of an operation that needs none, or None."""
    if all(_known(x) for x in e):
        return _compute(name, p, dtype, e)
    if name == "select_n":
        which, *cases = e
        if _known(which):
            return cases[int(which)]
        first = cases[0]
        same = all(c is first or _equal(c, first) for c in cases[1:])
        return first if same else None
    if name == "integer_pow" and p["y"] == 1:
        return e[0]
    if len(e) != 2:
        return None
    a, b = e
    for x, other, left in ((a, b, True), (b, a, False)):
        if not _known(x):
            continue
        if name in ("add", "add_any") and x == 0:
            return other
        if name == "sub" and not left and x == 0:
            return other
        if name == "mul" and x == 0:
            return np.zeros((), dtype)[()]
        if name == "mul" and x == 1:
            return other
        if name == "div" and not left and x == 1:
            return other
        if name == "div" and left and x == 0:
            return x
        if name == "and" and x.dtype == bool:
            return other if x else x
        if name == "or" and x.dtype == bool:
            return x if x else other
        if name == "max" and x.dtype.kind == "f" and x == -np.inf:
            return other
        if name == "min" and x.dtype.kind == "f" and x == np.inf:
            return other
    return None


def _equal(a: Any, b: Any) -> bool:
    return _known(a) and _known(b) and bool(a == b)


def _compute(name: str, p: dict[str, Any], dtype: Any, e: tuple[Any, ...]) -> Any:
    with np.errstate(all="ignore"):
        if name in _NUMPY:
            out = _NUMPY[name](*e)
        elif name == "select_n":
            out = e[1:][int(e[0])]
        elif name == "convert_element_type":
            out = e[0]
        elif name == "integer_pow":
            out = e[0] ** p["y"]
        elif name == "clamp":
            out = np.minimum(np.maximum(e[1], e[0]), e[2])
        elif name == "div" and dtype.kind == "f":
            out = e[0] / e[1]
        elif name == "div" and e[1]:
            out = np.trunc(np.float64(e[0]) / np.float64(e[1]))
        else:
            return None
    return np.asarray(out).astype(dtype)[()]


__all__ = ["MAX_ENTRIES", "entries", "scalarized"]
