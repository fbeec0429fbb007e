"""Notebooks as Jupyter reads them, from their sources.

    python -m scripts.notebooks
    python -m scripts.notebooks --only gap_on_a_log --execute --size tiny

A source is plain Python with ``# %%`` before each cell (jupytext's percent format), so
that it is linted, run in tests and read in a diff; the ``.ipynb`` is never committed.
Needs the extra ``notebooks``.
"""

import dataclasses
import os
import time
from pathlib import Path
from typing import Any, Literal

from train._command import main, say

ROOT = Path(__file__).parents[1]
SOURCES = ROOT / "benchmarks" / "notebooks"


@dataclasses.dataclass(frozen=True)
class Config:
    """Writes the .ipynb of each notebook and, where asked, runs it first."""

    out: Path = Path("results/notebooks")
    """Folder for the notebooks, and where they run."""
    only: tuple[str, ...] = ()
    """Names, such as gap_on_a_log; all where not given."""
    execute: bool = False
    """Run each, so that the file holds its output and pictures."""
    size: Literal["tiny", "full"] = "full"
    """How much is computed: full, or tiny to see that every cell runs."""
    limit: float = 3600.0
    """Seconds that a notebook may run."""


def run(config: Config) -> None:
    """Converts, runs, writes."""
    from easi_jax.errors import UserError, nearest
    from easi_jax.io.files import atomic_write

    known = sorted(p.stem for p in SOURCES.glob("*.py"))
    for name in config.only:
        if name not in known:
            raise UserError(f'no notebook "{name}"{nearest(name, known)}')
    if not config.limit > 0:
        raise UserError(f"--limit is {config.limit:g}: give seconds above 0")
    jupytext, nbformat, nbclient = _packages()
    for name in config.only or known:
        notebook = jupytext.read(SOURCES / f"{name}.py", fmt="py:percent")
        notebook.metadata["kernelspec"] = {
            **{"name": "python3", "display_name": "Python 3", "language": "python"}
        }
        failed = _executed(nbclient, notebook, config) if config.execute else None
        path = config.out / f"{name}.ipynb"
        atomic_write(path, nbformat.writes(notebook) + "\n")
        if failed is not None:
            raise UserError(f"{name}: {failed} (see {path})")
        say(f"written: {path}")


def _packages() -> tuple[Any, Any, Any]:
    from easi_jax.errors import UserError

    try:
        import jupytext  # pyright: ignore[reportMissingImports]
        import nbclient  # pyright: ignore[reportMissingImports]
        import nbformat  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise UserError(
            f"{error.name} is not installed: pip install -e '.[notebooks]'"
        ) from None
    return jupytext, nbformat, nbclient


def _executed(nbclient: Any, notebook: Any, config: Config) -> str | None:
    """Runs all cells, which then hold their output; what stopped it, or None."""
    config.out.mkdir(parents=True, exist_ok=True)
    end = time.monotonic() + config.limit
    client = nbclient.NotebookClient(
        notebook,
        kernel_name="python3",
        resources={"metadata": {"path": str(config.out)}},
        timeout_func=lambda _: max(1, round(end - time.monotonic())),
    )
    paths = [str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = {
        **os.environ,
        "EASI_NOTEBOOK_SIZE": config.size,
        "PYTHONPATH": os.pathsep.join(paths),
    }
    try:
        client.execute(env=environment)
    except nbclient.exceptions.CellTimeoutError:
        return f"ran past --limit {config.limit:g}"
    except nbclient.exceptions.CellExecutionError as error:
        return f"{error.ename}: {error.evalue}"
    return None


if __name__ == "__main__":
    main(Config, run, name="scripts.notebooks")
