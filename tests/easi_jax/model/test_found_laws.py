"""Laws as text: read, evaluated, remembered, simulated, written."""

from collections.abc import Iterator
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from easi_jax.data.law_states import memory_path
from easi_jax.errors import UserError
from easi_jax.io.models.effects_file import read_effects, write_effects
from easi_jax.io.models.repaired_mjcf import repaired_model
from easi_jax.model.found_effects import EffectEntry, FoundEffects, joined
from easi_jax.model.found_laws import FoundLaw, add_law, public_name
from easi_jax.model.law_terms import Known, Term
from easi_jax.model.own_effects import registered
from easi_jax.model.parameters import ParameterSpace
from easi_jax.simulation.engine import Engine
from easi_jax.simulation.simulator import Simulator
from easi_jax.simulation.with_effects import simulator_with

XML = """<mujoco><option timestep="0.002" gravity="0 0 0"/><worldbody><body>
<joint name="a" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 .3 0 0" size=".02"
mass="1"/><body pos=".3 0 0"><joint name="left-wrist" axis="0 1 0"/>
<geom type="capsule" fromto="0 0 0 .3 0 0" size=".02" mass=".5"/></body></body>
</worldbody><actuator><motor name="m" joint="a"/></actuator></mujoco>"""
SUM = '(qvel.a + qvel["left-wrist"])'


@pytest.fixture
def m() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(XML)


@pytest.fixture(autouse=True)
def catalog() -> Iterator[None]:
    with registered([]):
        yield


def known(t: np.ndarray) -> Known:
    q, v = {"a": np.sin(t)}, {"a": np.cos(t)}
    return Known(q, v, {"m": 0.5 * t}, t)


@pytest.mark.parametrize(
    ("text", "value", "unit"),
    [
        ("qpos.a**3", lambda t: np.sin(t) ** 3, {"rad": 3.0}),
        ("abs(qvel.a)", lambda t: abs(np.cos(t)), {"rad": 1.0, "s": -1.0}),
        ("-time*ctrl.m", lambda t: -0.5 * t**2, {"s": 1.0, "ctrl": 1.0}),
        (
            "sign(qvel.a, 0.1)*sin(2*qpos.a)",
            lambda t: np.tanh(10 * np.cos(t)) * np.sin(2 * np.sin(t)),
            {},
        ),
    ],
)
def test_terms(text: str, value, unit: dict[str, float]) -> None:
    t = np.linspace(0, 3, 20)
    term = Term(text)
    np.testing.assert_allclose(term.value(known(t)), value(t), rtol=1e-6, atol=1e-7)
    got = term.unit(lambda kind, name: "ctrl" if kind == "ctrl" else "rad")
    assert got == unit


@pytest.mark.parametrize(
    "text",
    [
        *(
            "__import__('os').system('x')",
            "qpos.a.b",
            "x",
            "qvel.a**99",
            "1 if 1 else 2",
        ),
        *("sign(qvel.a)", "lag(lag(qvel.a, 1), 2)", "qpos[a]", "qvel.a/2", "sin()"),
        *("lag(qvel.a, -1)", "(" * 200, "qpos.a" + "+1" * 200, "True"),
    ],
)
def test_what_is_no_term_is_refused(text: str) -> None:
    with pytest.raises(UserError, match="term"):
        Term(text)


def test_shown_without_widths() -> None:
    law = FoundLaw(
        (("a", 1.0), ("left-wrist", 1.0)),
        (Term(f"sign({SUM}, 0.02)"), Term("lag(abs(qvel.a), 10)*qvel.a")),
    )
    assert law.shown((-1.9, 0.25), "N m") == (
        "-1.9*sign(qvel.a + qvel.left-wrist) + 0.25*lag(abs(qvel.a), 10 s)*qvel.a N m"
    )
    assert public_name(f"{law.name}@a, x") == "found_law@a, x"


