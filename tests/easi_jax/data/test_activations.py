"""Activations as commands and positions tell them, beside MuJoCo's own."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from easi_jax.data.activations import activation_guess, activation_spread
from easi_jax.data.recording import Run
from easi_jax.data.scales import scales_of
from easi_jax.model.joint_space import Configuration

ACTUATORS = {
    "filter": '<general dyntype="filter" dynprm="0.05" gainprm="3" joint="j"/>',
    "filterexact": (
        '<general dyntype="filterexact" dynprm="0.05" gainprm="20" '
        'biastype="affine" biasprm="0 -20 -1" joint="j"/>'
    ),
    "intvelocity": '<intvelocity kp="80" kv="4" actrange="-2 2" joint="j"/>',
    "integrator": '<general dyntype="integrator" gainprm="1" joint="j"/>',
}


def recorded(actuator: str) -> tuple[mujoco.MjModel, Run, np.ndarray]:
    m = mujoco.MjModel.from_xml_string(
        '<mujoco><option timestep="0.005"/><worldbody><body>'
        '<joint name="j" axis="0 1 0" damping="0.3"/>'
        '<geom type="capsule" size="0.02" fromto="0 0 0 0 0 -0.3" mass="0.5"/>'
        f"</body></worldbody><actuator>{actuator}</actuator></mujoco>"
    )
    d, rows = mujoco.MjData(m), []
    for k in range(400):
        d.ctrl[:] = np.sin(0.05 * k)
        rows.append((d.time, d.qpos.copy(), d.qvel.copy(), d.ctrl.copy(), d.act.copy()))
        mujoco.mj_step(m, d)
    time, q, v, u, act = (np.array(x) for x in zip(*rows, strict=True))
    run = Run("r", "r", 0.005, time, q, v, True, u, Configuration.of(m))
    return m, run, act


@pytest.mark.parametrize("name", ACTUATORS)
def test_guess_is_within_its_spread_of_the_truth(name: str) -> None:
    m, run, act = recorded(ACTUATORS[name])
    guess = activation_guess(m, run)
    spread = activation_spread(m, [run])
    assert guess.shape == act.shape
    assert 0 < spread[0] < 10
    assert np.abs(guess - act).max() < 2 * spread[0]


def test_filter_is_followed_exactly_after_its_start() -> None:
    m, run, act = recorded(ACTUATORS["filterexact"])
    np.testing.assert_allclose(activation_guess(m, run)[100:], act[100:], atol=1e-6)


def test_integrator_of_commands_is_their_sum() -> None:
    m, run, act = recorded(ACTUATORS["integrator"])
    np.testing.assert_allclose(activation_guess(m, run), act, atol=1e-9)


def test_scales_of_a_drive_do_not_hang_on_how_it_is_written() -> None:
    """A position drive that holds its joint pulls next to nothing, with a filter of its
    commands as without; a speed command is no activation of an integrated one."""
    drives = {
        "plain": '<position kp="100" joint="j"/>',
        "filtered": '<position kp="100" timeconst="0.005" joint="j"/>',
        "integrated": '<intvelocity kp="100" actrange="-2 2" joint="j"/>',
    }
    found = {}
    for name, drive in drives.items():
        m, run, _ = recorded(drive)
        held = 1.0 + 0.01 * np.sin(0.2 * np.arange(400))[:, None]
        command = held if name != "integrated" else np.full_like(held, 1.5)
        still = replace(run, qpos=held, qvel=np.zeros_like(held), ctrl=command)
        found[name] = scales_of(m, [still])
    for scales in found.values():
        assert scales.force[0] < 5 and scales.peak[0] < 5
        np.testing.assert_allclose(scales.torque, found["plain"].torque, rtol=0.3)
