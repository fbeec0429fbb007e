"""Effects that an owner wrote: what they do, and what is refused."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from easi_jax import Number, OwnEffect
from easi_jax.errors import UserError
from easi_jax.gap.candidates import places
from easi_jax.gap.effect_vector import Layout
from easi_jax.io.models.effects_file import parsed_effects
from easi_jax.io.models.own_effects_file import read_all, read_own_effects
from easi_jax.model import own_effects_check
from easi_jax.model.effect_catalog import CATALOG, Scales
from easi_jax.model.effect_numbers import EFFECT_TABLE, NUMBERS, OWN_LAWS
from easi_jax.model.found_effects import joined
from easi_jax.model.own_effects import registered
from easi_jax.model.own_effects_check import check_own_effects
from easi_jax.model.own_laws import reading_offsets
from easi_jax.model.parameters import ParameterSpace
from easi_jax.simulation.simulator import Simulator

EXAMPLES = Path(__file__).parents[3] / "examples" / "own_effects"
STEP, SUBSTEPS, COUNT = 0.002, 5, 30
XML = """<mujoco><option timestep="0.002" gravity="0 0 0" integrator="implicitfast"/>
<worldbody><body><joint name="shoulder" axis="0 1 0" damping="0.05"/>
<geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.02" mass="1"/><body pos="0.3 0 0">
<joint name="elbow" axis="0 1 0" damping="0.05"/>
<geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.02" mass="0.5"/></body></body>
</worldbody><actuator><motor name="m1" joint="shoulder"/>
<motor name="m2" joint="elbow"/></actuator></mujoco>"""
SPRING, REST, SHARE = 2.0, 0.3, 0.7
FIXED = {
    "effect.coupling_spring.stiffness": SPRING,
    "effect.coupling_spring.rest": REST,
    "effect.quadratic_thrust.m1.share": SHARE,
    "effect.tide.elbow.size": 0.4,
}
START, COMMAND = np.array([0.1, -0.2]), np.array([0.5, -0.1])


def tide(now, p):
    return p.size * jnp.sin(3.0 * now.time)


_WORD: Any = "0"
TIDE = OwnEffect(
    "tide",
    'something pulls "{at}" by {size}, now this way, now that',
    (Number("size", "N m", -1.0, 1.0),),
    force=tide,
    on="joint",
    at=("elb*",),
)


@pytest.fixture
def arm() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(XML)


@pytest.fixture
def own() -> Iterator[None]:
    files = [EXAMPLES / "coupling_spring.py", EXAMPLES / "propeller.py"]
    with registered([*read_all(files), TIDE]):
        yield


def scales_of(m: mujoco.MjModel) -> Scales:
    joints, actuators = [np.ones(m.nv)] * 9, [np.ones(m.nu)] * 3
    order = [*joints[:7], *actuators, *joints[7:], np.zeros(0)]
    return Scales(*order, dt=0.01, longest=0.1)


@pytest.mark.parametrize("engine", ["mjx", "mujoco"])
def test_moves_as_mujoco_does_with_the_forces(
    arm: mujoco.MjModel, own: None, engine
) -> None:
    """A force, a command and what depends on the time, beside MuJoCo C."""
    check_own_effects(arm)
    s = Simulator(arm, ParameterSpace(()), STEP * SUBSTEPS, fixed=FIXED, engine=engine)
    model = s.model(jnp.zeros(0))
    first = s.start(jnp.asarray(START), jnp.zeros(2), model)

    @jax.jit
    def moved(first):
        def step(x, _):
            return s.step(model, x, jnp.asarray(COMMAND)), None

        return jax.lax.scan(step, first, None, length=COUNT)[0]

    end = moved(first)
    d = mujoco.MjData(arm)
    d.qpos[:] = START
    u = COMMAND[0]
    for _ in range(COUNT * SUBSTEPS):
        d.ctrl[:] = (1 - SHARE) * u + SHARE * u * abs(u), COMMAND[1]
        twist = SPRING * (d.qpos[1] - d.qpos[0] - REST)
        d.qfrc_applied[:] = twist, -twist + 0.4 * np.sin(3.0 * d.time)
        mujoco.mj_step(arm, d)
    np.testing.assert_allclose(end.qpos, d.qpos, atol=2e-6)
    np.testing.assert_allclose(end.qvel, d.qvel, atol=2e-5)
    assert float(end.time) == pytest.approx(d.time, rel=1e-5)


def test_catalog_has_them_inside_alone(arm: mujoco.MjModel, own: None) -> None:
    before = set(CATALOG)
    assert {"coupling_spring", "quadratic_thrust", "tide"} <= before
    found = [p for p in places(arm, scales_of(arm)) if p.effect in OWN_LAWS]
    # One actuator after the other, both alike are no candidate; the tide at one joint.
    assert [p.key for p in found] == [
        *("tide@elbow", "quadratic_thrust@m1", "quadratic_thrust@m2"),
        "coupling_spring@",
    ]
    layout = Layout(arm, found)
    x = np.arange(1.0, len(layout) + 1)
    e = layout.effects(jnp.asarray(x, jnp.float32))
    assert layout.columns[0].name == "tide.size"
    # Rows: stiffness, rest, share, size.
    np.testing.assert_array_equal(e.own, [[4, 0], [5, 0], [2, 3], [0, 1]])
    neutral = layout.effects(jnp.asarray(layout.neutral, jnp.float32))
    assert not np.any(neutral.own)


def test_nothing_stays_registered(arm: mujoco.MjModel) -> None:
    before = [*CATALOG], [*NUMBERS], [*EFFECT_TABLE]
    with pytest.raises(UserError, match="give it another"), registered([TIDE, TIDE]):
        pass
    assert ([*CATALOG], [*NUMBERS], [*EFFECT_TABLE]) == before and not OWN_LAWS


def test_a_found_one_is_a_parameter(arm: mujoco.MjModel, own: None) -> None:
    content = {
        "effects": [
            {
                **{"effect": "tide", "at": "elbow", "kind": "joint"},
                "columns": {"tide.size": 0.4},
                "std": {"tide.size": 0.01},
            }
        ]
    }
    space, _ = joined(arm, ParameterSpace(()), parsed_effects(content, "e.yaml"))
    (p,) = space.parameters
    assert (p.name, p.unit, p.nominal) == ("tide@elbow.size", "N m", 0.4)
    assert p.bounds == (-1.0, 1.0)


def test_an_effects_file_alone_says_what_it_needs() -> None:
    item = {"effect": "tide", "columns": {"tide.size": 0.4}}
    with pytest.raises(UserError, match="--effects-from"):
        parsed_effects({"effects": [item]}, "e.yaml")


def test_readings(arm: mujoco.MjModel) -> None:
    """An encoder that is off by a sine of its own position."""

    def misread(now, p):
        q = now.position[now.here]
        return q + p.size * jnp.sin(q)

    effect = OwnEffect(
        "eccentric",
        "{size}",
        (Number("size", "rad", -0.1, 0.1),),
        reading=misread,
        on="joint",
    )
    with registered([effect]):
        check_own_effects(arm)
        (first, *_) = (
            p for p in places(arm, scales_of(arm)) if p.effect == "eccentric"
        )
        e = Layout(arm, [first]).effects(jnp.array([0.05]))
        none = jnp.zeros(2)
        off = reading_offsets(e.own, e.laws, jnp.array([0.5, 1.0]), none, none, 0.0)
    np.testing.assert_allclose(off, [0.05 * np.sin(0.5), 0.0], rtol=1e-6)


HEAD = "import time\nimport numpy\nimport jax.numpy as jnp\n"
HEAD += "from easi_jax import Number, OwnEffect\nseen = []\n"
TAIL = "\nX = OwnEffect('x', '{a}', (Number('a', '1', 0.0, 1.0),), force=f, on='joint')"


@pytest.mark.parametrize(
    ("body", "said"),
    [
        ("def f(now, p):\n    return p.b", "line 7: AttributeError"),
        ("def f(now, p):\n    return jnp.ones(3) * p.a", r"shape \(3,\)"),
        ("def f(now, p):\n    return {'wrist': p.a}", '"wrist" is no joint'),
        ("def f(now, p):\n    return p.a / 0.0", "not finite"),
        ("def f(now, p):\n    return 1.0 + p.a", "neutral"),
        ("def f(now, p):\n    return p.a * numpy.random.normal()", "two answers"),
        (
            "def f(now, p):\n    seen.append(1)\n    return p.a * len(seen)",
            "two answers",
        ),
        ("def f(now, p):\n    time.sleep(1.2)\n    return p.a", "quicker"),
        ("def f(now, p):\n    return p.a if now.time > 1 else 0.0", "jnp.where"),
        ("def f(now, p):\n    return {}", "nothing"),
        ("def f(now, p):\n    p.a", "None, which is no real number"),
        ("def f(now, p):\n    return '0.1'", "'0.1', which is no real number"),
        ("def f(now, p):\n    return {'elbow': 1j * p.a}", "no real number"),
    ],
)
def test_what_cannot_be_believed_is_refused(
    arm: mujoco.MjModel, body: str, said: str, tmp_path: Path
) -> None:
    path = tmp_path / "mine.py"
    path.write_text(HEAD + body + TAIL)
    with (
        registered(read_own_effects(path)),
        pytest.raises(UserError, match=said) as told,
    ):
        check_own_effects(arm)
    assert "mine.py, line " in str(told.value)


def test_a_function_that_never_ends_is_refused(
    arm: mujoco.MjModel, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(own_effects_check, "_PATIENCE", 0.5)
    path = tmp_path / "mine.py"
    body = "def f(now, p):\n    while not seen:\n        time.sleep(0.05)"
    path.write_text(HEAD + body + TAIL)
    (effect,) = read_own_effects(path)
    with (
        registered([effect]),
        pytest.raises(UserError, match=r"mine.py, line \d+: .*loop without end"),
    ):
        check_own_effects(arm)
    effect.force.__globals__["seen"].append(1)  # type: ignore[union-attr]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("x = (", "mine.py, line 1: "),
        ("import jax\n\nx = 1 / 0\n", "mine.py, line 3: ZeroDivisionError"),
        ("x = 1\n", "no easi_jax.OwnEffect"),
    ],
)
def test_bad_files(text: str, said: str, tmp_path: Path) -> None:
    path = tmp_path / "mine.py"
    with pytest.raises(UserError, match="no such file"):
        read_own_effects(path)
    path.write_text(text)
    with pytest.raises(UserError, match=said):
        read_own_effects(path)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"name": "Tide"}, "lower-case"),
        ({"name": "backlash"}, "give it another"),
        ({"force": None}, "force="),
        ({"reading": tide}, "two effects"),
        ({"on": "body"}, "joint, actuator or model"),
        ({"numbers": ()}, "numbers= is empty"),
        ({"numbers": (Number("a", "1", 1.0, 0.0),)}, "no range"),
        ({"numbers": (Number("a", "1", 1.0, 2.0),)}, "not within"),
        ({"sentence": "{none}"}, "no number of it"),
        ({"at": ("wrist",)}, "its at= names"),
        ({"at": "wrist"}, "at= holds a tuple, of one with a comma"),
        ({"numbers": Number("a", "1", 0.0, 1.0)}, "numbers= holds a tuple"),
        ({"numbers": ("a",)}, "numbers= holds a tuple"),
        ({"numbers": (Number("a", "1", _WORD, 1.0),)}, "hold numbers"),
        ({"name": 3}, "lower-case"),
        ({"sentence": 3}, "no text"),
        ({"sentence": "by {at:.3g}"}, "nothing more there"),
        ({"sentence": "by {at.x}"}, "nothing more there"),
    ],
)
def test_bad_effects(arm: mujoco.MjModel, changes: dict, said: str) -> None:
    given = {f: getattr(TIDE, f) for f in TIDE.__dataclass_fields__} | changes
    with (
        pytest.raises(UserError, match=said),
        registered([OwnEffect(**given)]),
    ):
        check_own_effects(arm)
