"""Errors are placed where, and at the moments when, they were put."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from easi_jax.data.recording import Run
from easi_jax.gap.error_localization import Conditions, condition_errors, where
from easi_jax.gap.gap_metric import Channels
from easi_jax.gap.window_set import Rows, WindowSet
from easi_jax.model.joint_space import Configuration

# A weight on a vertical slide that reaches the floor, and an arm beside it.
XML = """<mujoco><compiler angle="radian"/><worldbody><geom type="plane" size="1 1 1"/>
<body name="weight" pos="0 0 0.3"><joint name="lift" type="slide" axis="0 0 1"/>
<geom size="0.1" mass="1"/></body>
<body name="arm" pos="3 0 2"><joint name="turn" axis="0 1 0" range="-0.6 0.6"
limited="true"/><geom size="0.1" mass="1" pos="0 0 0.5"/></body></worldbody>
<actuator><motor name="winch" joint="lift"/><motor name="motor" joint="turn"/>
</actuator></mujoco>"""
MODEL = mujoco.MjModel.from_xml_string(XML)
H = 4
ROWS = 800
TIME = 0.02 * np.arange(ROWS)


@pytest.fixture(scope="module")
def simulator() -> tuple[WindowSet, list[Run]]:
    rng = np.random.default_rng(0)
    # It is below 0.1 m, in the floor, for about a fifth of the time.
    lift = -0.1 - 0.13 * np.sin(1.7 * TIME)
    turn = 0.6 * np.sin(4.1 * TIME)
    qpos = np.stack([lift, turn], 1)
    ctrl = np.stack([np.sin(0.37 * TIME), np.sign(np.sin(5.3 * TIME))], 1)
    run = Run(
        "run",
        "made",
        0.02,
        TIME,
        qpos,
        np.gradient(qpos, 0.02, axis=0),
        False,
        ctrl + 1e-3 * rng.normal(size=ctrl.shape),
        Configuration.of(MODEL),
    )
    rows = np.arange(0, ROWS - H, H)
    at = rows[:, None] + np.arange(H)
    windows = WindowSet(
        run=np.zeros(len(rows), int),
        row=rows,
        start_qpos=qpos[rows],
        start_act=np.zeros((len(rows), 0)),
        ctrl=run.ctrl[at],
        past=run.ctrl[rows][:, None],
        past_qpos=qpos[rows][:, None],
        past_qvel=run.qvel[rows][:, None],
        read=np.zeros((len(rows), H + 2, 2)),
        speed=run.qvel[rows][:, None],
        read_speed=np.repeat(run.qvel[rows][:, None], H + 2, 1),
        led=rows >= 0,
        sensed=np.zeros((len(rows), H + 2, 0)),
        known=np.ones((len(rows), H + 2, 0)),
        last=run.ctrl[rows + H],
        time=TIME[rows],
        hidden=np.zeros((len(rows), 0)),
    )
    return windows, [run]


def conditions(
    windows: WindowSet, runs: list[Run], late: tuple[int, int] = (0, 0)
) -> Conditions:
    """Of predictions of readings that are late by some rows."""
    steps = windows.ctrl.shape[1]
    at = windows.row[:, None] + np.arange(steps + 1)
    rows = Rows(at[..., None] + np.array(late), at[:, :-1])
    return Conditions(MODEL, windows, runs, rows)


def channels(scale: tuple[float, float] = (1.0, 1.0)) -> Channels:
    names = ("lift", "turn")
    return Channels(names, names, ("m", "rad"), np.array(scale), {})


def errors(size: np.ndarray, dof: int) -> np.ndarray:
    rng = np.random.default_rng(1)
    out = 0.01 * rng.normal(size=(len(size), H, 2))
    out[..., dof] *= 1.0 + 4.0 * size[:, None]
    return out


@pytest.mark.parametrize(
    ("joint", "text"),
    [
        ("lift", "with weight in contact"),
        ("lift", "late in the recordings"),
        ("lift", "at large commands of winch"),
        ("turn", "when the command of motor jumps"),
        ("turn", "speed changes sign"),
        ("turn", "near a limit"),
        ("turn", "at high speed"),
        ("turn", "moving down"),
        ("turn", "at large positions"),
    ],
)
def test_the_condition_that_errors_were_put_under_is_told(
    simulator: tuple[WindowSet, list[Run]], joint: str, text: str
) -> None:
    found = conditions(*simulator)
    j = MODEL.joint(joint).id
    masks = {**found.general, **found.named, **found.of_joint(j)}
    assert 8 <= masks[text].sum() <= len(masks[text]) - 8
    told = where(errors(masks[text], j), found, MODEL, channels())
    assert told[0].at == joint and told[0].share > 0.7
    # What holds at the very same moments is as good an answer.
    same = [t for t, mask in masks.items() if np.array_equal(mask, masks[text])]
    assert told[0].when in same
    assert np.isclose(sum(w.share for w in told), 1.0)


def test_equal_errors_sit_throughout(simulator: tuple[WindowSet, list[Run]]) -> None:
    found = conditions(*simulator)
    even = np.full((len(simulator[0]), H, 2), 0.1)
    told = where(even, found, MODEL, channels())
    assert [w.when for w in told] == ["throughout"] * 2
    assert [w.share for w in told] == pytest.approx([0.5, 0.5])


def test_what_is_not_compared_has_no_share(
    simulator: tuple[WindowSet, list[Run]],
) -> None:
    found = conditions(*simulator)
    even = np.full((len(simulator[0]), H, 2), 0.1)
    told = where(even, found, MODEL, channels((np.inf, 1.0)))
    assert [(w.at, w.share) for w in told] == [("turn", 1.0)]
    joints, _, table = condition_errors(even, found, MODEL, channels((np.inf, 1.0)))
    assert joints == ["turn"] and len(table) == 1


def test_the_map_has_a_row_for_each_joint(
    simulator: tuple[WindowSet, list[Run]],
) -> None:
    found = conditions(*simulator)
    size = np.zeros(len(simulator[0]))
    joints, names, table = condition_errors(errors(size, 0), found, MODEL, channels())
    assert joints == ["lift", "turn"] and table.shape == (2, len(names))
    # Only one of them has limits.
    column = names.index("near a limit")
    assert np.isnan(table[0, column]) and np.isfinite(table[1, column])
    assert table[:, names.index("throughout")] == pytest.approx(0.01, rel=0.2)
    assert "in contact" in names


def test_a_window_of_one_step_has_no_jumps(
    simulator: tuple[WindowSet, list[Run]],
) -> None:
    windows, runs = simulator
    single = WindowSet(**{**vars(windows), "ctrl": windows.ctrl[:, :1]})
    assert not conditions(single, runs).general["when the command jumps"].any()


def test_errors_of_late_readings_belong_to_what_was_read(
    simulator: tuple[WindowSet, list[Run]],
) -> None:
    windows, runs = simulator
    found = conditions(windows, runs)
    late = conditions(windows, runs, (0, 3))
    after = conditions(replace(windows, row=windows.row + 3), runs)
    turn = MODEL.joint("turn").id
    then, told, now = (c.of_joint(turn)["moving down"] for c in (after, late, found))
    np.testing.assert_array_equal(told, then)
    assert (told != now).any()
    lift = MODEL.joint("lift").id
    told, now = (c.of_joint(lift)["moving down"] for c in (late, found))
    np.testing.assert_array_equal(told, now)
    np.testing.assert_array_equal(
        late.positions[:-1, :, 1],
        runs[0].qpos[windows.row[:-1, None] + 3 + np.arange(H + 1), 1],
    )


def test_a_machine_without_hinges_and_slides_has_no_map(
    simulator: tuple[WindowSet, list[Run]],
) -> None:
    ball = mujoco.MjModel.from_xml_string(
        """<mujoco><worldbody><body><joint name="b" type="ball"/>
