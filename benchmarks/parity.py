"""MuJoCo's features, each as a small model: does MJX do what MuJoCo C does?

    python -m benchmarks.parity

Each model goes through the guard (`easi_jax.simulation.guard`): the engine that
``--engine auto`` may take follows from it. Where this package has its native engine, a
replay through it is compared with a plain loop of `mj_step`. About four minutes on two
cores; a run that was cut off goes on where it stopped. Written to
``results/parity.json``, shown by `benchmarks.summary`.
"""

import dataclasses
import hashlib
import math
from collections import Counter
from pathlib import Path
from typing import Any

from benchmarks._common import RESULTS, command_of, write_result
from benchmarks._page import table
from benchmarks.parity_models import feature_models
from train._command import main, say, show_table

_REPLAYED = 50  # physics steps


@dataclasses.dataclass(frozen=True)
class Config:
    """Compares MJX with MuJoCo C, feature by feature."""

    seed: int = 0
    """Of the random states."""
    only: str = ""
    """Features whose names hold this; the others keep their rows."""
    fresh: bool = False
    """Compare again what is written already."""
    results: Path = RESULTS
    """Folder of parity.json."""


def run(config: Config) -> None:
    """Goes through the features; the file is written after each."""
    from easi_jax.io.files import read_json
    from easi_jax.io.runs.versions import versions

    load_plugins()
    path = config.results / "parity.json"
    body = read_json(path) if path.is_file() else {}
    made_with, made_by = versions(), body.get("versions", {})
    same = all(made_by.get(k) == made_with[k] for k in ("commit", "mujoco_mjx"))
    rows = body.get("features", {}) if same and not config.fresh else {}
    models = feature_models()
    rows = {n: r for n, r in rows.items() if n in models}
    plain = dataclasses.replace(config, results=RESULTS, only="", fresh=False)
    for name, text in models.items():
        digest = hashlib.sha256(text.encode()).hexdigest()[:16]
        done = rows.get(name, {}).get("model") == digest
        if config.only not in name or (done and not config.fresh):
            continue
        rows[name] = {"model": digest, **examined(text, config.seed)}
        say(f"{name}: {_found(rows[name])}")
        ordered = {n: rows[n] for n in models if n in rows}
        write_result(
            *("parity", command_of("benchmarks.parity", plain), plain, config.results),
            features=ordered,
        )
    counts = Counter(r["engine"] for r in rows.values())
    show_table("Parity", ("engine", "features"), list(counts.items()))
    say(f"written: {path}")


def load_plugins() -> None:
    """Makes MuJoCo's own plugins known; models with one do not load otherwise."""
    import mujoco

    folder = Path(mujoco.__file__).parent / "plugin"
    for library in sorted(folder.glob("*.so")):
        mujoco.mj_loadPluginLibrary(str(library))


def examined(text: str, seed: int) -> dict[str, Any]:
    """The row of a model: engine, error, and what deviates or is refused."""
    import mujoco

    from easi_jax.simulation import guard

    m = mujoco.MjModel.from_xml_string(text)
    states = guard.random_states(m, seed)
    found = guard.compare(m, *states)
    return {
        **native(m, *(x[0] for x in states)),
        "engine": "mujoco" if found.deviates else "mjx",
        "error": found.error if math.isfinite(found.error) else None,
        "force_error": found.force_error if math.isfinite(found.error) else None,
        "causes": list(found.causes),
        "refusal": found.refusal,
        "states": found.states,
        "seconds": round(found.seconds, 2),
    }


def native(m: Any, qpos: Any, qvel: Any, _: Any, ctrl: Any) -> dict[str, Any]:
    """A replay of 50 physics steps through the engine ``mujoco`` beside a plain loop of
    `mj_step`: the largest difference of a position or velocity, or what was refused."""
    import jax
    import mujoco
    import numpy as np

    from easi_jax.errors import UserError
    from easi_jax.model.parameters import ParameterSpace
    from easi_jax.simulation.simulator import Simulator

    d, ends = mujoco.MjData(m), []
    d.qpos[:], d.qvel[:], d.ctrl[:] = qpos, qvel, ctrl
    for _ in range(_REPLAYED):
        mujoco.mj_step(m, d)
        ends.append(np.concatenate([d.qpos, d.qvel]))
    with jax.enable_x64(True):
        commands = jax.numpy.asarray(np.repeat(ctrl[None], _REPLAYED, 0))
        try:
            simulator = Simulator(m, ParameterSpace(()), engine="mujoco")
            model = simulator.model(jax.numpy.zeros(0))
            got = simulator.replay(model, simulator.start(qpos, qvel), commands)
        except UserError as error:
            return {"native_error": None, "native_refusal": str(error)}
    assert got is not None
    off = np.abs(np.concatenate(got[:2], -1) - np.array(ends)).max()
    return {"native_error": float(off), "native_refusal": ""}


def _found(row: dict[str, Any]) -> str:
    if row["refusal"]:
        return f"refused: {row['refusal']}"
    return ", ".join(row["causes"]) or "agrees"


def _error(row: dict[str, Any]) -> str:
    return "" if row["error"] is None else f"{row['error']:.1e}"


def _native(row: dict[str, Any]) -> str:
    if row["native_refusal"]:
        return f"refused: {row['native_refusal']}"
    return f"{row['native_error']:.1g}"


def _exact(rows: list[dict[str, Any]]) -> list[str]:
    exact = sum(r["native_error"] == 0 for r in rows)
    unable = sum(bool(r["native_refusal"]) for r in rows)
    return [
        f"A replay of {_REPLAYED} steps through native MuJoCo equals a loop of "
        f"`mj_step` to the last bit on {exact} of {len(rows)}; {unable} are refused."
    ]


def paragraphs(result: dict[str, Any]) -> list[str]:
    """The table as on the page of results."""
    rows = [{"name": n, **r} for n, r in result["features"].items()]
    replayed = all("native_error" in r for r in rows)  # not in results of before
    mjx = sum(r["engine"] == "mjx" for r in rows)
    refused = sum(bool(r["refusal"]) for r in rows)
    times = sorted(r["seconds"] for r in rows)
    return [
        f"`{result['command']}`: {len(rows)} features, each a small model; one step of "
        "this package's MJX beside MuJoCo C, double precision, solvers converged. "
        f"MJX agrees on {mjx}, deviates on {len(rows) - mjx - refused}, refuses "
        f"{refused}; where it does not agree, native MuJoCo is to be taken. A "
        f"comparison took {times[len(times) // 2]:.1f} s in the median, "
        f"{times[-1]:.1f} s at most.",
        *(_exact(rows) if replayed else ()),
        "Error: of a velocity after the step, as a share of the largest change.",
        table(
            rows,
            {
                "feature": "{name}",
                "engine": "{engine}",
                "error of MJX": _error,
                **({"error of native": _native} if replayed else {}),
                "what MJX does": _found,
            },
        ),
    ]


if __name__ == "__main__":
    main(Config, run, name="benchmarks.parity")
