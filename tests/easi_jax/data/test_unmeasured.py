"""Joints that nobody measured: which the model places, the guess, how far it may be."""

import math
from collections.abc import Sequence
from dataclasses import replace

import mujoco
import numpy as np
import pytest

from easi_jax.data.measured import measured_runs
from easi_jax.data.noise import estimate_noise, pooled_noise
from easi_jax.data.recording import Log, Run, check_run
from easi_jax.data.unmeasured import (
    measured_alike,
    placed_by_model,
    start_spread,
    with_guess,
)
from easi_jax.errors import UserError
from easi_jax.model.joint_space import Configuration

DT = 0.01
BODY = """<mujoco><compiler angle="radian"/><option timestep="0.002"/><worldbody>
<body name="a" pos="0 0 1"><joint name="drive" axis="0 1 0"/>{inner}
<geom type="capsule" fromto="0 0 0 .2 0 0" size=".02" mass=".5"/>{outer}</body>
{beside}</worldbody>{rest}
<actuator><motor name="m" joint="drive"/></actuator></mujoco>"""
OTHER = """<body name="b" pos=".2 0 0"><joint name="other" axis="0 1 0" {joint}/>
<geom type="capsule" fromto="0 0 0 .2 0 0" size=".02" mass=".5"/></body>"""


def model(
    joint: str = "", rest: str = "", inner: str = "", beside: str = ""
) -> mujoco.MjModel:
    outer = "" if inner or beside else OTHER.format(joint=joint)
    return mujoco.MjModel.from_xml_string(
        BODY.format(inner=inner, outer=outer, beside=beside, rest=rest)
    )


def run_of(m: mujoco.MjModel, hidden: Sequence[float], rows: int = 60, **more) -> Run:
    c, t = Configuration.of(m), DT * np.arange(rows)
    qpos = np.tile(m.qpos0, (rows, 1))
    qpos[:, 0] = 0.6 * np.sin(4 * t)
    qvel = np.zeros((rows, m.nv))
    qvel[:, 0] = 2.4 * np.cos(4 * t)
    ctrl = np.zeros((rows, m.nu))
    return Run(
        *("r", "r.csv", DT, t, qpos, qvel, True, ctrl, c),
        hidden=np.array(hidden),
        **more,
    )


def equality(inside: str, active: bool = True) -> str:
    on = str(active).lower()
    return f'<equality><joint active="{on}" {inside}/></equality>'


def tendons(second: str = "", inside: str = 'tendon1="t"') -> str:
    """Fixed tendons, of which an equality says something."""
    made = '<fixed name="t"><joint joint="drive" coef="2"/>'
    made += '<joint joint="other" coef="1"/></fixed>'
    return f"<tendon>{made}{second}</tendon><equality><tendon {inside}/></equality>"


ALONE = '<fixed name="u"><joint joint="{}" coef="1"/></fixed>'
PLAY = '<joint name="other" axis="0 1 0" range="-.04 .04" limited="true"/>'


@pytest.mark.parametrize(
    ("given", "how"),
    [
        ({}, ""),
        ({"joint": 'range="-2 2" limited="true"'}, ""),
        # A spring that its weight bends far is a joint of its own.
        ({"joint": 'stiffness="1"'}, ""),
        ({"joint": 'stiffness="100"'}, "play beside drive"),
        ({"inner": PLAY}, "play beside drive"),
        # A stiff drive is no play.
        (
            {
                "joint": 'range="-.1 .1" limited="true"',
                "rest": '<actuator><motor name="n" joint="other"/></actuator>',
            },
            "",
        ),
        ({"rest": equality('joint1="other"')}, "held by an equality"),
        ({"rest": equality('joint1="other" joint2="drive"')}, "coupled to drive"),
        ({"rest": equality('joint1="drive" joint2="other"')}, "coupled to drive"),
        ({"rest": equality('joint1="other" joint2="drive"', active=False)}, ""),
        (
            {"rest": equality('joint1="drive" joint2="other" polycoef="0 0 1 0 0"')},
            "",
        ),
        ({"rest": tendons()}, "coupled to drive"),
        (
            {"rest": tendons(ALONE.format("other"), 'tendon1="u"')},
            "held by an equality",
        ),
        (
            {"rest": tendons(ALONE.format("drive"), 'tendon1="u" tendon2="t"')},
            "coupled to drive",
        ),
        (
            {
                "rest": tendons(
                    ALONE.format("drive"),
                    'tendon1="u" tendon2="t" polycoef="0 0 1 0 0"',
                )
            },
            "",
        ),
        # No chain leads from the measured joint to this one.
        ({"beside": f'<body>{PLAY}<geom size=".1"/></body>'}, ""),
    ],
)
def test_what_the_model_places(given, how):
    m = model(**given)
    assert placed_by_model(m, {0}) == ({1: how} if how else {})
    assert not placed_by_model(m, set()) or "held" in how


