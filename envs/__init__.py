"""Built-in robots, by name."""

from collections.abc import Callable
from typing import Any

from easi_jax.errors import UserError, nearest
from envs.cartpole import Cartpole

REGISTRY: dict[str, Callable[..., Any]] = {"cartpole": Cartpole}


def make(name: str, **options: Any) -> Any:
    """The built-in robot ``name``.

    Raises:
        UserError: no robot of that name.
    """
    if name not in REGISTRY:
        known = ", ".join(sorted(REGISTRY))
        raise UserError(
            f'unknown robot "{name}" (known: {known}){nearest(name, REGISTRY)}'
        )
    return REGISTRY[name](**options)