def test_memories_follow() -> None:
    t = np.arange(0, 5, 0.001)
    (lag,) = Term("lag(ctrl.m, 0.5)").memories
    # A ramp is followed by one time later.
    path = memory_path(lag, known(t), 0.001)
    np.testing.assert_allclose(path[-1], 0.5 * (t[-1] - 0.5), rtol=1e-3)
    (bristle,) = Term("dahl(qvel.a, 0.1)").memories
    path = memory_path(bristle, known(t), 0.001)
    # Dahl: 1 - exp(-x / s) after a way x from rest.
    k = 500
    np.testing.assert_allclose(path[k], 1 - np.exp(-np.sin(t[k]) / 0.1), rtol=2e-3)


@pytest.mark.parametrize("how", ["mujoco", "mjx"])
def test_a_law_is_simulated_as_mujoco_does(m: mujoco.MjModel, how: Engine) -> None:
    """Friction on the sum of two speeds, and a bristle, by either engine."""
    law = FoundLaw(
        (("a", 1.0), ("left-wrist", 1.0)),
        (Term(f"sign({SUM}, 0.2)"), Term(f"dahl({SUM}, 0.05)")),
    )
    name = add_law(law)
    fixed = {f"effect.{name}.a.c1": -0.3, f"effect.{name}.a.c2": -0.2}
    s = Simulator(m, ParameterSpace(()), 0.01, fixed=fixed, engine=how)
    model = s.model(jnp.zeros(0))
    first = s.start(jnp.array([0.1, -0.2]), jnp.array([2.0, 1.0]), model)

    @jax.jit
    def moved(first):
        def step(x, _):
            return s.step(model, x, jnp.array([0.1])), None

        return jax.lax.scan(step, first, None, length=40)[0]

    end = moved(first)
    d, z = mujoco.MjData(m), 0.0
    d.qpos[:], d.qvel[:], d.ctrl[:] = (0.1, -0.2), (2.0, 1.0), 0.1
    for _ in range(200):
        w = d.qvel.sum()
        d.qfrc_applied[:] = -0.3 * np.tanh(w / 0.2) - 0.2 * z
        z = np.sign(w) + (z - np.sign(w)) * np.exp(-abs(w) / 0.05 * 0.002)
        mujoco.mj_step(m, d)
    np.testing.assert_allclose(end.qpos, d.qpos, atol=3e-5)
    np.testing.assert_allclose(end.hidden, [z], atol=1e-4)


@pytest.mark.parametrize("how", ["mujoco", "mjx"])
def test_a_law_that_a_model_has_at_zero_alone_is_left_out(
    m: mujoco.MjModel, how: Engine
) -> None:
    """As a program does that is for vectors without laws, whatever is registered."""
    name = add_law(FoundLaw((("a", 1.0),), (Term("dahl(qvel.a, 0.05)"),)))
    fixed = {f"effect.{name}.a.c1": -0.3}
    s = Simulator(m, ParameterSpace(()), 0.01, fixed=fixed, engine=how)
    given = s.model(jnp.zeros(0))
    assert given.effects is not None and given.effects.laws
    ends = []
    for laws in (given.effects, given.effects.replace(laws=())):
        model = given.replace(effects=laws, present=("coulomb",))
        first = s.start(jnp.array([0.1, -0.2]), jnp.array([2.0, 1.0]), model)
        assert first.hidden == ()
        ends.append(s.step(model, first, jnp.array([0.1])).qpos)
    np.testing.assert_array_equal(*ends)


DIFFERENCE = '(qpos.a - qpos["left-wrist"])'


