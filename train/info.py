"""``python -m train.info``: versions, devices, and what protects a run; its engine."""

import contextlib
import dataclasses
import io
from pathlib import Path

from train._command import main, show_table


@dataclasses.dataclass(frozen=True)
class Config:
    """Shows versions, devices and whether each runtime measure is in force."""

    run: Path | None = None
    """Folder of a run: what simulates there, and why."""


def run(config: Config) -> None:
    """Prints the tables."""
    printed = _import_output()
    from easi_jax.devices import runtime
    from easi_jax.io.runs.folder import engine_of, read_config
    from easi_jax.io.runs.versions import versions

    if config.run is not None:
        read_config(config.run)  # refuses what holds no run
        known = engine_of(config.run) or ("not known", "no simulation was made yet")
        rows = [("engine", known[0]), ("why", known[1]), *_ended(config.run)]
        show_table(f"Run {config.run}", ("", "found"), rows)
    found = versions()
    packages = {k: v or "not installed" for k, v in found["packages"].items()}
    rows = [
        ("easi-jax", found["easi-jax"]),
        ("commit", found["commit"] or "not a checkout"),
        ("python", found["python"]),
        ("system", found["system"]),
        *packages.items(),
    ]
    show_table("Versions", ("package", "version"), rows)
    state = runtime.status()
    devices = [
        ("platform", state["platform"]),
        ("kind", state["device_kind"]),
        ("devices", state["devices"]),
        ("CPU cores", state["cores"]),
    ]
    show_table("Devices", ("", "found"), devices)
    show_table(
        "Runtime measures", ("measure", "in force", "detail"), measures(state, printed)
    )


def _ended(folder: Path) -> list[tuple[str, str]]:
    """How the fits of a run's seeds ended."""
    from easi_jax.io.runs.schemas import read_distribution

    path = folder / "distribution.json"
    if not path.is_file():
        return []
    found = read_distribution(path)
    ends = {s: (r.get("outcome"), r.get("reason")) for s, r in found["seeds"].items()}
    ends |= {s: ("diverged", why) for s, why in (found.get("diverged") or {}).items()}
    return [
        (f"fit of seed {seed}", f"{end}{f' ({why})' if why else ''}")
        for seed, (end, why) in ends.items()
        if end
    ]


def measures(state: dict[str, object], printed: str) -> list[tuple[str, str, str]]:
    """Name, yes or no, and detail of each measure of ``easi_jax.devices.runtime``.

    Args:
        state: of ``runtime.status()``.
        printed: what importing ``easi_jax`` printed.
    """
    cache = state["compilation_cache"]
    precision = state["matmul_precision"]
    late = "" if state["prepared_before_backend"] else "jax started before easi_jax"
    pool = f"NPROC={state['nproc']}, {state['cores']} cores"
    return [
        ("set before jax starts", _yes(not late), late or "nothing was too late"),
        ("deadlock cure", _yes(state["deadlock_cure"]), pool),
        (
            "one device per core",
            _yes(state["one_device_per_core"]),
            f"{state['devices']} {state['platform']} devices",
        ),
        ("compilation cache", _yes(cache), str(cache or "no folder can be written")),
        (
            "full float32 products",
            _yes(precision in ("highest", "float32")),
            f"jax_default_matmul_precision={precision}",
        ),
        ("quiet imports", _yes(not printed), printed[:60] or "nothing printed"),
    ]


def _yes(value: object) -> str:
    return "yes" if value else "NO"


def _import_output() -> str:
    with contextlib.redirect_stdout(io.StringIO()) as out:
        import easi_jax  # noqa: F401
    return " ".join(out.getvalue().split())


if __name__ == "__main__":
    main(Config, run, name="train.info")
