"""What is reckoned without simulating is what simulations say."""

import mujoco
import numpy as np
import pytest

from easi_jax.data.scales import scales_of
from easi_jax.gap import screening
from easi_jax.gap.batched_least_squares import bounds_of
from easi_jax.gap.candidates import places
from easi_jax.gap.effect_set import Candidate
from easi_jax.gap.effect_vector import Layout
from easi_jax.gap.forward_selection import Selector
from easi_jax.gap.linear_response import LinearResponse
from easi_jax.gap.predictor import Predictor
from easi_jax.gap.whitening import Residuals
from easi_jax.gap.window_set import window_set
from easi_jax.model.parameters import ParameterSpace
from easi_jax.simulation import engine
from tests.easi_jax.gap.test_late_readings import ARM, DT, SECOND, recorded

_ON_FLOOR = """<mujoco><option timestep="0.002"/><worldbody>
<geom type="plane" size="5 5 0.1" friction="1 0.01 0.01"/>
<body pos="0 0 0.099"><joint name="x" type="slide" axis="1 0 0"/>
<joint name="z" type="slide" axis="0 0 1"/><geom type="box" size="0.1 0.1 0.1"/>
</body></worldbody><actuator><motor name="push" joint="x" gear="20"/></actuator>
</mujoco>"""


def _about(
    xml: str, horizon: float, speeds: bool = False
) -> tuple[Predictor, LinearResponse]:
    m = mujoco.MjModel.from_xml_string(xml)
    run = recorded(m, (0.0,) * m.nv)
    layout = Layout(m, places(m, scales_of(m, [run])))
    windows = window_set(m, [run], horizon, 0.0)
    assert windows is not None
    with engine.using("mujoco"):
        p = Predictor(m, ParameterSpace(()), layout, windows, DT, speeds=speeds)
    moved = np.zeros((len(windows), p.size))
    return p, LinearResponse(p, p.neutral, np.arange(p.blocks), moved)


@pytest.fixture(scope="module", params=[False, True], ids=["positions", "speeds"])
def arm(request: pytest.FixtureRequest) -> tuple[Predictor, LinearResponse]:
    return _about(ARM.format(SECOND), 0.2, request.param)


@pytest.mark.parametrize(
    ("field", "size", "near"),
    [
        ("constant", 0.02, 0.02),
        ("damping", 0.005, 0.06),
        ("stiffness", 0.05, 0.06),
        ("gain", 0.01, 0.03),
        ("mass", 0.01, 0.05),
        ("delay", 0.002, 0.1),
        ("armature", 0.0005, 0.1),
        ("coulomb", 0.005, 0.2),
    ],
)
def test_torques_are_as_simulated(
    arm: tuple[Predictor, LinearResponse], field: str, size: float, near: float
) -> None:
    p, linear = arm
    assert linear.holds.mean() > 0.9
    at = [i for i, c in enumerate(p.layout.columns) if c.field == field and c.index]
    vectors = np.repeat(p.neutral[None], len(at), 0)
    vectors[np.arange(len(at)), at] += size
    assert len(at) and linear.covers(vectors).all()
    errors = p.errors(np.concatenate([p.neutral[None], vectors])).astype(float)
    true = p.motion((errors[1:] - errors[0])[:, linear.holds])
    found = p.motion(linear.changes(vectors)[:, linear.holds])
    for a, b in list(zip(found, true, strict=True))[: 1 + p.speeds]:
        off, whole = (np.sqrt((x**2).mean((1, 2, 3))) for x in (a - b, b))
        assert (whole > 1e-7).all(), whole
        assert (off < near * whole).all(), (off / whole).tolist()


def test_a_machine_that_nothing_drives() -> None:
    passive = ARM.partition("<actuator>")[0] + "</mujoco>"
    spring = 'name="a" springref="50" stiffness="3"'
    p, linear = _about(passive.replace('name="a"', spring).format(SECOND), 0.2)
    assert p.simulator.mj_model.nu == 0
    assert linear.holds.mean() > 0.9


