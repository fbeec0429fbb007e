"""``python -m train.gap``: which physical effect does the model lack?"""

import dataclasses
from pathlib import Path
from typing import Any

from train._command import main, say, show_table

_HORIZON = 0.2


@dataclasses.dataclass(frozen=True)
class Config:
    """Finds where a simulation and measured logs disagree, and names what is missing.

    The model predicts short windows of the logs from their measured starts. Every
    known physical effect (dry friction, delay, backlash, a payload, ...) at every place
    of the model is then fitted together with the model's own parameters, and kept
    where it predicts data that no fit has seen. Writes gap.json, model.xml (the model
    with the effects), effects.yaml (for --effects of the other commands) and
    report.html.
    """

    model: str = ""
    """MuJoCo model (MJCF), or the name of a built-in robot."""
    data: tuple[Path, ...] = ()
    """Measured logs (CSV, NPZ or Parquet)."""
    out: Path = Path("results/gap")
    """Folder for the results."""
    held_out: tuple[Path, ...] = ()
    """Logs kept out of every fit; not given: a quarter of the data."""
    horizon: float = _HORIZON
    """Length of a prediction [s]; at least 10 control steps are predicted."""
    parameters: Path | None = None
    """What may be refitted in the model (see train.parameters); not given: damping,
    friction and stiffness that the model states, each within a factor of 5."""
    mapping: Path | None = None
    """Mapping file (YAML) for logs with foreign column names."""
    overwrite: bool = False
    """Delete the results in the folder first."""


def run(config: Config) -> None:
    """Reads and checks, finds, writes."""
    from easi_jax.errors import UserError
    from easi_jax.io.runs import RunFolder
    from train._gap_problem import read_gap_problem
    from train._gap_results import write_results

    if not config.model or not config.data:
        raise UserError("give --model M.xml (or a robot's name) and --data LOG...")
    problem = read_gap_problem(config)
    from easi_jax.gap.analysis import Analysis

    analysis = Analysis(
        problem.mj_model,
        problem.space,
        problem.fit,
        problem.held,
        problem.noise,
        config.horizon,
        tell=say,
    )
    with RunFolder.open(
        config.out, config, command="train.gap", overwrite=config.overwrite
    ) as folder:
        for note in problem.notes:
            say(f"note: {note}")
        outcome = analysis.run()
        outcome.notes = problem.notes
        report = write_results(folder, config, problem, analysis, outcome)
    _show(outcome)
    say(f"report: {report}")


def _show(outcome: Any) -> None:
    rows = [
        (
            f"{f.place.effect} at {f.place.at}" if f.place.at else f.place.effect,
            ", ".join(
                f"{k} {v:.4g} ± {s:.2g} {u}" for k, (v, s, u) in f.values.items()
            ),
            f"{f.confidence:.2f}",
            ", ".join(f.indistinguishable) or "-",
        )
        for f in outcome.found
    ]
    if rows:
        show_table(
            "Effects that the model lacks",
            ["effect", "parameters", "confidence", "as good"],
            rows,
        )
    say(
        f"verdict: {outcome.verdict}; gap {outcome.before.gap:.3g} as given, "
        f"{outcome.refit.gap:.3g} refitted, {outcome.after.gap:.3g} after, floor "
        f"{outcome.floor:.3g}"
    )


if __name__ == "__main__":
    main(Config, run, name="train.gap")
