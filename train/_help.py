"""Help texts of options, each one paragraph, without a default that is none.

tyro takes the indented lines of a field's docstring for lines of their own.
"""

import ast
import dataclasses
import inspect
import textwrap
from typing import Annotated, Any, get_type_hints

import tyro

_NONE = None, (), ""


def with_help(config: type) -> type:
    """A dataclass like ``config`` whose help can be shown."""
    texts: dict[str, str] = {}
    for cls in reversed(config.__mro__[:-1]):
        texts |= _docstrings(cls)
    hints, fields = get_type_hints(config, include_extras=True), []
    for f in dataclasses.fields(config):
        kind = hints[f.name]
        positional = tyro.conf.Positional in getattr(kind, "__metadata__", ())
        said = "" if positional or f.default in _NONE else None
        shown = tyro.conf.arg(help=texts.get(f.name), help_behavior_hint=said)
        own: Any = dataclasses.field(default=f.default, kw_only=True)
        fields.append((f.name, Annotated[kind, shown], own))
    namespace: dict[str, Any] = {"__doc__": config.__doc__}
    return dataclasses.make_dataclass(config.__name__, fields, namespace=namespace)


def _docstrings(cls: type) -> dict[str, str]:
    """What stands under each field of a class."""
    (tree,) = ast.parse(textwrap.dedent(inspect.getsource(cls))).body
    assert isinstance(tree, ast.ClassDef)
    out = {}
    for field, below in zip(tree.body, tree.body[1:], strict=False):
        match field, below:
            case (
                ast.AnnAssign(target=ast.Name(id=name)),
                ast.Expr(value=ast.Constant(value=str(text))),
            ):
                out[name] = " ".join(text.split())
    return out