def test_faults_of_readings_and_limits_are_not_reckoned(
    arm: tuple[Predictor, LinearResponse],
) -> None:
    p, linear = arm
    for field in ("late", "bias", "limit"):
        vector = p.neutral.copy()
        (at,) = [i for i, c in enumerate(p.layout.columns) if c.field == field][:1]
        vector[at] += 0.001
        assert not linear.covers(vector[None]).any(), field


@pytest.mark.parametrize("speeds", [False, True])
def test_windows_in_which_a_foot_begins_to_slip_are_left_out(speeds: bool) -> None:
    p, linear = _about(_ON_FLOOR, 0.1, speeds)
    assert 0.1 < linear.holds.mean() < 0.9
    (at,) = [i for i, c in enumerate(p.layout.columns) if c.field == "constant"][:1]
    vector = p.neutral.copy()
    vector[at] += 0.5 * p.layout.columns[at].size
    errors = p.errors(np.stack([p.neutral, vector])).astype(float)
    true, _ = p.motion((errors[1] - errors[0])[: linear.count])
    found, _ = p.motion(linear.changes(vector[None])[0])
    off = np.sqrt(((found - true) ** 2).sum((1, 2)) / (true**2).sum((1, 2)))
    assert off[linear.holds].max() < 0.12 < np.median(off[~linear.holds])


@pytest.mark.parametrize("rows", [None, 8])  # of 11: short windows begin like that
def test_names_are_the_same_with_and_without(
    rows: int | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    m = mujoco.MjModel.from_xml_string(ARM.format(SECOND))
    truth = mujoco.MjModel.from_xml_string(ARM.format(SECOND))
    truth.dof_damping[1] += 0.05
    run = recorded(truth, (0.0, 0.0))
    found = places(m, scales_of(m, [run]))
    layout = Layout(m, found)
    windows = window_set(m, [run], 0.1, 0.0)
    assert windows is not None
    space = ParameterSpace(())
    with engine.using("mujoco"):
        p = Predictor(m, space, layout, windows, DT)
    count = len(windows)
    group = np.arange(count) % 4
    selector = Selector(p, bounds_of(space, layout), group, rows=rows)
    selector.residuals = _plain(p, rows)  # type: ignore[assignment]
    base = selector.fit([], p.neutral)
    candidates = [Candidate(q, s) for q in found for s in q.starts]
    asked = []
    simulate = Selector.simulate

    def counted(self: Selector, x: np.ndarray, *more: object) -> np.ndarray:
        asked.append(len(x))
        return simulate(self, x, *more)  # type: ignore[arg-type]

    monkeypatch.setattr(Selector, "simulate", counted)

    def best(few: int) -> list[str]:
        monkeypatch.setattr(screening, "_SIMULATED", few)
        asked.clear()
        screened = screening.screened(selector, base, candidates)
        return [*dict.fromkeys(c.place.key for _, c in screened)][:5]

    reckoned, few = best(8), sum(asked)
    monkeypatch.setattr(screening, "_HOLDS", 2.0)
    simulated, many = best(8), sum(asked)
    assert reckoned[0] == simulated[0] == "viscous_damping@b", simulated
    assert {*reckoned[:3]} == {*simulated[:3]}
    assert few < 0.7 * many


def _plain(p: Predictor, rows: int | None) -> object:
    """Residuals that are the errors themselves, in milliradians, of some rows."""

    rows = rows or p.steps + 1
    size = rows * p.nv

    class Plain:
        of = Residuals.of
        plain = np.broadcast_to(np.eye(size), (len(p.windows), size, size))

        def grouped(self, errors: np.ndarray) -> np.ndarray:
            assert errors.shape[2] == rows
            return 1e3 * errors

        def whitened(self, grouped: np.ndarray, at: object = None) -> np.ndarray:
            return grouped.reshape(*grouped.shape[:2], -1).astype(float)

    return Plain()
