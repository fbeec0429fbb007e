"""``python -m train.gap``: which physical effect does the model lack?"""

import dataclasses
from functools import partial
from pathlib import Path
from typing import Any

from train._command import main, progress, say, show_table

_HORIZON = 0.2
_LAST = "report.html"
_PATIENCE = 5.0  # s; a stage that takes no longer shows no progress


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
    allow_assets: tuple[Path, ...] = ()
    """Files, or folders with all below them, that the model may read besides those in
    its own folder (meshes, textures, includes)."""
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
    retrain: str | None = None
    """Robot with a task (built-in, or a Python file as --env takes it) whose policy is
    then trained with what was found and without it, both tested in the repaired model.
    """
    retrain_steps: int | None = None
    """Control steps of each of both trainings; the robot's preset where not given."""
    retrain_seeds: tuple[int, ...] = (0,)
    """Seeds of the trainings."""
    resume: bool = False
    """Go on with the analysis in the folder."""
    overwrite: bool = False
    """Delete the results in the folder first."""


def run(config: Config) -> None:
    """Reads and checks, finds, writes."""
    from easi_jax.devices import runtime
    from easi_jax.errors import UserError
    from easi_jax.io.runs.folder import RunFolder
    from easi_jax.io.runs.versions import versions
    from train._gap_problem import read_gap_problem
    from train._gap_results import retrained_line, write_results
    from train._retrain import check_robot, retrain
    from train._robots import check_seeds

    if not config.model or not config.data:
        raise UserError("give --model M.xml (or a robot's name) and --data LOG...")
    runtime.larger_loops()
    check_seeds(config.retrain_seeds)
    problem = read_gap_problem(config)
    if config.retrain is not None:
        check_robot(config.retrain, problem.model.mj_model, config.retrain_steps)
    from easi_jax.gap.analysis import Analysis
    from easi_jax.io.runs.step_cache import Journal, key_of

    analysis = Analysis(
        problem.model.mj_model,
        problem.space,
        problem.fit,
        problem.held,
        problem.noise,
        config.horizon,
        tell=say,
        fixed=problem.fixed,
        progress=partial(progress, patience=_PATIENCE),
    )
    with RunFolder.open(
        config.out,
        config,
        command="train.gap",
        resume=config.resume,
        overwrite=config.overwrite,
    ) as folder:
        journal = folder.checkpoints / "analysis"
        if folder.resumed and not journal.exists() and (folder.path / _LAST).exists():
            say(f"this analysis is finished; report: {folder.path / _LAST}")
            return
        made_by = versions()
        key = key_of(analysis.key, made_by["commit"], made_by["packages"])
        analysis.selector.journal = Journal(journal, key)
        if analysis.selector.journal.kept:
            say(f"going on after {analysis.selector.journal.kept} steps that are done")
        for note in problem.notes:
            say(f"note: {note}")
        outcome = analysis.run()
        if problem.readings and outcome.verdict == "no_gap":
            outcome.verdict = "explained"  # the readings' effect is named
        for note in outcome.notes:
            say(f"note: {note}")
        outcome.notes = [*problem.notes, *outcome.notes]
        outcome.record_next = _record_next(analysis, outcome, problem, config.horizon)
        report = write_results(folder, config, problem, analysis, outcome)
        retrained = None
        if config.retrain is not None and (outcome.found or outcome.refitted):
            retrained = retrain(
                config.retrain,
                config.out,
                config.out / "effects.yaml",
                config.retrain_seeds,
                config.retrain_steps,
                config.resume,
            )
            write_results(folder, config, problem, analysis, outcome, retrained)
        analysis.selector.journal.clear()
    _show(problem, outcome)
    if retrained is not None:
        say(retrained_line(retrained))
    say(f"report: {report}")


_ASKED = 3  # rivals of an effect that a test is looked for
_LONGEST_TEST, _ROWS = 20.0, 5_000  # s, and rows


def _record_next(
    analysis: Any, outcome: Any, problem: Any, horizon: float
) -> list[str]:
    """What to record, so that names can be told apart that these data cannot."""
    from easi_jax.excite.propose import propose, quick_tests

    open_names = [f for f in outcome.found if f.indistinguishable]
    if not open_names:
        return []
    say("looking for what to record next ...")
    known = {p.key: p for p in (*analysis.places, *analysis.ripples)}
    # Rows cost time, whatever their rate.
    seconds = max(10 * horizon, min(_LONGEST_TEST, _ROWS * problem.fit[0].dt))
    plan = quick_tests(problem.model.mj_model, problem.fit, seconds)
    said = []
    for f in open_names:
        proposals = propose(
            problem.model.mj_model,
            analysis.predictor,
            analysis.bounds,
            outcome.x,
            outcome.active,
            f.place,
            [known[key] for key in f.indistinguishable[:_ASKED]],
            problem.fit,
            analysis.noise,
            horizon,
            plan,
        )
        said += [p.text() for p in proposals]
    return said


def _show(problem: Any, outcome: Any) -> None:
    from train._gap_results import disagreement, effect_rows

    rows = effect_rows(problem, outcome, ", ", "-")
    if rows:
        show_table(
            "Effects that the model lacks",
            ["effect", "at", "parameters", "confidence", "as good"],
            rows,
        )
    for item in outcome.disagreeing.items():
        say(disagreement(*item))
    for line in outcome.record_next:
        say(line)
    say(
        f"verdict: {outcome.verdict}; gap {outcome.before.gap:.3g} as given, "
        f"{outcome.refit.gap:.3g} refitted, {outcome.after.gap:.3g} after, floor "
        f"{outcome.floor:.3g}"
    )


if __name__ == "__main__":
    main(Config, run, name="train.gap")
