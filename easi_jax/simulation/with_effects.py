"""A simulator, or an environment, with found effects in its model."""

import copy
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from easi_jax.errors import UserError
from easi_jax.model.found_effects import FoundEffects, joined, set_by_none
from easi_jax.model.parameters import ParameterSpace
from easi_jax.simulation.simulator import Simulator


def simulator_with(simulator: Simulator, found: FoundEffects) -> Simulator:
    """The machine with effects in its physics and in its space.

    Raises:
        UserError: as `joined`.
    """
    space, fixed = joined(simulator.mj_model, simulator.space, found)
    return simulator.rebuilt(space=space, fixed={**simulator.fixed, **fixed})


def env_with(env: Any, found: FoundEffects) -> Any:
    """An environment with effects; the given one stays as it is.

    Raises:
        UserError: as `joined`; or the environment simulates with something else than
            its ``simulator``.
    """
    if not (found.physical or found.own):
        return env
    needs_simulator(env, "effects")
    out = copy.copy(env)
    out.simulator = simulator_with(env.simulator, found)
    out.space = out.simulator.space
    return _simulated_by_own(out, "effects")


def env_identified(
    env: Any, space: ParameterSpace, means: ArrayLike, fixed: Mapping[str, float]
) -> Any:
    """An environment with the parameters of ``space`` alone, nominal at ``means (n,)``,
    SI; others of its own keep their nominal values. ``fixed``: values by address that
    hold where no parameter sets them.

    Raises:
        UserError: as `env_with`, or an address that the robot lacks.
    """
    needs_simulator(env, "other parameters")
    m, (low, high) = env.mj_model, space.bounds
    values = np.clip(np.asarray(means, float), low, high).tolist()
    each = zip(space.parameters, values, strict=True)
    found = ParameterSpace(tuple(replace(p, nominal=value) for p, value in each))
    fixed = set_by_none(m, space.addresses, fixed)
    own = {a: p.nominal for p in env.space.parameters for a in p.addresses}
    own = set_by_none(m, [*space.addresses, *([a] for a in fixed)], own)
    return env_with_space(env, found, {**own, **fixed})


def env_with_space(
    env: Any, space: ParameterSpace, fixed: Mapping[str, float] | None = None
) -> Any:
    """An environment with other parameters, and ``fixed`` values by address besides;
    the given one stays as it is.

    Raises:
        UserError: as `env_with`.
    """
    needs_simulator(env, "other parameters")
    out = copy.copy(env)
    fixed = {**env.simulator.fixed, **(fixed or {})}
    out.simulator, out.space = env.simulator.rebuilt(space=space, fixed=fixed), space
    return _simulated_by_own(out, "other parameters")


def needs_simulator(env: Any, what: str) -> None:
    """Raises UserError where an environment has no simulator of ours, which ``what``
    needs."""
    if not isinstance(getattr(env, "simulator", None), Simulator):
        raise UserError(
            f"{env.name}: {what} need an environment whose `simulator` is an "
            "easi_jax.simulation.simulator.Simulator"
        )


def _simulated_by_own(out: Any, what: str) -> Any:
    """The environment, checked to simulate with its ``simulator``."""
    theta = jnp.asarray(out.space.nominal, jnp.float32)
    model = jax.eval_shape(out.model, theta)
    if getattr(model, "present", None) != out.simulator.base.present:
        raise UserError(
            f"{out.name}: {what} need an environment whose model() is that of its "
            "`simulator` (self.simulator.model(theta))"
        )
    return out
