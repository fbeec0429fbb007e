"""What an effects file may say."""

from typing import Any

import pytest

from easi_jax.errors import UserError
from easi_jax.io.models.effects_file import parsed_effects


def content(effect: str, **columns: Any) -> dict[str, Any]:
    return {"effects": [{"effect": effect, "at": "j", "columns": columns}]}


@pytest.mark.parametrize(
    ("effect", "column"),
    [
        ("coulomb_friction", "coulomb"),
        ("com_offset", "com.2"),
        ("sensor_bias", "bias"),
        ("sensor_bias", "bias.5"),  # of a sensor of six numbers
    ],
)
def test_columns_are_those_of_the_catalog(effect: str, column: str) -> None:
    found = parsed_effects(content(effect, **{column: 0.1}), "effects.yaml")
    assert found.entries[0].columns == {column: 0.1}


def test_numbers_are_read_as_in_other_files() -> None:
    """YAML 1.1 takes 1e-3 for text."""
    columns: dict[str, Any] = {"coulomb": "1e-3"}
    found = parsed_effects(content("coulomb_friction", **columns), "effects.yaml")
    assert found.entries[0].columns == {"coulomb": 1e-3}
    for wrong in ("a", True, None, "nan"):
        with pytest.raises(UserError, match="is no finite number"):
            parsed_effects(content("coulomb_friction", coulomb=wrong), "e.yaml")


@pytest.mark.parametrize("column", ["com", "com.3", "com.x", "colomb", "bias.-1"])
def test_an_unknown_column_is_told(column: str) -> None:
    with pytest.raises(UserError, match=f'unknown column "{column}"') as caught:
        parsed_effects(content("com_offset", **{column: 0.1}), "effects.yaml")
    assert "\n" not in str(caught.value)


def one(effect: str, kind: str, at: Any = "j", **columns: float) -> dict[str, Any]:
    entry = {"effect": effect, "at": at, "kind": kind, "columns": columns}
    return {"effects": [entry]}


def test_columns_that_are_left_out_are_as_without_the_effect() -> None:
    (found,) = parsed_effects(
        one("joint_stiffness", "joint", stiffness=2.0), "e"
    ).entries
    assert found.columns == {"stiffness": 2.0, "spring": 0.0}
    (found,) = parsed_effects(one("payload_mass", "body", mass=0.3), "e").entries
    assert found.columns == {"mass": 0.3, "spread": 0.0}


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (
            one("actuator_delay", "actuator", lag=0.01),
            'actuator_delay at a actuator has no column "lag" (it has delay)',
        ),
        (one("coulomb_friction", "joint", coulomb=1.0, damping=1.0), '"damping"'),
        (one("coulomb_friction", "joint", ["a", "b"], coulomb=1.0), "holds one name"),
    ],
)
def test_columns_of_another_effect_are_refused(
    content: dict[str, Any], said: str
) -> None:
    with pytest.raises(UserError) as caught:
        parsed_effects(content, "effects.yaml")
    assert said in str(caught.value) and str(caught.value).startswith("effects.yaml")
