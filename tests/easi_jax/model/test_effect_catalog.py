"""One row an effect: as the contract has it, and nowhere else."""

import ast
import re
import string
from pathlib import Path

import mujoco
import numpy as np
import pytest

from easi_jax.gap.candidates import places, ripples
from easi_jax.model.contact_pairs import pair_ids
from easi_jax.model.effect_catalog import CATALOG, Effect, Scales
from easi_jax.model.effect_numbers import NUMBERS, field_of
from easi_jax.model.effects import Effects
from easi_jax.model.quantities import TABLE

ROOT = Path(__file__).parents[3]

# Name, kinds of places and parameters, as in the log format's table.
CONTRACT = """
coulomb_friction     joint         torque
stribeck_friction    joint         static kinetic velocity
viscous_damping      joint         damping
quadratic_drag       joint body    coefficient
joint_stiffness      joint         stiffness rest
constant_force       joint body    torque x y z
torque_ripple        joint         amplitude cycles_per_rev phase
armature             joint         armature
backlash             joint         width
actuator_gain        actuator      gain
drive_stiffness      actuator      factor
drive_damping        actuator      factor
actuator_strength    actuator      factor
actuator_delay       actuator      delay
actuator_lag         actuator      time_constant
actuator_saturation  actuator      limit
actuator_deadband    actuator      width
payload_mass         body          mass
com_offset           body          x y z
gravity_tilt         model         roll pitch
sensor_bias          joint sensor  bias
sensor_delay         joint sensor  delay
contact_friction     geom model    friction
contact_softness     geom model    stiffness damping
"""
# Literals with the name of an effect outside the catalog, and why.
ELSEWHERE = {
    "easi_jax/gap/sensor_faults.py": "finds these two where no simulation shows them",
}
# An effect and a number of the model have this name.
NUMBER_OF_MODELS = "armature"

# Two slides and a hinge in contact with a floor, one drive of either kind.
XML = """
<mujoco>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 1"/>
    <body name="cart" pos="0 0 0.1">
      <joint name="x" type="slide" axis="1 0 0" damping="1" frictionloss="0.2"/>
      <geom name="cart" size="0.1"/>
      <body name="pole">
        <joint name="turn" axis="0 1 0" armature="0.01"/>
        <geom name="pole" size="0.1" pos="0 0 0.5"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="push" joint="x"/>
    <position name="twist" joint="turn" kp="2" kv="0.1"/>
  </actuator>
</mujoco>"""


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(XML)


def scales(m: mujoco.MjModel) -> Scales:
    rng = np.random.default_rng(0)
    joint, drive = rng.uniform(0.2, 3.0, (9, m.nv)), rng.uniform(0.2, 3.0, (3, m.nu))
    touching = np.ones(len(pair_ids(m)))
    sizes = (*joint[:7], *drive, *joint[7:], touching)
    return Scales(*sizes, dt=0.01, longest=0.1)


def kinds(row: Effect) -> set[str]:
    numbers = [p.number for s in row.sites.values() for p in s.parts]
    sensors = {"sensor"} if all(n.acts == "readings" for n in numbers) else set()
    return {*row.sites, *sensors}


def parameters(row: Effect) -> list[str]:
    names = [p.name for s in row.sites.values() for p in s.parts if p.name]
    return list(dict.fromkeys(names))


def test_each_effect_of_the_contract_is_one_row() -> None:
    known = {}
    for line in CONTRACT.strip().splitlines():
        name, at, numbers = re.split(r"\s{2,}", line)
        known[name] = (set(at.split()), set(numbers.split()))
    assert {n: (kinds(r), set(parameters(r))) for n, r in CATALOG.items()} == known


def test_the_contract_of_this_test_is_the_log_formats() -> None:
    path = ROOT.parent / "shared" / "LOG_FORMAT.md"
    if not path.is_file():
        pytest.skip("../shared/LOG_FORMAT.md is not here")
    rows = re.findall(r"^\| `(\w+)` \|.*\| (`.*?) \|$", path.read_text(), re.M)
    told = {name: text for name, text in rows if name in CATALOG}
    assert set(told) == set(CATALOG)
    others = {*CATALOG} - {NUMBER_OF_MODELS}
    for name, text in told.items():
        named = {*re.findall(r"`(\w+)`", text)} - others
        assert named == set(parameters(CATALOG[name]))


def test_every_number_belongs_to_an_effect() -> None:
    used = {
        p.column for r in CATALOG.values() for s in r.sites.values() for p in s.parts
    }
    assert used == set(NUMBERS)
    fields = {field_of(column) for column in used}
    of_owners = {"own", "laws"}
    assert (
        fields == set(Effects.__dataclass_fields__) - {"effective_inertia"} - of_owners
    )


def test_units_have_one_notation(model: mujoco.MjModel) -> None:
    """`kg m^2` is `kg m^2` wherever people are told."""
    unit = re.compile(r"(1|ctrl|[A-Za-z]+(\^\d)?)([ /][A-Za-z]+(\^\d)?)*")
    s = scales(model)
    found = places(model, s) + ripples(model, 0, s, [30.0])
    told = {c.unit for p in found for c in p.columns}
    told |= {q.unit(model, 0) for table in TABLE.values() for q in table.values()}
    assert {"kg m^2", "N m s^2/rad^2", "1/s^2", "ctrl"} <= told
    assert [u for u in told if not unit.fullmatch(u)] == []


def test_what_a_refit_may_move_has_the_units_of_the_model(
    model: mujoco.MjModel,
) -> None:
    for row in CATALOG.values():
        kind, quantity = row.refits
        if not kind:
            continue
        number = row.sites[kind].parts[0].number
        for i in (0, 1):
            if number.unit(model, i) == "1":  # a factor on the model's
                continue
            assert number.unit(model, i) == TABLE[kind][quantity].unit(model, i), row


def test_what_an_effect_contains_sits_at_the_same_places() -> None:
    for row in CATALOG.values():
        if row.contains:
            assert set(row.sites) <= set(CATALOG[row.contains].sites), row.name


def test_sentences_name_parameters_of_the_row() -> None:
    for row in CATALOG.values():
        said = {name for _, name, _, _ in string.Formatter().parse(row.sentence)}
        allowed = {None, "at", "kind", "pair", *parameters(row)}
        assert said <= allowed, row.name


def test_fits_start_within_their_bounds(model: mujoco.MjModel) -> None:
    s = scales(model)
    found = places(model, s) + ripples(model, 0, s, [30.0])
    assert {p.effect for p in found} == set(CATALOG)
    assert {p.kind for p in found} == {"joint", "actuator", "body", "model", "geom"}
    assert {p.effect for p in found if p.shared} == {"actuator_delay", "actuator_lag"}
    for p in found:
        for k, c in enumerate(p.columns):
            assert c.low < c.high and 0 < c.size < c.high - c.low, (p.key, c)
            for start in p.starts:
                assert c.low <= start[k] <= c.high, (p.key, c, start)


def literals(path: Path) -> set[str]:
    nodes = ast.walk(ast.parse(path.read_text()))
    found = {n.value for n in nodes if isinstance(n, ast.Constant)}
    return {x for x in found if isinstance(x, str) and x in CATALOG}


def test_no_other_place_restates_an_effect() -> None:
    stated = set()
    for top in ("easi_jax", "train", "envs", "scripts"):
        for path in sorted((ROOT / top).rglob("*.py")):
            rows = path.name == "effect_catalog.py"
            if not rows and literals(path) - {NUMBER_OF_MODELS}:
                stated.add(str(path.relative_to(ROOT)))
    assert stated == set(ELSEWHERE)
