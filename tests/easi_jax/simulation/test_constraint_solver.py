"""The constraint solver against MuJoCo C, and its derivatives."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx

from easi_jax.simulation import constraint_solver
from easi_jax.simulation import step as physics
from easi_jax.simulation.cpu.batched_newton import solve_spd

XML = """<mujoco><option timestep="0.002" iterations="{iterations}" cone="{cone}"
  tolerance="1e-14" ls_iterations="50" solver="Newton" integrator="Euler"/>
<worldbody>
<geom name="floor" type="plane" size="3 3 1"/>
<body name="box" pos="0 0 0.11"><freejoint/>
  <geom type="box" size="0.1 0.07 0.05" mass="0.7" friction="0.4"/></body>
<body name="ball" pos="1 0 0.12"><freejoint/>
  <geom type="sphere" size="0.08" mass="0.3" friction="0.9"/></body>
<body name="arm" pos="0 1 1"><joint name="a" type="hinge" axis="0 1 0"
    range="-0.4 0.4" limited="true" frictionloss="0.2"/>
  <geom type="capsule" fromto="0 0 0 0.4 0 0" size="0.02" mass="0.5" contype="0"
    conaffinity="0"/>
  <body pos="0.4 0 0"><joint name="b" type="hinge" axis="0 1 0" frictionloss="0.05"/>
    <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.02" mass="0.2" contype="0"
      conaffinity="0"/></body></body>
<body name="cart" pos="0 2 1"><joint name="c" type="slide" axis="1 0 0"
    frictionloss="0.4"/>
  <geom type="box" size="0.1 0.1 0.1" mass="1" contype="0" conaffinity="0"/></body>
</worldbody>
<equality><joint joint1="c" joint2="b" polycoef="0 0.3 0 0 0"/></equality>
</mujoco>"""


def load(iterations: int = 100, cone: str = "pyramidal") -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(XML.format(iterations=iterations, cone=cone))


@pytest.fixture(scope="module")
def states() -> tuple[list[Any], np.ndarray, np.ndarray]:
    """States of a C simulation in which every kind of row bears force, and the
    acceleration and the number of contacts that C finds there."""
    m = load()
    d = mujoco.MjData(m)
    d.qvel[:6], d.qvel[6:12] = (0.8, -0.3, 0, 0.2, 0.4, 0.1), (0.5, 0, 0, 0, 2.0, 0)
    d.qvel[12:] = (2.0, -3.0, 0.4)
    picked, found, touching, kinds = [], [], [], set()
    for step in range(300):
        if step % 20 == 0:
            mujoco.mj_forward(m, d)
            kinds |= set(d.efc_type[np.abs(d.efc_force) > 1e-6].tolist())
            picked.append((d.qpos.copy(), d.qvel.copy()))
            found.append(d.qacc.copy())
            touching.append(d.ncon)
        mujoco.mj_step(m, d)
    kind = mujoco.mjtConstraint
    assert kinds >= {
        int(kind.mjCNSTR_EQUALITY),
        int(kind.mjCNSTR_FRICTION_DOF),
        int(kind.mjCNSTR_LIMIT_JOINT),
        int(kind.mjCNSTR_CONTACT_PYRAMIDAL),
    }
    return picked, np.array(found), np.array(touching)


@pytest.mark.parametrize("wide", [False, True])
def test_equals_mujoco_c_with_every_kind_of_row(states: Any, wide: bool) -> None:
    picked, want, touching = states
    with jax.enable_x64(True):
        put = mjx.put_model(load(iterations=12), impl="jax")

        @jax.jit
        def solution(qpos: jax.Array, qvel: jax.Array) -> tuple[jax.Array, jax.Array]:
            data = mjx.make_data(put).replace(qpos=qpos, qvel=qvel)
            data = physics.forward(put, data, wide)
            return data.qacc, jnp.sum(data._impl.contact.dist < 0)

        inputs = (jnp.asarray(np.array(x)) for x in zip(*picked, strict=True))
        got, contacts = map(np.asarray, jax.vmap(solution)(*inputs))
    scale = np.abs(want).max(axis=1, keepdims=True)
    # A tilted box meets the floor with fewer corners in MJX's collision than in C's.
    same = contacts == touching
    assert same.sum() >= 12 and (touching[same] == 5).sum() >= 8
    np.testing.assert_allclose((got / scale)[same], (want / scale)[same], atol=1e-9)


def test_elliptic_cones_stay_with_mjx() -> None:
    assert constraint_solver.supported(mjx.put_model(load(), impl="jax"))
    assert not constraint_solver.supported(
        mjx.put_model(load(cone="elliptic"), impl="jax")
    )


ARM = """<mujoco><option timestep="0.005" iterations="{iterations}" solver="Newton"
  integrator="implicitfast"><flag contact="disable"/></option><worldbody>
