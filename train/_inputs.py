"""The files that a command reads, whose digests a run keeps."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

_FILES = "parameters", "mapping", "env", "demonstrations", "retrain"
_LISTS = "data", "held_out", "stand", "effects_from"
_RUNS = "udr", "policy", "start_from", "found"  # folders of earlier runs, or files
_RESULTS = "results.json", "distribution.json"  # of a run folder


def files_of(config: Any) -> list[Path]:
    """The model with all that it names, parameters, logs, an environment, the owner's
    effects, and results of earlier runs; what an effects file says is part of the
    configuration, and stands there."""
    return list(dict.fromkeys(_each(config)))


def _each(config: Any) -> Iterator[Path]:
    from easi_jax.io.models.mjcf import check_assets
    from envs import REGISTRY

    model, logs = getattr(config, "model", None), getattr(config, "data", ())
    if model and str(model) not in REGISTRY:
        yield Path(model)
        yield from check_assets(Path(model), config.allow_assets)
    for name in _FILES:
        given = getattr(config, name, None)
        if given:
            yield Path(given)
    for name in _LISTS:
        yield from map(Path, getattr(config, name, ()))
    for name in _RUNS:
        given = getattr(config, name, None)
        if given and not (name == "udr" and logs):
            path = Path(given)
            each = [path / r for r in _RESULTS] if path.is_dir() else [path]
            yield from filter(Path.is_file, each)
