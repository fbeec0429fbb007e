"""Names do not depend on the horizon, nor on what no machine can have."""

from collections.abc import Callable
from dataclasses import replace

import mujoco
import numpy as np
import pytest

from easi_jax.data.cleaning import rows_of
from easi_jax.data.noise import resolutions
from easi_jax.data.recording import Configuration, Run
from easi_jax.data.scales import scales_of
from easi_jax.data.sensor_channels import NO_SENSORS
from easi_jax.data.windows import fitted_velocity
from easi_jax.gap import effect_search
from easi_jax.gap.analysis import Analysis
from easi_jax.gap.batched_least_squares import Bounds
from easi_jax.gap.candidates import places
from easi_jax.gap.fitting import steps_error
from easi_jax.gap.recorded import recorded as recorded_data
from easi_jax.gap.result import Outcome
from easi_jax.model.parameter_proposal import own_space
from easi_jax.model.parameters import ParameterSpace
from easi_jax.simulation import engine

MODEL = """<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody>
<body name="rod"><joint name="hinge" axis="0 1 0" {more}/>
<geom type="capsule" fromto="0 0 0 0 0 -0.4" size="0.02" mass="0.8"/></body></worldbody>
<actuator><motor name="motor" joint="hinge"/></actuator></mujoco>"""
DT, NOISE = 0.01, 3e-4
FEW = ("coulomb_friction", "viscous_damping", "armature", "joint_stiffness")


def recorded(seed: int, more: str = "", rows: int = 300) -> Run:
    """A pendulum with what the owner's model has not."""
    return recorded_of(
        mujoco.MjModel.from_xml_string(MODEL.format(more=more)), seed, rows
    )


def recorded_of(m: mujoco.MjModel, seed: int, rows: int = 100) -> Run:
    """What hinges of a machine do under motors."""
    d, rng, time = mujoco.MjData(m), np.random.default_rng(seed), np.arange(rows) * DT
    rate, phase = rng.uniform(2, 12, (5, m.nu)), rng.uniform(0, 6, (5, m.nu))
    ctrl = 0.5 * np.sin(time[:, None, None] * rate + phase).sum(1)
    q = np.zeros((rows, m.nq))
    for i, u in enumerate(ctrl):
        q[i], d.ctrl[:] = d.qpos + NOISE * rng.normal(size=m.nq), u
        mujoco.mj_step(m, d, 5)
    c = Configuration.of(m)
    v = fitted_velocity(q, DT, c)
    return Run(str(seed), "made", DT, time, q, v, False, ctrl, c)


@pytest.fixture
def analysed(monkeypatch: pytest.MonkeyPatch) -> Callable[[float], Outcome]:
    """What is found in a machine with dry friction, by the horizon; of few names."""
    monkeypatch.setattr(
        *(effect_search, "places"),
        lambda *a: [p for p in places(*a) if p.effect in FEW],
    )
    monkeypatch.setattr(effect_search, "ripples", lambda *a: [])
    m = mujoco.MjModel.from_xml_string(MODEL.format(more=""))
    fit, held = (recorded(k, 'frictionloss="0.05"') for k in (0, 1))

    def found(horizon: float) -> Outcome:
        given = m, ParameterSpace(()), [fit], [held], np.array([NOISE]), horizon
        with engine.using("mujoco"):
            return Analysis(*given).run()

    return found


def test_names_see_the_same_windows_whatever_the_horizon() -> None:
    """Those that are fitted, and those held out that say whether names hold."""
    m = mujoco.MjModel.from_xml_string(MODEL.format(more=""))
    runs = [recorded(k) for k in (0, 1)]
    seen, judged = [], []
    for horizon in (0.1, 0.2, 0.6):
        given = m, ParameterSpace(()), runs[:1], runs[1:], np.array([NOISE]), horizon
        with engine.using("mujoco"):
            analysis = Analysis(*given)
            search, judges = analysis.search, analysis.judges(analysis.search.at)
        assert search.at.steps * DT == pytest.approx(0.25)
        assert (judges is analysis.held_out) == (horizon == 0.2)
        judged.append(judges.windows.row.tolist())
        x = search.at.plain(search.at.neutral)
        judged.append(round(judges.look(x).gap, 9))
        lengths = [(f.steps, f.windows.row.tolist()) for f in search.lengths]
        seen.append(lengths)
    assert seen[0] == seen[1] == seen[2]
    assert judged[:2] == judged[2:4] == judged[4:]
    assert [steps - 5 for steps, _ in seen[0]] == [10, 20, 100]


