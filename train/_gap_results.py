"""Files of ``train.gap``, in the order in which they are written.

``gap.json``, ``effects.yaml``, ``report.html`` and ``model.xml`` come first; then the
optional parts, each in a guard of `Extras`; then ``gap.json`` and ``report.html`` again
with what these parts have added.
"""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from train._command import say, show_table
from train._extras import Extras

if TYPE_CHECKING:
    from easi_jax.gap.analysis import Analysis
    from easi_jax.gap.result import Outcome
    from easi_jax.io.models.repaired_mjcf import Repaired
    from easi_jax.io.report.html import Picture
    from easi_jax.io.runs.folder import RunFolder
    from easi_jax.model.results import GapResult, Retrained
    from train._gap_config import Config
    from train._gap_problem import GapProblem

REPORT = "report.html"
EFFECTS = "effects.yaml"
_ASKED = 3  # rivals of an effect that a test is looked for
_LONGEST_TEST, _ROWS = 20.0, 5_000  # s, and rows


def write_all(
    folder: "RunFolder",
    config: "Config",
    problem: "GapProblem",
    analysis: "Analysis",
    outcome: "Outcome",
) -> tuple["GapResult", bool]:
    """Writes everything; returns the result, and whether every part of it was made."""
    from easi_jax.gap.law_curves import law_curves
    from easi_jax.gap.summary import error_map, error_places, telling_traces
    from easi_jax.io.report.gap_report import (
        law_picture,
        map_picture,
        steps_picture,
        traces_picture,
    )

    m = problem.model.mj_model
    extras, pictures = Extras(folder), []
    result = _result(problem, outcome)
    _write(folder, config, result, pictures)
    _write_effects(folder, problem, result)
    for note in result.notes[len(problem.notes) :]:
        say(f"note: {note}")

    def drawn(what: str, draw: "Callable[[], Picture | None]") -> None:
        made = extras.attempt(f'the picture "{what}"', draw, None)
        pictures.extend([made] if made is not None else [])

    def map_of_errors() -> "Picture | None":
        found = error_map(outcome, m)
        return None if found is None else map_picture(found)

    def traces() -> "Picture":
        return traces_picture(telling_traces(outcome, m, problem.held[0]))

    def laws() -> "Picture | None":
        curves = law_curves(result, m, problem.held)
        return law_picture(curves) if curves else None

    left = extras.attempt(
        "model.xml", lambda: _write_model(folder, problem, result), None
    )
    where = extras.attempt(
        "where the error sits", lambda: error_places(outcome, m), None
    )
    result = dataclasses.replace(result, not_in_model_xml=left, where=where)
    drawn("the gap, step by step", lambda: steps_picture(result))
    drawn("the law that was found", laws)
    drawn("where and when", map_of_errors)
    drawn("measured and predicted", traces)
    advice = extras.attempt(
        "what to record next", lambda: _record_next(analysis, outcome, problem), ()
    )
    result = dataclasses.replace(result, record_next=advice)
    _write(folder, config, result.noted(extras.notes), pictures)
    if config.retrain is not None and (result.effects or result.refitted):
        trained = extras.attempt("the retraining", lambda: retrained(config), None)
        result = dataclasses.replace(result, retrained=trained)
        _write(folder, config, result.noted(extras.notes), pictures)
    return result.noted(extras.notes), not extras.notes


def _result(problem: "GapProblem", outcome: "Outcome") -> "GapResult":
    from easi_jax.gap.summary import gap_result

    return gap_result(
        outcome,
        model=problem.model.name,
        readings=problem.readings,
        held_out=problem.held_names,
        held_name=problem.held_name,
        notes=problem.notes,
    )


def _write(
    folder: "RunFolder",
    config: "Config",
    result: "GapResult",
    pictures: "list[Picture]",
) -> None:
    from easi_jax.io.report.gap_report import gap_json, gap_report
    from easi_jax.io.report.html import write_report
    from easi_jax.io.runs.versions import versions

    folder.write_json("gap.json", gap_json(result))
    report = gap_report(result, pictures, config, versions())
    write_report(folder.path / REPORT, report)


