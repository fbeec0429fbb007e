"""Parameters by name: SI units outside, the unit cube inside.

Coordinate 0 to 1 of the unit cube is the range in which the search starts
(``initial``); where it may go (``bounds``) is physics, and may lie outside the cube.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from easi_jax.errors import UserError, nearest
from easi_jax.model import addresses as language

Range = tuple[float, float]


@dataclass(frozen=True)
class Parameter:
    """One physical parameter.

    Attributes:
        name: unique in its space.
        addresses: places of the model that it sets, all to the same value.
        nominal: best guess, SI units.
        initial: where the search starts, (low, high).
        bounds: what physics allows, (low, high); may be infinite.
        unit: SI unit, for people.
        log: search on a logarithmic scale (used only where ``initial`` is positive).

    Raises:
        UserError: a range reversed or not finite, ``initial`` or ``nominal`` outside
            the bounds, no address.
    """

    name: str
    addresses: tuple[str, ...]
    nominal: float
    initial: Range
    bounds: Range
    unit: str = ""
    log: bool = True

    def __post_init__(self) -> None:
        def fail(text: str) -> None:
            raise UserError(f'parameter "{self.name}": {text}')

        if not self.name:
            raise UserError("a parameter has no name")
        if not self.addresses:
            fail("no address")
        for address in self.addresses:
            language.split(address)
        (low, high), (least, most) = self.initial, self.bounds
        if not all(map(math.isfinite, (self.nominal, low, high))):
            fail("nominal and initial must be finite numbers")
        if math.isnan(least) or math.isnan(most):
            fail("bounds must be numbers")
        if not least < most:
            fail(f"bounds [{least:g}, {most:g}] are reversed or empty")
        if not least <= self.nominal <= most:
            fail(
                f"nominal {self.nominal:g} is outside its bounds [{least:g}, {most:g}]"
            )
        if not low < high:
            fail(f"initial [{low:g}, {high:g}] is reversed or empty")
        if low < least or high > most:
            fail(
                f"initial [{low:g}, {high:g}] is outside its bounds "
                f"[{least:g}, {most:g}]"
            )

    @property
    def uses_log(self) -> bool:
        """Whether its unit coordinate is logarithmic."""
        return self.log and self.initial[0] > 0


@dataclass(frozen=True)
class ParameterSpace:
    """An ordered set of parameters; immutable and hashable.

    All arrays are ``(n,)`` or ``(..., n)`` in the order of ``parameters``.

    Raises:
        UserError: two parameters of one name.
    """

    parameters: tuple[Parameter, ...]

    def __post_init__(self) -> None:
        seen: set[str] = set()
        for p in self.parameters:
            if p.name in seen:
                raise UserError(f'parameter "{p.name}" is there twice')
            seen.add(p.name)

    @property
    def size(self) -> int:
        """Number of parameters."""
        return len(self.parameters)

    @property
    def names(self) -> tuple[str, ...]:
        """Names."""
        return tuple(p.name for p in self.parameters)

    @property
    def units(self) -> tuple[str, ...]:
        """SI units."""
        return tuple(p.unit for p in self.parameters)

    @property
    def addresses(self) -> tuple[tuple[str, ...], ...]:
        """Addresses of each parameter, as `easi_jax.model.mjx_model.put_model` takes
        them."""
        return tuple(p.addresses for p in self.parameters)

    @property
    def nominal(self) -> np.ndarray:
        """Nominal values, ``(n,)`` SI units."""
        return np.array([p.nominal for p in self.parameters])

    @property
    def initial(self) -> tuple[np.ndarray, np.ndarray]:
        """Where the search starts, (low, high), each ``(n,)`` SI units."""
        low, high = np.array([p.initial for p in self.parameters]).reshape(-1, 2).T
        return low, high

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """What physics allows, (low, high), each ``(n,)`` SI units."""
        low, high = np.array([p.bounds for p in self.parameters]).reshape(-1, 2).T
        return low, high

    @property
    def log(self) -> np.ndarray:
        """Where the unit coordinate is logarithmic, ``(n,)`` bool."""
        return np.array([p.uses_log for p in self.parameters])

    @cached_property
    def _affine(self) -> tuple[np.ndarray, np.ndarray]:
        """Offset and width of the unit coordinate, in SI or in log SI, ``(n,)``."""
        low, high = self.initial
        safe = np.where(self.log, low, 1.0), np.where(self.log, high, 1.0)
        offset = np.where(self.log, np.log(safe[0]), low)
        return offset, np.where(self.log, np.log(safe[1] / safe[0]), high - low)

    def _constants(self) -> tuple[jax.Array, jax.Array]:
        """`_affine`, anew each time: jax knows a program's constants by their identity,
        and a part of it may be of another precision than the rest."""
        offset, width = self._affine
        return jnp.asarray(offset.copy()), jnp.asarray(width.copy())

    @property
    def log_width(self) -> np.ndarray:
        """d log(value) / d unit where logarithmic, 1 elsewhere, ``(n,)``."""
        return np.where(self.log, self._affine[1], 1.0)

    def to_si(self, unit: jax.Array | np.ndarray) -> jax.Array:
        """SI values of unit coordinates ``(..., n)``; not clipped."""
        offset, width = self._constants()
        x = offset + width * unit
        return jnp.where(self.log, jnp.exp(jnp.where(self.log, x, 0.0)), x)

    def to_unit(self, si: jax.Array | np.ndarray) -> jax.Array:
        """Unit coordinates of SI values ``(..., n)``; -inf for 0 on a log scale."""
        offset, width = self._constants()
        si = jnp.asarray(si)
        positive = jnp.maximum(jnp.where(self.log, si, 1.0), 0.0)
        return (jnp.where(self.log, jnp.log(positive), si) - offset) / width

    @property
    def unit_bounds(self) -> tuple[jax.Array, jax.Array]:
        """The bounds in unit coordinates, (low, high), each ``(n,)``; may be inf."""
        low, high = self.bounds
        return self.to_unit(low), self.to_unit(high)

    def clip(self, unit: jax.Array) -> jax.Array:
        """Unit coordinates ``(..., n)`` moved to the nearest ones within bounds."""
        return jnp.clip(unit, *self.unit_bounds)

    def index(self, name: str) -> int:
        """Position of a parameter.

        Raises:
            UserError: no parameter of that name.
        """
        if name not in self.names:
            raise UserError(
                f'unknown parameter "{name}" (known: {", ".join(self.names)})'
                f"{nearest(name, self.names)}"
            )
        return self.names.index(name)

    def select(self, names: Iterable[str]) -> "ParameterSpace":
        """The space of the named parameters, in the order given.

        Raises:
            UserError: unknown or repeated name.
        """
        return ParameterSpace(tuple(self.parameters[self.index(n)] for n in names))

    def with_initial(
        self, low: Sequence[float], high: Sequence[float]
    ) -> "ParameterSpace":
        """Starts the search elsewhere; SI values, one each per parameter.

        Raises:
            UserError: reversed, not finite, outside the bounds, or of another length.
        """
        if not len(low) == len(high) == self.size:
            raise UserError(
                f"initial ranges: {len(low)} and {len(high)} values for "
                f"{self.size} parameters"
            )
        return ParameterSpace(
            tuple(
                replace(p, initial=(float(a), float(b)))
                for p, a, b in zip(self.parameters, low, high, strict=True)
            )
        )

    def with_scale(self, log: bool) -> "ParameterSpace":
        """All parameters on a logarithmic (where positive) or a linear scale."""
        return ParameterSpace(tuple(replace(p, log=log) for p in self.parameters))

    def scaled(self, low: float, high: float) -> "ParameterSpace":
        """Starts the search in [low, high] times the nominal values.

        Raises:
            UserError: as `with_initial`.
        """
        ends = np.sort(np.stack([low * self.nominal, high * self.nominal]), axis=0)
        if low > high:
            raise UserError(f"factors [{low:g}, {high:g}] are reversed")
        least, most = self.bounds
        return self.with_initial(
            np.maximum(ends[0], least).tolist(), np.minimum(ends[1], most).tolist()
        )


def not_of_readings(what: str, address: str) -> None:
    """Raises UserError about ``what`` where an address is in the readings."""
    if address.startswith("effect.bias."):
        raise UserError(
            f"{what} is in what is read, not in the machine: train.gap finds it as "
            "sensor_bias, and --effects takes it out of logs"
        )


def declare(
    mj_model: mujoco.MjModel,
    name: str,
    addresses: str | Iterable[str],
    *,
    nominal: float | None = None,
    initial: Range | None = None,
    bounds: Range | None = None,
    unit: str | None = None,
    log: bool = True,
) -> Parameter:
    """A parameter of a model, what is not given taken from the model.

    Defaults: ``nominal`` the model's value, ``initial`` a third to three times the
    nominal, ``bounds`` and ``unit`` those of the quantity.

    Raises:
        UserError: an address that does not fit the model; a nominal or an initial
            range that must be given.
    """
    texts = (addresses,) if isinstance(addresses, str) else tuple(addresses)
    for text in texts:
        not_of_readings(f'parameter "{name}": {text}', text)
    default_unit, physics = language.describe(mj_model, texts)
    value = language.nominal(mj_model, texts) if nominal is None else float(nominal)
    bounds = physics if bounds is None else bounds
    if bounds[0] < physics[0] or bounds[1] > physics[1]:
        raise UserError(
            f'parameter "{name}": bounds [{bounds[0]:g}, {bounds[1]:g}] are outside '
            f"what physics allows, [{physics[0]:g}, {physics[1]:g}]"
        )
    if initial is None:
        if value == 0:
            raise UserError(
                f'parameter "{name}": its nominal is 0, so give the initial range'
            )
        ends = sorted((value / 3, value * 3))
        initial = max(ends[0], bounds[0]), min(ends[1], bounds[1])
    return Parameter(
        name, texts, value, initial, bounds, default_unit if unit is None else unit, log
    )
