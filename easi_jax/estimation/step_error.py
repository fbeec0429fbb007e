"""What the model's own physics step does to what is stated.

A machine knows no steps. A simulation in steps of milliseconds damps a little too much
or too little and lets commands act half a step early, and parameters make up for it:
they are those with which this timestep predicts best, and may be far from the machine's
beside how well the data tell them. The same pieces simulated with smaller steps say
what a machine would have read otherwise, and a fit to that where its values would be.
Motion that was simulated with the model's own step fits worse then, and nothing is said
of it.
"""

import copy
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from easi_jax.data.segments import Segments
from easi_jax.devices.runtime import quick_compile
from easi_jax.estimation.posterior import Estimate
from easi_jax.estimation.weights import step_weights
from easi_jax.model.distribution import covariance, gaussian
from easi_jax.model.parameters import ParameterSpace
from easi_jax.simulation import open_loop
from easi_jax.simulation.simulator import Simulator
from easi_jax.simulation.slopes import shift_start

_FINER = 4  # times, of the step that the model is compared with
# Of the first power of the step: such a comparison sees less than all by that.
_WHOLE = _FINER / (_FINER - 1.0)
_VISIBLE = 0.5  # half the weighted squared error that a parameter could follow
_WORSE = 4.0  # the same: the data have the model's own steps, surely
_TOLD = 1.0  # standard deviations of a value, that are worth a note


def error_of_steps(
    simulator: Simulator,
) -> Callable[[jax.Array, Segments, jax.Array], jax.Array]:
    """A program that says what the steps of a simulator do to its predictions.

    Returns:
        Takes parameters of ``simulator.space``, unit coordinates ``(n,)``, pieces, and
        corrections of their starts ``(M, S)``. Returns predictions less those without
        steps, tangents ``(M, H, 2 nv)``; zero for pieces where either is not finite.
    """
    m, space = copy.copy(simulator.mj_model), simulator.space
    m.opt.timestep = simulator.dt / simulator.substeps / _FINER
    given: Any = {"fixed": simulator.fixed, "logged": simulator.logged}
    # Which compiles next to nothing.
    given["engine"] = simulator.engine if simulator.moves_centers else "mujoco"
    drives = simulator.base.torque_speed
    coarse, fine = (
        Simulator(x, space, simulator.dt, torque_speed=drives, **given)
        for x in (simulator.mj_model, m)
    )

    def error(unit: jax.Array, pieces: Segments, delta: jax.Array) -> jax.Array:
        begun = shift_start(coarse, pieces, delta)
        path, right = (
            open_loop.predict(s, s.model(space.to_si(unit)), begun)
            for s in (coarse, fine)
        )
        out = _WHOLE * open_loop.prediction_residuals(coarse, right, path)
        finite = jnp.isfinite(out).all((1, 2), keepdims=True)
        return jnp.where(finite, out, 0.0)

    return jax.jit(error, compiler_options=quick_compile())


def is_visible(found: Estimate, error: jax.Array) -> bool:
    """Whether the data would show the ``error (M, H, 2 nv)`` of the model's steps."""
    noise = found.noise[: error.shape[-1]]
    weight = step_weights(found.pieces, found.noise, found.misfit)
    weight = weight[..., : error.shape[-1]]
    size = jnp.where(weight > 0, weight * (error / noise) ** 2, 0.0)
    return bool(0.5 * size.sum() > _VISIBLE)


def widened_by(space: ParameterSpace, found: Estimate, other: Estimate) -> Estimate:
    """What is stated, so wide that the values without steps are a deviation away:
    those of ``other``, the fit to what would have been read with the model's steps. As
    it was where that fits surely worse."""
    if not _cost(other) < _cost(found) + _WORSE:
        return found
    d = found.distribution
    off = other.distribution.mean - d.mean
    cov = jnp.asarray(covariance(d)) + jnp.outer(off, off)
    return replace(found, distribution=gaussian(space, d.mean, cov), steps=off)


def notes(space: ParameterSpace, found: Estimate, step: float) -> list[str]:
    """What the model's ``step`` [s] makes of values, where that is more than their
    deviations."""
    if isinstance(found.steps, tuple):
        return []
    d, off = found.distribution, np.asarray(found.steps, float)
    before = np.diag(covariance(d)) - off**2
    values, others = space.to_si(d.mean), space.to_si(d.mean + found.steps)
    told = [
        f"{space.names[i]} {values[i]:.3g} instead of {others[i]:.3g} {space.units[i]}"
        for i in np.argsort(-(off**2) / np.maximum(before, 1e-30)).tolist()
        if off[i] ** 2 > _TOLD**2 * before[i]
    ]
    if not told:
        return []
    return [
        f"the model's timestep of {1000 * step:.3g} ms has a part in values, which are "
        f"those that predict best with it: {', '.join(told)}; their spreads take that "
        "in. A smaller timestep would say what the machine's are"
    ]


def _cost(found: Estimate) -> float:
    return float(jnp.min(found.cost))
