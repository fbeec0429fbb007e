from pathlib import Path

import mujoco
import pytest

from easi_jax.errors import UserError
from easi_jax.io.models.parameter_file import read_parameter_file, write_parameter_file

MODEL = mujoco.MjModel.from_xml_string(
    """<mujoco><worldbody><body name="cart">
    <joint name="cart" type="slide" damping="0.5"/>
    <geom size="0.1" mass="0.3"/></body></worldbody>
    <actuator><motor name="cart" joint="cart"/></actuator></mujoco>"""
)


def write(folder: Path, text: str) -> Path:
    path = folder / "p.yaml"
    path.write_text(text)
    return path


def test_defaults_come_from_the_model(tmp_path: Path) -> None:
    path = write(
        tmp_path,
        """parameters:
  - {name: mass, address: body.cart.mass}
  - name: damping
    address: [joint.cart.damping]
    initial: [1e-1, 2]
    bounds: [1e-3, .inf]
    scale: linear
    unit: kg/s
  - {name: limit, address: actuator.cart.force_limit, nominal: 4, unit: N}
""",
    )
    mass, damping, limit = read_parameter_file(path, MODEL).parameters
    assert (mass.nominal, mass.unit, mass.log) == (pytest.approx(0.3), "kg", True)
    assert mass.initial == pytest.approx((0.1, 0.9))
    assert mass.bounds[0] > 0
    assert damping.addresses == ("joint.cart.damping",)
    assert damping.initial == (0.1, 2.0)
    assert damping.bounds == (0.001, float("inf"))
    assert (damping.unit, damping.log) == ("kg/s", False)
    assert limit.nominal == 4.0


def test_round_trip(tmp_path: Path) -> None:
    path = write(
        tmp_path,
        """parameters:
  - {name: mass, address: body.c*.mass, initial: [1e-5, 1e+9]}
  - {name: damping, address: [joint.cart.damping, joint.*.damping], scale: linear}
  - {name: gain µ, address: actuator.cart.gain, unit: 1}
""",
    )
    space = read_parameter_file(path, MODEL)
    write_parameter_file(tmp_path / "q.yaml", space)
    assert read_parameter_file(tmp_path / "q.yaml", MODEL) == space


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "key"),
        ("[1, 2]", 'the key "parameters:"'),
        ("parameters: 3", "must hold a list"),
        ("parameters: []", "must hold a list"),
        ("parameter: []", 'unknown key "parameter"; did you mean "parameters"?'),
        ("parameters:\n  - name: [", "not valid YAML in line 2"),
        ("parameters: !!python/object:os.system {}", "not valid YAML in line 1"),
        ("parameters:\n- {name: a, name: b}", '"name" is there twice'),
        ("parameters: [3]", 'parameter 1: write "- name:'),
        ("parameters: [{name: a}]", 'parameter 1: the key "address" is missing'),
        ("parameters: [{address: a}]", 'the key "name" is missing'),
        ("parameters: [{name: 3, address: a}]", "name is 3, not a text"),
        ("parameters: [{name: a, adress: a}]", 'did you mean "address"?'),
        ("parameters: [{name: a, address: []}]", "empty list"),
        ("parameters: [{name: a, address: 7}]", "address is 7"),
        (
            "parameters: [{name: a, address: body.crat.mass}]",
            'parameter 1 "a": address "body.crat.mass" names no body',
        ),
        ("parameters: [{name: a, address: M, nominal: many}]", "'many', not a number"),
        ("parameters: [{name: a, address: M, nominal: yes}]", "True, not a number"),
        ("parameters: [{name: a, address: M, nominal: .inf}]", "finite"),
        (
            f"parameters: [{{name: a, address: M, nominal: 0x{'f' * 400}}}]",
            "must be finite numbers",
        ),
        ("parameters: [{name: a, address: M, initial: 3}]", "write [low, high]"),
        ("parameters: [{name: a, address: M, initial: [1, 2, 3]}]", "[low, high]"),
        ("parameters: [{name: a, address: M, initial: [2, 1]}]", "reversed"),
        ("parameters: [{name: a, address: M, bounds: [2, 1]}]", "reversed"),
        ("parameters: [{name: a, address: M, bounds: [-1, 1]}]", "physics allows"),
        ("parameters: [{name: a, address: M, bounds: [1, 2]}]", "outside its bounds"),
        ("parameters: [{name: a, address: M, scale: cubic}]", "log or linear"),
        ("parameters: [{name: a, address: M}, {name: a, address: M}]", "twice"),
        ("parameters: [{name: a, address: actuator.cart.force_limit}]", "no value"),
    ],
)
def test_bad_file_is_one_clear_line(tmp_path: Path, text: str, message: str) -> None:
    path = write(tmp_path, text.replace("address: M", "address: body.cart.mass"))
    with pytest.raises(UserError) as error:
        read_parameter_file(path, MODEL)
    shown = str(error.value)
    assert shown.startswith(f"{path}: ")
    assert message in shown
    assert "\n" not in shown


def test_missing_and_binary_file(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="cannot be read"):
        read_parameter_file(tmp_path / "none.yaml", MODEL)
    (tmp_path / "b.yaml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(UserError, match="not UTF-8"):
        read_parameter_file(tmp_path / "b.yaml", MODEL)
