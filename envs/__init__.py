"""Built-in robots, by name, and environments of the user's own, by file."""

import importlib.util
import inspect
import numbers
import sys
import traceback
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from easi_jax.errors import UserError, nearest
from easi_jax.simulation.engine import chosen
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


def make(name: str, *, engine: str = "auto", **options: Any) -> Any:
    """The built-in robot ``name``, ``options`` its own.

    Args:
        engine: ``mjx``, ``mujoco``, or ``auto``: as the commands choose
            (`easi_jax.simulation.engine`).

    Raises:
        UserError: no robot of that name, or none of its options.
    """
    if name not in REGISTRY:
        known = ", ".join(sorted(REGISTRY))
        raise UserError(
            f'unknown robot "{name}" (known: {known}){nearest(name, REGISTRY)}'
        )
    known = inspect.signature(REGISTRY[name]).parameters
    for option in options:
        if option not in known:
            raise UserError(
                f'{name} has no option "{option}" (known: '
                f"{', '.join(known) or 'none'}){nearest(option, known)}"
            )
    with chosen(engine):
        return REGISTRY[name](**options)


_NEEDED = (
    *("name", "obs_size", "action_size", "episode_length", "dt", "mj_model", "space"),
    *("simulator", "model", "reset", "step", "control"),
)


def load(path: Path, *, engine: str = "auto") -> Any:
    """The environment that a Python file's ``make()`` returns.

    The file runs as it is, with all rights of the user; a template is
    ``examples/my_robot/env.py``. ``engine``: as for `make`.

    Raises:
        UserError: no such file, an error in it, or an environment that lacks something
            or in which no policy can act.
    """
    if path.suffix != ".py":
        raise UserError(f"--env {path}: give a Python file (.py) that defines make()")
    if not path.is_file():
        raise UserError(f"--env {path}: there is no such file")
    spec = importlib.util.spec_from_file_location(f"_own_env_{path.stem}", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look their own module up
    try:
        spec.loader.exec_module(module)
        if not callable(getattr(module, "make", None)):
            raise UserError(f"--env {path}: the file defines no function make()")
        with chosen(engine):
            env = module.make()
    except UserError:
        raise
    except Exception as e:  # whatever the user's code does
        frames = traceback.extract_tb(e.__traceback__)
        lines = [f.lineno for f in frames if Path(f.filename).name == path.name]
        own = (isinstance(e, SyntaxError) and e.lineno) or (lines or [None])[-1]
        where = f"{path}, line {own}" if own else str(path)
        raise UserError(f"--env {where}: {type(e).__name__}: {e}") from e
    if not hasattr(env, "simulator") and hasattr(env, "machine"):
        env.simulator = env.machine  # its name in version 0.1
    missing = [n for n in _NEEDED if not hasattr(env, n)]
    if missing:
        raise UserError(
            f"--env {path}: the environment that make() returns lacks "
            f"{', '.join(missing)} (template: examples/my_robot/env.py)"
        )
    for name in ("obs_size", "action_size", "episode_length"):
        count = getattr(env, name)
        if not isinstance(count, numbers.Integral) or int(count) < 1:
            hint = " (its model has no actuators)" * (env.mj_model.nu == 0)
            raise UserError(
                f"--env {path}: {name} is {count!r}: a policy needs a whole number "
                f"from 1{hint * (name == 'action_size')}"
            )
    return env


def open_env(robot: str, path: Path | None = None, options: Sequence[str] = ()) -> Any:
    """The environment in the file ``path``, or else the built-in ``robot``.

    ``options`` of a built-in robot are texts NAME=VALUE.
    """
    if path is not None:
        if options:
            raise UserError("--option is for built-in robots: set it in the --env file")
        return load(path)
    if not options or robot not in REGISTRY:
        return make(robot)
    known = inspect.signature(REGISTRY[robot]).parameters
    return make(robot, **dict(_option(text, known) for text in options))


_WORDS = {"true": True, "false": False}


def _option(text: str, known: Mapping[str, inspect.Parameter]) -> tuple[str, Any]:
    name, sign, value = text.partition("=")
    if not sign:
        raise UserError(f"--option {text}: write NAME=VALUE, such as parameters=full")
    if name not in known:
        return name, value  # `make` says which there are
    like = known[name].default
    if isinstance(like, bool):
        if value.lower() not in _WORDS:
            raise UserError(f"--option {text}: the value must be true or false")
        return name, _WORDS[value.lower()]
    if isinstance(like, int):
        if not (value.isascii() and value.isdigit() and int(value) > 0):
            raise UserError(f"--option {text}: the value must be a whole number from 1")
        return name, int(value)
    if not isinstance(like, str):
        raise UserError(f"--option {text}: {name} cannot be given on the command line")
    return name, value
