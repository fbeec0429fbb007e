"""What an effects file may say."""

from typing import Any

import pytest

from easi_jax.errors import UserError
from easi_jax.io.models.effects_file import parsed_effects


def content(effect: str, **columns: float) -> dict[str, Any]:
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


@pytest.mark.parametrize("column", ["com", "com.3", "com.x", "colomb", "bias.-1"])
def test_an_unknown_column_is_told(column: str) -> None:
    with pytest.raises(UserError, match=f'unknown column "{column}"') as caught:
        parsed_effects(content("com_offset", **{column: 0.1}), "effects.yaml")
    assert "\n" not in str(caught.value)
