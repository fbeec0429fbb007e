"""A Python file with effects that the owner of a machine wrote (``--effects-from``).

It is run because the user names it, never because a run folder or an effects file does.
What goes wrong in it is told by its line.
"""

import runpy
from collections.abc import Sequence
from pathlib import Path

from easi_jax.errors import UserError, told_by_line
from easi_jax.model.own_effects import OwnEffect


def read_own_effects(path: Path) -> list[OwnEffect]:
    """Runs a file; all `OwnEffect` that it has names for, in its order.

    Raises:
        UserError: no such file; what went wrong in it, by its line; no effects in it.
    """
    if not path.is_file():
        raise UserError(f"{path}: no such file (--effects-from)")
    try:
        names = runpy.run_path(str(path), run_name=path.stem)
    except Exception as error:
        raise UserError(told_by_line(path, error)) from error
    found: list[OwnEffect] = []
    for value in names.values():
        many = value if isinstance(value, list | tuple) else [value]
        found += [x for x in many if isinstance(x, OwnEffect) and x not in found]
    if not found:
        raise UserError(
            f"{path}: it makes no easi_jax.OwnEffect at its top level (template: "
            "examples/own_effects/coupling_spring.py)"
        )
    return found


def read_all(paths: Sequence[Path]) -> list[OwnEffect]:
    """Effects of several files.

    Raises:
        UserError: as `read_own_effects`.
    """
    return [effect for path in paths for effect in read_own_effects(path)]
