"""Work spread over devices gives what one device gives; large batches end."""

import os
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from easi_jax.devices.mesh import make_mesh, sharded_map

SHARDED = """
import easi_jax, jax, jax.numpy as jnp, numpy as np
from easi_jax.devices.mesh import make_mesh, sharded_map
assert len(jax.devices()) == 3, jax.devices()
x = {"a": jnp.arange(7.0)[:, None] * jnp.arange(2.0), "b": jnp.arange(7)}
def f(t, w):
    return {"sum": t["a"].sum(-1) * w, "b": t["b"] + 1}
want = f(x, jnp.float32(3.0))
for size in (1, 2, 3):
    got = jax.jit(lambda v: sharded_map(f, make_mesh(size), v, jnp.float32(3.0)))(x)
    for k in want:
        np.testing.assert_array_equal(got[k], want[k])
# A device that has nothing but padding does not compute.
calls = []
def count(x):
    jax.debug.callback(lambda _: calls.append(1), x[0])
    return x + 1
for rows, expected in ((1, 1), (2, 2), (4, 2), (7, 3)):
    calls.clear()
    run = jax.jit(lambda v: sharded_map(count, make_mesh(3), v))
    np.testing.assert_array_equal(run(jnp.arange(rows)), np.arange(rows) + 1)
    jax.effects_barrier()
    assert len(calls) == expected, (rows, len(calls))
print("same")
"""

LARGE = """
import easi_jax, jax, jax.numpy as jnp
from mujoco import mjx
from envs.cartpole import Cartpole
m = mjx.put_model(Cartpole().mj_model, impl="jax")
def run(x):
    d = mjx.make_data(m).replace(qpos=x)
    step = lambda d, _: (mjx.step(m, d), None)
    return jax.lax.scan(step, d, None, length=50)[0].qpos
x = 0.1 * jax.random.normal(jax.random.key(0), (1024, 2))
out = jax.jit(jax.vmap(run))(x)
assert jnp.isfinite(out).all()
print("ended")
"""


def fresh(code: str, seconds: float, **env: str) -> str:
    import os

    done = subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, **env},
        timeout=seconds,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout


def test_three_devices_and_padding() -> None:
    out = fresh(SHARDED, 120, JAX_NUM_CPU_DEVICES="3", JAX_PLATFORMS="cpu")
    assert out == "same\n"


def test_a_large_batch_ends() -> None:
    """Without the larger thread pool this hangs on few cores (see runtime)."""
    assert fresh(LARGE, 120, JAX_PLATFORMS="cpu", NPROC="") == "ended\n"


@pytest.mark.parametrize("count", [1, 2, 5])
def test_every_device_sees_its_slice_only(count: int) -> None:
    mesh = make_mesh()
    seen = []

    def f(x: jax.Array) -> jax.Array:
        seen.append(x.shape)
        return 2 * x

    x = jnp.arange(float(count))
    np.testing.assert_array_equal(sharded_map(f, mesh, x), 2 * np.arange(count))
    assert seen[0] == (-(-count // mesh.size),)


def test_mesh_takes_the_number_asked_for() -> None:
    assert make_mesh(1).size == 1
    assert make_mesh().size == len(jax.devices())


@pytest.mark.slow
def test_a_device_waits_for_another_longer_than_a_minute() -> None:
    """XLA's default ends the process; a chunk of training takes longer."""
    code = """
import time, numpy as np
import easi_jax
import jax, jax.numpy as jnp
from jax.sharding import PartitionSpec as P
from easi_jax.devices.mesh import AXIS, make_mesh

def slow(x):
    time.sleep(70)
    return np.asarray(x)

def local(x):
    shape = jax.ShapeDtypeStruct(x.shape, x.dtype)
    wait = lambda x: jax.pure_callback(slow, shape, x)
    first = jax.lax.axis_index(AXIS) == 0
    return jax.lax.psum(jax.lax.cond(first, wait, lambda x: x, x), AXIS)

mesh = make_mesh()
f = jax.shard_map(local, mesh=mesh, in_specs=P(AXIS), out_specs=P(), check_vma=False)
print(float(jax.jit(f)(jnp.ones((mesh.size, 1)))[0, 0]) == mesh.size)
"""
    env = {**os.environ, "JAX_NUM_CPU_DEVICES": "2"}
    env.pop("XLA_FLAGS", None)
    got = subprocess.run(
        [sys.executable, "-c", code],
        cwd=Path(__file__).parents[3],
        env=env,
        capture_output=True,
        text=True,
        timeout=200,
    )
    assert got.returncode == 0, got.stderr
    assert got.stdout.split() == ["True"]
    assert "stuck" not in got.stderr
