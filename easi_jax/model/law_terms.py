"""Terms of laws that nobody listed, as text: ``abs(qvel.elbow)``.

A term is an expression of positions (``qpos.JOINT``), speeds (``qvel.JOINT``), commands
(``ctrl.ACTUATOR``) and ``time``, of numbers, ``+ - * **`` and

    sin(x), cos(x), abs(x)
    sign(x, w)      of x, turning from -1 to 1 over about the width w
    lag(x, T)       x through a first-order lag of T seconds: z' = (x - z) / T
    dahl(v, s)      what a bristle that bends by s at most carries, -1 to 1, by Dahl's
                    model of friction before it slips: z' = (v - |v| z) / s

A name that is no plain word is written ``qpos["left-wrist"]``. The text is all of it:
the same term is evaluated on rows of a log, in a simulation, and printed.
"""

import ast
import functools
import keyword
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp

from easi_jax.errors import UserError

_KINDS = ("qpos", "qvel", "ctrl")
_CALLS = {"sin": 1, "cos": 1, "abs": 1, "sign": 2, "lag": 2, "dahl": 2}
_REMEMBERS = ("lag", "dahl")
_LONGEST = 300  # characters of a term
_MOST = 6.0  # highest power


@dataclass(frozen=True)
class Memory:
    """What a term remembers: ``z' = rate (target - z)``.

    Attributes:
        kind: lag or dahl.
        of: the expression that drives it.
        size: its time [s], or its bend.
    """

    kind: str
    of: ast.expr
    size: float

    @property
    def text(self) -> str:
        """Of what drives it."""
        return ast.unparse(self.of)

    def follows(self, known: "Known") -> tuple[Any, Any]:
        """Target and rate [1/s]."""
        x = _value(self.of, known, ())
        if self.kind == "lag":
            return x, 1.0 / self.size
        return jnp.sign(x), abs(x) / self.size


@dataclass(frozen=True)
class Known:
    """What terms are evaluated on: arrays of one shape, by the names of joints and
    actuators.

    Attributes:
        qpos, qvel, ctrl: positions [rad, m], speeds, commands.
        time: [s].
    """

    qpos: Mapping[str, Any]
    qvel: Mapping[str, Any]
    ctrl: Mapping[str, Any]
    time: Any


@dataclass(frozen=True)
class Term:
    """A term by its text.

    Raises:
        UserError: when it is made: no such expression.
    """

    text: str

    def __post_init__(self) -> None:
        _ = self.tree

    @property
    def tree(self) -> ast.expr:
        """The expression, checked."""
        return _parsed(self.text)

    @property
    def names(self) -> frozenset[tuple[str, str]]:
        """What it is about: (qpos, qvel or ctrl; name)."""
        return frozenset(
            found for node in ast.walk(self.tree) if (found := _named(node)) is not None
        )

    @property
    def memories(self) -> tuple[Memory, ...]:
        """What it remembers, in the order of `value`'s ``memory``."""
        return tuple(_memories(self.tree))

    def value(self, known: Known, memory: Any = ()) -> Any:
        """Of arrays of one shape; ``memory``: the states of its `memories`."""
        return _value(self.tree, known, memory)

    @property
    def shown(self) -> str:
        """As people read it: without widths, names without brackets."""
        return _shown(self.tree)

    @property
    def is_sum(self) -> bool:
        """Whether it takes brackets as a factor."""
        tree = self.tree
        return isinstance(tree, ast.BinOp) and isinstance(tree.op, ast.Add | ast.Sub)

    def unit(self, of: Callable[[str, str], str]) -> dict[str, float]:
        """Powers of rad, m, s and ctrl in its unit; ``of`` tells the length of a
        joint's position, "rad" or "m", or that of a command."""
        return _unit(self.tree, of)


@functools.lru_cache(4096)
def _parsed(text: str) -> ast.expr:
    if len(text) > _LONGEST:
        raise UserError(f"a term of {len(text)} characters (at most {_LONGEST})")
    try:
        tree = ast.parse(text, mode="eval").body
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        raise UserError(f'term "{text}" cannot be read: {error}') from error
    _check(tree, text)
    return tree


def _check(node: ast.expr, text: str) -> None:
    def no(what: str) -> UserError:
        return UserError(
            f'term "{text}": {what} (a term has qpos.NAME, qvel.NAME, ctrl.NAME, time, '
            f"numbers, + - * ** and {', '.join(_CALLS)})"
        )

    if _named(node) is not None or (isinstance(node, ast.Name) and node.id == "time"):
        return
    if isinstance(node, ast.expr) and _number(node) is not None:
        return
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
        _check(node.operand, text)
    elif isinstance(node, ast.BinOp) and isinstance(node.op, ast.Pow):
        power = _number(node.right)
        if power is None or not 0 < power <= _MOST:
            raise no(f"a power is a number up to {_MOST:g}")
        _check(node.left, text)
    elif isinstance(node, ast.BinOp) and isinstance(
        node.op, ast.Add | ast.Sub | ast.Mult
    ):
        _check(node.left, text)
        _check(node.right, text)
    elif isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
        name, args = node.func.id, node.args
        if name not in _CALLS or len(args) != _CALLS[name] or node.keywords:
            raise no(f'"{name}" of {len(args)}')
        if len(args) == 2 and not (_number(args[1]) or 0) > 0:
            raise no(f"the second number of {name} is one above zero")
        inner = [c for c in ast.walk(args[0]) if _remembers(c)]
        if name in _REMEMBERS and inner:
            raise no(f"{name} of what remembers itself")
        _check(args[0], text)
    else:
        raise no(f'"{ast.unparse(node)}" is not part of one')