def test_what_is_placed_places_others():
    m = model(
        beside='<body><joint name="other"/><geom size=".1"/></body>'
        '<body><joint name="third"/><geom size=".1"/></body>',
        rest="<equality>"
        '<joint joint1="third" joint2="other"/><joint joint1="other" joint2="drive"/>'
        "</equality>",
    )
    assert placed_by_model(m, {0}) == {1: "coupled to drive", 2: "coupled to other"}


@pytest.mark.parametrize("first", ["other", "drive"])
def test_the_guess_follows_the_equality_either_way(first):
    second = "drive" if first == "other" else "other"
    coef = [0.1, 0.5, 0.2, 0.0, 0.0]
    text = " ".join(map(str, coef))
    m = model(
        rest=equality(f'joint1="{first}" joint2="{second}" polycoef="{text}"'),
        joint='ref="0.3"',
    )
    run = with_guess(m, run_of(m, [False, True]))
    drive, other = run.qpos.T
    moved = {"drive": drive, "other": other - 0.3}
    np.testing.assert_allclose(
        moved[first], np.polyval(coef[::-1], moved[second]), atol=1e-8
    )
    slope = np.gradient(other, DT)
    np.testing.assert_allclose(run.qvel[2:-2, 1], slope[2:-2], atol=0.05)
    before = run_of(m, [False, True])
    np.testing.assert_array_equal(drive, before.qpos[:, 0])
    np.testing.assert_array_equal(run.qvel[:, 0], before.qvel[:, 0])


def test_the_guess_closes_a_loop():
    """A four-bar of which one joint is measured."""
    m = mujoco.MjModel.from_xml_string(
        """<mujoco><compiler angle="radian"/><worldbody>
        <body name="a"><joint name="drive" axis="0 1 0"/>
          <geom type="capsule" fromto="0 0 0 0 0 .3" size=".01"/>
          <body name="b" pos="0 0 .3"><joint name="mid" axis="0 1 0"/>
            <geom type="capsule" fromto="0 0 0 .5 0 0" size=".01"/></body></body>
        <body name="c" pos=".5 0 0"><joint name="end" axis="0 1 0"/>
          <geom type="capsule" fromto="0 0 0 0 0 .3" size=".01"/></body></worldbody>
        <equality><connect body1="b" body2="c" anchor=".5 0 0"/></equality></mujoco>"""
    )
    run = with_guess(m, run_of(m, [False, True, True]))
    # A parallelogram: the link opposite turns as the driven one.
    np.testing.assert_allclose(run.qpos[:, 2], run.qpos[:, 0], atol=1e-7)
    np.testing.assert_allclose(run.qpos[:, 1], -run.qpos[:, 0], atol=1e-7)


def test_the_guess_of_a_spring_carries_the_weight():
    m = model(joint='stiffness="100" springref="0.1"')
    run = with_guess(m, run_of(m, [False, True]))
    d = mujoco.MjData(m)
    for q in run.qpos[::20]:
        d.qpos[:] = q
        mujoco.mj_forward(m, d)
        net = d.qfrc_passive[1] - d.qfrc_bias[1]
        assert abs(net) < 1e-4 * abs(d.qfrc_bias[1])
    soft = model(joint='stiffness="0.1" springref="0.1"')
    assert np.all(with_guess(soft, run_of(soft, [False, True])).qpos[:, 1] == 0.1)


