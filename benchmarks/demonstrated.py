"""Commands of a user that benchmarks of imitation run once, whoever needs them."""

import fcntl
import subprocess
import sys
import time
from pathlib import Path

SHARES = (1.0, 0.224, 0.05)  # of the episodes, that trot, pace and bound have
_LONGEST = 4 * 3600.0  # s, of a command


def demonstrated(
    folder: Path, gaits: tuple[str, ...], env_steps: int | None
) -> tuple[Path, float]:
    """The log of demonstrations (``train.demonstrate``; experts by its own number of
    steps where None), and the seconds that making it took."""
    from train.demonstrate import LOG

    steps = [] if env_steps is None else ["--env-steps", env_steps]
    shares = ["--shares", *SHARES] if len(gaits) > 1 else []
    name = "_".join(["shown", *gaits, *map(str, steps[1:])])
    seconds = ran(
        *("train.demonstrate", folder / name, "--gaits", *gaits, *shares, *steps)
    )
    return folder / name / LOG, seconds


def ran(module: str, out: Path, *words: object) -> float:
    """Seconds of a command with the run folder ``out``, now or before.

    Raises:
        RuntimeError: it failed; it has said why.
    """
    from easi_jax.io.files import atomic_write, read_json, to_json

    told = out / "seconds.json"
    out.parent.mkdir(parents=True, exist_ok=True)
    # Another process may be at it: its result will do.
    with Path(f"{out}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if told.exists():
            return float(read_json(told)["seconds"])
        begun = time.monotonic()
        given = [*map(str, words), "--out", str(out), "--resume"]
        done = subprocess.run([sys.executable, "-m", module, *given], timeout=_LONGEST)
        if done.returncode:
            raise RuntimeError(f"{module} failed with {done.returncode}")
        seconds = time.monotonic() - begun
        atomic_write(told, to_json({"seconds": seconds}))
    return seconds
