"""What a log and a simulation both have, when nobody measures the base."""

from dataclasses import replace

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from easi_jax.data.noise import pooled_noise
from easi_jax.data.proprioception import proprioception
from easi_jax.errors import UserError
from tests.walker import walk

JOINTS = tuple("abcd")


def test_channels_are_what_neither_place_nor_heading_enters() -> None:
    m, run = walk(4.0)
    of, notes = proprioception(m, [run], "mujoco")
    gravity = tuple(f"gravity.orientation.{axis}" for axis in "xyz")
    assert of.names == (
        *(f"qpos.{j}" for j in JOINTS),
        *(f"qvel.{j}" for j in JOINTS),
        *(f"sensor.gyro.{i}" for i in range(3)),
        *gravity,
        "sensor.foot",
    )
    assert list(of.kinds) == ["qpos", "qvel", "gyro", "orientation", "foot"]
    assert any("place is left out: it depends on the heading" in n for n in notes)


def test_a_slow_sensor_is_left_out_and_a_gap_is_filled() -> None:
    """Between readings far apart nothing is as rough as a simulation's."""
    m, run = walk(4.0)
    sensors = {k: np.array(v) for k, v in run.sensors.items()}
    sensors["gyro"][np.arange(len(run)) % 4 != 0] = np.nan
    sensors["orientation"][7:9] = np.nan
    of, notes = proprioception(m, [replace(run, sensors=sensors)], "mujoco")
    assert not any("gyro" in name for name in of.names)
    assert "sensor.gyro.0 is left out: it misses too many rows" in notes
    rows = of.of_run(replace(run, sensors=sensors))
    there = np.delete(np.arange(len(run)), [7, 8])
    whole = proprioception(m, [run], "mujoco")[0]
    expected = whole.of_run(run)[:, whole.of_sensor["orientation"]]
    got = rows[:, of.of_sensor["orientation"]]
    np.testing.assert_allclose(got[there], expected[there], atol=1e-6)
    assert np.abs(got[7:9] - expected[7:9]).max() < 0.1


def test_of_an_orientation_the_direction_of_gravity_is_left() -> None:
    """Whatever the heading is, and in the frame of the sensor."""
    m, run = walk(4.0)
    of, _ = proprioception(m, [run], "mujoco")
    rows = of.of_run(run)[:, of.of_sensor["orientation"]]
    for k in (0, 57, 120):
        turned = np.zeros(9)
        mujoco.mju_quat2Mat(turned, run.sensors["orientation"][k])
        down = turned.reshape(3, 3).T @ [0.0, 0.0, -1.0]
        np.testing.assert_allclose(rows[k], down, atol=1e-5)
    quat = np.array([np.cos(0.4), 0.0, 0.0, np.sin(0.4)])
    other = np.zeros_like(run.sensors["orientation"])
    for k, q in enumerate(run.sensors["orientation"]):
        mujoco.mju_mulQuat(other[k], quat, q)
    ahead = replace(run, sensors={**run.sensors, "orientation": other})
    np.testing.assert_allclose(
        of.of_run(ahead)[:, of.of_sensor["orientation"]], rows, atol=1e-5
    )


def test_a_foot_touches_or_does_not() -> None:
    m, run = walk(4.0)
    of, _ = proprioception(m, [run], "mujoco")
    read = of.of_run(run)[:, of.of_sensor["foot"]]
    assert set(np.unique(read)) == {0.0, 1.0}
    noise = of.noise(pooled_noise([run]), [run])
    assert noise[of.of_sensor["foot"]] == 0
    # White noise beside motion: never less than there is.
    assert (noise[:4] > 0.8e-4).all() and (noise[4:8] > 0.8e-2).all()


def test_speeds_that_come_from_positions_are_no_channel() -> None:
    m, run = walk(4.0)
    of, _ = proprioception(m, [replace(run, qvel_measured=False)], "mujoco")
    assert of.speeds == () and not any(n.startswith("qvel.") for n in of.names)
    state = jnp.asarray(run.qpos[3]), jnp.asarray(run.qvel[3])
    read = jnp.asarray(of.sensors.readings(run)[3])
    np.testing.assert_allclose(of.channels(*state, read), of.of_run(run)[3], atol=1e-6)


def test_nothing_to_compare_is_told() -> None:
    m, run = walk(1.0)
    with pytest.raises(UserError, match="no joint and no sensor"):
        all_hidden = np.ones(m.nv, bool)
        proprioception(m, [replace(run, hidden=all_hidden, sensors={})], "mujoco")