<body name="cart"><joint name="x" type="slide" axis="1 0 0" frictionloss="0.1"
    range="-0.2 0.2" limited="true"/><geom size="0.1" mass="0.4"/>
  <body name="pole"><joint name="p" axis="0 1 0" frictionloss="0.003"/>
    <geom type="capsule" fromto="0 0 0 0 0 0.3" size="0.01" mass="0.1"/></body></body>
</worldbody></mujoco>"""


@pytest.fixture(scope="module")
def small() -> Any:
    """qacc of a cart with a pole, by Newton steps, in x64."""
    with jax.enable_x64(True):

        def make(iterations: int) -> Any:
            m = mujoco.MjModel.from_xml_string(ARM.format(iterations=iterations))
            put = mjx.put_model(m, impl="jax")

            def qacc(
                qpos: jax.Array, qvel: jax.Array, loss: jax.Array, wide: bool = False
            ) -> jax.Array:
                changed = put.replace(dof_frictionloss=loss)
                data = mjx.make_data(changed).replace(qpos=qpos, qvel=qvel)
                return physics.forward(changed, data, wide).qacc

            return qacc

        yield make


def points() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    qpos = rng.uniform([-0.22, -1.5], [0.22, 1.5], (64, 2))
    qvel = rng.uniform(-0.2, 0.2, (64, 2)) * rng.integers(0, 2, (64, 2))
    loss = rng.uniform([0.05, 1e-3], [1.0, 1e-2], (64, 2))
    return qpos, qvel, loss


def test_three_newton_steps_suffice_for_a_cart_with_a_pole(
    small: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert (
        constraint_solver.newton_steps(100, 4) >= 3
        and constraint_solver.newton_steps(2, 400) == 2
    )
    with jax.enable_x64(True):
        args = [jnp.asarray(x) for x in points()]
        with monkeypatch.context() as change:
            change.setattr(
                constraint_solver, "newton_steps", lambda iterations, rows: iterations
            )
            three = jax.jit(jax.vmap(small(3)))(*args)
            many = jax.jit(jax.vmap(small(20)))(*args)
            one = jax.jit(jax.vmap(small(1)))(*args)
    scale = 1 + np.abs(np.asarray(many))
    assert (np.abs(np.asarray(three - many)) / scale).max() < 1e-9
    assert (np.abs(np.asarray(one - many)) / scale).max() > 1e-6


@pytest.mark.parametrize("wide", [False, True])
def test_forward_derivatives_equal_finite_differences(small: Any, wide: bool) -> None:
    with jax.enable_x64(True):
        qpos, qvel, loss = (jnp.asarray(x) for x in points())
        # Not at rest: there the solution has corners.
        qvel = qvel + 0.3
        f = jax.jit(jax.vmap(partial(small(4), wide=wide)))
        v = jax.random.normal(jax.random.key(1), qpos.shape)
        _, slope = jax.jvp(
            lambda e: f(qpos + e * v, qvel + e * v, loss * (1 + e)), (0.0,), (1.0,)
        )
        h = 1e-6
        plus = f(qpos + h * v, qvel + h * v, loss * (1 + h))
        minus = f(qpos - h * v, qvel - h * v, loss * (1 - h))
        numeric = (plus - minus) / (2 * h)
    assert np.isfinite(slope).all() and np.abs(slope).max() > 1.0
    np.testing.assert_allclose(slope, numeric, rtol=1e-5, atol=1e-5)


def test_lanes_add_up_over_nested_batches() -> None:
    rng = np.random.default_rng(0)
    roots = rng.normal(size=(3, 4, 6, 6))
    a = jnp.asarray(roots @ roots.swapaxes(-1, -2) + np.eye(6), jnp.float32)
    b = jnp.asarray(rng.normal(size=(4, 6)), jnp.float32)
    each = jax.vmap(solve_spd)  # over 4
    got = jax.jit(jax.vmap(each, in_axes=(0, None)))(a, b)  # over 3, the same b
    want = np.linalg.solve(np.asarray(a, float), np.asarray(b, float)[None, ..., None])
    np.testing.assert_allclose(got, want[..., 0], rtol=2e-3, atol=1e-4)
    alone = solve_spd(a[1, 2], b[2])
    np.testing.assert_allclose(got[1, 2], alone, rtol=1e-4)
    assert np.isnan(solve_spd(a[0, 0] * jnp.nan, b[0])).all()


@pytest.mark.parametrize("barely", [1e-6, 1e-10, 1e-20, 1e-33])
def test_a_row_that_a_direction_barely_moves_does_not_spoil_the_search(
    barely: float,
) -> None:
    """A contact opens at 0.5 m/s^2, the minimum is at 0.9 with only the mass left; the
    other contact, which rounding moves, would open far behind."""
    given = [[-0.5, -1e-3], [1.0, barely], [1e3, 1e3], [0.0, 0.0], [np.inf] * 2]
    rows = np.array(given, np.float32)
    x, jv, stiff, low, high = map(jnp.asarray, rows)
    curve = jnp.float32(0.73)
    step = constraint_solver._exact_step(x, jv, stiff, low, high, -0.9 * curve, curve)
    assert float(step) == pytest.approx(0.9, rel=1e-5)