def _number(node: ast.expr) -> float | None:
    value: Any = node.value if isinstance(node, ast.Constant) else None
    return float(value) if type(value) in (int, float) else None


def _named(node: ast.AST) -> tuple[str, str] | None:
    if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
        kind, name = node.value.id, node.attr
    elif isinstance(node, ast.Subscript) and isinstance(node.value, ast.Name):
        key = node.slice
        if not (isinstance(key, ast.Constant) and isinstance(key.value, str)):
            return None
        kind, name = node.value.id, key.value
    else:
        return None
    return (kind, name) if kind in _KINDS else None


def name_of(kind: str, name: str) -> str:
    """The text of a position, speed or command."""
    plain = name.isascii() and name.isidentifier() and not keyword.iskeyword(name)
    return f"{kind}.{name}" if plain else f'{kind}["{name}"]'


def _remembers(node: ast.AST) -> bool:
    return (
        isinstance(node, ast.Call)
        and isinstance(node.func, ast.Name)
        and node.func.id in _REMEMBERS
    )


def _memories(node: ast.AST) -> Iterator[Memory]:
    if isinstance(node, ast.Call) and _remembers(node):
        assert isinstance(node.func, ast.Name)
        yield Memory(node.func.id, node.args[0], _number(node.args[1]) or 1.0)
        return
    for child in ast.iter_child_nodes(node):
        yield from _memories(child)


def _value(node: ast.expr, known: Known, memory: Any) -> Any:
    states = iter(range(len(memory)))

    def of(node: Any) -> Any:
        found = _named(node)
        if found is not None:
            return getattr(known, found[0])[found[1]]
        if isinstance(node, ast.Name):
            return known.time
        if isinstance(node, ast.Constant):
            return float(node.value)  # type: ignore[arg-type]
        if isinstance(node, ast.UnaryOp):
            return -of(node.operand)
        if isinstance(node, ast.BinOp):
            left, right = of(node.left), of(node.right)
            if isinstance(node.op, ast.Add):
                return left + right
            if isinstance(node.op, ast.Sub):
                return left - right
            return (
                left * right if isinstance(node.op, ast.Mult) else _power(left, right)
            )
        if _remembers(node):
            return memory[next(states)]
        x = of(node.args[0])
        if node.func.id == "sign":
            return jnp.tanh(x / of(node.args[1]))
        return {"sin": jnp.sin, "cos": jnp.cos, "abs": jnp.abs}[node.func.id](x)

    return of(node)


def _power(x: Any, power: float) -> Any:
    return x ** int(power) if power == int(power) else jnp.abs(x) ** power


def _shown(node: Any) -> str:
    found = _named(node)
    if found is not None:
        return f"{found[0]}.{found[1]}"
    if isinstance(node, ast.Call):
        assert isinstance(node.func, ast.Name)
        name, inner = node.func.id, _shown(node.args[0])
        if name == "lag":
            return f"lag({inner}, {_number(node.args[1]):.3g} s)"
        if name == "dahl":
            return f"dahl({inner}, {_number(node.args[1]):.3g})"
        return f"{name}({inner})"
    if isinstance(node, ast.BinOp):
        left, right = _shown(node.left), _shown(node.right)
        if isinstance(node.op, ast.Add | ast.Sub):
            return f"{left} {'+' if isinstance(node.op, ast.Add) else '-'} {right}"
        sums = (
            isinstance(x, ast.BinOp) and isinstance(x.op, ast.Add | ast.Sub)
            for x in (node.left, node.right)
        )
        left, right = (
            f"({x})" if is_sum else x
            for x, is_sum in zip((left, right), sums, strict=True)
        )
        return f"{left}{'*' if isinstance(node.op, ast.Mult) else '^'}{right}"
    if isinstance(node, ast.UnaryOp):
        return f"-{_shown(node.operand)}"
    if isinstance(node, ast.Constant):
        return f"{float(node.value):.3g}"  # type: ignore[arg-type]
    return "time"


def _unit(node: Any, of: Callable[[str, str], str]) -> dict[str, float]:
    found = _named(node)
    if found is not None:
        kind, name = found
        if kind == "ctrl":
            return {of(kind, name): 1.0}
        length = {of(kind, name): 1.0}
        return length if kind == "qpos" else length | {"s": -1.0}
    if isinstance(node, ast.Name):
        return {"s": 1.0}
    if isinstance(node, ast.UnaryOp):
        return _unit(node.operand, of)
    if isinstance(node, ast.BinOp):
        left = _unit(node.left, of)
        if isinstance(node.op, ast.Pow):
            return {k: p * (_number(node.right) or 1.0) for k, p in left.items()}
        if isinstance(node.op, ast.Mult):
            right = _unit(node.right, of)
            both = {k: left.get(k, 0.0) + right.get(k, 0.0) for k in {*left, *right}}
            return {k: p for k, p in both.items() if p}
        return left
    if isinstance(node, ast.Call):
        assert isinstance(node.func, ast.Name)
        if node.func.id in ("abs", "lag"):
            return _unit(node.args[0], of)
    return {}