def test_the_guess_else_is_the_reference_within_the_range():
    m = model(joint='ref="0.3" range="0.5 0.9" limited="true"')
    assert np.all(with_guess(m, run_of(m, [False, True])).qpos[:, 1] == 0.5)
    run = run_of(m, [False, False])
    assert with_guess(m, run) is run


@pytest.mark.parametrize(
    ("joint", "spread"),
    [
        ("", 1.0),
        ('type="slide"', 0.1),
        ('range="-.4 .4" limited="true"', 0.4),
        ('range="-3 3" limited="true"', 1.0),
        # Twice 0.5 kg at 0.1 m against the spring.
        ('stiffness="20"', 2 * 0.5 * 9.81 * 0.1 / 20),
    ],
)
def test_the_spread_of_a_start(joint, spread):
    m = model(joint=joint)
    run = run_of(m, [False, True])
    found = start_spread(m, [run])
    assert found[1] == pytest.approx(spread, rel=1e-3)
    speed = 0.0 if "slide" in joint else float(np.sqrt(np.mean(run.qvel[:, 0] ** 2)))
    assert found[3] == pytest.approx(max(spread, speed), rel=1e-3)
    assert np.isinf(found[[0, 2]]).all()


def test_noise_of_what_is_hidden_is_infinite():
    m = model()
    run = run_of(m, [False, True])
    for noise in (estimate_noise(run), pooled_noise([run, run])):
        assert np.isinf(noise).tolist() == [False, True, False, True]
    fewer = replace(run, qvel_measured=False)
    assert np.isinf(estimate_noise(fewer)).tolist() == [False, True, False, True]


def test_runs_are_brought_to_the_same_joints():
    m = model()
    full, part = run_of(m, [False, False]), run_of(m, [False, True])
    full.qpos[:, 1] = 0.2
    runs, notes = measured_alike(m, [full, replace(part, name="s")])
    assert [r.hidden.tolist() for r in runs] == [[False, True]] * 2
    assert np.all(runs[0].qpos[:, 1] == 0)
    assert notes == ["readings of other are not used, for some of the logs lack them"]
    assert measured_alike(m, [full, full]) == ([full, full], [])
    with pytest.raises(UserError, match="no joint is measured in all"):
        measured_alike(m, [part, run_of(m, [True, False])])


def test_hidden_joints_through_all_of_cleaning():
    m = model()
    whole = run_of(m, [False, False], rows=400)
    rng = np.random.default_rng(0)
    noisy = whole.qpos + 1e-3 * rng.normal(size=whole.qpos.shape)
    noisy[:, 1] = 0.0
    fit = replace(run_of(m, [False, True], rows=400), qpos=noisy, qvel_measured=False)
    found = measured_runs(m, Log((fit,), ()), Log((whole,), ()), 0.2)
    assert np.isinf(found.noise).tolist() == [False, True, False, True]
    assert found.noise[0] == pytest.approx(1e-3, rel=0.2)
    assert all(r.hidden.tolist() == [False, True] for r in (*found.fit, *found.held))
    assert any("readings of other are not used" in n for n in found.notes)
    split = measured_runs(m, Log((fit,), ()), None, 0.2)
    assert all(r.hidden.tolist() == [False, True] for r in (*split.fit, *split.held))


def test_runs_made_by_hand():
    m = model()
    assert run_of(m, []).hidden.tolist() == [False, False]
    check_run(run_of(m, [False, True]), m)
    for hidden, words in (
        ([True], "shape"),
        ([0.0, 1.0], "type"),
        ([True, True], "no joint is measured"),
    ):
        with pytest.raises(UserError, match=words):
            check_run(run_of(m, hidden), m)
    assert math.isfinite(start_spread(m, [run_of(m, [False, True])])[1])