def _write_effects(
    folder: "RunFolder", problem: "GapProblem", result: "GapResult"
) -> None:
    from easi_jax.io.models.effects_file import write_effects

    write_effects(
        folder.path / EFFECTS,
        str(problem.model.path or problem.model.name),
        result.found.entries,
        [
            {k: v for k, (v, _, _) in e.values.items()}
            for e in (*result.effects, *result.readings)
            for _ in e.at
        ],
        [{"address": p.address, "to": p.value} for p in result.refitted],
    )


def _write_model(
    folder: "RunFolder", problem: "GapProblem", result: "GapResult"
) -> tuple[str, ...]:
    """Writes ``model.xml``; returns what it cannot say."""
    model = _with_found(problem, result)
    for name, place in model.assets.items():
        folder.write(name, place.read_bytes())
    folder.write("model.xml", model.xml)
    return tuple(model.left)


def _with_found(problem: "GapProblem", result: "GapResult") -> "Repaired":
    """The model with refitted values and effects, as MJCF."""
    import numpy as np

    from easi_jax.export.mjcf import identified_model
    from easi_jax.io.models.repaired_mjcf import repaired_model
    from easi_jax.model.parameters import ParameterSpace
    from easi_jax.simulation.simulator import Simulator

    source, entries = problem.model.source, result.found.entries
    values = {p.address: p.value for p in result.refitted}
    moved = [p for p in problem.space.parameters if p.addresses[0] in values]
    if not moved and problem.model.path is not None:
        return repaired_model(source, entries, problem.model.mj_model)
    simulator = Simulator(
        problem.model.mj_model, ParameterSpace(tuple(moved)), problem.fit[0].dt
    )
    theta = np.array([values[p.addresses[0]] for p in moved], float)
    return identified_model(source, simulator, theta, entries)


def _record_next(
    analysis: "Analysis", outcome: "Outcome", problem: "GapProblem"
) -> tuple[str, ...]:
    """What to record, so that names can be told apart that these data cannot."""
    from easi_jax.excite.propose import propose, quick_tests

    open_names = [f for f in outcome.found if f.indistinguishable]
    if not open_names:
        return ()
    say("looking for what to record next ...")
    known = analysis.places.known
    # Rows cost time, whatever their rate.
    horizon, dt = outcome.horizon, problem.fit[0].dt
    seconds = max(10 * horizon, min(_LONGEST_TEST, _ROWS * dt))
    plan = quick_tests(problem.model.mj_model, problem.fit, seconds)
    said: list[str] = []
    for f in open_names:
        proposals = propose(
            problem.model.mj_model,
            analysis.predictor,
            analysis.bounds,
            outcome.x,
            outcome.active,
            f.place,
            # What all actuators have alike is offered once, and told by groups.
            [
                known.get(key) or known[f"{key.partition('@')[0]}@"]
                for key in f.indistinguishable[:_ASKED]
            ],
            problem.fit,
            analysis.data.noise[: problem.model.mj_model.nv],
            horizon,
            plan,
        )
        said += [p.text() for p in proposals]
    return tuple(said)


def retrained(config: "Config") -> "Retrained":
    """Policies trained with what was found and without it; see `_retrain`."""
    from train._retrain import retrain

    assert config.retrain is not None
    return retrain(
        config.retrain,
        config.out,
        config.out / EFFECTS,
        config.retrain_seeds,
        config.retrain_steps,
        config.resume,
    )


def show(result: "GapResult", report: Path) -> None:
    """Prints what matters of it."""
    from easi_jax.io.report.gap_report import (
        EFFECT_COLUMNS,
        disagreement,
        effect_rows,
        retrained_line,
    )
    from easi_jax.io.report.numbers import number

    r = result
    rows = effect_rows(r, ", ", "-")
    if rows:
        columns = [*EFFECT_COLUMNS, "as good"]
        show_table("Effects that the model lacks", columns, rows)
    for item in r.disagreeing.items():
        say(disagreement(*item))
    for line in r.record_next:
        say(line)
    given, refitted, after, floor = (
        number(g, 3) for g in (r.before.gap, r.refit.gap, r.after.gap, r.floor)
    )
    say(
        f"verdict: {r.verdict}; gap {given} as given, {refitted} refitted, {after} "
        f"after, floor {floor}"
    )
    if r.retrained is not None:
        say(retrained_line(r.retrained))
    say(f"report: {report}")
