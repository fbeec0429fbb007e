"""Numbers as people write them, the same in every table, sentence and note."""

import math
import re
from typing import Any

import numpy as np

_DIGITS = 4  # that a reader compares; a deviation seldom leaves more
# Symbols between which a space means a product; other words of users stay as they are.
_SYMBOLS = {*("A", "Hz", "J", "N", "V", "W", "deg", "kg", "m", "mm", "rad", "s", "1")}
_SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def number(value: float, digits: int = _DIGITS) -> str:
    """``value`` with so many digits: ``0.2``, ``1234``, ``1.5·10⁻⁵``.

    Zeros at the end of a fraction are left out. Words for what is not finite.
    """
    if math.isnan(value):
        return "not a number"
    if math.isinf(value):
        return "infinite" if value > 0 else "-infinite"
    if value == 0:
        return "0"
    # The power of the rounded number: 9999.6 has that of 10000.
    power = int(f"{value:.{digits - 1}e}".split("e")[1])
    if -4 < power < 6:
        text = f"{value:.{max(0, digits - 1 - power)}f}"
        return text.rstrip("0").rstrip(".") if "." in text else text
    return f"{value / 10.0**power:.{digits}g}·{_power(power)}"


def compact(value: float) -> str:
    """A number for a small cell, at most four characters: ``0.7``, ``240``, ``1.2k``.

    ``""`` for what is not a number, ``>1T`` from 10¹² on.
    """
    if math.isnan(value):
        return ""
    size = abs(value)
    if size >= 999.5e9:
        return ">1T" if value > 0 else "<-1T"
    for unit, scale in (("", 1.0), ("k", 1e3), ("M", 1e6), ("G", 1e9)):
        if size < 999.5 * scale:
            digits = 1 if size < 9.95 * scale else 0
            return f"{value / scale:.{digits}f}{unit}"
    raise AssertionError(value)


def measured(value: float, unit: str, digits: int = _DIGITS) -> str:
    """A number with its unit: ``0.2 N·m``; ``1`` and ``""`` stand for no unit."""
    return with_unit(number(value, digits), unit)


def with_unit(text: str, unit: str) -> str:
    """``text`` and its unit; ``1`` and ``""`` stand for none."""
    return text if unit in ("", "1") else f"{text} {shown_unit(unit)}"


def shown_unit(unit: str) -> str:
    """A unit as people print it: ``kg·m²`` for ``kg m^2``, which files have."""
    if not _SYMBOLS.issuperset(re.sub(r"\^\d+", "", unit).replace("/", " ").split()):
        return unit
    raised = re.sub(r"\^(\d+)", lambda m: m[1].translate(_SUPERSCRIPT), unit)
    return raised.replace(" ", "·")


def quantity(mean: float, std: float) -> str:
    """``0.2996 ± 0.0012``: two digits of the deviation, the mean to the same place."""
    if not (math.isfinite(mean) and math.isfinite(std)):
        return f"{number(mean)} ± {number(std)}"
    if std <= 0:
        return f"{number(mean)} ± 0"
    largest = max(abs(mean), std)
    power = math.floor(math.log10(largest))
    shift = power if power < -3 or power > 5 else 0
    # The power of the rounded number: 0.0996 has that of 0.1.
    place = 1 - int(f"{std:.1e}".split("e")[1]) + shift
    digits = max(0, place)
    scale = 10.0**shift
    text = " ± ".join(f"{round(x / scale, place):.{digits}f}" for x in (mean, std))
    return f"({text})·{_power(shift)}" if shift else text


def cell(value: Any) -> str:
    """A table cell: four digits for numbers, words for what is not finite."""
    if value is None:
        return "-"
    if isinstance(value, bool | np.bool_):
        return "yes" if value else "no"
    if isinstance(value, int | np.integer):
        return str(value)
    if not isinstance(value, str) and hasattr(value, "__float__"):
        return number(float(value))
    return str(value)


def _power(exponent: int) -> str:
    return f"10{str(exponent).translate(_SUPERSCRIPT)}"
