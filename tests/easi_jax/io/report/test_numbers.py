import math

import pytest

from easi_jax.io.report.numbers import (
    cell,
    compact,
    measured,
    number,
    quantity,
    with_unit,
)


@pytest.mark.parametrize(
    ("mean", "std", "text"),
    [
        (0.29963, 0.00121, "0.2996 ± 0.0012"),
        (19.33, 0.44, "19.33 ± 0.44"),
        (1234.5, 67.0, "1234 ± 67"),
        (98765.0, 4321.0, "98800 ± 4300"),
        (0.5, 0.0996, "0.50 ± 0.10"),
        (3.02e-4, 5e-6, "(3.020 ± 0.050)·10⁻⁴"),
        (-2e7, 3e5, "(-2.000 ± 0.030)·10⁷"),
        (0.0, 0.5, "0.00 ± 0.50"),
        (5.0, 0.0, "5 ± 0"),
        (math.nan, 1.0, "not a number ± 1"),
    ],
)
def test_quantity(mean, std, text):
    assert quantity(mean, std) == text


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.1 + 0.2, "0.3"),
        (12345.6, "12346"),
        (99999999.0, "1·10⁸"),
        (3.14159e-7, "3.142·10⁻⁷"),
        (0.0, "0"),
        (-math.inf, "-infinite"),
        (7, "7"),
        (True, "yes"),
        (None, "-"),
        ("0.10", "0.10"),
    ],
)
def test_cell(value, text):
    assert cell(value) == text


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (measured(0.200009, "s"), "0.2 s"),
        (measured(0.0123456, "N m", 3), "0.0123 N·m"),
        (measured(2.0, "kg m^2"), "2 kg·m²"),
        (measured(2.0, "N m s^2/rad^2"), "2 N·m·s²/rad²"),
        (measured(2.0, "parts of a turn"), "2 parts of a turn"),
        (measured(1.0, "1"), "1"),
        (measured(math.nan, "rad"), "not a number rad"),
        (with_unit("0.20 ± 0.01", "1"), "0.20 ± 0.01"),
        (number(9999.6, 3), "10000"),
        (number(0.0012345, 3), "0.00123"),
        (number(-1234567.0, 3), "-1.23·10⁶"),
    ],
)
def test_as_people_write_it(text, said):
    assert text == said


@pytest.mark.parametrize(
    ("value", "said"),
    [
        (0.001, "0.0"),
        (0.66, "0.7"),
        (9.96, "10"),
        (-240.4, "-240"),
        (1234.0, "1.2k"),
        (999.6, "1.0k"),
        (99_960.0, "100k"),
        (4.2e9, "4.2G"),
        (1e30, ">1T"),
        (math.inf, ">1T"),
        (-math.inf, "<-1T"),
        (math.nan, ""),
    ],
)
def test_in_a_small_cell(value, said):
    assert compact(value) == said and len(said) <= 4
