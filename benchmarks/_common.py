"""What all benchmarks share: where figures go, and what they were made with."""

import dataclasses
import time
from pathlib import Path
from typing import Any

RESULTS = Path(__file__).parent / "results"


def write_result(name: str, command: str, config: Any, **figures: Any) -> Path:
    """Writes ``benchmarks/results/NAME.json`` with config, versions and device."""
    from easi_jax.io.files import atomic_write, to_json
    from easi_jax.io.versions import versions

    RESULTS.mkdir(exist_ok=True)
    path = RESULTS / f"{name}.json"
    body = {
        "command": command,
        "config": dataclasses.asdict(config),
        "versions": versions(),
        "finished": time.strftime("%Y-%m-%d"),
        **figures,
    }
    atomic_write(path, to_json(body))
    return path
