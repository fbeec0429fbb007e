"""From effects that were found to a model that has them and parameters to search.

`train.gap` finds effects and says how sure it is; here they become part of a machine:
their values are its new nominal ones, and what is uncertain about them joins the
parameters that training draws and a search looks for.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np

from easi_jax.errors import UserError
from easi_jax.model import addresses as language
from easi_jax.model.effect_numbers import EFFECT_TABLE, EffectEntry
from easi_jax.model.found_laws import check_law, law_of, public_name
from easi_jax.model.own_effects_check import check_own_effects
from easi_jax.model.parameters import Parameter, ParameterSpace, not_of_readings

_STDS = 3.0
_SHARE = 0.1  # of a value, at least, that it is taken to be uncertain by
_FARTHER = 2.0  # times the upper end of where a search starts, that a delay may reach


@dataclass(frozen=True)
class FoundEffects:
    """Effects of a machine, and values of its model's own parameters.

    Attributes:
        entries: the effects.
        own: values by address.
    """

    entries: tuple[EffectEntry, ...] = ()
    own: Mapping[str, float] | None = None

    @property
    def physical(self) -> tuple[EffectEntry, ...]:
        """Those of the physics; the others are in the readings of sensors."""
        return tuple(e for e in self.entries if not e.of_readings)

    def __bool__(self) -> bool:
        return bool(self.entries or self.own)


def joined(
    m: mujoco.MjModel, space: ParameterSpace, found: FoundEffects
) -> tuple[ParameterSpace, dict[str, float]]:
    """Parameters of a model with effects, and values that stay, by address.

    A number of an effect becomes a parameter, named ``EFFECT@PLACE.NUMBER``. What
    several places have alike, deviations included, is one parameter, for it has one
    cause. A parameter's search starts within three standard deviations of what was
    found, a tenth of the value at least; its bounds are those of physics. Parameters of
    ``space`` whose own values were refitted start about the new ones.

    Effects in the readings change no motion: they are left out here, and measured logs
    are mended by `easi_jax.data.cleaning.true_readings`.

    Raises:
        UserError: a joint, actuator or body that the model lacks, a value outside what
            physics allows.
    """
    own = dict(found.own or {})
    space, rest = _renewed(m, space, own)
    new: list[Parameter] = []
    stay = dict(rest)
    for entry in found.physical:
        _check(m, entry)
    own = [e.effect for e in found.entries if law_of(e.effect) is None]
    check_own_effects(m, own)
    for alike in _alike(found.physical):
        for column, value in alike[0].columns.items():
            p = _parameter(m, alike, column, value)
            if p is None:
                stay |= {entry.address(column): value for entry in alike}
            else:
                new.append(p)
    return ParameterSpace((*space.parameters, *new)), stay


def _alike(entries: Iterable[EffectEntry]) -> list[list[EffectEntry]]:
    """Entries of one cause together, in the order of the first of each: the same to the
    last digit, at several places."""
    groups: dict[object, list[EffectEntry]] = {}
    for k, e in enumerate(entries):
        numbers = (*sorted(e.columns.items()), *sorted(e.std.items()))
        cause = (e.effect, e.kind, numbers)
        again = any(e.at == other.at for other in groups.get(cause, ()))
        groups.setdefault(k if again or not e.std else cause, []).append(e)
    return [*groups.values()]


def _check(m: mujoco.MjModel, entry: EffectEntry) -> None:
    if (law := law_of(entry.effect)) is not None:
        check_law(m, law)
    where = f'effect {entry.effect} at "{entry.at}"' if entry.at else entry.effect
    for column in entry.columns:
        if column not in EFFECT_TABLE:
            raise UserError(f'{where}: no column "{column}"')
        row = EFFECT_TABLE[column]
        if row.on != entry.kind:
            raise UserError(
                f'{where}: column "{column}" is of kind {row.on}, not {entry.kind}'
            )
        language.places(m, entry.address(column))


def _parameter(
    m: mujoco.MjModel, alike: Sequence[EffectEntry], column: str, value: float
) -> Parameter | None:
    """None where nothing is uncertain."""
    entry = alike[0]
    half = max(_STDS * entry.std.get(column, 0.0), _SHARE * abs(value))
    if EFFECT_TABLE[column].is_shape or half == 0:
        return None
    addresses = tuple(e.address(column) for e in alike)
    unit, (low, high) = language.describe(m, addresses)
    start = max(value - half, low), min(value + half, high)
    if EFFECT_TABLE[column].is_shift:
        high = min(high, _FARTHER * start[1])
    every = entry.kind == "actuator" and len(alike) == m.nu > 1
    at = "all" if every else "+".join(e.at for e in alike)
    place = f"@{at}" if at else ""
    name = public_name(f"{entry.effect}{place}.{EFFECT_TABLE[column].word}")
    return Parameter(name, addresses, value, start, (low, high), unit, log=False)


Number = tuple[str, tuple[int, ...], int]


def _numbers(m: mujoco.MjModel, addresses: Iterable[str]) -> list[Number]:
    writers = language.resolve(m, (tuple(addresses),))
    return [(e.field, e.index, e.sign) for w in writers for e in w.entries]


def set_by_none(
    m: mujoco.MjModel,
    addresses: Iterable[Iterable[str]],
    values: Mapping[str, float],
) -> dict[str, float]:
    """Those values, by address, that no parameter of these addresses sets."""
    free = {n for tied in addresses for n in _numbers(m, tied)}
    return {a: v for a, v in values.items() if not free & set(_numbers(m, (a,)))}


def _renewed(
    m: mujoco.MjModel, space: ParameterSpace, own: Mapping[str, float]
) -> tuple[ParameterSpace, dict[str, float]]:
    """Parameters about refitted values, and the values that no parameter sets.

    Where a parameter sets several places, it gets their mean.
    """
    for address in own:
        not_of_readings(address, address)
    values = {n: v for a, v in own.items() for n in _numbers(m, (a,))}
    out = []
    for p in space.parameters:
        places = _numbers(m, p.addresses)
        if not any(n in values for n in places):
            out.append(p)
            continue
        nominal = float(np.mean([values.get(n, p.nominal) for n in places]))
        out.append(_about(p, nominal))
    return ParameterSpace(tuple(out)), set_by_none(m, space.addresses, own)


def _about(p: Parameter, nominal: float) -> Parameter:
    """The parameter with another nominal value and its range moved along."""
    (low, high), (least, most) = p.initial, p.bounds
    if p.nominal > 0 and nominal > 0:
        low, high = low * nominal / p.nominal, high * nominal / p.nominal
    else:
        low, high = low + nominal - p.nominal, high + nominal - p.nominal
    return replace(p, nominal=nominal, initial=(max(low, least), min(high, most)))


def named(entries: Sequence[EffectEntry]) -> str:
    """``EFFECT@PLACE`` of all, for a line of text."""
    names = (f"{e.effect}@{e.at}" if e.at else e.effect for e in entries)
    return public_name(", ".join(names))
