"""``--effects`` and ``--target-effects``: read, put into robots, kept in run folders.

A run folder holds what the file said, not where it lay: a policy is always tested and
trained on with the effects that it was trained with.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

FIELDS = ("effects", "target_effects")


@dataclasses.dataclass(frozen=True)
class Given:
    """Contents of effects files; None where none was given.

    Attributes:
        effects: what the model gets and the search may vary.
        target_effects: what the pseudo-real robot has in their place.
    """

    effects: dict[str, Any] | None = None
    target_effects: dict[str, Any] | None = None

    def recorded(self, config: Any) -> dict[str, Any]:
        """The configuration with contents in place of paths."""
        plain = dataclasses.asdict(config)
        return {**plain, **{k: getattr(self, k) for k in FIELDS if k in plain}}

    def results(self) -> dict[str, Any]:
        """The same for ``results.json``; nothing where nothing was given."""
        return {k: v for k in FIELDS if (v := getattr(self, k)) is not None}


def read_given(config: Any) -> Given:
    """Reads the files that a command was given.

    Raises:
        UserError: what is wrong with them.
    """
    return Given(**{k: _content(getattr(config, k, None)) for k in FIELDS})


def _content(path: Path | None) -> dict[str, Any] | None:
    from easi_jax.io.models.effects_file import parsed_effects
    from easi_jax.io.strict_yaml import read_yaml

    if path is None:
        return None
    content = read_yaml(path)
    parsed_effects(content, str(path))
    return content


def found_in(content: dict[str, Any] | None, where: str = "--effects") -> Any:
    """`FoundEffects` of a recorded content; empty where there is none."""
    from easi_jax.io.models.effects_file import parsed_effects
    from easi_jax.model.found_effects import FoundEffects

    return FoundEffects() if content is None else parsed_effects(content, where)


def robots(env: Any, given: Given) -> tuple[Any, Any]:
    """The robot that is simulated, and the one that stands for the real one.

    The second is None where it is the first.

    Raises:
        UserError: effects at a place that the robot lacks.
    """
    from easi_jax.simulation.with_effects import env_with

    real = None
    if given.target_effects is not None:
        found = found_in(given.target_effects, "--target-effects")
        real = env_with(env, found)
    return env_with(env, found_in(given.effects)), real


def target_name(changes: Sequence[str], given: Given) -> str:
    """The target in a line: what differs from the nominal robot."""
    from easi_jax.model.found_effects import named

    hidden = named(found_in(given.target_effects).physical)
    return ", ".join([*changes, *([hidden] if hidden else [])]) or "nominal"


def effect_notes(given: Given) -> list[str]:
    """What a report says of them."""
    from easi_jax.model.found_effects import named

    notes = []
    if given.effects is not None:
        found = found_in(given.effects)
        text = named(found.physical) or "none"
        own = f"; refitted: {', '.join(found.own)}" if found.own else ""
        notes.append(f"effects in the model: {text}{own}")
        notes += _read_only(found)
    if given.target_effects is not None:
        found = found_in(given.target_effects)
        notes.append(f"effects of the target: {named(found.physical) or 'none'}")
        notes += _read_only(found)
    return notes


def _read_only(found: Any) -> list[str]:
    from easi_jax.model.found_effects import named

    left = [e for e in found.entries if e.of_readings]
    if not left:
        return []
    return [
        f"{named(left)}: in the readings of a sensor, not in the physics, so "
        "simulations are without it; mend the sensor, or the program that reads it"
    ]
