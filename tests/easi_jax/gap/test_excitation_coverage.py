"""What the fitting data never show is said."""

import mujoco
import numpy as np
import pytest

from easi_jax.data.recording import Run
from easi_jax.gap.excitation_coverage import coverage_notes
from easi_jax.model.joint_space import Configuration

MODEL = mujoco.MjModel.from_xml_string(
    """<mujoco><worldbody><body><joint name="rail" type="slide" axis="1 0 0"/>
<geom size="0.1" mass="1"/><body><joint name="pole" axis="0 1 0"/>
<geom size="0.1" mass="1" pos="0 0 1"/></body></body></worldbody>
<actuator><motor name="drive" joint="rail"/></actuator></mujoco>"""
)
TIME = 0.01 * np.arange(400)


def run(rail: np.ndarray, command: np.ndarray, name: str = "run") -> Run:
    qpos = np.stack([rail, 0.3 * np.sin(3 * TIME)], 1)
    return Run(
        name,
        "made",
        0.01,
        TIME,
        qpos,
        np.gradient(qpos, 0.01, axis=0),
        False,
        command[:, None],
        Configuration.of(MODEL),
    )


WAVE = np.sin(2 * TIME)


def test_motion_both_ways_needs_no_note() -> None:
    both = [run(WAVE, WAVE)]
    assert coverage_notes(MODEL, both, both) == []


@pytest.mark.parametrize(("sign", "word"), [(1, "positive"), (-1, "negative")])
def test_motion_one_way_is_told(sign: float, word: str) -> None:
    away = [run(sign * (TIME + 0.1 * WAVE), WAVE)]
    (note,) = coverage_notes(MODEL, away, away)
    assert f"joint rail in the {word} direction only" in note


@pytest.mark.parametrize(("sign", "word"), [(1, "negative"), (-1, "positive")])
def test_commands_of_one_sign_are_told(sign: float, word: str) -> None:
    pushed = [run(WAVE, sign * WAVE**2)]
    (note,) = coverage_notes(MODEL, pushed, pushed)
    assert f"actuator drive are never {word}" in note


def test_held_out_data_beyond_the_fit_are_told() -> None:
    slow, fast = [run(WAVE, WAVE)], [run(np.sin(5 * TIME), 3 * WAVE)]
    first, second = coverage_notes(MODEL, slow, fast)
    assert "speed of joint rail reaches 4.99 m/s" in first and "and 2 m/s in" in first
    assert "command of actuator drive reaches 3 in the held-out data" in second
    assert coverage_notes(MODEL, fast, slow) == []


def test_a_closed_loop_is_told_and_an_open_one_is_not() -> None:
    rng = np.random.default_rng(0)
    target = np.sin(2 * TIME) + 0.5 * np.sin(5.1 * TIME)
    read = 0.8 * target + 2e-3 * rng.standard_normal(len(TIME))
    back = 30 * (target - read)
    (note,) = coverage_notes(MODEL, [run(read, back)], [run(read, back)])
    assert "commands of drive follow the measured state" in note
    for command in (target, back + 2 * rng.standard_normal(len(TIME))):
        assert coverage_notes(MODEL, [run(read, command)], [run(read, command)]) == []
