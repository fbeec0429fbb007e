"""Built-in robots, by name."""

from collections.abc import Callable
from typing import Any

from easi_jax.errors import UserError, nearest
from envs.ant import Ant
from envs.ballbalance import Ballbalance
from envs.cartpole import Cartpole
from envs.go2 import Go2

REGISTRY: dict[str, Callable[..., Any]] = {
    "cartpole": Cartpole,
    "ant": Ant,
    "ballbalance": Ballbalance,
    "go2": Go2,
}


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
