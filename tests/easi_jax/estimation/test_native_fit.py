"""Least squares on the engine `mujoco`: a wrong start is left for the truth."""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from easi_jax.data.segments import Segments
from easi_jax.estimation.levenberg_marquardt import refine
from easi_jax.estimation.normal_equations import PairedFit
from easi_jax.model.parameters import ParameterSpace, declare
from easi_jax.simulation.simulator import Simulator
from tests.tiny_robot.env import XML

_PLACES = {
    "mass": "body.arm.mass",
    "damping": "joint.hinge.damping",
    "armature": "joint.hinge.armature",
    "friction": "joint.hinge.frictionloss",
}
_TRUTH = np.array([0.5, 0.1, 0.02, 0.05])
_NOISE = np.array([1e-6, 1e-5])  # rad, rad/s


def _recorded(count: int, steps: int) -> Segments:
    """Of MuJoCo C alone, with the noise."""
    m = mujoco.MjModel.from_xml_string(XML)
    m.dof_armature[:], m.dof_frictionloss[:] = _TRUTH[2:]
    mujoco.mj_setConst(m, mujoco.MjData(m))
    rng = np.random.default_rng(0)
    ctrl = rng.uniform(-1, 1, (count, steps, 1))
    states = np.empty((count, steps + 1, 2))
    for i in range(count):
        d = mujoco.MjData(m)
        d.qpos[:], d.qvel[:] = rng.normal(size=(2, 1))
        states[i, 0] = *d.qpos, *d.qvel
        for k in range(steps):
            d.ctrl[:] = ctrl[i, k]
            mujoco.mj_step(m, d)
            states[i, k + 1] = *d.qpos, *d.qvel
    states += _NOISE * rng.normal(size=states.shape)
    q, v = (jnp.asarray(x, jnp.float32) for x in np.split(states, 2, axis=2))
    weight, sent = jnp.ones(count), jnp.asarray(ctrl, jnp.float32)
    return Segments(q[:, 0], v[:, 0], sent, q[:, 1:], v[:, 1:], weight)


@pytest.fixture(scope="module")
def fitted() -> PairedFit:
    m = mujoco.MjModel.from_xml_string(XML)
    space = ParameterSpace(
        tuple(
            declare(m, name, address, nominal=value, initial=(value / 3, value * 3))
            for (name, address), value in zip(_PLACES.items(), _TRUTH, strict=True)
        )
    )
    simulator = Simulator(m, space, 0.02, engine="mujoco")
    return PairedFit(simulator, space, _recorded(24, 8), jnp.asarray(_NOISE))


def test_a_wrong_start_is_left_for_the_truth(fitted: PairedFit) -> None:
    space, pieces = fitted.space, fitted.segments
    wrong = space.to_unit(jnp.asarray(_TRUTH * [1.4, 0.6, 1.8, 0.5]))

    @jax.jit
    def run(unit: jax.Array) -> Any:
        return refine(fitted, unit, robust=0)

    out = run(wrong)
    off = np.asarray(out.unit - space.to_unit(_TRUTH), float)
    np.testing.assert_allclose(off, 0.0, atol=3e-5)
    spread = np.sqrt(np.diag(np.linalg.inv(np.asarray(out.hessian, float))))
    assert (np.abs(off) < 4 * spread + 1e-6).all()
    # By slopes that are exact it is a matter of a few steps.
    assert out.cost[3] - out.cost[-1] < 0.05
    numbers = pieces.next_qpos.size + pieces.next_qvel.size
    assert out.cost[-1] < 0.5 * numbers + 3 * np.sqrt(0.5 * numbers)


def test_what_counts_half_says_half(fitted: PairedFit) -> None:
    """Of the parameters and of its start, which it places where it did."""
    unit = fitted.space.to_unit(jnp.asarray(1.1 * _TRUTH))
    shift = fitted.unmoved + fitted.noise
    half = replace(fitted.segments, weight=0.5 * fitted.segments.weight)
    whole, part = (
        fit.normal(unit, shift, fit.weight)
        for fit in (fitted, replace(fitted, segments=half))
    )
    for name in ("hessian", "gradients", "costs"):
        np.testing.assert_allclose(
            getattr(part, name), 0.5 * getattr(whole, name), rtol=1e-3
        )
    np.testing.assert_allclose(part.start_step, whole.start_step, rtol=1e-3)
    np.testing.assert_allclose(part.start_gain, whole.start_gain, rtol=1e-3, atol=1e-6)
