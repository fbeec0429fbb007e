"""What results depend on besides the configuration: no host paths, no names."""

import datetime
import platform
import subprocess
from importlib import metadata
from pathlib import Path
from typing import Any

from easi_jax.devices import runtime
from easi_jax.io.files import to_plain
from easi_jax.version import __version__

_PACKAGES = (
    "jax",
    "jaxlib",
    "mujoco",
    "mujoco-mjx",
    "brax",
    "flax",
    "optax",
    "evosax",
    "orbax-checkpoint",
    "numpy",
    "scipy",
)


def versions() -> dict[str, Any]:
    """Versions, commit, device and runtime measures, as in ``versions.json``."""
    state = runtime.status()
    state["compilation_cache"] = state["compilation_cache"] is not None
    return {
        "easi-jax": __version__,
        "commit": _commit(),
        "python": platform.python_version(),
        "system": f"{platform.system()} {platform.machine()}",
        "packages": {name: _version(name) for name in _PACKAGES},
        "runtime": to_plain(state),
        "started": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
    }


def _version(name: str) -> str | None:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


def _commit() -> str | None:
    """Commit of the source, ``+`` where it has changes; None outside a checkout."""
    here = Path(__file__).resolve().parent

    def git(*args: str) -> str:
        command = ["git", "-C", str(here), *args]
        found = subprocess.run(
            command, capture_output=True, text=True, timeout=10, check=True
        )
        return found.stdout.strip()

    try:
        git("ls-files", "--error-unmatch", Path(__file__).name)
        dirty = git("status", "--porcelain", "--untracked-files=no")
        return git("rev-parse", "HEAD") + ("+" if dirty else "")
    except (OSError, subprocess.SubprocessError):
        return None