<geom size="0.1" mass="1"/></body></worldbody></mujoco>"""
    )
    windows, runs = simulator
    rows = Rows(np.zeros((len(windows), H + 1, 3), int), np.zeros((1, 1), int))
    found = Conditions(ball, windows, runs, rows)
    channels = Channels(("b.0",) * 3, ("b",) * 3, ("rad",) * 3, np.ones(3), {})
    errors = np.ones((len(windows), H, 3))
    joints, _, table = condition_errors(errors, found, ball, channels)
    assert joints == [] and table.shape[0] == 0


def test_a_machine_without_actuators_has_no_commands_that_jump(
    simulator: tuple[WindowSet, list[Run]],
) -> None:
    windows, runs = simulator
    xml = mujoco.MjSpec.from_string(XML)
    for actuator in list(xml.actuators):
        xml.delete(actuator)
    bare, none = xml.compile(), np.zeros((ROWS, 0))
    still = [replace(run, ctrl=none) for run in runs]
    found = Conditions(bare, windows, still, conditions(windows, runs).rows)
    assert list(found.general) == ["late in the recordings", "in contact"]
    told = where(errors(found.general["in contact"], 0), found, bare, channels())
    assert told[0].at == "lift" and "in contact" in told[0].when
    wrong = errors(found.general["in contact"], 0)
    joints, names, table = condition_errors(wrong, found, bare, channels())
    assert joints == ["lift", "turn"] and not any("jumps" in name for name in names)
    assert table[0, names.index("in contact")] > table[0, names.index("throughout")] > 0