def test_lengths_in_which_nothing_moves_are_left_out() -> None:
    """A slow motion shows in windows of 0.2 s, and in none of 0.05 s."""
    m = mujoco.MjModel.from_xml_string(MODEL.format(more=""))
    time, c, noise = np.arange(1500) * 0.005, Configuration.of(m), 2e-3
    runs = []
    for k in (0, 1):
        rng = np.random.default_rng(k)
        q = 0.5 * np.sin(2 * np.pi * 0.06 * time + k)[:, None]
        read = q + noise * rng.normal(size=q.shape)
        v = fitted_velocity(read, 0.005, c)
        runs.append(Run(str(k), "made", 0.005, time, read, v, False, 0 * q, c))
    given = m, ParameterSpace(()), runs[:1], runs[1:], np.array([noise]), 0.2
    with engine.using("mujoco"):
        search = Analysis(*given).search
    assert [round(f.steps * 0.005, 2) for f in search.lengths] == [0.23, 1.03]
    assert search.settles == 0


@pytest.mark.slow
def test_what_is_named_does_not_depend_on_the_horizon(
    analysed: Callable[[float], Outcome],
) -> None:
    short, long = analysed(0.2), analysed(0.6)
    assert [f.place.key for f in short.found] == ["coulomb_friction@hinge"]
    assert [f.place.key for f in long.found] == ["coulomb_friction@hinge"]
    a, b = (o.found[0].values["torque"] for o in (short, long))
    assert a[0] == pytest.approx(0.05, rel=0.05)
    assert b[:2] == pytest.approx(a[:2], rel=1e-4)
    assert long.horizon == pytest.approx(0.6) and short.horizon == pytest.approx(0.2)
    assert long.before.gap > 2 * short.before.gap
    assert short.verdict == long.verdict == "explained"


def test_a_spring_rests_where_its_joint_can_be() -> None:
    free = mujoco.MjModel.from_xml_string(MODEL.format(more=""))
    held = mujoco.MjModel.from_xml_string(MODEL.format(more='range="-60 60"'))
    run = recorded(0, rows=100)
    for m, most in ((free, np.pi + 1), (held, np.pi / 3)):
        s = scales_of(m, [run])
        (spring,) = [p for p in places(m, s) if p.effect == "joint_stiffness"]
        low, high = spring.rests
        assert -most - 1e-9 <= low < high <= most + 1e-9
        assert spring.possible(np.array([2.0, 2.0 * 0.9 * high]))
        assert not spring.possible(np.array([2.0, 2.0 * 1.1 * high]))
        assert not spring.possible(np.array([0.0, 100.0])), "a constant force"
        assert spring.possible(np.zeros(2))


def test_friction_that_stops_all_motion_is_out_of_bounds() -> None:
    m = mujoco.MjModel.from_xml_string(MODEL.format(more=""))
    s = replace(scales_of(m, [recorded(0, rows=100)]), most=np.array([3.0]))
    (dry,) = [p for p in places(m, s) if p.effect == "coulomb_friction"]
    assert dry.columns[0].high == pytest.approx(6.0)


def test_a_few_rows_have_no_resolution() -> None:
    """Of thirteen rows two are far apart by chance; a floor that took that for the step
    of a coarse encoder would hide everything."""
    m = mujoco.MjModel.from_xml_string(MODEL.format(more=""))
    run = recorded(0)
    short = rows_of(run, 40, 53)
    assert resolutions([short])[0] > 10 * NOISE
    scales = scales_of(m, [run])
    bounds = Bounds(*(np.zeros(0) for _ in range(3)))
    given = m, [run], [short], scales, bounds, NO_SENSORS, np.full(1, NOISE), 5
    assert recorded_data(*given).resolution[0] < NOISE


def test_steps_of_the_found_model_are_in_doubt() -> None:
    """In the model as given they do what MuJoCo C says, which the share takes off;
    with four times the damping something else. Data that have them leave no doubt."""
    damped = MODEL.replace("0.002", "0.005").format(more='damping="0.1"')
    m = mujoco.MjModel.from_xml_string(damped)
    runs = [recorded_of(m, k) for k in (0, 1)]
    given = m, own_space(m), runs[:1], runs[1:], np.array([NOISE]), 0.2
    with engine.using("mujoco"):
        analysis = Analysis(*given, only=[])
        at = analysis.search.at
        at.begin(at.neutral)
        finer, left = analysis._finer(at), []
        for damping, share in ((1.0, 0.0), (1.0, 1.0), (4.0, 1.0)):
            x = at.neutral.copy()
            x[0] *= damping
            x[-1] = share
            at.doubt_steps(x, finer)
            assert at.unseen_steps is not None
            left.append(np.abs(at.unseen_steps).max())
    assert at.own_steps > 1.0, "else nothing was fitted of them"
    whole = np.abs(steps_error(at.predictor, at.data)).max()
    # The share's is from starts as read, this one from starts that were fitted.
    assert left[0] == 0.0 and left[1] < 0.4 * whole and left[2] > 2.0 * left[1]
