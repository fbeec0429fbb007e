"""Arrays that a user hands to a public function: their shape, and that they are finite.

Checked by chex outside of compiled functions; what is wrong becomes one line.
"""

from collections.abc import Sequence
from typing import Any

import chex
import numpy as np

from easi_jax.errors import UserError


def checked_array(
    name: str,
    value: Any,
    shape: Sequence[int | None],
    what: str = "",
) -> np.ndarray:
    """``value`` as an array of floats.

    Args:
        name: of it, for the message.
        value: numbers.
        shape: that it must have; None: any length along an axis.
        what: the entries' meaning, for the message.

    Raises:
        UserError: no numbers, another shape, or one that is not finite.
    """
    try:
        array = np.asarray(value, float)
    except (TypeError, ValueError):
        raise UserError(f"{name} is not an array of numbers") from None
    needed = ", ".join("any" if n is None else str(n) for n in shape)
    meaning = f" ({what})" if what else ""
    try:
        chex.assert_shape(array, tuple(shape))
    except AssertionError:
        raise UserError(
            f"{name} has shape {array.shape}, needed is ({needed}){meaning}"
        ) from None
    try:
        chex.assert_tree_all_finite(array)
    except AssertionError:
        first = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
        raise UserError(
            f"{name} is not finite: entry {list(first)} is {array[first]}{meaning}"
        ) from None
    return array
