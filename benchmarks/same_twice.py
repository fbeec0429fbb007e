"""Whether a seed gives the same result twice on this device, and what it takes.

    python -m benchmarks.same_twice
    python -m benchmarks.same_twice --robot ant --env-steps 200000

UDR training, search, finish and final training of ``train.pipeline`` run twice from one
seed, each time in a process of its own; then twice more with XLA's operations of random
order left out (``--xla_gpu_exclude_nondeterministic_ops``). Compared are the bits of
what is found and of every return. Where they differ, the spread is told: of parameters
in their own standard deviations, of returns as shares. On a CPU both must be the same.
``benchmarks/results/same_twice_*.json``, one for each device and robot.
"""

import dataclasses
import os
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from benchmarks._common import RESULTS, at_least_one, markdown_table
from benchmarks._page import Section
from train._command import main, say

WAYS = {"as it is": "", "in one order": "--xla_gpu_exclude_nondeterministic_ops=true"}
_LIMIT = 1800.0  # s of a run


@dataclasses.dataclass(frozen=True)
class Config:
    """Runs a whole chain twice."""

    robot: str = "cartpole"
    """Built-in robot."""
    seed: int = 0
    """Of everything random."""
    env_steps: int = 20_000
    """Control steps of each training."""
    generations: int = 10
    """Of the search."""
    population: int = 64
    """Individuals of a generation."""
    trajectories: int = 20
    """Demonstrations."""
    folder: Path = RESULTS
    """Where the result goes."""


def run(config: Config) -> None:
    """Runs, compares and writes."""
    import jax

    from benchmarks._common import command_of, write_result
    from easi_jax.errors import UserError, nearest
    from envs import REGISTRY
    from train._robots import check_seeds

    at_least_one(config, "env_steps", "generations", "population", "trajectories")
    check_seeds((config.seed,))
    if config.robot not in REGISTRY:
        raise UserError(
            f"--robot {config.robot}: {', '.join(REGISTRY)}"
            f"{nearest(config.robot, REGISTRY)}"
        )
    found: dict[str, Any] = {}
    for way, flags in WAYS.items():
        begun = time.monotonic()
        with tempfile.TemporaryDirectory() as folder:
            both = [chain(config, Path(folder) / name, flags) for name in "ab"]
        seconds = (time.monotonic() - begun) / 2
        found[way] = {**compared(*both), "seconds": seconds}
        say(f"{way}: {told(found[way])}, {seconds:.0f} s a run")
    kind = re.sub(r"\W+", "_", jax.devices()[0].device_kind).strip("_").lower()
    path = write_result(
        *(f"same_twice_{config.robot}_{kind}",),
        command_of("benchmarks.same_twice", config),
        {k: v for k, v in dataclasses.asdict(config).items() if k != "folder"},
        config.folder,
        ways=found,
    )
    say(f"written: {path}")


def chain(config: Config, out: Path, flags: str) -> dict[str, Any]:
    """Results of one run: ``returns`` by method, ``mean`` and ``std`` of parameters.

    Raises:
        UserError: it failed, with its last line.
    """
    from easi_jax.errors import UserError
    from easi_jax.io.files import read_json

    words = [sys.executable, "-m", "train.pipeline", "--robot", config.robot]
    words += ["--seeds", config.seed, "--env-steps", config.env_steps, "--out", out]
    words += ["--generations", config.generations, "--population", config.population]
    words += ["--trajectories", config.trajectories]
    given = " ".join(x for x in (os.environ.get("XLA_FLAGS", ""), flags) if x)
    try:
        ended = subprocess.run(
            list(map(str, words)),
            env={**os.environ, "XLA_FLAGS": given},
            capture_output=True,
            text=True,
            timeout=_LIMIT,
        )
    except subprocess.TimeoutExpired:
        raise UserError(f"train.pipeline did not end within {_LIMIT:g} s") from None
    if ended.returncode:
        last = (ended.stderr.strip().splitlines() or ["no reason given"])[-1]
        raise UserError(f"train.pipeline ended with {ended.returncode}: {last}")
    results = read_json(out / "results.json")
    seeds = read_json(out / "distribution.json")["seeds"][str(config.seed)]
    return {
        "returns": {m: r[str(config.seed)] for m, r in results["returns"].items()},
        "mean": seeds["mean"],
        "std": seeds["std"],
    }


def compared(one: dict[str, Any], two: dict[str, Any]) -> dict[str, Any]:
    """``same``: whether all bits are; ``deviations``: largest difference of a parameter
    in its standard deviations (None where it has none); ``returns``: largest of a
    return, as a share."""
    off = [
        abs(a - b) / s if s else None
        for a, b, s in zip(one["mean"], two["mean"], one["std"], strict=True)
    ]
    apart = [
        abs(a - two["returns"][m]) / max(abs(a), 1e-30)
        for m, a in one["returns"].items()
    ]
    return {
        "same": one == two,
        "deviations": max((x for x in off if x is not None), default=None),
        "returns": max(apart),
    }


def told(found: dict[str, Any]) -> str:
    """The comparison in words."""
    if found["same"]:
        return "the same to the last bit"
    parts = [f"returns differ by up to {100 * found['returns']:.2g} %"]
    if found["deviations"] is not None:
        parts.append(f"parameters by up to {found['deviations']:.2g} deviations")
    return ", ".join(parts)


def _paragraphs(found: dict[str, dict[str, Any]]) -> list[str]:
    lines = [
        (
            *(r["config"]["robot"], r["versions"]["runtime"]["device_kind"], way),
            *(told(w), f"{w['seconds']:.0f} s"),
        )
        for r in found.values()
        for way, w in r["ways"].items()
    ]
    return [
        "`python -m benchmarks.same_twice`: the whole chain of `train.pipeline` twice "
        "from one seed, each time in a process of its own; as it is, and with XLA's "
        "operations of random order left out (`XLA_FLAGS="
        f"{WAYS['in one order']}`).",
        markdown_table(("robot", "device", "XLA", "two runs", "seconds a run"), lines),
    ]


SECTIONS = (
    Section(
        *("## The same seed twice", "same_twice_*.json", "same_twice", _paragraphs)
    ),
)


if __name__ == "__main__":
    main(Config, run, name="benchmarks.same_twice")
