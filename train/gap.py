"""``python -m train.gap``: which physical effect does the model lack?"""

from functools import partial

from train._command import compiled, main, progress, say
from train._gap_config import Config
from train._inputs import files_of

_PATIENCE = 5.0  # s; a stage that takes no longer shows no progress


def run(config: Config) -> None:
    """Reads and checks, finds, writes."""
    from easi_jax.model.own_effects import registered

    with registered([]):  # laws that are found are of this machine alone
        _run(config)


def _run(config: Config) -> None:
    from easi_jax.devices import runtime
    from easi_jax.errors import UserError
    from easi_jax.io.runs.folder import RunFolder
    from easi_jax.io.runs.versions import versions
    from train._gap_problem import read_gap_problem
    from train._gap_results import REPORT, show, write_all
    from train._retrain import check_robot
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
        wait=partial(compiled, "physics"),
    )
    with RunFolder.open(
        config.out,
        config,
        command="train.gap",
        resume=config.resume,
        overwrite=config.overwrite,
        files=files_of(config),
    ) as folder:
        journal = folder.checkpoints / "analysis"
        if folder.resumed and not journal.exists() and (folder.path / REPORT).exists():
            say(f"this analysis is finished; report: {folder.path / REPORT}")
            return
        made_by = versions()
        key = key_of(analysis.key, made_by["commit"], made_by["packages"])
        analysis.journal = Journal(journal, key)
        if analysis.journal.kept:
            say(f"going on after {analysis.journal.kept} steps that are done")
        problem.notes.extend(analysis.predictor.simulator.notes)
        for note in problem.notes:
            say(f"note: {note}")
        outcome = analysis.run()
        result, whole = write_all(folder, config, problem, analysis.final, outcome)
        if whole:
            analysis.journal.clear()
        else:
            say("the same command with --resume tries again what was left out")
    show(result, config.out / REPORT)


if __name__ == "__main__":
    main(Config, run, name="train.gap")