@pytest.mark.parametrize(
    ("share", "terms", "numbers", "said"),
    [
        (-1.0, [DIFFERENCE, DIFFERENCE.replace("qpos", "qvel")], (-2.0, -0.05), True),
        (1.0, [f"sign({SUM}, 0.02)"], (-0.3,), True),
        (1.0, [SUM], (0.1,), False),  # drives on
        (1.0, [f"{SUM}*abs({SUM})"], (-0.1,), False),
        (1.0, [DIFFERENCE], (-2.0,), False),  # acts along another sum
    ],
)
def test_a_tendon_says_what_two_joints_share(
    m: mujoco.MjModel,
    share: float,
    terms: list[str],
    numbers: tuple[float, ...],
    said: bool,
    tmp_path: Path,
) -> None:
    (tmp_path / "m.xml").write_text(XML)
    law = FoundLaw((("a", 1.0), ("left-wrist", share)), tuple(map(Term, terms)))
    each = zip(law.numbers, numbers, strict=True)
    columns = {f"{law.name}.{k}": x for k, x in each}
    entry = EffectEntry(add_law(law), "a", "joint", columns, {})
    written = repaired_model(tmp_path / "m.xml", [entry])
    assert written.left == ([] if said else ["found_law@a"])
    assert written.model.ntendon == int(said)
    if not said:
        return
    fixed = {entry.address(k): x for k, x in columns.items()}
    s = Simulator(m, ParameterSpace(()), 0.01, fixed=fixed, engine="mujoco")
    model, d = s.model(jnp.zeros(0)), mujoco.MjData(written.model)
    state = s.start(jnp.array([0.4, -0.2]), jnp.array([2.0, 1.0]), model)
    d.qpos[:], d.qvel[:], d.ctrl[:] = (0.4, -0.2), (2.0, 1.0), 0.1
    step = jax.jit(lambda x: s.step(model, x, jnp.array([0.1])))
    for _ in range(20):
        state = step(state)
        mujoco.mj_step(written.model, d, 5)
    # Forces of laws are explicit; those of tendons are what the integrator makes them.
    np.testing.assert_allclose(state.qpos, d.qpos, atol=5e-3)
    free = mujoco.MjData(m)
    free.qpos[:], free.qvel[:], free.ctrl[:] = (0.4, -0.2), (2.0, 1.0), 0.1
    mujoco.mj_step(m, free, 100)
    assert np.abs(free.qpos - d.qpos).max() > 0.05


FILE = """
effects:
- effect: found_law
  at: a
  kind: joint
  law: whatever
  acts: {a: 1.0}
  terms: [qpos.a**3, abs(qvel.a)]
  columns: {c1: -0.25, c2: 0.1}
  std: {c1: 0.01}
"""


def test_a_file_says_all_of_it(m: mujoco.MjModel, tmp_path: Path) -> None:
    path = tmp_path / "effects.yaml"
    path.write_text(FILE)
    entries, _ = read_effects(path)
    space, stays = joined(m, ParameterSpace(()), FoundEffects(tuple(entries)))
    names = [p.name for p in space.parameters]
    assert names == ["found_law@a.c1", "found_law@a.c2"] and not stays
    assert [p.unit for p in space.parameters] == ["N m/rad^3", "N m s/rad"]
    again = tmp_path / "again.yaml"
    write_effects(again, "m", entries, [{}], [])
    assert "found_law_" not in again.read_text()
    assert "-0.25*qpos.a^3 + 0.1*abs(qvel.a)" in again.read_text()
    second, _ = read_effects(again)
    assert second == entries
    machine = Simulator(m, ParameterSpace(()), 0.01, engine="mujoco")
    assert simulator_with(machine, FoundEffects(tuple(entries))).is_timed


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("qpos.a**3", "exec(1)", "effect 1: term"),
        ("terms: [qpos.a**3, abs(qvel.a)]", "terms: qpos.a", "acts: holds joints"),
        ("columns: {c1: -0.25, c2: 0.1}", "columns: {c1: -0.25}", "lacks a number"),
        ("std: {c1: 0.01}", "std: {c7: 0.01}", "for each term: c1, c2"),
        ("acts: {a: 1.0}", "acts: {a: .nan}", "no finite number"),
        ("acts: {a: 1.0}", "acts: {}", "names joints"),
        ("law: whatever", "lore: whatever", 'unknown key "lore"'),
    ],
)
def test_bad_files(old: str, new: str, said: str, tmp_path: Path) -> None:
    path = tmp_path / "effects.yaml"
    assert old in FILE
    path.write_text(FILE.replace(old, new))
    with pytest.raises(UserError, match=said):
        read_effects(path)


def test_a_model_without_the_joint(m: mujoco.MjModel, tmp_path: Path) -> None:
    path = tmp_path / "effects.yaml"
    path.write_text(FILE.replace("qpos.a**3", "qpos.elbow**3"))
    entries, _ = read_effects(path)
    with pytest.raises(UserError, match='no joint "elbow"'):
        joined(m, ParameterSpace(()), FoundEffects(tuple(entries)))
