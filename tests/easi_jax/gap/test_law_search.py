"""Laws that nobody listed, from motion to a formula."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest

from easi_jax.data.recording import Run
from easi_jax.data.windows import fitted_velocity
from easi_jax.gap import fitting
from easi_jax.gap.analysis import Analysis, proposed_laws
from easi_jax.gap.effect_search import Places
from easi_jax.gap.offered_terms import offered
from easi_jax.model.found_laws import FOUND_LAW, FoundLaw, add_law, public_name
from easi_jax.model.joint_space import Configuration
from easi_jax.model.law_terms import Term
from easi_jax.model.own_effects import registered
from easi_jax.model.own_effects_check import check_own_effects
from easi_jax.model.parameters import ParameterSpace
from easi_jax.simulation import engine

DT, STEPS, NOISE = 0.01, 4, 3e-4
ONE = """<mujoco><option timestep="0.0025"/><worldbody><body>
<joint name="j" axis="0 1 0" damping="0.05"/>
<geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.02" mass="0.5"/></body></worldbody>
<actuator><motor name="m" joint="j"/></actuator></mujoco>"""


@pytest.fixture(autouse=True)
def catalog() -> Iterator[None]:
    with registered([]):
        yield


GYRO = ONE.replace("<geom", '<site name="s"/><geom').replace(
    "</mujoco>", '<sensor><gyro name="gyro" site="s"/></sensor></mujoco>'
)


def recorded(m: mujoco.MjModel, seed: int, force: Callable) -> Run:
    rng, d, c = np.random.default_rng(seed), mujoco.MjData(m), Configuration.of(m)
    t = DT * np.arange(400)
    rate, phase = rng.uniform(2, 10, 3), rng.uniform(0, 6, 3)
    ctrl = 0.4 * np.sin(rate * t[:, None] + phase).sum(1)[:, None]
    q, sensed = [], []
    for u in ctrl:
        q.append(d.qpos + NOISE * rng.normal(size=m.nq))
        d.ctrl[:] = u
        mujoco.mj_forward(m, d)
        sensed.append(d.sensordata + 0.01 * rng.normal(size=m.nsensordata))
        for _ in range(STEPS):
            d.qfrc_applied[:] = force(d)
            mujoco.mj_step(m, d)
    qpos = np.array(q)
    speed = fitted_velocity(qpos, DT, c)
    read = {"gyro": np.array(sensed)} if m.nsensordata else {}
    given = f"r{seed}", "made", DT, t, qpos, speed, False, ctrl, c
    return replace(Run(*given), sensors=read)


def analysis(force: Callable, xml: str = ONE) -> Analysis:
    """Without any effect of the catalog, so that it takes seconds."""
    m = mujoco.MjModel.from_xml_string(xml)
    runs = [recorded(m, k, force) for k in range(3)]
    noise = np.array([NOISE, 1.0])
    given = m, ParameterSpace(()), runs[:2], runs[2:], noise, 0.2
    return Analysis(*given, only=[])


@pytest.mark.slow
def test_a_cubic_spring_is_found_and_confirmed() -> None:
    with engine.using("mujoco"):
        a = analysis(lambda d: -0.3 * d.qpos**3)
        outcome = a.run()
    (found,) = outcome.found
    assert public_name(found.place.effect) == FOUND_LAW
    assert found.values["c1"][0] == pytest.approx(-0.3, rel=0.02)
    assert found.values["c1"][2] == "N m/rad^3"
    assert outcome.verdict == "explained" and a.final is not a
    assert outcome.known_effects is not None
    assert outcome.after.gap < 0.2 * outcome.known_effects


@pytest.mark.parametrize(
    ("force", "text", "xml"),
    [
        (lambda d: 0.05 * np.abs(d.qvel), "abs(qvel.j)", ONE),
        (lambda d: 0.15 * d.ctrl * np.abs(d.ctrl), "ctrl.m*abs(ctrl.m)", ONE),
        (lambda d: 0.05 * np.abs(d.qvel), "abs(qvel.j)", GYRO),
    ],
)
def test_terms_are_proposed(force: Callable, text: str, xml: str) -> None:
    """Also where sensors are compared."""
    with engine.using("mujoco"):
        a = analysis(force, xml)
        assert len(a.predictor.sensors) == 3 * (xml == GYRO)
        proposed = proposed_laws(a, a._chosen().model)
    assert proposed[0].law.terms[0].text == text


def test_nothing_is_proposed_where_nothing_is_left() -> None:
    with engine.using("mujoco"):
        a = analysis(lambda d: 0.0 * d.qpos)
        assert proposed_laws(a, a._chosen().model) == []


def test_laws_of_an_earlier_analysis_are_not_offered() -> None:
    with engine.using("mujoco"):
        a = analysis(lambda d: 0.0 * d.qpos)
        name = add_law(FoundLaw((("j", 1.0),), (Term("qpos.j**3"),)))
        given = a.m, a.space, a.data.scales
        assert not [p for p in Places(*given).known if p.startswith(name)]
        assert f"{name}@j" in Places(*given, only=[f"{name}@j"]).known


def test_a_law_is_looked_for_where_nothing_was_fitted(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """No effect, no parameter, and steps whose error does not show."""
    monkeypatch.setattr(fitting, "STEPS_SEEN", np.inf)
    with engine.using("mujoco"):
        a = analysis(lambda d: 0.05 * np.abs(d.qvel))
        model = a._chosen().model
        assert not len(model.fit.active)
        (law, *_) = proposed_laws(a, model)
    assert law.law.terms[0].text == "abs(qvel.j)"


def test_laws_of_another_machine_are_not_tried_on_this_one() -> None:
    """As where one process has looked at both."""
    add_law(FoundLaw((("elbow", 1.0),), (Term("qvel.elbow**0.3"),)))
    check_own_effects(mujoco.MjModel.from_xml_string(ONE))


def test_what_is_offered_between_joints() -> None:
    """Of few joints all pairs, also with each other's commands; of many those next to
    each other."""

    def pairs(count: int) -> set[tuple[int, int]]:
        body = ""
        for k in reversed(range(count)):
            body = (
                f'<body pos="0 0 -0.1"><joint name="{k}" axis="0 1 0"/>'
                f'<geom size="0.02"/><body><geom size="0.01"/>{body}</body></body>'
            )
        drive = '<motor name="m" joint="0"/>'
        m = mujoco.MjModel.from_xml_string(
            f"<mujoco><worldbody>{body}</worldbody><actuator>{drive}</actuator></mujoco>"
        )
        ones = np.ones(m.nv)
        given = {k: ones for k in ("position", "speed", "span", "torque", "inertia")}
        scales: Any = SimpleNamespace(**given, command=np.ones(1))
        found, texts = set(), []
        for t in offered(m, scales):
            about = {int(n) for kind, n in t.term.names if kind != "ctrl"}
            about |= {int(n) for n, _ in t.acts}
            found |= {tuple(sorted(about))} if len(about) == 2 else set()
            if ("ctrl", "m") in t.term.names and t.acts[0][0] == "1":
                texts.append(t.term.text)
        assert "ctrl.m" in texts
        return found

    assert pairs(3) == {(0, 1), (0, 2), (1, 2)}
    assert pairs(8) == {(k, k + 1) for k in range(7)}


def test_what_the_table_has_is_not_offered() -> None:
    m = mujoco.MjModel.from_xml_string(ONE)
    with engine.using("mujoco"):
        scales = analysis(lambda d: 0.0 * d.qpos).data.scales
    texts = [t.term.text for t in offered(m, scales)]
    assert len(set(texts)) == len(texts) > 40
    assert not {"qpos.j", "qvel.j"} & {*texts}
